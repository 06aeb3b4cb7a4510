"""Cell updates per second of the 2-D kernel beside the package `fdtd` and beside the memory's bandwidth.

Same grid, absorbers and block of material, interleaved rounds in one run. `fdtd` (numpy, float64) is three-dimensional:
it carries all six components, on a grid of one layer. Needs `pip install fdtd==0.3.5`. The fields of 1024 x 1024 cells
(20 MiB) fit a large cache, those of 3072 x 3072 (180 MiB) do not: only there is the memory's bandwidth a limit.
Run from the root of the checkout: python -m benchmarks.simulator.fdtd_speed [--cells 1024] [--rounds 5] [--out FILE]
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

from benchmarks.perception.ra_forming import machine
from sim_player.fdtd.cpml import CpmlParams
from sim_player.fdtd.grid import Drive, GridParams, Media, YeeGrid

CELL_M, FREQUENCY_HZ, ABSORBER_CELLS, BLOCK_EPS = 1e-3, 10e9, 20, 4.0
#: Values moved per cell and step in TE: v reads u vx vz and writes vx vz, u reads u a b vx vz and writes u.
VALUES_PER_CELL = 11


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=1024, help="cells along each side")
    parser.add_argument("--rounds", type=int, default=5, help="interleaved repetitions")
    parser.add_argument("--steps", type=int, default=64, help="steps of a round; of the package a sixteenth")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    report = {"machine": machine(), "numba_threads": numba.get_num_threads(), **measure(options)}
    print(json.dumps(report, indent=1))
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report, indent=1))


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Rounds of every contender in turn; medians and best of updates per second."""
    cells, package_steps = options.cells, max(2, options.steps // 16)
    runs: dict[str, tuple[Callable[[], object], float]] = {
        "float32": (stepper(cells, "float32", options.steps), cells**2 * options.steps),
        "float64": (stepper(cells, "float64", options.steps), cells**2 * options.steps),
        "package": (package(cells, package_steps), cells**2 * package_steps),
        "triad_float32": (triad(np.float32), 16.0 * TRIAD_VALUES),
    }
    for run, _ in runs.values():
        run()  # compile, touch the memory
    rates: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(options.rounds):
        for name, (run, work) in runs.items():
            start = time.perf_counter()
            run()
            rates[name].append(work / (time.perf_counter() - start))
    middle = {name: statistics.median(values) for name, values in rates.items()}
    best = {name: max(values) for name, values in rates.items()}
    limit = best["triad_float32"] / (4.0 * VALUES_PER_CELL)
    return {
        "cells": [cells, cells],
        "package": f"fdtd {importlib.metadata.version('fdtd')} numpy",
        "updates_per_s_median": {name: middle[name] for name in ("float32", "float64", "package")},
        "updates_per_s_best": {name: best[name] for name in ("float32", "float64", "package")},
        "ratio_float32": [ours / theirs for ours, theirs in zip(rates["float32"], rates["package"], strict=True)],
        "ratio_float64": [ours / theirs for ours, theirs in zip(rates["float64"], rates["package"], strict=True)],
        "ratio_median": {name: middle[name] / middle["package"] for name in ("float32", "float64")},
        "triad_gbyte_per_s": best["triad_float32"] / 1e9,
        "bytes_per_cell_float32": 4 * VALUES_PER_CELL,
        "fields_mib_float32": 5 * 4 * cells**2 / 2**20,
        "bandwidth_limit_updates_per_s": limit,
        "share_of_limit": best["float32"] / limit,
    }


def stepper(cells: int, dtype: str, steps: int) -> Callable[[], object]:
    """Our TE grid with a block and absorbers on all sides."""
    params = GridParams(
        cells, cells, CELL_M, FREQUENCY_HZ, absorber=CpmlParams(cells=ABSORBER_CELLS, leak=1e-6), dtype=dtype
    )
    eps = np.ones((cells, cells), np.complex128)
    eps[cells // 4 : cells // 2, cells // 4 : cells // 2] = BLOCK_EPS
    grid = YeeGrid(params, Media(out=eps))
    profile = np.zeros(cells, np.complex128)
    profile[cells // 2] = 1.0
    drive = Drive(cells // 3, profile, 20.0)
    nothing = np.zeros((0, cells), np.complex128)
    return lambda: grid.run(drive, (), steps, nothing)


def package(cells: int, steps: int) -> Callable[[], object]:
    """The package's grid of the same cells, block and absorbers."""
    import fdtd

    fdtd.set_backend("numpy")
    grid = fdtd.Grid(shape=(cells, cells, 1), grid_spacing=CELL_M)
    edge = ABSORBER_CELLS
    grid[0:edge, :, :] = fdtd.PML(name="x_low")
    grid[-edge:, :, :] = fdtd.PML(name="x_high")
    grid[:, 0:edge, :] = fdtd.PML(name="y_low")
    grid[:, -edge:, :] = fdtd.PML(name="y_high")
    quarter = slice(cells // 4, cells // 2)
    grid[quarter, quarter, 0:1] = fdtd.Object(permittivity=BLOCK_EPS, name="block")
    grid[cells // 2, cells // 3, 0] = fdtd.PointSource(period=30, name="source")

    def run() -> None:
        for _ in range(steps):
            grid.step()

    return run


TRIAD_VALUES = 32 * 2**20


def triad(dtype: type) -> Callable[[], object]:
    """a = b + s c on arrays far larger than the caches: 4 values an element, as a is fetched before it is written."""
    a, b, c = (np.ones(TRIAD_VALUES, dtype) for _ in range(3))
    return lambda: _triad(a, b, c, dtype(1.5))


@numba.njit(parallel=True, fastmath=True)
def _triad(a, b, c, s):  # type: ignore[no-untyped-def]
    for i in numba.prange(len(a)):
        a[i] = b[i] + s * c[i]


if __name__ == "__main__":
    main()
