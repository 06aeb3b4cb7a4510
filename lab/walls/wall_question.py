"""A wall in question: of what, how thick, how rough, by which method; what can be asked of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

#: The bands shown where none is asked for.
BANDS_GHZ = (10.0, 77.0)
#: FDTD: steepest angles [deg] of smooth and of rough walls; runs lengthen as 1 / (1 - sin).
FDTD_MAX_DEG, FDTD_MAX_ROUGH_DEG = 89.0, 70.0


class Method(StrEnum):
    """Method of finding the coefficients: transfer matrix, or a wave simulated on a grid."""

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


def wall_of(name: str, thickness_mm: float | None, roughness_mm: float, method: Method, extrapolate: bool) -> Wall:
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


def known_bands(wall: Wall, bands_ghz: tuple[float, ...]) -> tuple[float, ...]:
    """The bands a wall's materials are known in; all of them where extrapolation is allowed or none is known."""
    from models.physics.materials import needs_extrapolation

    bands = tuple(band for band in bands_ghz if not needs_extrapolation(wall.material, 1e9 * band))
    return bands_ghz if wall.extrapolate else bands or bands_ghz


def check_fdtd(wall: Wall, most_deg: float) -> None:
    """ValueError where the wave simulation would refuse or run for hours."""
    from models.physics.materials import CONSTRUCTIONS

    if wall.method is not Method.FDTD:
        return
    limit_deg = FDTD_MAX_ROUGH_DEG if wall.roughness_m > 0.0 else FDTD_MAX_DEG
    if most_deg > limit_deg:
        kind = "a rough wall" if wall.roughness_m > 0.0 else "a wall"
        raise ValueError(f"--angles-deg must end at {limit_deg:g} at most for {kind} by fdtd, got {most_deg:g}")
    built_of = {layer.material for layer in CONSTRUCTIONS.get(wall.material, ())} | {wall.material}
    if wall.roughness_m > 0.0 and "metal" in built_of:
        raise ValueError(f"--roughness-mm must be 0 for {wall.material} by fdtd: rough metal is refused in tm")


def total_thickness_m(wall: Wall) -> float | None:
    """Return the thickness of all layers; None of a half-space."""
    from models.physics.materials import CONSTRUCTIONS

    if wall.material in CONSTRUCTIONS:
        return sum(layer.thickness_m for layer in CONSTRUCTIONS[wall.material])
    return wall.thickness_m


def title_of(wall: Wall) -> str:
    """Return what a wall is built of, for people."""
    from models.physics.materials import CONSTRUCTIONS

    thickness_m = total_thickness_m(wall)
    if wall.material in CONSTRUCTIONS:
        built = " + ".join(f"{1e3 * part.thickness_m:g} mm {part.material}" for part in CONSTRUCTIONS[wall.material])
    else:
        built = "half-space" if thickness_m is None else f"{1e3 * thickness_m:g} mm"
    return f"{wall.material} ({built})"
