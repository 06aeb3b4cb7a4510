"""One target under atheris: libFuzzer picks inputs by the branches they reach, `fuzz.mutations` keeps them meaningful.

A wrong exception is written down, once for each place in the code, and fuzzing goes on; a hang and a crash of native
code end the process, and libFuzzer writes their input.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import random
import resource
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import atheris

from fuzz.mutations import joined, mutated, split
from fuzz.seeds import SEEDS
from fuzz.targets import TARGETS, execute

#: Memory a reader may ask for at once is far below; a length field must not be what it asks for.
_ADDRESS_SPACE = 16 << 30
_OURS = ("msgs", "models", "sim_player", "nodes", "mirrorwave", "lab", "contrib")


def fuzz(name: str, work: Path) -> None:
    """Fuzz until libFuzzer's time is over; does not return."""
    target = TARGETS[name]
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    # libFuzzer ends the process where it stands: the parent takes this folder away
    folder = Path(tempfile.mkdtemp())
    with atheris.instrument_imports(include=[*_OURS, *target.modules], exclude=_compiled_modules()):
        # what a reader imports when it is first called is instrumented too
        for parts in SEEDS[name]():
            data = joined(parts)
            (work / "inputs" / hashlib.sha256(data).hexdigest()[:40]).write_bytes(data)
            _take(name, parts, folder, work)

    def one_input(data: bytes) -> None:
        _take(name, split(data), folder, work)

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.25:
            return bytes(atheris.Mutate(data, max_size))
        parts = split(data)
        if parts and rng.random() < 0.2:
            at = rng.randrange(len(parts))
            parts[at] = bytes(atheris.Mutate(parts[at], max(max_size - len(data) + len(parts[at]), 1)))
        else:
            parts = mutated(parts, target.kinds, rng)
        return joined(parts)[:max_size]

    arguments = [sys.argv[0], *json.loads(os.environ.get("FUZZ_ARGUMENTS", "[]"))]
    atheris.Setup(arguments, one_input, custom_mutator=mutate)
    atheris.Fuzz()


def _take(name: str, parts: list[bytes], folder: Path, work: Path) -> None:
    try:
        execute(TARGETS[name], parts, folder)
    except Exception as error:  # noqa: BLE001 - whatever a reader does not document is what is looked for
        _write_down(error, joined(parts), work / "findings")


def _write_down(error: Exception, data: bytes, findings: Path) -> None:
    """Keep the shortest input of each place in the project's own code."""
    frames = traceback.extract_tb(error.__traceback__)
    root = str(Path(__file__).parents[1])
    own = [one for one in frames if one.filename.startswith(root) and "site-packages" not in one.filename]
    place = (own or frames)[-1]
    name = f"{type(error).__name__}-{Path(place.filename).stem}-{place.lineno}"
    path = findings / name
    if not path.exists() or len(data) < path.stat().st_size:
        path.write_bytes(data)
        path.with_suffix(".txt").write_text("".join(traceback.format_exception(error)))


def _compiled_modules() -> list[str]:
    """Modules whose functions numba compiles, which it cannot once they are instrumented."""
    root = Path(__file__).parents[1]
    sources = [path.relative_to(root) for name in _OURS for path in (root / name).rglob("*.py")]
    return [".".join(path.with_suffix("").parts) for path in sources if "numba" in (root / path).read_text()]
