"""References of curved mirrors: rays against an arc, the ray factor, all Fermat points, the field of a point source."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from models.physics.curved_mirror import _LONGEST, CurvedBounces, _frame, _local, _search, bounces


def arc_length_m(a: np.ndarray, b: np.ndarray, curvature_per_m: float) -> float:
    """Return the length of the arc."""
    return 2.0 * _frame(a, b, curvature_per_m)[2]


def arc_crosses(
    origin: np.ndarray,
    targets: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    curvature_per_m: float,
    clearance_m: float = 1e-6,
) -> np.ndarray:
    """Return whether the arc crosses each ray origin -> target; bool [N]. Ends and clearance as in `mirror.crosses`.

    `origin` [2] or [N, 2], `targets` [N, 2].
    """
    middle, along, half_m = _frame(a, b, curvature_per_m)
    targets = _local(targets, middle, along)
    start = np.broadcast_to(_local(origin, middle, along), targets.shape)
    ray = targets - start
    half_rad = curvature_per_m * half_m
    reach_m = half_m * np.sinc(half_rad / np.pi)
    # the circle: curvature/2 (x^2 + y^2) - y cos(half) - curvature/2 reach^2 = 0
    second = 0.5 * curvature_per_m * np.sum(ray**2, axis=-1)
    first = curvature_per_m * np.sum(start * ray, axis=-1) - ray[:, 1] * np.cos(half_rad)
    zeroth = 0.5 * curvature_per_m * (np.sum(start**2, axis=-1) - reach_m**2) - start[:, 1] * np.cos(half_rad)
    root = first**2 - 4.0 * second * zeroth
    larger = -0.5 * (first + np.copysign(np.sqrt(np.maximum(root, 0.0)), first))
    length_m = np.hypot(ray[:, 0], ray[:, 1])
    edge = clearance_m / np.maximum(length_m, clearance_m)
    crossed = np.zeros(len(targets), bool)
    for above, below in ((larger, second), (zeroth, larger)):
        meets = (root >= 0.0) & (below != 0.0) & (length_m > 0.0)
        share = np.divide(
            above, below, out=np.full(len(targets), -1.0), where=meets & (np.abs(below) * 1e9 > np.abs(above))
        )
        point = start + share[:, None] * ray
        on_arc = (np.abs(point[:, 0]) <= reach_m + clearance_m) & (point[:, 1] * curvature_per_m <= clearance_m)
        crossed |= (share > edge) & (share < 1.0 - edge) & on_arc
    return crossed


def focusing(
    out_m: np.ndarray, on_m: np.ndarray, cos_incidence: np.ndarray, curvature_towards_per_m: np.ndarray
) -> np.ndarray:
    """Return the field of one bounce over that of a flat mirror of the same length, by geometrical optics; complex.

    F = 1 / sqrt(D), D = 1 - 2 kappa l1 l2 / ((l1 + l2) cos): the second derivative of the path along the arc is
    cos^2 (1/l1 + 1/l2) D, and stationary phase divides by its root; D = 0 is the mirror equation
    1/l1 + 1/l2 = 2 kappa / cos. Segments and cosine in plan, also for paths with slope: the heights cancel.
    `curvature_towards_per_m` is positive where the wall is hollow towards the segments. Behind a caustic (D < 0) the
    phase is +pi/2 (e^{+jwt}); on it the factor is infinite. Source: stationary phase, as above; it is the spreading
    factor of Kouyoumjian and Pathak (1974) for a cylinder.
    """
    spread = 1.0 - 2.0 * np.asarray(curvature_towards_per_m) * out_m * on_m / (
        (np.asarray(out_m) + on_m) * cos_incidence
    )
    size = np.full(np.shape(spread), np.inf)
    np.divide(1.0, np.sqrt(np.abs(spread)), out=size, where=spread != 0.0)
    factor = np.zeros(np.shape(spread), np.complex128)
    factor.real, factor.imag = np.where(spread < 0.0, 0.0, size), np.where(spread < 0.0, size, 0.0)
    return factor


def fermat_points(
    origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray, curvature_per_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return all points of the arc that mirror targets towards the origin: (target index, share, longest); each [M].

    `longest` (bool) marks points where the path is a maximum along the arc: behind their caustic. Either face may
    reflect, both segments on one side of the tangent and neither crossed by the arc itself. Interval subdivision with
    bounds on the derivatives loses none; the share is exact to rounding (near a caustic to its square root).
    """
    points = _search(origin, targets, a, b, curvature_per_m, np.inf)
    return points[0], points[1], points[2] == _LONGEST


def one_way_field(
    origin: np.ndarray,
    targets: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    curvature_per_m: float,
    wavelength_m: float,
    reflection: complex | Callable[[np.ndarray], np.ndarray] = 1.0,
) -> tuple[CurvedBounces, np.ndarray]:
    """Return the bounces and the complex field [M] of each at its target, for a unit point source (e^{-jkr} / r).

    `reflection` is the wall's coefficient, or a function of the cosine of incidence in space.
    """
    reflected = bounces(origin, targets, a, b, curvature_per_m, wavelength_m)
    cosine = reflected.cos_incidence * (reflected.out_m + reflected.on_m) / reflected.length_m
    factor = reflection(cosine) if callable(reflection) else reflection
    phase_rad = 2.0 * np.pi / wavelength_m * reflected.length_m
    return reflected, factor * reflected.gain * np.exp(-1j * phase_rad) / reflected.length_m
