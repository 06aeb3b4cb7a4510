"""Returns of walls, told by the returns about them: elongated, straight and dense, where a blob is wide.

About each return a line is fitted to its neighbours within a disc, strong ones first. On a wall most of the disc's
amplitude lies in the strip of the line's own error; scattered returns share it by area. A vehicle's side passes as a
part of a wall does: it is the length of the whole wall that tells them apart (`WallParams.min_length_m`).
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled

#: Statistics of the returns within this of a return of a wall: least number, ...
RADIUS_M = 3.0
MIN_POINTS = 6
#: unevenness of real walls, added to the returns' own errors (the strip is two standard deviations wide each way), ...
FLATNESS_M = 0.15
#: share of the amplitude within the strip, that share over the strip's part of the disc, ...
MIN_SHARE = 0.5
MIN_CONTRAST = 2.2
#: and extent along the line over the radius.
MIN_EXTENT = 0.8
#: What moves faster over ground is no wall.
MAX_SPEED_MPS = 0.6


def wall_like(
    points_m: np.ndarray,
    covariance_m2: np.ndarray,
    snr_db: np.ndarray,
    speed_mps: np.ndarray | None,
) -> np.ndarray:
    """Return which returns [N, 2] with covariances [N, 2, 2] look like part of a wall; bool [N].

    Radial speeds over ground [N], NaN where not known; None: of none.
    """
    stands = np.ones(len(points_m), bool) if speed_mps is None else ~(np.abs(speed_mps) > MAX_SPEED_MPS)
    standing = np.flatnonzero(stands)
    # the square root of the amplitude: one strong reflector must not be a line by itself
    weight = 10.0 ** (0.025 * (snr_db - snr_db.max(initial=-np.inf)))
    on_line = _on_lines(
        np.ascontiguousarray(points_m[standing]),
        np.ascontiguousarray(covariance_m2[standing]),
        np.ascontiguousarray(weight[standing]),
    )
    stands[standing] = on_line
    return stands


@compiled(error_model="numpy")
def _on_lines(points_m: np.ndarray, covariance_m2: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return which points lie on the line of their neighbours; bool [N]."""
    count = len(points_m)
    result = np.zeros(count, np.bool_)
    order = np.argsort(points_m[:, 0], kind="mergesort")
    first = 0
    near = np.empty(count, np.int64)
    for at in range(count):
        i = order[at]
        while points_m[order[first], 0] < points_m[i, 0] - RADIUS_M:
            first += 1
        count_near = _neighbours(points_m, order, first, i, near)
        if count_near >= MIN_POINTS:
            result[i] = _is_on_line(points_m, covariance_m2, weight, i, near[:count_near])
    return result


@compiled
def _neighbours(points_m: np.ndarray, order: np.ndarray, first: int, i: int, near: np.ndarray) -> int:
    """Write the indices of the points within the radius of point `i` to `near`; return how many there are."""
    count = 0
    for k in range(first, len(order)):
        j = order[k]
        dx, dy = points_m[j, 0] - points_m[i, 0], points_m[j, 1] - points_m[i, 1]
        if dx > RADIUS_M:
            break
        if dx * dx + dy * dy <= RADIUS_M * RADIUS_M:
            near[count] = j
            count += 1
    return count


@compiled(error_model="numpy")
def _is_on_line(points_m, covariance_m2, weight, i, near):  # type: ignore[no-untyped-def]
    """Return whether point `i` lies in the strip of the line through its neighbours, and they stand out of a disc."""
    inside = np.ones(len(near), np.bool_)
    cx, cy, nx, ny, half_m = 0.0, 0.0, 0.0, 1.0, 0.0
    for _ in range(3):
        if np.count_nonzero(inside) < MIN_POINTS:
            return False
        cx, cy, nx, ny = _weighted_line(points_m, weight, near[inside])
        half_m = _strip_m(covariance_m2, near, nx, ny)
        for k in range(len(near)):
            j = near[k]
            inside[k] = abs((points_m[j, 0] - cx) * nx + (points_m[j, 1] - cy) * ny) <= half_m
    along = (points_m[near[inside], 1] - cy) * nx - (points_m[near[inside], 0] - cx) * ny
    # a strip as wide as half the disc cannot stand out of it
    if len(along) < MIN_POINTS or half_m > 0.5 * RADIUS_M or along.max() - along.min() < MIN_EXTENT * RADIUS_M:
        return False
    share = weight[near[inside]].sum() / weight[near].sum()
    part = half_m / RADIUS_M
    of_disc = 2.0 / math.pi * (math.asin(part) + part * math.sqrt(1.0 - part * part))
    own_m = abs((points_m[i, 0] - cx) * nx + (points_m[i, 1] - cy) * ny)
    return bool(own_m <= half_m and share >= MIN_SHARE and share >= MIN_CONTRAST * of_disc)


@compiled(error_model="numpy")
def _weighted_line(points_m, weight, members):  # type: ignore[no-untyped-def]
    """Return the weighted mean and the unit normal of the principal axis of some points."""
    total, cx, cy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in members:
        total += weight[j]
        cx += weight[j] * points_m[j, 0]
        cy += weight[j] * points_m[j, 1]
    cx, cy = cx / total, cy / total
    for j in members:
        dx, dy = points_m[j, 0] - cx, points_m[j, 1] - cy
        xx += weight[j] * dx * dx
        xy += weight[j] * dx * dy
        yy += weight[j] * dy * dy
    angle_rad = 0.5 * math.atan2(2.0 * xy, xx - yy)
    return cx, cy, -math.sin(angle_rad), math.cos(angle_rad)


@compiled(error_model="numpy")
def _strip_m(covariance_m2, near, nx, ny):  # type: ignore[no-untyped-def]
    """Return two standard deviations across a line: the median of the points' own and the unevenness."""
    across = np.empty(len(near))
    for k in range(len(near)):
        c = covariance_m2[near[k]]
        across[k] = nx * nx * c[0, 0] + 2.0 * nx * ny * c[0, 1] + ny * ny * c[1, 1]
    return 2.0 * math.sqrt(np.median(across) + FLATNESS_M * FLATNESS_M)
