"""`mirrorwave sim reflectance` and `sim wall`: tables of simulated walls, and a wave on its way through one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorwave.console import AsJson, print_json, print_line, print_table

if TYPE_CHECKING:
    from rich.progress import Progress

    from sim_player.fdtd import Experiment, Transmission
    from sim_player.fdtd.reflectance import Comparison, ReflectanceTable

#: A picture of more cells takes minutes and gigabytes.
MOST_CELLS = 3_000_000
#: Cells per wavelength of the column that reads R and T.
COLUMN_CELLS = 40.0
#: Thickness [mm] of a wall of one material where none is given.
USUAL_THICKNESS_MM = 400.0
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#555555", "#CC79A7", "#56B4E9")
PlotFile = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Picture to write (png, svg, pdf).")]


class PolarisationOption(StrEnum):
    """Polarisations: te has its field along the wall's vertical."""

    TE = "te"
    TM = "tm"


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


def reflectance(
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Simulate all walls again; minutes, goes on if stopped.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table to write (.npz) or to read; none is the shipped one.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes of a rebuild.")] = 2,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Tables of what walls reflect by FDTD, and where they agree with the formula that the ray tracer uses."""
    from sim_player.fdtd.reflectance import SHIPPED, load_table

    path = SHIPPED if out is None else out
    if path.suffix != ".npz":
        raise ValueError(f"--out must be an .npz file, got {path}")
    if rebuild:
        _rebuild(path, workers)
    table = load_table(path)
    if plot is not None:
        draw_comparison(table, plot)
    if as_json:
        print_json(as_document(table))
        return
    _print_table(table, path)
    if plot is not None:
        print_line(f"{plot}")


def wall(
    material: Annotated[str, typer.Option(help="Material or construction.")] = "concrete",
    thickness_mm: Annotated[
        float | None, typer.Option(help="Thickness; 400 if none; a construction has its own.", show_default=False)
    ] = None,
    frequency_ghz: float = 10.0,
    angle_deg: Annotated[float, typer.Option(help="Angle of incidence, at most 60.")] = 0.0,
    polarisation: PolarisationOption = PolarisationOption.TE,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """What a wall of finite thickness reflects and lets through, by FDTD and exactly; with --plot a beam hits it."""
    title, layers = wall_of(material, thickness_mm, frequency_ghz)
    if not 0.0 <= angle_deg <= 60.0:
        raise ValueError(f"--angle-deg must lie in 0..60, got {angle_deg!r}")
    found = answer(title, layers, 1e9 * frequency_ghz, angle_deg, polarisation.value, picture=plot is not None)
    if plot is not None:
        draw_wall(found, plot)
    if as_json:
        print_json(_wall_document(found))
        return
    _print_wall(found)
    if plot is not None:
        print_line(f"{plot}")


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
    import numpy as np

    from models.physics.fresnel import stack_reflection, stack_transmission
    from msgs.values.units import SPEED_OF_LIGHT_MPS
    from sim_player.fdtd import reflect, transmission_experiment

    setup = layout(layers, frequency_hz) if picture else None
    angle_rad = math.radians(angle_deg)
    media, thicknesses_m = zip(*layers, strict=True)
    case = (media, thicknesses_m, np.cos(angle_rad), SPEED_OF_LIGHT_MPS / frequency_hz, polarisation)
    exact_db = _level_db(stack_reflection(*case)), _level_db(stack_transmission(*case))
    column = reflect(layers, angle_rad, frequency_hz, polarisation, COLUMN_CELLS)
    beam, sides_m = None, (0.0, 0.0)
    if setup is not None:
        with _progress() as progress:
            on_step = _Steps(progress, title)
            beam = transmission_experiment(layers, frequency_hz, polarisation, angle_rad, setup, on_step)
        sides_m = setup.before_m, setup.behind_m
    column_db = _level_db(column.r), _level_db(column.t)
    return WallAnswer(title, frequency_hz, angle_deg, polarisation, exact_db, column_db, beam, *sides_m)


def layout(layers: Any, frequency_hz: float) -> Experiment:
    """The experiment's layout, as wide in wavelengths at every frequency; ValueError where it takes too many cells."""
    from msgs.values.units import SPEED_OF_LIGHT_MPS
    from sim_player.fdtd import Experiment
    from sim_player.fdtd.rough import cell_size

    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    setup = Experiment(30.0 * wavelength_m, 3.3 * wavelength_m, 10.0 * wavelength_m, 5.0 * wavelength_m)
    cell_m = cell_size(layers, wavelength_m, setup.cells_per_wavelength)
    depth_m = setup.before_m + setup.behind_m + sum(thickness_m for _, thickness_m in layers)
    cells = setup.width_m * depth_m / cell_m**2
    if cells > MOST_CELLS:
        raise ValueError(
            f"--plot takes at most {MOST_CELLS} cells, got {cells:.0f}; ask for a thinner wall or a lower frequency"
        )
    return setup


def as_document(table: ReflectanceTable) -> dict[str, Any]:
    """Card, comparison and absent cells as plain values."""
    keys = ("wall", "frequency_hz", "polarisation", "roughness_m", "angle_deg", "reason")
    return {
        "card": table.card,
        "comparison": [_comparison_row(one) for one in table.compare()],
        "absent": [dict(zip(keys, row, strict=True)) for row in table.absent()],
    }


def draw_comparison(table: ReflectanceTable, path: Path) -> None:
    """Write a picture: specular gain of rough concrete in each band, and what all rough walls do beyond the formula."""
    import numpy as np

    from mirrorwave.plots.style import legend_beside, new_figure, save

    figure = new_figure(10.0, 9.0)
    upper, lower = figure.subfigures(2, 1, squeeze=False).ravel()
    for panel, band in zip(upper.subplots(1, len(table.bands_hz)), table.bands_hz, strict=True):
        _draw_band(panel, table, band)
    panel, seen = lower.subplots(), set[str]()
    _plain(panel)
    panel.axhspan(-0.5, 0.5, color="#EEEEEE")
    walls = dict(zip(table.walls, COLOURS * 3, strict=False))
    for one in table.compare():
        if one.roughness_m == 0.0 or not len(one.angles_deg):
            continue
        wavelength_m = 299_792_458.0 / one.frequency_hz
        phase = 4.0 * np.pi * one.roughness_m * np.cos(np.radians(one.angles_deg)) / wavelength_m
        mark = ("o" if one.polarisation == "te" else "s", walls[one.wall], one.frequency_hz < 50e9)
        label = f"{one.wall} {one.frequency_hz / 1e9:g} GHz {one.polarisation.upper()}"
        panel.errorbar(
            phase,
            one.difference_db,
            one.error_db,
            fmt=mark[0],
            color=mark[1],
            markersize=4.5,
            linewidth=0.8,
            markerfacecolor=mark[1] if mark[2] else "white",
            label="_" if label in seen else label,
        )
        seen.add(label)
    panel.set_title("rough walls: FDTD minus formula [dB]", fontsize=10)
    panel.set_xlabel("rms phase g = 4π s cos θ / λ [rad]")
    legend_beside(panel)
    save(figure, path)


def draw_wall(found: WallAnswer, path: Path) -> None:
    """Write a picture: the field around the wall, and its level along the beam's axis with R and T beside it."""
    import numpy as np

    beam = found.beam
    if beam is None:
        raise ValueError("a picture needs an answer with a beam")
    from mirrorwave.plots.style import new_figure, save

    figure = new_figure(10.0, 6.2)
    left, right = figure.subplots(1, 2)
    for panel in (left, right):
        _plain(panel)
    level_db = 20.0 * np.log10(np.maximum(np.abs(beam.field), 1e-6))
    front_m, back_m = beam.wall_m
    z_m = beam.z_m - front_m
    extent = (1e2 * z_m[0], 1e2 * z_m[-1], 1e2 * beam.x_m[0], 1e2 * beam.x_m[-1])
    image = left.imshow(level_db, origin="lower", extent=extent, cmap="magma", vmin=-100.0, vmax=6.0, aspect="auto")
    figure.colorbar(image, ax=left, label="field per incident one [dB]")
    name = "E" if found.polarisation == "te" else "H"
    left.set_title(f"|{name}| of a beam on {found.title}, {found.frequency_hz / 1e9:g} GHz", fontsize=10)
    left.set_ylabel("along the wall [cm]")
    left.grid(visible=False)
    axis_x_m = math.tan(math.radians(found.angle_deg)) * np.minimum(z_m, 0.0)
    on_axis_db = level_db[np.abs(beam.x_m[:, None] - axis_x_m).argmin(axis=0), np.arange(len(z_m))]
    right.plot(1e2 * z_m, on_axis_db, "#0072B2", linewidth=1.2)
    right.axvspan(0.0, 1e2 * (back_m - front_m), color="#E4E4E4", zorder=0)
    right.set_title("level at the beam's axis [dB]", fontsize=10)
    right.set_ylim(-125.0, 8.0)
    figure.supxlabel(_caption(found), family="monospace", fontsize=9, ha="center", linespacing=1.4)
    for panel in (left, right):
        panel.set_xlabel("depth from the front face [cm]")
        panel.set_xlim(-1e2 * found.before_m, 1e2 * (back_m - front_m + found.behind_m))
    for face_m in (0.0, back_m - front_m):
        left.axvline(1e2 * face_m, color="white", linewidth=1.0)
    save(figure, path)


def _rebuild(path: Path, workers: int) -> None:
    """Build a table and write it; what is done lies beside it until all is."""
    from sim_player.fdtd.reflectance import build_tables, table_entries

    if not path.absolute().parent.is_dir():
        raise NotADirectoryError(20, "its directory does not exist", str(path))
    partial = path.with_suffix(".cells.jsonl")
    with _progress() as progress:
        task = progress.add_task("simulating walls")
        table = build_tables(
            table_entries(), lambda done, total: progress.update(task, completed=done, total=total), partial, workers
        )
    table.save(path, provenance(workers))
    partial.unlink(missing_ok=True)


def provenance(workers: int) -> dict[str, Any]:
    """Where a table comes from: command, version of the code, kind of machine, day."""
    import os
    import platform
    from datetime import UTC, datetime

    return {
        "command": "mirrorwave sim reflectance --rebuild",
        "version": _version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {workers} processes",
        "date": datetime.now(UTC).date().isoformat(),
    }


def _version() -> str:
    """What git calls this checkout; "unknown" outside of one."""
    import subprocess

    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


class _Steps:
    """Progress of an experiment: its two runs, without and with the wall, each end when the field has decayed."""

    def __init__(self, progress: Progress, title: str) -> None:
        self.progress, self.task = progress, progress.add_task(f"a beam on {title}", total=2.0)
        self.runs, self.steps = 0, 0

    def __call__(self, steps: int, residue: float) -> None:
        from sim_player.fdtd.experiment import DECAY

        if steps < self.steps:
            self.runs += 1
        self.steps = steps
        share = math.log(min(max(residue, DECAY), 1.0)) / math.log(DECAY)
        self.progress.update(self.task, completed=self.runs + share)


def _progress() -> Progress:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        "{task.description}",
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        "left",
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _print_table(table: ReflectanceTable, path: Path) -> None:
    card = table.card
    print_line(f"{path.name}: {card['date']}, {card['version']}, {card['machine']}, SHA-256 {card['sha256'][:12]}")
    rows = []
    for one in table.compare():
        worst_db, error_db, angle_deg = (None if math.isnan(value) else value for value in one.worst)
        rows.append(
            [
                one.wall,
                f"{one.frequency_hz / 1e9:g}",
                one.polarisation,
                f"{1e3 * one.roughness_m:g}",
                "-" if worst_db is None else f"{worst_db:+.2f}",
                "-" if error_db is None or one.roughness_m == 0.0 else f"{error_db:.2f}",
                "-" if angle_deg is None else f"{angle_deg:g}",
                f"{one.agreeing} of {len(one.angles_deg)}",
                f"{one.absent}",
            ]
        )
    print_table(("wall", "GHz", "pol", "rough mm", "worst dB", "error dB", "at deg", "within 0.5 dB", "absent"), rows)
    print_line("FDTD minus |r|^2 exp(-g^2), the ray tracer's formula; error: standard error over the seeds")
    for row in card["walls"]:
        for band in row["bands"]:
            if band["note"]:
                print_line(f"{row['name']} at {band['ghz']:g} GHz: {band['note']}")
    for reason, count in card["status"].items():
        print_line(f"{count} rough cells {reason}")


def _comparison_row(one: Comparison) -> dict[str, Any]:
    worst_db, error_db, angle_deg = one.worst
    return {
        "wall": one.wall,
        "frequency_hz": one.frequency_hz,
        "polarisation": one.polarisation,
        "roughness_m": one.roughness_m,
        "worst_db": worst_db,
        "worst_error_db": error_db,
        "worst_angle_deg": angle_deg,
        "angles": len(one.angles_deg),
        "within_half_db": one.agreeing,
        "absent": one.absent,
    }


def _wall_document(found: WallAnswer) -> dict[str, Any]:
    document = {
        "wall": found.title,
        "frequency_hz": found.frequency_hz,
        "angle_deg": found.angle_deg,
        "polarisation": found.polarisation,
        "exact": dict(zip(("r_db", "t_db"), found.exact_db, strict=True)),
        "fdtd": dict(zip(("r_db", "t_db"), found.column_db, strict=True)) | {"cells_per_wavelength": COLUMN_CELLS},
    }
    beam = found.beam
    if beam is not None:
        document["beam"] = {
            "r_db": beam.reflection_db,
            "t_db": beam.transmission_db,
            "cells": beam.cells,
            "steps": beam.steps,
            "residue": beam.residue,
        }
    return document


def _print_wall(found: WallAnswer) -> None:
    print_line(f"{found.title} at {found.frequency_hz / 1e9:g} GHz, {found.angle_deg:g} deg, {found.polarisation}")
    print_table(("", "R dB", "T dB"), [(name, f"{r_db:.2f}", f"{t_db:.2f}") for name, r_db, t_db in _levels(found)])


def _levels(found: WallAnswer) -> list[tuple[str, float, float]]:
    rows = [("exact", *found.exact_db), (f"fdtd, {COLUMN_CELLS:g} cells a wavelength", *found.column_db)]
    if found.beam is not None:
        rows.append(("beam of the picture, 10 cells", found.beam.reflection_db, found.beam.transmission_db))
    return rows


def _caption(found: WallAnswer) -> str:
    head = f"{'':<30}{'R dB':>8}{'T dB':>8}\n"
    return head + "\n".join(f"{name:<30}{r_db:8.2f}{t_db:8.2f}" for name, r_db, t_db in _levels(found))


def _draw_band(panel: Any, table: ReflectanceTable, band: float) -> None:
    """Concrete, TE: lines of the formula, marks of FDTD, a colour a roughness."""
    import numpy as np

    from mirrorwave.plots.style import legend_below
    from models.physics.fresnel import coherent_power

    fine_deg = np.linspace(0.0, 85.0, 171)
    smooth = table.specular_gain("concrete", band, np.cos(np.radians(fine_deg)))
    rows = [
        one for one in table.compare() if (one.wall, one.frequency_hz, one.polarisation) == ("concrete", band, "te")
    ]
    for colour, one in zip(COLOURS, rows, strict=False):
        factor = coherent_power(np.asarray(one.roughness_m), np.cos(np.radians(fine_deg)), 299_792_458.0 / band)
        formula_db = 10.0 * np.log10(np.maximum(smooth * factor, 1e-9))
        panel.plot(fine_deg, formula_db, color=colour, linewidth=1.3, label=f"{1e3 * one.roughness_m:g} mm rms")
        here = slice(None, None, 10) if one.roughness_m == 0.0 else slice(None)
        at_deg = one.angles_deg[here]
        marks_db = np.interp(at_deg, fine_deg, formula_db) + one.difference_db[here]
        panel.errorbar(at_deg, marks_db, one.error_db[here], fmt="o", color=colour, markersize=4, label="_")
    panel.set_title(f"concrete, {band / 1e9:g} GHz, TE: specular gain [dB]", fontsize=10)
    panel.set_xlabel("angle of incidence [deg]")
    panel.set_ylim(-40.0, 1.0)
    _plain(panel)
    legend_below(panel, columns=len(rows), title="lines: formula, marks: FDTD", title_fontsize=9, fontsize=8)


def _plain(panel: Any) -> None:
    """Pale lines behind the data, no frame above and to the right of it."""
    panel.grid(color="#DDDDDD", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)


def _level_db(field: Any) -> float:
    return 20.0 * math.log10(max(abs(complex(field)), 1e-30))
