"""Guards broken on purpose: which tests of the catalogue notice, one broken guard at a time on a copy of the sources.

A guard is a place in the code that keeps a hard case stable; its mutation is what a reasonable programmer might have
written. The unbroken copy must pass. No random numbers; one core.
Usage: python -m benchmarks.mutations [--only NAME ...] [--tests tests/stability] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.progress import track

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("msgs", "models", "sim_player", "nodes", "mirrorwave", "launch", "tests", "benchmarks")


class Mutation(NamedTuple):
    """Text of a file that stands there exactly once, and what takes its place."""

    name: str
    file: str
    guard: str
    broken: str


MUTATIONS = (
    Mutation(
        "absorber coefficients by expm1",
        "sim_player/fdtd/cpml.py",
        "share * np.expm1(-exponent)",
        "share * (np.exp(-exponent.astype(np.float32)) - np.float32(1.0))",
    ),
    Mutation("Courant limit", "sim_player/fdtd/grid.py", "self.courant <= math.sqrt(0.5)", "self.courant <= 1.0"),
    Mutation(
        "film's loss by expm1",
        "models/physics/fresnel.py",
        "-np.expm1(2.0 * exponent)",
        "1.0 - np.exp(2.0 * exponent)",
    ),
    Mutation(
        "phase reduced to one turn in float64",
        "models/physics/waveform.py",
        "return 2.0 * np.pi * (turns % 1.0)",
        "return 2.0 * np.pi * np.asarray(turns, np.float32).astype(np.float64)",
    ),
    Mutation(
        "power squared in float64",
        "models/perception/peaks.py",
        "power = np.square(np.abs(ra_map.values), dtype=np.float64)",
        "power = np.square(np.abs(ra_map.values))",
    ),
    Mutation(
        "roots on an arc without a difference of like numbers",
        "models/physics/curved_mirror.py",
        "larger = -0.5 * (first + np.copysign(np.sqrt(np.maximum(root, 0.0)), first))",
        "larger = -0.5 * (first + np.sqrt(np.maximum(root, 0.0)))",
    ),
    Mutation(
        "logarithm of the sigmoid in one step",
        "models/training/losses.py",
        "-functional.logsigmoid(at_peak)",
        "-torch.log(torch.sigmoid(at_peak))",
    ),
    Mutation(
        "newest state by its stamp",
        "nodes/state_history.py",
        "max(known, key=lambda state: state.stamp_ns, default=None)",
        "next(iter(known), None)",
    ),
)


def copied(folder: Path) -> Path:
    """A copy of the sources; kernels compiled of them come along, a changed file's are compiled anew."""
    for room in ROOMS:
        shutil.copytree(ROOT / room, folder / room)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def broken(folder: Path, mutation: Mutation) -> None:
    """Break the guard; raises `ValueError` where it does not stand exactly once."""
    path = folder / mutation.file
    source = path.read_text()
    if source.count(mutation.guard) != 1:
        raise ValueError(
            f"{mutation.file}: guard of {mutation.name!r} must stand once, stands {source.count(mutation.guard)} times"
        )
    path.write_text(source.replace(mutation.guard, mutation.broken))


def failing(folder: Path, tests: list[str]) -> list[str]:
    """Tests that fail on a copy, by name; raises `RuntimeError` where they do not even start."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", "--tb=no", *tests]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, check=False
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"pytest: exit code {done.returncode}: {done.stdout[-500:]}{done.stderr[-500:]}")
    return re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)


def run(only: list[str], tests: list[str]) -> dict[str, list[str]]:
    """Names of failing tests by broken guard; raises `RuntimeError` where the unbroken copy fails."""
    chosen = [one for one in MUTATIONS if not only or one.name in only]
    found = {}
    for mutation in track([None, *chosen], "guards", disable=not sys.stderr.isatty()):
        with TemporaryDirectory() as folder:
            copy = copied(Path(folder))
            if mutation is not None:
                broken(copy, mutation)
            names = failing(copy, tests)
        if mutation is not None:
            found[mutation.name] = names
        elif names:
            raise RuntimeError(f"the unbroken copy fails: {', '.join(names)}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], choices=[one.name for one in MUTATIONS])
    parser.add_argument("--tests", nargs="+", default=["tests/stability"])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = run(arguments.only, arguments.tests)
    if arguments.json:
        print(json.dumps(found, indent=1))
        return
    for name, names in found.items():
        print(f"{name}: {len(names)} notice" + "".join(f"\n    {one}" for one in names))


if __name__ == "__main__":
    main()
