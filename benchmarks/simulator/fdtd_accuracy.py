"""FDTD of smooth walls against the exact slab: relative L2 of complex r over 0..80 deg at 10, 20 and 40 cells.

Cells are counted per wavelength in the material. Second order shows as a fall by four per halving; an exact formula in
disguise would not fall. Run from the root of the checkout: python -m benchmarks.simulator.fdtd_accuracy [--out FILE]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS
from lab.full_wave.rough import RoughParams
from lab.full_wave.scattering import reflect
from lab.full_wave.smooth import SMOOTH_WALLS, SmoothWall
from lab.studies.report import machine
from models.physics.fresnel import slab_reflection, slab_transmission
from models.physics.materials import permittivity

ANGLES_DEG = np.arange(0.0, 81.0, 5.0)
CELLS = (10, 20, 40)


def main() -> None:
    """Measure, print the table, write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--dtype", default="float64", choices=("float32", "float64"))
    options = parser.parse_args()
    console = Console()
    reflect(((2.0, math.inf),), 0.0, 10e9)  # compile
    with Progress(console=console) as progress:
        task = progress.add_task("walls", total=len(SMOOTH_WALLS) * len(CELLS))
        rows = [measure(wall, options.dtype, lambda: progress.advance(task)) for wall in SMOOTH_WALLS]
    console.print(table(rows))
    thick = thick_concrete()
    console.print_json(json.dumps(thick))
    report = {"machine": machine(), "dtype": options.dtype, "rows": rows, "concrete_40_cm": thick}
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report, indent=1))


def measure(wall: SmoothWall, dtype: str, done: Callable[[], object]) -> dict[str, object]:
    """One row: errors at each resolution, how fast they fall, time of the finest."""
    angles_rad = np.radians(ANGLES_DEG)
    exact = wall.exact(angles_rad)
    errors, residue, seconds = [], 0.0, 0.0
    for cells in CELLS:
        start = time.perf_counter()
        found = wall.simulated(angles_rad, cells, dtype)
        seconds = time.perf_counter() - start
        residue = max(residue, *(one.residue for one in found))
        errors.append(float(np.linalg.norm([one.r for one in found] - exact) / np.linalg.norm(exact)))
        done()
    return {
        "frequency_ghz": wall.frequency_hz / 1e9,
        "wall": wall.name,
        "polarisation": wall.polarisation,
        "relative_l2": errors,
        "fall": [coarse / fine for coarse, fine in pairwise(errors)],
        "residue": residue,
        "seconds_finest": seconds,
    }


def thick_concrete() -> dict[str, object]:
    """40 cm of concrete at 10 GHz, normal incidence: R and T in dB, exact and at each resolution."""
    eps = permittivity("concrete", 10e9)
    shape = (eps, 1.0, 0.4, SPEED_OF_LIGHT_MPS / 10e9)
    runs = [reflect(((eps, 0.4),), 0.0, 10e9, settings=RoughParams(cells, dtype="float64")) for cells in CELLS]
    return {
        "exact_db": [level_db(slab_reflection(*shape)), level_db(slab_transmission(*shape))],
        "fdtd_db": [[level_db(run.r), level_db(run.t)] for run in runs],
    }


def level_db(field: complex | np.ndarray) -> float:
    """Power level of a field [dB]."""
    return round(20.0 * math.log10(abs(complex(field))), 3)


def table(rows: list[dict[str, object]]) -> Table:
    """The rows for the eye."""
    found = Table("GHz", "wall", "pol", *(f"{cells} cells" for cells in CELLS), "fall", "s at 40 (17 angles)")
    for row in rows:
        errors, fall = row["relative_l2"], row["fall"]
        found.add_row(
            f"{row['frequency_ghz']:g}",
            str(row["wall"]),
            str(row["polarisation"]),
            *(f"{error:.2e}" for error in errors),  # type: ignore[attr-defined]
            " ".join(f"{ratio:.2f}" for ratio in fall),  # type: ignore[attr-defined]
            f"{row['seconds_finest']:.2f}",
        )
    return found


if __name__ == "__main__":
    main()
