"""Topics that the launch file of a running graph declares, in its run directory: all who open a bus there know them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec

from msgs.bus.topics import TOPICS, Declaration
from msgs.files.whole_files import no_link

NAME = "topics.json"
_MAX_BYTES = 1 << 20


class _Declared(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of the file."""

    #: What declares them, for errors.
    origin: str
    topics: dict[str, Declaration]
    #: Names of sensors, each with topics of its own.
    sensors: tuple[str, ...] = ()


def write_declared(
    run_dir: Path, topics: Mapping[str, Declaration], origin: str, sensors: tuple[str, ...] = ()
) -> None:
    """Write the topics and sensors of a graph that starts in `run_dir`; no file where there are none."""
    path = run_dir / NAME
    path.unlink(missing_ok=True)
    if topics or sensors:
        with open(path, "xb", opener=no_link) as file:
            file.write(msgspec.json.encode(_Declared(origin, dict(topics), sensors)))


def expect_declared(run_dir: Path) -> None:
    """Make the topics known that the graph in `run_dir` declares; none where no file of this user's says so."""
    try:
        with open(run_dir / NAME, "rb", opener=no_link) as file:
            status = os.fstat(file.fileno())
            # it names modules to import
            if status.st_uid != os.geteuid() or status.st_mode & 0o022:
                return
            declared = msgspec.json.decode(file.read(_MAX_BYTES), type=_Declared)
    except (OSError, ValueError, msgspec.MsgspecError):
        return
    for name, declaration in declared.topics.items():
        TOPICS.expect(name, declaration, declared.origin)
    for sensor in declared.sensors:
        with suppress(ValueError):
            TOPICS.expect_sensor(sensor)
