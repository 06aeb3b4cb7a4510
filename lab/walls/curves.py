"""Power that a wall reflects and transmits over angle, for both polarisations: exact, or by a simulated wave."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.walls.wall_question import BANDS_GHZ, Method, Wall, total_thickness_m

MAX_ANGLES = 10_000
#: FDTD: the weakest transmitted field that a run resolves; of rough walls cells per wavelength, and correlation length
#: in wavelengths.
FDTD_MIN_FIELD = 1e-6
FDTD_ROUGH_CELLS, FDTD_CORRELATION_WAVELENGTHS = 16.0, 4.0 / 3.0


@dataclass(frozen=True)
class Curves:
    """Over the angles: complex field reflection and transmission, specular gain (power ratio, roughness included)."""

    r: np.ndarray
    t: np.ndarray
    specular_gain: np.ndarray


@dataclass(frozen=True)
class Answer:
    """A wall's curves at one frequency; outside measured bands `note` says how, `error_db` how well R is known."""

    frequency_hz: float
    angles_deg: np.ndarray
    te: Curves
    tm: Curves
    note: str
    error_db: float | None


def parse_angles(text: str) -> np.ndarray:
    """Angles [deg] of "first:last:step", both ends in; ValueError unless 0 <= first <= last <= 90 and step > 0."""
    try:
        first, last, step = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"--angles-deg must be FIRST:LAST:STEP, got {text!r}") from None
    # comparisons with nan are false
    if not (0.0 <= first <= last <= 90.0 and 0.0 < step < math.inf):
        raise ValueError(f"--angles-deg must rise within 0..90 by a positive step, got {text!r}")
    # may be infinite
    steps = (last - first) / step + 1e-9
    if steps >= MAX_ANGLES:
        raise ValueError(f"--angles-deg must be at most {MAX_ANGLES} angles, got {steps + 1.0:.0f} from {text!r}")
    return first + step * np.arange(math.floor(steps) + 1)


def answer(wall: Wall, frequency_hz: float, angles_deg: np.ndarray) -> Answer:
    """Curves of a wall at one frequency; ValueError where its materials are not known."""
    from models.physics.materials import band_note, is_volume, reflection_error_db

    note = band_note(wall.material, frequency_hz)
    if is_volume(wall.material):
        both = _volume_curves(wall, frequency_hz, angles_deg)
        return Answer(frequency_hz, angles_deg, both, both, note, None)
    curves = _exact_curves if wall.method is Method.EXACT else _fdtd_curves
    te, tm = (curves(wall, frequency_hz, angles_deg, polarisation) for polarisation in ("te", "tm"))
    return Answer(frequency_hz, angles_deg, te, tm, note, reflection_error_db(wall.material, frequency_hz))


def note_and_error(result: Answer) -> str:
    """Return "interpolated between 40 and 110 GHz, R within 0.23 dB"; empty in a measured band."""
    return result.note if result.error_db is None else f"{result.note}, R within {result.error_db:.2f} dB"


def as_contract(wall: Wall, result: Answer) -> dict[str, Any]:
    """The JSON document of one answer."""
    return {
        "material": wall.material,
        "frequency_hz": result.frequency_hz,
        "thickness_m": total_thickness_m(wall),
        "roughness_m": wall.roughness_m,
        "method": str(wall.method),
        "angles_deg": result.angles_deg.tolist(),
        "te": _plain_curves(result.te),
        "tm": _plain_curves(result.tm),
    }


def overview(extrapolate: bool = False) -> list[dict[str, str]]:
    """Every material, construction and volume as a row of texts: what it is, what it reflects (TE), where it holds."""
    from models.physics.materials import typical_roughness_mm, validity_ghz, wall_names

    rows = []
    for name in wall_names():
        roughness = typical_roughness_mm(name)
        row = {"material": name}
        row |= {f"eps {band:g} GHz": _permittivity_text(name, 1e9 * band, extrapolate) for band in BANDS_GHZ}
        row |= {f"R {band:g} GHz": _reflection_text(name, 1e9 * band, extrapolate) for band in BANDS_GHZ}
        row["error dB"] = _error_text(name, extrapolate)
        row["valid GHz"] = ", ".join(f"{lower:g}..{upper:g}" for lower, upper in validity_ghz(name))
        row["roughness mm"] = "-" if roughness is None else f"{roughness[0]:g}..{roughness[1]:g}"
        rows.append(row)
    return rows


def _exact_curves(wall: Wall, frequency_hz: float, angles_deg: np.ndarray, polarisation: Any) -> Curves:
    from models.physics.fresnel import coherent_power, stack_reflection, stack_transmission
    from models.physics.materials import wall_layers
    from msgs.values.units import SPEED_OF_LIGHT_MPS

    media, thicknesses_m = zip(
        *wall_layers(wall.material, wall.thickness_m, frequency_hz, wall.extrapolate), strict=True
    )
    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    cosine = np.cos(np.radians(angles_deg))
    r = stack_reflection(media, thicknesses_m, cosine, wavelength_m, polarisation)
    t = stack_transmission(media, thicknesses_m, cosine, wavelength_m, polarisation)
    left = coherent_power(np.asarray(wall.roughness_m), cosine, wavelength_m)
    return Curves(r, t, np.square(np.abs(r)) * left)


def _fdtd_curves(wall: Wall, frequency_hz: float, angles_deg: np.ndarray, polarisation: Any) -> Curves:
    """Smooth walls as a column of cells, rough ones as one random surface; |t| below what a run resolves is 0."""
    from lab.full_wave.rough import RoughParams
    from lab.full_wave.scattering import reflect
    from mirrorwave.console import progress_bar
    from models.physics.materials import wall_layers
    from msgs.values.units import SPEED_OF_LIGHT_MPS

    layers = wall_layers(wall.material, wall.thickness_m, frequency_hz, wall.extrapolate)
    settings = RoughParams(roughness_m=wall.roughness_m, dtype="float64")
    if wall.roughness_m > 0.0:
        correlation_m = FDTD_CORRELATION_WAVELENGTHS * SPEED_OF_LIGHT_MPS / frequency_hz
        settings = RoughParams(FDTD_ROUGH_CELLS, wall.roughness_m, correlation_m)
    results = []
    with progress_bar(f"{wall.material} {frequency_hz / 1e9:g} GHz {polarisation}, angles", len(angles_deg)) as advance:
        for angle in np.radians(angles_deg):
            results.append(reflect(layers, float(angle), frequency_hz, polarisation, settings))
            advance()
    t = np.array([result.t for result in results], np.complex128)
    return Curves(
        np.array([result.r for result in results], np.complex128),
        np.where(np.abs(t) > FDTD_MIN_FIELD, t, 0.0),
        np.array([result.specular_power for result in results], np.float64),
    )


def _volume_curves(wall: Wall, frequency_hz: float, angles_deg: np.ndarray) -> Curves:
    """Foliage of a depth: no mirror, and the loss of the slanted way through it; the phase is random, written as 0."""
    from models.physics.attenuation import vegetation_db

    thickness_m = wall.thickness_m or 0.0
    cosine = np.cos(np.radians(angles_deg))
    # a way along the hedge ends where the law does
    depth_m = thickness_m / np.maximum(cosine, min(thickness_m / 100.0, 1.0))
    t = 10.0 ** (-vegetation_db(frequency_hz, depth_m) / 20.0)
    return Curves(np.zeros_like(t, np.complex128), t.astype(np.complex128), np.zeros_like(t))


def _plain_curves(curves: Curves) -> dict[str, Any]:
    return {
        "r": [[float(value.real), float(value.imag)] for value in curves.r],
        "t": [[float(value.real), float(value.imag)] for value in curves.t],
        "specular_gain": curves.specular_gain.tolist(),
    }


def field_db(field: np.ndarray) -> np.ndarray:
    """Level of a field [dB]; nan where it vanishes."""
    size = np.abs(field)
    return 20.0 * np.log10(np.where(size > 0.0, size, np.nan))


def _permittivity_text(name: str, frequency_hz: float, extrapolate: bool) -> str:
    from models.physics.materials import CONSTRUCTIONS, is_volume, needs_extrapolation, permittivity

    if name in CONSTRUCTIONS:
        return "layers"
    if is_volume(name):
        return "volume"
    if needs_extrapolation(name, frequency_hz) and not extrapolate:
        return "-"
    medium = permittivity(name, frequency_hz, extrapolate)
    return f"{medium.real:.3g} - {-medium.imag:.3g}j"


def _error_text(name: str, extrapolate: bool) -> str:
    """Return the stated errors of what is shown outside measured bands, by band."""
    from models.physics.materials import needs_extrapolation, reflection_error_db

    shown = [band for band in BANDS_GHZ if extrapolate or not needs_extrapolation(name, 1e9 * band)]
    errors_db = {band: reflection_error_db(name, 1e9 * band) for band in shown}
    return ", ".join(f"{band:g} GHz: {error:.2f}" for band, error in errors_db.items() if error is not None) or "-"


def _reflection_text(name: str, frequency_hz: float, extrapolate: bool) -> str:
    from models.physics.materials import is_volume, needs_extrapolation

    if is_volume(name) or (needs_extrapolation(name, frequency_hz) and not extrapolate):
        return "-"
    wall = Wall(name, None, 0.0, Method.EXACT, extrapolate)
    levels = field_db(answer(wall, frequency_hz, np.array([0.0, 45.0, 70.0])).te.r)
    return " / ".join("-" if math.isnan(level) else f"{round(level, 1) + 0.0:.1f}" for level in levels)
