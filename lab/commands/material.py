"""`mirrorwave sim material`: what a wall reflects and lets through, over angle, for both polarisations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.walls.wall_question import BANDS_GHZ, Method, Wall, check_fdtd, known_bands, title_of, wall_of
from mirrorwave.completion import complete_materials
from mirrorwave.console import AsJson, print_json, print_line, print_table

if TYPE_CHECKING:
    from lab.walls.curves import Answer


def material(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="Material or construction; none lists all.", autocompletion=complete_materials
        ),
    ] = None,
    frequency_ghz: Annotated[list[float] | None, typer.Option(help="Repeat for several; 10 and 77 if none.")] = None,
    angles_deg: Annotated[str, typer.Option(metavar="FIRST:LAST:STEP", help="Angles of incidence.")] = "0:85:5",
    thickness_mm: Annotated[float | None, typer.Option(help="Thickness; none is a half-space.")] = None,
    roughness_mm: Annotated[float, typer.Option(help="Rms height of the face.")] = 0.0,
    method: Method = Method.EXACT,
    extrapolate: Annotated[
        bool, typer.Option("--extrapolate", help="Allow bands below and above all measured ones.")
    ] = False,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Picture to write (png, svg, pdf).")] = None,
    as_json: AsJson = False,
) -> None:
    """Reflection, transmission and specular gain of a wall over angle; te is vertical polarisation at an upright wall.

    With --json one frequency is answered, 10 GHz if none is given.
    """
    from lab.walls.curves import answer, as_contract, note_and_error, parse_angles

    if name is None:
        _list_materials(as_json, extrapolate)
        return
    wall = wall_of(name, thickness_mm, roughness_mm, method, extrapolate)
    angles = parse_angles(angles_deg)
    check_fdtd(wall, float(angles[-1]))
    if as_json and len(frequency_ghz or ()) > 1:
        raise ValueError(f"--json answers one --frequency-ghz, got {len(frequency_ghz or ())}")
    wanted = tuple(frequency_ghz or BANDS_GHZ[: 1 if as_json else None])
    bands = wanted if frequency_ghz or as_json else known_bands(wall, wanted)
    answers = [answer(wall, 1e9 * band, angles) for band in bands]
    if as_json:
        print_json(as_contract(wall, answers[0]))
        if answers[0].note:
            typer.echo(f"mirrorwave: {wall.material} at {bands[0]:g} GHz: {note_and_error(answers[0])}", err=True)
    else:
        for result in answers:
            _print_answer(wall, result)
        for band in sorted(set(wanted) - set(bands)):
            print_line(f"{band:g} GHz: not known for {wall.material}; --extrapolate shows it all the same")
    if plot is not None:
        from lab.walls.curve_figure import draw_wall_curves

        draw_wall_curves(wall, answers, plot)
        if not as_json:
            print_line(f"{plot}")


def _print_answer(wall: Wall, result: Answer) -> None:
    from lab.walls.curves import field_db, note_and_error
    from models.physics.materials import typical_roughness_mm

    usual = typical_roughness_mm(wall.material)
    roughness = f"roughness {1e3 * wall.roughness_m:g} mm"
    if usual is not None:
        roughness += f" (usual {usual[0]:g}..{usual[1]:g})"
    parts = [f"{title_of(wall)} at {result.frequency_hz / 1e9:g} GHz", roughness, str(wall.method)]
    print_line(", ".join([*parts, note_and_error(result)] if result.note else parts))
    columns = ["angle_deg"] + [f"{p}_{quantity}_db" for p in ("te", "tm") for quantity in ("r", "t", "gain")]
    levels = [
        level
        for curves in (result.te, result.tm)
        for level in (field_db(curves.r), field_db(curves.t), field_db(curves.specular_gain**0.5))
    ]
    print_table(
        columns,
        [
            [float(angle), *(_rounded(level[index]) for level in levels)]
            for index, angle in enumerate(result.angles_deg)
        ],
        ("te_t_db", "tm_t_db"),
    )


def _rounded(level_db: float) -> float | None:
    # adding zero turns -0.0 into 0.0
    return round(float(level_db), 2) + 0.0 if math.isfinite(level_db) else None


def _list_materials(as_json: bool, extrapolate: bool) -> None:
    from lab.walls.curves import overview

    rows = overview(extrapolate)
    if as_json:
        print_json(rows)
        return
    least = ("roughness mm", "error dB", *(name for name in rows[0] if name.startswith("eps")), "valid GHz")
    print_table(list(rows[0]), [list(row.values()) for row in rows], least)
    print_line("R: TE power reflection [dB] at 0/45/70 deg, materials as half-spaces; -: not known at this frequency")
    print_line("error: of R at 0 deg [dB], where the frequency lies in no measured band")
