"""Compiled kernels: loaded without numba's compiler, and compiled anew when what they call changes."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from models.compiled import KernelCache
from msgs.files.shipped import CHECKOUT

CALLEE = """
from models.compiled import compiled

SCALE = {scale}

@compiled
def scaled(value):
    return {factor} * SCALE * value
"""
CALLER = """
import numpy as np
import callee
from callee import SCALE, scaled
from models.compiled import compiled

OFFSETS = np.array([{offset}])

@compiled(error_model="numpy")
def total(values):
    '''An array made within, and numbers and kernels of another file.'''
    found = np.zeros(len(values))
    for i in range(len(values)):
        found[i] = scaled(values[i]) + callee.scaled(0.0) + OFFSETS[0] + 0.0 * SCALE
    return found
"""
#: What is printed: the sum, whether the compiler was loaded, how often a kernel was found as it was kept, and how many
#: were read in the form that others are compiled from; an empty one has some hundred bytes.
PROGRAM = """
import sys
import llvmlite.binding as llvm
import numpy as np
import caller
from numba.core.registry import cpu_target
sizes, parse = [], llvm.parse_bitcode
llvm.parse_bitcode = lambda code: sizes.append(len(code)) or parse(code)
found = caller.total(np.ones(2)).sum()
hits = sum(caller.total.stats.cache_hits.values())
print(found, bool(cpu_target.typing_context._functions), hits, sum(size > 2000 for size in sizes))
"""


class Kernels:
    """Two modules in a folder, and what a fresh interpreter makes of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, factor: float = 2.0, scale: float = 1.0, offset: float = 0.0) -> None:
        """Write the modules; one that stays the same is left alone."""
        self._put("callee.py", CALLEE.format(factor=factor, scale=scale))
        self._put("caller.py", CALLER.format(offset=offset))

    def run(self) -> tuple[float, bool, int, int]:
        """Return the sum, whether the compiler was loaded, hits of the cache, and kernels read to compile with."""
        paths = os.pathsep.join([str(self.folder), str(CHECKOUT)])
        environment = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(self.folder / "cache")}
        command = [sys.executable, "-c", PROGRAM]
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=300).stdout
        found, loaded, hits, read = said.split()
        return float(found), loaded == "True", int(hits), int(read)

    def _put(self, name: str, text: str) -> None:
        path = self.folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def test_kernels_are_loaded_without_the_compiler_and_follow_what_they_were_made_from(tmp_path: Path) -> None:
    kernels = Kernels(tmp_path)
    kernels.write()
    assert kernels.run() == (4.0, True, 0, 0)
    assert kernels.run() == (4.0, False, 1, 0)
    kernels.write(factor=3.0)
    assert kernels.run() == (6.0, True, 0, 0), "a kernel of another file was changed"
    kernels.write(factor=3.0, scale=5.0)
    assert kernels.run() == (30.0, True, 0, 0), "a number of another file was changed"
    kernels.write(factor=3.0, scale=5.0, offset=1.0)
    assert kernels.run() == (32.0, True, 0, 1), "its own file was changed, and it is compiled with a kept kernel"
    assert kernels.run() == (32.0, False, 1, 0)


#: Prints the digest of a beam's codes and how many kernels were compiled for them.
BEAM = """
import hashlib
import numpy as np
from models.compiled import KernelCache
from msgs.values.radar import RadarSetup
from sim_player.signal.fmcw import beam_codes, noise_bank, noise_reads
setup, rng = RadarSetup(), np.random.default_rng(0)
chirps, samples = setup.radar.chirps_per_beam, setup.radar.samples_per_chirp
beats = 0.02 * rng.standard_normal((5, samples, 2)).view(complex)[..., 0]
noise = noise_reads(setup.radar, noise_bank(setup.radar, 0), [0])
codes = beam_codes(setup, beats, np.exp(2j * np.arange(chirps)), rng.standard_normal((5, chirps)), noise)
print(hashlib.sha256(codes).hexdigest(), KernelCache.compiled)
"""


def test_the_run_that_compiles_and_those_that_load_give_equal_codes(tmp_path: Path) -> None:
    """Callees that the first run has compiled on their own do not take the place of the copies in a kept kernel."""
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", BEAM]
    (first, compiled), (later, none) = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=300).stdout.split()
        for _ in range(2)
    )
    assert int(compiled) >= 1
    assert int(none) == 0
    assert later == first


#: Prints the stamps of kernels: what stands in no other way than by an address would differ each time.
STAMPS = """
import sys
from tests.models.test_compiled import stamps
print(*stamps(sys.argv[1:]), sep="\\n")
"""


def stamps(modules: Sequence[str]) -> list[str]:
    return [
        f"{name} {kernel} {value._cache.stamp}"
        for name in modules
        for kernel, value in sorted(vars(importlib.import_module(name)).items())
        if isinstance(getattr(value, "_cache", None), KernelCache)
    ]


def test_every_kernel_has_the_same_stamp_in_every_process() -> None:
    paths = [path for floor in ("models", "sim_player") for path in (CHECKOUT / floor).rglob("*.py")]
    names = [
        ".".join(path.relative_to(CHECKOUT).with_suffix("").parts) for path in paths if "@compiled" in path.read_text()
    ]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "PYTHONHASHSEED": "1"}
    command = [sys.executable, "-c", STAMPS, *names]
    other = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=300).stdout
    assert len(other.splitlines()) > 200
    assert other.splitlines() == stamps(names)
