"""Physical optics of one upright wall: the field p -> wall -> q as an integral over the wall, the reference for rays.

Kirchhoff's integral with the mean of both obliquities, so that both directions give one number. For an endless flat
wall it is the mean of the two Rayleigh-Sommerfeld integrals and so exactly e^{-jkL} / L, the field of the image; the
reflection coefficient (-1 for a conductor with the field along its wall) is removed. It includes edge diffraction, as
far as physical optics describes it. Time convention e^{+jwt}.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fresnel

from models.physics.curved_mirror import arc_normals, arc_points
from tests.models.physics.curved_reference import arc_length_m

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
#: Gauss panels are half a wavelength long: a node every twelfth of one, and the phase turns twice as fast.
_PANEL_WAVELENGTHS = 0.5


def wall_field(
    origin: np.ndarray,
    target: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    curvature_per_m: float,
    wavelength_m: float,
    heights_m: tuple[float, float] | None = None,
    taper_m: float = 0.0,
) -> complex:
    """Return the field at `target` [3] of a unit point source (e^{-jkr} / r) at `origin` [3], via the wall only.

    The integral over height is done by stationary phase, between the Fresnel integrals of the wall's foot and top
    (`heights_m`, in the points' own z; None: endless), which leaves one along the arc. `taper_m` fades the wall out
    over that length at both ends (0: sharp edges, which diffract). Error against the surface itself: of order
    1 / (k times the shorter segment). Parts of the wall that do not face both ends contribute nothing; the arc's own
    shadow (a segment that crosses the arc elsewhere) is not included.
    """
    k = _wavenumber(wavelength_m)
    share, weight_m = _panels(arc_length_m(a, b, curvature_per_m), wavelength_m)
    segments = [_segments(position, a, b, curvature_per_m, share) for position in (origin, target)]
    (l1, c1), (l2, c2) = segments
    plan = l1 + l2
    rise_m = float(target[2] - origin[2])
    length = np.hypot(plan, rise_m)
    field = np.sqrt(k / (2.0 * np.pi)) * np.exp(0.25j * np.pi - 1j * k * length)
    field = field * 0.5 * (np.abs(c1) + np.abs(c2)) * plan / (length * np.sqrt(length * l1 * l2))
    if heights_m is not None:
        stationary_m = origin[2] + rise_m * l1 / plan
        edges = []
        for edge_m in heights_m:
            detour_m = np.hypot(l1, edge_m - origin[2]) + np.hypot(l2, edge_m - target[2]) - length
            edges.append(np.sign(edge_m - stationary_m) * np.sqrt(4.0 / wavelength_m * np.maximum(detour_m, 0.0)))
        field = field * _between(*edges)
    return complex(
        np.sum(weight_m * _fade(share, arc_length_m(a, b, curvature_per_m), taper_m) * (c1 * c2 > 0.0) * field)
    )


def surface_field(
    origin: np.ndarray,
    target: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    curvature_per_m: float,
    wavelength_m: float,
    heights_m: tuple[float, float],
    taper_m: float = 0.0,
) -> complex:
    """Return `wall_field` integrated over arc and height: slow, without stationary phase, for small walls.

    `taper_m` fades the wall out towards foot and top too.
    """
    k = _wavenumber(wavelength_m)
    share, weight_m = _panels(arc_length_m(a, b, curvature_per_m), wavelength_m)
    up, up_weight_m = _panels(heights_m[1] - heights_m[0], wavelength_m)
    (l1, c1), (l2, c2) = (_segments(position, a, b, curvature_per_m, share) for position in (origin, target))
    weight_m = weight_m * _fade(share, arc_length_m(a, b, curvature_per_m), taper_m) * (c1 * c2 > 0.0)
    up_weight_m = up_weight_m * _fade(up, heights_m[1] - heights_m[0], taper_m)
    total = 0.0j
    for height_m, step_m in zip(heights_m[0] + up * (heights_m[1] - heights_m[0]), up_weight_m, strict=True):
        r1, r2 = np.hypot(l1, height_m - origin[2]), np.hypot(l2, height_m - target[2])
        mean = 0.5 * (
            np.abs(c1) * l1 / r1 * (1.0 + 1.0 / (1j * k * r1)) + np.abs(c2) * l2 / r2 * (1.0 + 1.0 / (1j * k * r2))
        )
        total += step_m * np.sum(weight_m * mean * np.exp(-1j * k * (r1 + r2)) / (r1 * r2))
    return complex(1j * k / (2.0 * np.pi) * total)


def two_way_field(field: complex) -> complex:
    """Return the field radar -> wall -> point scatterer -> wall -> radar: the one-way field squared (reciprocity).

    With several Fermat points it holds every pair of outbound and inbound path: (sum u_i)^2 = sum_ij u_i u_j.
    """
    return field * field


def _wavenumber(wavelength_m: float) -> float:
    """Return 2 pi / wavelength; checks the module's input."""
    if not (np.isfinite(wavelength_m) and wavelength_m > 0.0):
        raise ValueError(f"wavelength must be positive and finite, got {wavelength_m} m")
    return 2.0 * np.pi / wavelength_m


def _panels(length_m: float, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (shares 0..1) and weights [m] of Gauss-Legendre panels over a length."""
    count = max(1, int(np.ceil(length_m / (_PANEL_WAVELENGTHS * wavelength_m))))
    nodes = (np.arange(count)[:, None] + 0.5 + 0.5 * _NODES) / count
    return nodes.ravel(), np.tile(0.5 * _WEIGHTS * length_m / count, count)


def _segments(
    position: np.ndarray, a: np.ndarray, b: np.ndarray, curvature_per_m: float, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance in plan from a position to each node, and the signed cosine to the wall's left normal."""
    away = np.asarray(position, np.float64)[:2] - arc_points(a, b, curvature_per_m, share)
    distance_m = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-12)
    return distance_m, np.sum(away * arc_normals(a, b, curvature_per_m, share), axis=1) / distance_m


def _between(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the share of an endless Fresnel integral between two arguments: (1 + j)/2 times that of C - j S."""
    (sine_low, cosine_low), (sine_high, cosine_high) = fresnel(low), fresnel(high)
    return 0.5 * (1.0 + 1j) * (cosine_high - cosine_low - 1j * (sine_high - sine_low))


def _fade(share: np.ndarray, length_m: float, taper_m: float) -> np.ndarray:
    """Return a weight of 1 in the middle, falling to 0 as a cosine square over `taper_m` at each end."""
    if taper_m <= 0.0:
        return np.ones_like(share)
    from_end_m = np.minimum(share, 1.0 - share) * length_m
    return np.sin(0.5 * np.pi * np.clip(from_end_m / taper_m, 0.0, 1.0)) ** 2
