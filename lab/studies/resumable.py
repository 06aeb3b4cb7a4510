"""A run of many jobs, one file a job: a run that was stopped goes on, and a part that fails keeps its reason."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from mirrorwave.console import error_line
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole

J = TypeVar("J", bound=Hashable)
R = TypeVar("R", bound=msgspec.Struct)


class ResumableRun(Generic[J, R]):
    """A folder that holds a run's plan and the result of each job, as MessagePack or JSON by the file's name.

    `kind`: type of a result. `files`: file of each job, relative to the folder, in the order of the results. Raises
    `ValueError` where the folder holds another run.
    """

    def __init__(self, plan: msgspec.Struct, out: Path, kind: type[R], files: Mapping[J, str]) -> None:
        claim(plan, out)
        self._kind = kind
        self._paths = {job: out / file for job, file in files.items()}
        for folder in {path.parent for path in self._paths.values()}:
            folder.mkdir(parents=True, exist_ok=True)

    def missing(self, tick: Callable[[], None] = lambda: None) -> list[J]:
        """Return the jobs without a result, in order; `tick` is called for each of the others."""
        missing = [job for job, path in self._paths.items() if not path.exists()]
        for _ in range(len(self._paths) - len(missing)):
            tick()
        return missing

    def keep(self, job: J, result: R) -> None:
        """Write the result of a job."""
        path = self._paths[job]
        encode = msgspec.json.encode if path.suffix == ".json" else msgspec.msgpack.encode
        write_whole(path, encode(result))

    def results(self) -> list[R]:
        """Return the results of all jobs; `ValueError` names a damaged file."""
        return [self._read(path) for path in self._paths.values()]

    def _read(self, path: Path) -> R:
        decode = msgspec.json.decode if path.suffix == ".json" else msgspec.msgpack.decode
        try:
            return decode(path.read_bytes(), type=self._kind)
        except msgspec.MsgspecError as error:
            raise ValueError(f"{path}: {error}; without this file its job is done again") from None


def claim(plan: msgspec.Struct, out: Path) -> None:
    """Write down which run a folder holds (`plan.json`); `ValueError` where it holds another."""
    path, wanted = out / "plan.json", json_lines(plan)
    if not path.exists():
        out.mkdir(parents=True, exist_ok=True)
        write_whole(path, wanted)
    elif path.read_bytes() != wanted:
        raise ValueError(f"{path}: out must be a new folder or hold the same run, holds another one")


@contextmanager
def charged(failed: dict[str, str], *names: str) -> Iterator[None]:
    """Charge what the body raises to these rows, in one line in `failed`, and not to the run."""
    try:
        yield
    except Exception as error:  # noqa: BLE001 - a row that cannot run is a result
        failed.update(dict.fromkeys(names, error_line(error)))
