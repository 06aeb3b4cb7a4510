"""`mirrorwave sim reflectance`: tables of simulated walls."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import AsJson, print_json, print_line, print_table

if TYPE_CHECKING:
    from lab.full_wave.reflectance import ReflectanceTable


def reflectance(
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Simulate all walls again; minutes, goes on if stopped.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table to write (.npz) or to read; none is the shipped one.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes of a rebuild.")] = 1,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Picture to write (png, svg, pdf).")] = None,
    as_json: AsJson = False,
) -> None:
    """Tables of what walls reflect by FDTD, and where they agree with the formula that the ray tracer uses."""
    from lab.full_wave.reflectance import SHIPPED, load_table
    from lab.walls.simulated_table import as_document, rebuild_table

    path = SHIPPED if out is None else out
    if path.suffix != ".npz":
        raise ValueError(f"--out must be an .npz file, got {path}")
    if rebuild:
        rebuild_table(path, workers)
    table = load_table(path)
    if plot is not None:
        from lab.walls.table_figure import draw_comparison

        draw_comparison(table, plot)
    if as_json:
        print_json(as_document(table))
        return
    _print_table(table, path)
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
