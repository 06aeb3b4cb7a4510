"""Reflection and transmission of walls by FDTD: the interface of tables and commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from lab.full_wave.media import Layers
from lab.full_wave.rough import FloquetOrders, RoughParams, scatter
from lab.full_wave.strip import StripParams, build_strips, run_strip
from models.physics.fresnel import Polarisation

#: Steepest planar incidence: nearer to grazing, the length of a pulse clear of the cut-off grows without bound.
MAX_ANGLE_RAD = math.radians(89.0)
#: A column of cells: a wall without roughness.
SMOOTH = RoughParams(dtype="float64")


@dataclass(frozen=True)
class Scattered:
    """Scattering of a plane wave of unit power by a wall."""

    #: Complex field reflection of the specular lobe at the front's mean plane, sign of TM as Eq. (13).
    r: complex
    #: Complex field transmission, front face to back face; 0 for a half-space.
    t: complex
    #: |r|^2, and the share of power in all reflected directions, the specular one included.
    specular_power: float
    reflected_power: float
    #: Share of power behind the wall, all directions; 0 for a half-space.
    transmitted_power: float
    #: Angles [rad] from the wall's normal and power shares of the reflected directions.
    orders: tuple[np.ndarray, np.ndarray]
    cells: int
    steps: int
    #: Field left at the end as a share of its peak.
    residue: float


def reflect(
    layers: Layers,
    angle_rad: float,
    frequency_hz: float,
    polarisation: Polarisation = "te",
    settings: RoughParams = SMOOTH,
    on_step: Callable[[int, float], None] | None = None,
) -> Scattered:
    """Return the reflection of a plane wave by layers (permittivity, thickness_m) in air, front first, by time
    stepping.

    Smooth walls run on one column of cells, rough ones (rms height, correlation exp(-x^2/l^2)) on a periodic strip of
    `settings.width_m`. Angle from the normal, at most 89 deg (86 deg rough). `on_step(steps, residue)` is called now
    and then. Look at `residue`: a rough wall without loss rings beyond the run. Raises ValueError for bad media, angle,
    settings.
    """
    if polarisation not in ("te", "tm"):
        raise ValueError(f"polarisation must be te or tm, got {polarisation!r}")
    if not (math.isfinite(frequency_hz) and frequency_hz > 0.0):
        raise ValueError(f"frequency_hz must be finite and positive, got {frequency_hz!r}")
    if settings.roughness_m == 0.0:
        params = StripParams(settings.cells_per_wavelength, dtype=settings.dtype)
        return _reflect_smooth(layers, angle_rad, frequency_hz, polarisation, params, on_step)
    return _from_orders(scatter(layers, angle_rad, frequency_hz, polarisation, settings, on_step))


def reflect_angles(
    layers: Layers,
    angles_rad: Sequence[float] | np.ndarray,
    frequency_hz: float,
    polarisation: Polarisation = "te",
    settings: RoughParams = SMOOTH,
    workers: int = 2,
) -> list[Scattered]:
    """Return `reflect` of a smooth wall at many angles, side by side on threads; same results for any number of
    workers.
    """

    def reflect_at(angle_rad: float) -> Scattered:
        return reflect(layers, float(angle_rad), frequency_hz, polarisation, settings)

    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(reflect_at, angles_rad))


def _reflect_smooth(
    layers: Layers,
    angle_rad: float,
    frequency_hz: float,
    polarisation: Polarisation,
    params: StripParams,
    on_step: Callable[[int, float], None] | None,
) -> Scattered:
    """Return two runs of a column, with and without the wall: their difference at the front face is the reflected
    wave.
    """
    if not 0.0 <= angle_rad <= MAX_ANGLE_RAD:
        raise ValueError(f"angle_rad must lie in [0, 89 deg], got {angle_rad!r}")
    wall, air = build_strips(layers, angle_rad, frequency_hz, params)
    incident = run_strip(air, frequency_hz, polarisation, params)
    total = run_strip(wall, frequency_hz, polarisation, params)
    # of H in TM: the tangential E measured here reflects with the other sign
    sign = 1.0 if polarisation == "te" else -1.0
    r = sign * (total.front - incident.front) / incident.front
    t = 0j if math.isinf(layers[-1][1]) else total.back / incident.front
    if on_step is not None:
        on_step(total.steps, total.residue)
    power = abs(r) ** 2
    orders = (np.array([angle_rad]), np.array([power]))
    return Scattered(r, t, power, power, abs(t) ** 2, orders, total.cells, total.steps, total.residue)


def _from_orders(orders: FloquetOrders) -> Scattered:
    """Return the public form of a wide strip's result."""
    return Scattered(
        orders.r,
        orders.t,
        abs(orders.r) ** 2,
        float(orders.reflected.sum()),
        float(orders.transmitted.sum()),
        (orders.reflected_angle_rad, orders.reflected),
        orders.cells,
        orders.steps,
        orders.residue,
    )
