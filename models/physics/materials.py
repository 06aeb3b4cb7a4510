"""Materials of walls and grounds: complex permittivity by ITU-R P.2040, Table 3, and walls built of several layers.

eps = a f^b - j sigma / (2 pi f eps0), sigma = c f^d, f in GHz. Each row gives its measured band. Between two bands the
facing ends are interpolated; below and above all bands a frequency is refused unless extrapolation is asked for.
`band_note` names either case, and `reflection_error_db` states its error. A name denotes a material (one layer of any
thickness), a construction (layers of its own) or a volume (foliage: it attenuates waves without a mirror).
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

from msgs.values.wording import did_you_mean

VACUUM_PERMITTIVITY_F_PER_M = 8.854_187_812_8e-12
#: Ratio of eps - 1 between published samples of a material: concrete measured at 57.5 GHz (refractive index 2.55 -
#: j0.084) and that of P.2040 (eps 5.24). An extrapolated value claims no less.
SAMPLE_SCATTER = 1.3


@dataclass(frozen=True)
class MaterialRow:
    """One row of the table: coefficients a, b (permittivity), c, d (conductivity, S/m), validity in GHz, source."""

    a: float
    b: float
    c: float
    d: float
    min_ghz: float
    max_ghz: float
    source: str = "ITU-R P.2040"


@dataclass(frozen=True)
class Layer:
    """One layer of a construction."""

    material: str
    thickness_m: float


#: Some materials have a second row for a higher band; rows rise in frequency.
#: A material of yours needs a row in `models.physics.photons.optics.OPTICAL` too.
TABLE: dict[str, tuple[MaterialRow, ...]] = {
    "vacuum": (MaterialRow(1.0, 0.0, 0.0, 0.0, 0.001, 100.0),),
    "concrete": (
        MaterialRow(5.24, 0.0, 0.0462, 0.7822, 1.0, 100.0),
        MaterialRow(5.17, 0.0, 0.0145, 1.09, 110.0, 330.0),
    ),
    "brick": (
        MaterialRow(3.91, 0.0, 0.0238, 0.16, 1.0, 40.0),
        MaterialRow(4.15, 0.0, 0.0006, 1.5712, 110.0, 330.0),
    ),
    "plasterboard": (MaterialRow(2.73, 0.0, 0.0085, 0.9395, 1.0, 100.0),),
    "wood": (MaterialRow(1.99, 0.0, 0.0047, 1.0718, 0.001, 100.0),),
    "glass": (
        MaterialRow(6.31, 0.0, 0.0036, 1.3394, 0.1, 100.0),
        MaterialRow(5.79, 0.0, 0.0004, 1.658, 220.0, 450.0),
    ),
    "ceiling_board": (MaterialRow(1.48, 0.0, 0.0011, 1.0750, 1.0, 100.0),),
    "chipboard": (MaterialRow(2.58, 0.0, 0.0217, 0.7800, 1.0, 100.0),),
    "plywood": (MaterialRow(2.71, 0.0, 0.33, 0.0, 1.0, 40.0),),
    "marble": (MaterialRow(7.074, 0.0, 0.0055, 0.9262, 1.0, 60.0),),
    "floorboard": (MaterialRow(3.66, 0.0, 0.0044, 1.3515, 50.0, 100.0),),
    "metal": (MaterialRow(1.0, 0.0, 1e7, 0.0, 1.0, 100.0),),
    "very_dry_ground": (MaterialRow(3.0, 0.0, 0.00015, 2.52, 1.0, 10.0),),
    "medium_dry_ground": (MaterialRow(15.0, -0.1, 0.035, 1.63, 1.0, 10.0),),
    "wet_ground": (MaterialRow(30.0, -0.4, 0.15, 1.30, 1.0, 10.0),),
    # Not in P.2040. Dry pavement: eps 5.0 to 5.3 at 7..17 GHz (Olkkonen 2016); a loss tangent of 0.02 gives the 12 to
    # 14 cm and 4 cm of penetration at 8 and 30 GHz of an NCHRP study of density sensors.
    "asphalt": (MaterialRow(5.0, 0.0, 0.00556, 1.0, 7.0, 30.0, "engineering choice"),),
}

#: Walls of several layers, the one that faces the radar first. The thicknesses are engineering choices.
CONSTRUCTIONS: dict[str, tuple[Layer, ...]] = {
    "window": (Layer("glass", 6e-3),),
    "double_glazing": (Layer("glass", 4e-3), Layer("vacuum", 16e-3), Layer("glass", 4e-3)),
    # cladding, ventilated gap, sheathing, mineral wool (nearly air, taken as air), inner board
    "insulated_wall": (
        Layer("wood", 20e-3),
        Layer("vacuum", 30e-3),
        Layer("plasterboard", 12.5e-3),
        Layer("vacuum", 160e-3),
        Layer("plasterboard", 12.5e-3),
    ),
    "container": (Layer("metal", 2e-3),),
    "sound_barrier": (Layer("concrete", 120e-3),),
}

#: Volumes without a mirror; `models.physics.attenuation.vegetation_db` gives their attenuation.
VOLUMES = ("vegetation",)

#: Usual rms height [mm], minimum and maximum: textbook-level working values, not measured here and not to be quoted.
TYPICAL_ROUGHNESS_MM: dict[str, tuple[float, float]] = {
    "glass": (0.01, 0.05),
    "metal": (0.01, 0.05),
    "plasterboard": (0.05, 0.2),
    "concrete": (0.2, 0.5),
    "brick": (0.5, 1.5),
    "asphalt": (0.3, 1.5),
}

ALIASES: dict[str, str] = {
    "air": "vacuum",
    "bricks": "brick",
    "cement": "concrete",
    "steel": "metal",
    "aluminium": "metal",
    "window": "glass",
    "timber": "wood",
    "drywall": "plasterboard",
    "dry_ground": "medium_dry_ground",
    "ground": "medium_dry_ground",
}

_WALL_ALIASES: dict[str, str] = {
    "hedge": "vegetation",
    "tree": "vegetation",
    "trees": "vegetation",
    "foliage": "vegetation",
    "noise_barrier": "sound_barrier",
    "double_glazed_window": "double_glazing",
}


def material_name(name: str) -> str:
    """Return the table's name of a material or alias ("Very dry ground", "steel"); ValueError lists the valid ones."""
    key = _key(name)
    key = ALIASES.get(key, key)
    if key not in TABLE:
        raise ValueError(f"unknown material {name!r}, known are {', '.join(TABLE)}{did_you_mean(name, TABLE)}")
    return key


def wall_name(name: str) -> str:
    """Return the name of a construction (first: "window" is a pane), volume or material; ValueError lists them."""
    key = _WALL_ALIASES.get(_key(name), _key(name))
    if key in CONSTRUCTIONS or key in VOLUMES:
        return key
    key = ALIASES.get(key, key)
    if key not in TABLE:
        near = did_you_mean(name, wall_names())
        raise ValueError(f"unknown material {name!r}, known are {', '.join(wall_names())}{near}")
    return key


def wall_names() -> tuple[str, ...]:
    """Return all names of walls."""
    return (*TABLE, *CONSTRUCTIONS, *VOLUMES)


def is_volume(material: str) -> bool:
    """Return whether a name denotes a volume, which has no layers and no mirror; ValueError if it is unknown."""
    return wall_name(material) in VOLUMES


def wall_layers(
    material: str, thickness_m: float | None, frequency_hz: float, extrapolate: bool = False
) -> tuple[tuple[complex, float], ...]:
    """Return the layers (permittivity, thickness_m) of a wall, facing one first, for `fresnel.stack_reflection`.

    A material is one, endless where `thickness_m` is None. ValueError as `permittivity`, for a volume or a wrong
    thickness.
    """
    name = wall_name(material)
    if name in VOLUMES:
        raise ValueError(f"{name} is a volume: it has no layers and mirrors nothing")
    if thickness_m is not None and not thickness_m > 0.0:
        raise ValueError(f"thickness_m must be positive, got {thickness_m!r}")
    if name not in CONSTRUCTIONS:
        return ((permittivity(name, frequency_hz, extrapolate), math.inf if thickness_m is None else thickness_m),)
    if thickness_m is not None:
        raise ValueError(
            f"{name} has the thicknesses of its layers; thickness_m must not be given, got {thickness_m!r}"
        )
    return tuple(
        (permittivity(layer.material, frequency_hz, extrapolate), layer.thickness_m) for layer in CONSTRUCTIONS[name]
    )


def validity_ghz(material: str) -> tuple[tuple[float, float], ...]:
    """Return the ranges [GHz] in which all materials of a wall are valid (ends included); a volume has its law's."""
    name = wall_name(material)
    if name in VOLUMES:
        return ((0.23, 95.0),)
    common = [(0.0, math.inf)]
    for part in _parts(name):
        common = [
            (max(minimum, row.min_ghz), min(maximum, row.max_ghz)) for minimum, maximum in common for row in TABLE[part]
        ]
    return tuple((minimum, maximum) for minimum, maximum in common if minimum <= maximum)


def needs_extrapolation(material: str, frequency_hz: float) -> bool:
    """Return whether a frequency lies below or above everything measured of a wall; False between two bands."""
    name, frequency_ghz = wall_name(material), frequency_hz / 1e9
    bands = [validity_ghz(name)] if name in VOLUMES else [validity_ghz(part) for part in _parts(name)]
    return not all(band[0][0] <= frequency_ghz <= band[-1][1] for band in bands)


def band_note(material: str, frequency_hz: float) -> str:
    """Return "extrapolated beyond 1..40 GHz" or "interpolated between 40 and 110 GHz"; empty in a measured band."""
    ranges, frequency_ghz = validity_ghz(material), frequency_hz / 1e9
    if any(minimum <= frequency_ghz <= maximum for minimum, maximum in ranges):
        return ""
    if needs_extrapolation(material, frequency_hz):
        return "extrapolated beyond " + " and ".join(f"{lower:g}..{upper:g}" for lower, upper in ranges) + " GHz"
    rows = [_neighbours(TABLE[part], frequency_ghz) for part in _parts(wall_name(material))]
    gaps = sorted({(low.max_ghz, high.min_ghz) for low, high in rows if low is not high})
    return "interpolated " + " and ".join(f"between {low:g} and {high:g}" for low, high in gaps) + " GHz"


def reflection_error_db(material: str, frequency_hz: float) -> float | None:
    """Return the stated error [dB] of the power reflection at normal incidence outside measured bands; None inside.

    The largest change by other readings: rows continued, the band's end, eps - 1 more or less by SAMPLE_SCATTER.
    """
    parts = [] if is_volume(material) else _parts(wall_name(material))
    errors = (_error_db(part, frequency_hz) for part in parts)
    return max((error for error in errors if error is not None), default=None)


def typical_roughness_mm(material: str) -> tuple[float, float] | None:
    """Return the usual rms height [mm] of a wall's face, minimum and maximum; None if no value is available."""
    name = wall_name(material)
    return TYPICAL_ROUGHNESS_MM.get(CONSTRUCTIONS[name][0].material if name in CONSTRUCTIONS else name)


def permittivity(name: str, frequency_hz: float, extrapolate: bool = False) -> complex:
    """Return complex relative permittivity, Im <= 0; between two bands log over log frequency.

    Outside all bands (ends included): ValueError, or the nearest row continued if `extrapolate`.
    """
    if not (math.isfinite(frequency_hz) and frequency_hz > 0.0):
        raise ValueError(f"frequency_hz must be finite and positive, got {frequency_hz!r}")
    key, frequency_ghz = material_name(name), frequency_hz / 1e9
    if needs_extrapolation(key, frequency_hz) and not extrapolate:
        ranges = " and ".join(f"{row.min_ghz:g}..{row.max_ghz:g}" for row in TABLE[key])
        raise ValueError(f"material {key} is known for {ranges} GHz, got {frequency_ghz:g} GHz")
    low, high = _neighbours(TABLE[key], frequency_ghz)
    if low is high:
        return _complex_permittivity(*_row_values(low, frequency_ghz), frequency_ghz)
    share = math.log(frequency_ghz / low.max_ghz) / math.log(high.min_ghz / low.max_ghz)
    ends = zip(_row_values(low, low.max_ghz), _row_values(high, high.min_ghz), strict=True)
    real, conductivity_s_per_m = (at_low ** (1.0 - share) * at_high**share for at_low, at_high in ends)
    return _complex_permittivity(real, conductivity_s_per_m, frequency_ghz)


def _key(name: str) -> str:
    return name.strip().lower().replace(" ", "_").replace("-", "_")


def _parts(name: str) -> list[str]:
    """Return the materials of a wall's layers."""
    return [layer.material for layer in CONSTRUCTIONS[name]] if name in CONSTRUCTIONS else [name]


def _neighbours(rows: tuple[MaterialRow, ...], frequency_ghz: float) -> tuple[MaterialRow, MaterialRow]:
    """Return the rows below and above a gap that holds a frequency; elsewhere the nearest row, twice."""
    low = [row for row in rows if row.min_ghz <= frequency_ghz]
    high = [row for row in rows if frequency_ghz <= row.max_ghz]
    return low[-1] if low else high[0], high[0] if high else low[-1]


def _row_values(row: MaterialRow, frequency_ghz: float) -> tuple[float, float]:
    """Return eps' and conductivity [S/m] of a row's curves, beyond its band too."""
    return row.a * frequency_ghz**row.b, row.c * frequency_ghz**row.d


def _complex_permittivity(real: float, conductivity_s_per_m: float, frequency_ghz: float) -> complex:
    return complex(real, -conductivity_s_per_m / (2.0 * math.pi * frequency_ghz * 1e9 * VACUUM_PERMITTIVITY_F_PER_M))


def _error_db(name: str, frequency_hz: float) -> float | None:
    """Return the error of one material by the other readings of its rows; None in a measured band."""
    medium, frequency_ghz = permittivity(name, frequency_hz, extrapolate=True), frequency_hz / 1e9
    if not band_note(name, frequency_hz):
        return None
    low, high = _neighbours(TABLE[name], frequency_ghz)
    if low is high:
        end_ghz = min(max(frequency_ghz, low.min_ghz), low.max_ghz)
        scattered = (1.0 + (medium - 1.0) * ratio for ratio in (SAMPLE_SCATTER, 1.0 / SAMPLE_SCATTER))
        readings = [permittivity(name, 1e9 * end_ghz), *scattered]
    else:
        readings = [_complex_permittivity(*_row_values(row, frequency_ghz), frequency_ghz) for row in (low, high)]
    return max(abs(_reflection_db(reading) - _reflection_db(medium)) for reading in readings)


def _reflection_db(medium: complex) -> float:
    """Return the power reflection [dB] of a half-space at normal incidence; 0 of vacuum, which has none."""
    index = cmath.sqrt(medium)
    return 20.0 * math.log10(abs((index - 1.0) / (index + 1.0))) if medium != 1.0 else 0.0
