"""`mirrorwave sim reflectance` and `sim wall`: tables of simulated walls, and a wave on its way through one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mirrorwave.console import AsJson, print_json, print_line, print_table

if TYPE_CHECKING:
    from lab.full_wave.reflectance import ReflectanceTable

PlotFile = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Picture to write (png, svg, pdf).")]


def reflectance(
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Simulate all walls again; minutes, goes on if stopped.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table to write (.npz) or to read; none is the shipped one.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes of a rebuild.")] = 1,
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Tables of what walls reflect by FDTD, and where they agree with the formula that the ray tracer uses."""
    from lab.full_wave.reflectance import SHIPPED, load_table
    from lab.walls.transmission import as_document, rebuild_table

    path = SHIPPED if out is None else out
    if path.suffix != ".npz":
        raise ValueError(f"--out must be an .npz file, got {path}")
    if rebuild:
        rebuild_table(path, workers)
    table = load_table(path)
    if plot is not None:
        from lab.walls.transmission_figure import draw_comparison

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
    polarisation: Annotated[Literal["te", "tm"], typer.Option(help="te: field along the vertical.")] = "te",
    plot: PlotFile = None,
    as_json: AsJson = False,
) -> None:
    """Compute what a wall of finite thickness reflects and transmits, by FDTD and exactly; --plot draws a beam."""
    from lab.walls.transmission import answer, wall_document, wall_of

    title, layers = wall_of(material, thickness_mm, frequency_ghz)
    if not 0.0 <= angle_deg <= 60.0:
        raise ValueError(f"--angle-deg must lie in 0..60, got {angle_deg!r}")
    result = answer(title, layers, 1e9 * frequency_ghz, angle_deg, polarisation, picture=plot is not None)
    if plot is not None:
        from lab.walls.transmission_figure import draw_wall

        draw_wall(result, plot)
    if as_json:
        print_json(wall_document(result))
        return
    from lab.walls.transmission import levels_of

    print_line(f"{result.title} at {result.frequency_hz / 1e9:g} GHz, {result.angle_deg:g} deg, {result.polarisation}")
    print_table(("", "R dB", "T dB"), [(name, f"{r_db:.2f}", f"{t_db:.2f}") for name, r_db, t_db in levels_of(result)])
    if plot is not None:
        print_line(f"{plot}")


def _print_table(table: ReflectanceTable, path: Path) -> None:
    card = table.card
    print_line(f"{path.name}: {card['date']}, {card['version']}, {card['machine']}, SHA-256 {card['sha256'][:12]}")
    rows = []
    for comparison in table.compare():
        worst_db, error_db, angle_deg = (None if math.isnan(value) else value for value in comparison.worst)
        rows.append(
            [
                comparison.wall,
                f"{comparison.frequency_hz / 1e9:g}",
                comparison.polarisation,
                f"{1e3 * comparison.roughness_m:g}",
                "-" if worst_db is None else f"{worst_db:+.2f}",
                "-" if error_db is None or comparison.roughness_m == 0.0 else f"{error_db:.2f}",
                "-" if angle_deg is None else f"{angle_deg:g}",
                f"{comparison.agreeing} of {len(comparison.angles_deg)}",
                f"{comparison.absent}",
            ]
        )
    columns = ("wall", "GHz", "pol", "rough mm", "worst dB", "error dB", "at deg", "within 0.5 dB", "absent")
    print_table(columns, rows, ("absent", "at deg"))
    print_line("FDTD minus |r|^2 exp(-g^2), the ray tracer's formula; error: standard error over the seeds")
    for row in card["walls"]:
        for band in row["bands"]:
            if band["note"]:
                print_line(f"{row['name']} at {band['ghz']:g} GHz: {band['note']}")
    for reason, count in card["status"].items():
        print_line(f"{count} rough cells {reason}")
