"""A wave on its way through a wall, and tables of simulated walls, beside the formula that the ray tracer uses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mirrorwave.console import Progress, progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from lab.full_wave.experiment import Experiment, Transmission
    from lab.full_wave.reflectance import Comparison, ReflectanceTable


#: A picture of more cells takes minutes and gigabytes.
MAX_CELLS = 3_000_000
#: Cells per wavelength of the column that reads R and T.
COLUMN_CELLS = 40.0
#: Thickness [mm] of a wall of one material where none is given.
USUAL_THICKNESS_MM = 400.0


@dataclass(frozen=True)
class WallAnswer:
    """R and T of one wall [dB]: exact, by the column, and by the beam of the picture if there is one."""

    title: str
    frequency_hz: float
    angle_deg: float
    polarisation: str
    exact_db: tuple[float, float]
    column_db: tuple[float, float]
    beam: Transmission | None
    #: Air of the picture before and behind the wall.
    before_m: float = 0.0
    behind_m: float = 0.0


def wall_of(
    name: str, thickness_mm: float | None, frequency_ghz: float
) -> tuple[str, tuple[tuple[complex, float], ...]]:
    """Title and layers of a wall; ValueError names the option."""
    from models.physics.materials import CONSTRUCTIONS, is_volume, wall_layers, wall_name

    key = wall_name(name)
    if is_volume(key):
        raise ValueError(f"--material must be a wall, {key} is a volume and mirrors nothing")
    if not (math.isfinite(frequency_ghz) and frequency_ghz > 0.0):
        raise ValueError(f"--frequency-ghz must be finite and positive, got {frequency_ghz!r}")
    if key in CONSTRUCTIONS:
        if thickness_mm is not None:
            raise ValueError(f"--thickness-mm must not be given for {key}, which has the thicknesses of its layers")
        return key, wall_layers(key, None, 1e9 * frequency_ghz)
    thickness_mm = USUAL_THICKNESS_MM if thickness_mm is None else thickness_mm
    if not 0.0 < thickness_mm < math.inf:
        raise ValueError(f"--thickness-mm must be positive, got {thickness_mm!r}")
    return f"{thickness_mm:g} mm of {key}", wall_layers(key, 1e-3 * thickness_mm, 1e9 * frequency_ghz)


def answer(
    title: str, layers: Any, frequency_hz: float, angle_deg: float, polarisation: Any, picture: bool
) -> WallAnswer:
    """Ask the formula, the column of cells and, for a picture, the beam; progress goes to stderr."""
    from lab.full_wave.experiment import transmission_experiment
    from lab.full_wave.rough import RoughParams
    from lab.full_wave.scattering import reflect
    from models.physics.fresnel import stack_reflection, stack_transmission
    from msgs.values.units import SPEED_OF_LIGHT_MPS

    setup = layout(layers, frequency_hz) if picture else None
    angle_rad = math.radians(angle_deg)
    media, thicknesses_m = zip(*layers, strict=True)
    case = (media, thicknesses_m, np.cos(angle_rad), SPEED_OF_LIGHT_MPS / frequency_hz, polarisation)
    exact_db = _level_db(stack_reflection(*case)), _level_db(stack_transmission(*case))
    column = reflect(layers, angle_rad, frequency_hz, polarisation, RoughParams(COLUMN_CELLS, dtype="float64"))
    beam, sides_m = None, (0.0, 0.0)
    if setup is not None:
        with progress_bar(f"a beam on {title}, per cent", 100) as progress:
            beam = transmission_experiment(layers, frequency_hz, polarisation, angle_rad, setup, _Steps(progress))
        sides_m = setup.before_m, setup.behind_m
    column_db = _level_db(column.r), _level_db(column.t)
    return WallAnswer(title, frequency_hz, angle_deg, polarisation, exact_db, column_db, beam, *sides_m)


def layout(layers: Any, frequency_hz: float) -> Experiment:
    """The experiment's layout, as wide in wavelengths at every frequency; ValueError where it takes too many cells."""
    from lab.full_wave.experiment import Experiment
    from lab.full_wave.rough import cell_size
    from msgs.values.units import SPEED_OF_LIGHT_MPS

    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    setup = Experiment(30.0 * wavelength_m, 3.3 * wavelength_m, 10.0 * wavelength_m, 5.0 * wavelength_m)
    cell_m = cell_size(layers, wavelength_m, setup.cells_per_wavelength)
    depth_m = setup.before_m + setup.behind_m + sum(thickness_m for _, thickness_m in layers)
    cells = setup.width_m * depth_m / cell_m**2
    if cells > MAX_CELLS:
        raise ValueError(
            f"--plot takes at most {MAX_CELLS} cells, got {cells:.0f}; ask for a thinner wall or a lower frequency"
        )
    return setup


def as_document(table: ReflectanceTable) -> dict[str, Any]:
    """Card, comparison and absent cells as plain values."""
    keys = ("wall", "frequency_hz", "polarisation", "roughness_m", "angle_deg", "reason")
    return {
        "card": table.card,
        "comparison": [_comparison_row(comparison) for comparison in table.compare()],
        "absent": [dict(zip(keys, row, strict=True)) for row in table.absent()],
    }


def rebuild_table(path: Path, workers: int) -> None:
    """Build a table and write it; what is done lies beside it until all is."""
    from lab.full_wave.reflectance import build_tables, table_entries

    if not path.absolute().parent.is_dir():
        raise NotADirectoryError(20, "its directory does not exist", str(path))
    partial = path.with_suffix(".cells.jsonl")
    with progress_bar("cells of walls") as progress:
        table = build_tables(table_entries(), progress.update, partial, workers)
    table.save(path, provenance(workers))
    partial.unlink(missing_ok=True)


def provenance(workers: int) -> dict[str, Any]:
    """Return the origin of a table: command, version of the code, kind of machine, day."""
    import os
    import platform
    from datetime import UTC, datetime

    return {
        "command": "mirrorwave sim reflectance --rebuild",
        "version": _version(),
        "machine": f"{platform.system()} {platform.machine()}, {counted(os.cpu_count() or 1, 'core')}, "
        f"{counted(workers, 'process')}",
        "date": datetime.now(UTC).date().isoformat(),
    }


def _version() -> str:
    """Return git's name of this checkout; "unknown" outside of one."""
    import subprocess

    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


class _Steps:
    """Progress of an experiment: its two runs, without and with the wall, each end when the field has decayed."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.runs, self.steps = 0, 0

    def __call__(self, steps: int, residue: float) -> None:
        from lab.full_wave.experiment import DECAY

        if steps < self.steps:
            self.runs += 1
        self.steps = steps
        share = math.log(min(max(residue, DECAY), 1.0)) / math.log(DECAY)
        self.progress.update(50.0 * (self.runs + share), 100)


def _comparison_row(comparison: Comparison) -> dict[str, Any]:
    worst_db, error_db, angle_deg = comparison.worst
    return {
        "wall": comparison.wall,
        "frequency_hz": comparison.frequency_hz,
        "polarisation": comparison.polarisation,
        "roughness_m": comparison.roughness_m,
        "worst_db": worst_db,
        "worst_error_db": error_db,
        "worst_angle_deg": angle_deg,
        "angles": len(comparison.angles_deg),
        "within_half_db": comparison.agreeing,
        "absent": comparison.absent,
    }


def wall_document(answer: WallAnswer) -> dict[str, Any]:
    """Return an answer as JSON has it."""
    document = {
        "wall": answer.title,
        "frequency_hz": answer.frequency_hz,
        "angle_deg": answer.angle_deg,
        "polarisation": answer.polarisation,
        "exact": dict(zip(("r_db", "t_db"), answer.exact_db, strict=True)),
        "fdtd": dict(zip(("r_db", "t_db"), answer.column_db, strict=True)) | {"cells_per_wavelength": COLUMN_CELLS},
    }
    beam = answer.beam
    if beam is not None:
        document["beam"] = {
            "r_db": beam.reflection_db,
            "t_db": beam.transmission_db,
            "cells": beam.cells,
            "steps": beam.steps,
            "residue": beam.residue,
        }
    return document


def levels_of(answer: WallAnswer) -> list[tuple[str, float, float]]:
    """Return what told R and T [dB] of a wall, and both."""
    rows = [("exact", *answer.exact_db), (f"fdtd, {COLUMN_CELLS:g} cells a wavelength", *answer.column_db)]
    if answer.beam is not None:
        rows.append(("beam of the picture, 10 cells", answer.beam.reflection_db, answer.beam.transmission_db))
    return rows


def _level_db(field: Any) -> float:
    return 20.0 * math.log10(max(abs(complex(field)), 1e-30))
