"""`mirrorwave sim material`: what a wall reflects and lets through, over angle, for both polarisations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorwave.completion import complete_materials
from mirrorwave.console import AsJson, print_json, print_line, print_table

if TYPE_CHECKING:
    import numpy as np

#: The bands shown where none is asked for.
BANDS_GHZ = (10.0, 77.0)
MOST_ANGLES = 10_000
#: FDTD: steepest angles [deg] of smooth and of rough walls (runs lengthen as 1 / (1 - sin)), the weakest transmitted
#: field that a run resolves, cells per wavelength and correlation length (in wavelengths) of rough walls.
FDTD_MOST_DEG, FDTD_MOST_ROUGH_DEG, FDTD_LEAST_FIELD = 89.0, 70.0, 1e-6
FDTD_ROUGH_CELLS, FDTD_CORRELATION_WAVELENGTHS = 16.0, 4.0 / 3.0


class Method(StrEnum):
    """How the coefficients are found: transfer matrix, or a wave simulated on a grid."""

    EXACT = "exact"
    FDTD = "fdtd"


@dataclass(frozen=True)
class Wall:
    """A wall in question."""

    material: str
    thickness_m: float | None
    roughness_m: float
    method: Method
    extrapolate: bool


@dataclass(frozen=True)
class Curves:
    """Over the angles: complex field reflection and transmission, specular gain (power ratio, roughness included)."""

    r: np.ndarray
    t: np.ndarray
    specular_gain: np.ndarray


@dataclass(frozen=True)
class Answer:
    """A wall's curves at one frequency; `note` says what is extrapolated."""

    frequency_hz: float
    angles_deg: np.ndarray
    te: Curves
    tm: Curves
    note: str


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
    extrapolate: Annotated[bool, typer.Option("--extrapolate", help="Allow frequencies beyond the tables.")] = False,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Picture to write (png, svg, pdf).")] = None,
    as_json: AsJson = False,
) -> None:
    """Reflection, transmission and specular gain of a wall over angle; te is vertical polarisation at an upright wall.

    With --json one frequency is answered, 10 GHz if none is given.
    """
    if name is None:
        _list_materials(as_json)
        return
    wall = _wall(name, thickness_mm, roughness_mm, method, extrapolate)
    angles = parse_angles(angles_deg)
    _check_fdtd(wall, float(angles[-1]))
    if as_json and len(frequency_ghz or ()) > 1:
        raise ValueError(f"--json answers one --frequency-ghz, got {len(frequency_ghz or ())}")
    wanted = tuple(frequency_ghz or BANDS_GHZ[: 1 if as_json else None])
    bands = wanted if frequency_ghz or as_json else _known_bands(wall, wanted)
    answers = [answer(wall, 1e9 * band, angles) for band in bands]
    if as_json:
        print_json(as_contract(wall, answers[0]))
        if answers[0].note:
            typer.echo(f"mirrorwave: {wall.material} at {bands[0]:g} GHz: {answers[0].note}", err=True)
    else:
        for one in answers:
            _print_answer(wall, one)
        for band in sorted(set(wanted) - set(bands)):
            print_line(f"{band:g} GHz: not known for {wall.material}; --extrapolate shows it all the same")
    if plot is not None:
        draw(wall, answers, plot)
        if not as_json:
            print_line(f"{plot}")


def parse_angles(text: str) -> np.ndarray:
    """Angles [deg] of "first:last:step", both ends in; ValueError unless 0 <= first <= last <= 90 and step > 0."""
    import numpy as np

    try:
        first, last, step = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"--angles-deg must be FIRST:LAST:STEP, got {text!r}") from None
    # comparisons with nan are false
    if not (0.0 <= first <= last <= 90.0 and 0.0 < step < math.inf):
        raise ValueError(f"--angles-deg must rise within 0..90 by a positive step, got {text!r}")
    # may be infinite
    steps = (last - first) / step + 1e-9
    if steps >= MOST_ANGLES:
        raise ValueError(f"--angles-deg must be at most {MOST_ANGLES} angles, got {steps + 1.0:.0f} from {text!r}")
    return first + step * np.arange(math.floor(steps) + 1)


def answer(wall: Wall, frequency_hz: float, angles_deg: np.ndarray) -> Answer:
    """Curves of a wall at one frequency; ValueError where its materials are not known."""
    from models.physics.materials import extrapolation_note, is_volume

    note = extrapolation_note(wall.material, frequency_hz)
    if is_volume(wall.material):
        both = _volume_curves(wall, frequency_hz, angles_deg)
        return Answer(frequency_hz, angles_deg, both, both, note)
    curves = _exact_curves if wall.method is Method.EXACT else _fdtd_curves
    te, tm = (curves(wall, frequency_hz, angles_deg, polarisation) for polarisation in ("te", "tm"))
    return Answer(frequency_hz, angles_deg, te, tm, note)


def as_contract(wall: Wall, found: Answer) -> dict[str, Any]:
    """The JSON document of one answer."""
    return {
        "material": wall.material,
        "frequency_hz": found.frequency_hz,
        "thickness_m": _total_thickness_m(wall),
        "roughness_m": wall.roughness_m,
        "method": str(wall.method),
        "angles_deg": found.angles_deg.tolist(),
        "te": _plain_curves(found.te),
        "tm": _plain_curves(found.tm),
    }


def overview() -> list[dict[str, str]]:
    """Every material, construction and volume as a row of texts: what it is, what it reflects (TE), where it holds."""
    from models.physics.materials import typical_roughness_mm, validity_ghz, wall_names

    rows = []
    for name in wall_names():
        roughness = typical_roughness_mm(name)
        row = {"material": name}
        row |= {f"eps {band:g} GHz": _permittivity_text(name, 1e9 * band) for band in BANDS_GHZ}
        row |= {f"R {band:g} GHz": _reflection_text(name, 1e9 * band) for band in BANDS_GHZ}
        row["valid GHz"] = ", ".join(f"{least:g}..{most:g}" for least, most in validity_ghz(name))
        row["roughness mm"] = "-" if roughness is None else f"{roughness[0]:g}..{roughness[1]:g}"
        rows.append(row)
    return rows


def draw(wall: Wall, answers: list[Answer], path: Path) -> None:
    """Write a picture of R, specular gain (where rough) and T (where any) over angle; marks are simulated waves."""
    from mirrorwave.plots.style import handles_of, legend_of_figure, new_figure, save

    panels = {"reflection |r|² [dB]": lambda curves: _field_db(curves.r)}
    if wall.roughness_m > 0.0:
        title = f"specular gain [dB], roughness {1e3 * wall.roughness_m:g} mm"
        panels[title] = lambda curves: _field_db(curves.specular_gain**0.5)
    if any(abs(one.te.t).max() > 0.0 for one in answers):
        panels["transmission |t|² [dB]"] = lambda curves: _field_db(curves.t)
    figure = new_figure(0.6 + 3.2 * max(len(panels), 2), 4.6)
    for axes, (title, level_db) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        _draw_panel(axes, title, level_db, wall, answers)
    legend_of_figure(figure, handles_of(axes), columns=4)
    figure.suptitle(_title(wall), fontsize=12)
    save(figure, path, dpi=120)


def _wall(name: str, thickness_mm: float | None, roughness_mm: float, method: Method, extrapolate: bool) -> Wall:
    """The wall of the options; ValueError names the option."""
    from models.physics.materials import CONSTRUCTIONS, is_volume, wall_name

    key = wall_name(name)
    if thickness_mm is not None and not 0.0 < thickness_mm < math.inf:
        raise ValueError(f"--thickness-mm must be positive, got {thickness_mm!r}")
    if thickness_mm is not None and key in CONSTRUCTIONS:
        raise ValueError(f"--thickness-mm must not be given for {key}, which has the thicknesses of its layers")
    if not 0.0 <= roughness_mm < math.inf:
        raise ValueError(f"--roughness-mm must not be negative, got {roughness_mm!r}")
    if is_volume(key) and (thickness_mm is None or roughness_mm > 0.0 or method is Method.FDTD):
        raise ValueError(f"{key} is a volume: it needs --thickness-mm, takes no --roughness-mm and is no case for fdtd")
    return Wall(key, None if thickness_mm is None else 1e-3 * thickness_mm, 1e-3 * roughness_mm, method, extrapolate)


def _known_bands(wall: Wall, bands_ghz: tuple[float, ...]) -> tuple[float, ...]:
    """The bands a wall's materials are known in; all of them where extrapolation is allowed or none is known."""
    from models.physics.materials import extrapolation_note

    known = tuple(band for band in bands_ghz if not extrapolation_note(wall.material, 1e9 * band))
    return bands_ghz if wall.extrapolate else known or bands_ghz


def _exact_curves(wall: Wall, frequency_hz: float, angles_deg: np.ndarray, polarisation: Any) -> Curves:
    import numpy as np

    from models.physics.fresnel import stack_reflection, stack_transmission
    from models.physics.materials import wall_layers
    from models.physics.roughness import specular_gain
    from msgs.values.units import SPEED_OF_LIGHT_MPS

    media, thicknesses_m = zip(
        *wall_layers(wall.material, wall.thickness_m, frequency_hz, wall.extrapolate), strict=True
    )
    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    cosine = np.cos(np.radians(angles_deg))
    r = stack_reflection(media, thicknesses_m, cosine, wavelength_m, polarisation)
    t = stack_transmission(media, thicknesses_m, cosine, wavelength_m, polarisation)
    return Curves(r, t, specular_gain(r, np.asarray(wall.roughness_m), cosine, wavelength_m))


def _check_fdtd(wall: Wall, most_deg: float) -> None:
    """ValueError where the wave simulation would refuse or run for hours."""
    from models.physics.materials import CONSTRUCTIONS

    if wall.method is not Method.FDTD:
        return
    limit_deg = FDTD_MOST_ROUGH_DEG if wall.roughness_m > 0.0 else FDTD_MOST_DEG
    if most_deg > limit_deg:
        kind = "a rough wall" if wall.roughness_m > 0.0 else "a wall"
        raise ValueError(f"--angles-deg must end at {limit_deg:g} at most for {kind} by fdtd, got {most_deg:g}")
    built_of = {layer.material for layer in CONSTRUCTIONS.get(wall.material, ())} | {wall.material}
    if wall.roughness_m > 0.0 and "metal" in built_of:
        raise ValueError(f"--roughness-mm must be 0 for {wall.material} by fdtd: rough metal is refused in tm")


def _fdtd_curves(wall: Wall, frequency_hz: float, angles_deg: np.ndarray, polarisation: Any) -> Curves:
    """Smooth walls as a column of cells, rough ones as one random surface; |t| below what a run resolves is 0."""
    import numpy as np
    from rich.console import Console
    from rich.progress import track

    from models.physics.materials import wall_layers
    from msgs.values.units import SPEED_OF_LIGHT_MPS
    from sim_player.fdtd import reflect

    layers = wall_layers(wall.material, wall.thickness_m, frequency_hz, wall.extrapolate)
    options: dict[str, Any] = {"polarisation": polarisation, "roughness_m": wall.roughness_m}
    if wall.roughness_m > 0.0:
        correlation_m = FDTD_CORRELATION_WAVELENGTHS * SPEED_OF_LIGHT_MPS / frequency_hz
        options |= {"cells_per_wavelength": FDTD_ROUGH_CELLS, "correlation_m": correlation_m, "dtype": "float32"}
    console = Console(stderr=True)
    label = f"{wall.material} {frequency_hz / 1e9:g} GHz {polarisation}"
    angles = track(np.radians(angles_deg), label, console=console, transient=True, disable=not console.is_terminal)
    found = [reflect(layers, float(angle), frequency_hz, **options) for angle in angles]
    t = np.array([one.t for one in found], np.complex128)
    return Curves(
        np.array([one.r for one in found], np.complex128),
        np.where(np.abs(t) > FDTD_LEAST_FIELD, t, 0.0),
        np.array([one.specular_power for one in found], np.float64),
    )


def _volume_curves(wall: Wall, frequency_hz: float, angles_deg: np.ndarray) -> Curves:
    """Foliage of a depth: no mirror, and the loss of the slanted way through it; the phase is random, written as 0."""
    import numpy as np

    from models.physics.attenuation import vegetation_db

    thickness_m = wall.thickness_m or 0.0
    cosine = np.cos(np.radians(angles_deg))
    # a way along the hedge ends where the law does
    depth_m = thickness_m / np.maximum(cosine, min(thickness_m / 100.0, 1.0))
    t = 10.0 ** (-vegetation_db(frequency_hz, depth_m) / 20.0)
    return Curves(np.zeros_like(t, np.complex128), t.astype(np.complex128), np.zeros_like(t))


def _total_thickness_m(wall: Wall) -> float | None:
    from models.physics.materials import CONSTRUCTIONS

    if wall.material in CONSTRUCTIONS:
        return sum(layer.thickness_m for layer in CONSTRUCTIONS[wall.material])
    return wall.thickness_m


def _plain_curves(curves: Curves) -> dict[str, Any]:
    return {
        "r": [[float(value.real), float(value.imag)] for value in curves.r],
        "t": [[float(value.real), float(value.imag)] for value in curves.t],
        "specular_gain": curves.specular_gain.tolist(),
    }


def _title(wall: Wall) -> str:
    from models.physics.materials import CONSTRUCTIONS

    thickness_m = _total_thickness_m(wall)
    if wall.material in CONSTRUCTIONS:
        built = " + ".join(f"{1e3 * part.thickness_m:g} mm {part.material}" for part in CONSTRUCTIONS[wall.material])
    else:
        built = "half-space" if thickness_m is None else f"{1e3 * thickness_m:g} mm"
    return f"{wall.material} ({built})"


def _print_answer(wall: Wall, found: Answer) -> None:
    from models.physics.materials import typical_roughness_mm

    usual = typical_roughness_mm(wall.material)
    roughness = f"roughness {1e3 * wall.roughness_m:g} mm"
    if usual is not None:
        roughness += f" (usual {usual[0]:g}..{usual[1]:g})"
    parts = [f"{_title(wall)} at {found.frequency_hz / 1e9:g} GHz", roughness, str(wall.method), found.note]
    print_line(", ".join(part for part in parts if part))
    columns = ["angle_deg"] + [f"{p}_{what}_db" for p in ("te", "tm") for what in ("r", "t", "gain")]
    levels = [
        level
        for curves in (found.te, found.tm)
        for level in (_field_db(curves.r), _field_db(curves.t), _field_db(curves.specular_gain**0.5))
    ]
    print_table(
        columns,
        [[float(angle), *(_rounded(level[index]) for level in levels)] for index, angle in enumerate(found.angles_deg)],
    )


def _field_db(field: np.ndarray) -> np.ndarray:
    """Level of a field [dB]; nan where it vanishes."""
    import numpy as np

    size = np.abs(field)
    return 20.0 * np.log10(np.where(size > 0.0, size, np.nan))


def _rounded(level_db: float) -> float | None:
    # adding zero turns -0.0 into 0.0
    return round(float(level_db), 2) + 0.0 if math.isfinite(level_db) else None


def _draw_panel(axes: Any, title: str, level_db: Any, wall: Wall, answers: list[Answer]) -> None:
    """Lines of the exact curves over a fine grid: a colour a frequency, solid TE, dashed TM."""
    import dataclasses

    import numpy as np

    exact = dataclasses.replace(wall, method=Method.EXACT)
    lowest = -3.0
    for colour, one in zip(
        ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#555555") * len(answers), answers, strict=False
    ):
        angles_deg = np.linspace(one.angles_deg[0], one.angles_deg[-1], 361)
        fine = answer(exact, one.frequency_hz, angles_deg)
        for name, style, mark in (("te", "-", "o"), ("tm", "--", "s")):
            label = f"{one.frequency_hz / 1e9:g} GHz {name.upper()}{', extrapolated' if one.note else ''}"
            level = level_db(getattr(fine, name))
            axes.plot(angles_deg, level, style, color=colour, label=label, linewidth=1.6)
            if wall.method is Method.FDTD:
                axes.plot(one.angles_deg, level_db(getattr(one, name)), mark, color=colour, markersize=4, label="_")
            lowest = min(lowest, float(np.nanmin(level)) if np.isfinite(level).any() else 0.0)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("angle of incidence [deg]")
    axes.set_ylim(max(1.08 * lowest, -100.0 if "transmission" in title else -50.0), 1.0)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _list_materials(as_json: bool) -> None:
    rows = overview()
    if as_json:
        print_json(rows)
        return
    print_table(list(rows[0]), [list(row.values()) for row in rows])
    print_line("R: TE power reflection [dB] at 0/45/70 deg, materials as half-spaces; -: not known at this frequency")


def _permittivity_text(name: str, frequency_hz: float) -> str:
    from models.physics.materials import CONSTRUCTIONS, extrapolation_note, is_volume, permittivity

    if name in CONSTRUCTIONS:
        return "layers"
    if is_volume(name):
        return "volume"
    if extrapolation_note(name, frequency_hz):
        return "-"
    medium = permittivity(name, frequency_hz)
    return f"{medium.real:.3g} - {-medium.imag:.3g}j"


def _reflection_text(name: str, frequency_hz: float) -> str:
    import numpy as np

    from models.physics.materials import extrapolation_note, is_volume

    if is_volume(name) or extrapolation_note(name, frequency_hz):
        return "-"
    wall = Wall(name, None, 0.0, Method.EXACT, extrapolate=False)
    levels = _field_db(answer(wall, frequency_hz, np.array([0.0, 45.0, 70.0])).te.r)
    return " / ".join("-" if math.isnan(level) else f"{round(level, 1) + 0.0:.1f}" for level in levels)
