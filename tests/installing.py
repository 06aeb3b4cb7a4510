"""Installations in environments of their own, made without the network."""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from collections.abc import Iterable
from pathlib import Path

from mirrorwave.floors import FLOORS
from msgs.files.shipped import CHECKOUT

#: Where an installation has its floors, of the environment's packages.
WITHIN = Path("mirrorwave") / "floors_below"
_PIP = [sys.executable, "-m", "pip"]


def build_wheels(sources: Iterable[Path], folder: Path) -> None:
    """Put the wheel of each source into a folder."""
    build = [*_PIP, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([*build, *map(str, sources)], check=True, capture_output=True)


def make_environment(folder: Path) -> Path:
    """Return the packages' folder of a new virtual environment, which has none."""
    venv.create(folder, with_pip=False, symlinks=True)
    return next(folder.glob("lib/python*/site-packages"))


def install(environment: Path, wheels: Iterable[Path]) -> None:
    """Install wheels; modules are compiled when they are imported."""
    words = ["install", "--quiet", "--no-deps", "--no-index", "--no-compile", *map(str, wheels)]
    subprocess.run([*_pip_of(environment), *words], check=True)


def uninstall(environment: Path, name: str) -> None:
    """Take a distribution out of an environment."""
    subprocess.run([*_pip_of(environment), "uninstall", "--quiet", "--yes", name], check=True)


def lend_kernels(packages: Path, but: Iterable[str] = ()) -> None:
    """Give an installation the kernels that the checkout has compiled, but those of some modules.

    It would compile the same ones itself, for half a minute. numba knows a source by its size and time.
    """
    for floor in FLOORS:
        for source in (CHECKOUT / floor).rglob("*.py"):
            installed = packages / WITHIN / source.relative_to(CHECKOUT)
            kernels = [*source.parent.glob(f"__pycache__/{source.stem}.*.nb[ci]")]
            if not kernels or str(source.relative_to(CHECKOUT)) in but:
                continue
            shutil.copystat(source, installed)
            (installed.parent / "__pycache__").mkdir(exist_ok=True)
            for kernel in kernels:
                shutil.copy(kernel, installed.parent / "__pycache__")


def _pip_of(environment: Path) -> list[str]:
    return [*_PIP, "--python", str(environment / "bin" / "python")]
