"""Returns of walls, told by the returns about them: elongated, straight and dense, where a blob is wide.

About each return a line is fitted to its neighbours within a disc, strong ones first. On a wall most of the disc's
amplitude lies in the strip of the line's own error; scattered returns share it by area. A vehicle's side passes as a
part of a wall does: it is the length of the whole wall that tells them apart (`WallParams.min_length_m`).
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from models.compiled import compiled
from msgs.values.arrays import require_positive


class WallPointParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Statistics of the returns about a return of a wall."""

    radius_m: float = 3.0
    min_points: int = 6
    #: Unevenness of real walls, added to the returns' own errors; the strip is two standard deviations wide each way.
    flatness_m: float = 0.15
    #: Share of the amplitude within the strip, and that share over the strip's part of the disc.
    min_share: float = 0.5
    min_contrast: float = 2.2
    #: Extent along the line over the radius.
    min_extent: float = 0.8
    #: What moves faster over ground is no wall.
    max_speed_mps: float = 0.6

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require_positive(f"wall_points.{name}", getattr(self, name))


def wall_like(
    points_m: np.ndarray,
    covariance_m2: np.ndarray,
    snr_db: np.ndarray,
    speed_mps: np.ndarray | None,
    params: WallPointParams,
) -> np.ndarray:
    """Return which returns [N, 2] with covariances [N, 2, 2] look like part of a wall; bool [N].

    Radial speeds over ground [N], NaN where not known; None: of none.
    """
    stands = np.ones(len(points_m), bool) if speed_mps is None else ~(np.abs(speed_mps) > params.max_speed_mps)
    standing = np.flatnonzero(stands)
    # the square root of the amplitude: one strong reflector must not be a line by itself
    weight = 10.0 ** (0.025 * (snr_db - snr_db.max(initial=-np.inf)))
    limits = (params.radius_m, params.flatness_m, params.min_share, params.min_contrast, params.min_extent)
    on_line = _on_lines(
        np.ascontiguousarray(points_m[standing]),
        np.ascontiguousarray(covariance_m2[standing]),
        np.ascontiguousarray(weight[standing]),
        int(params.min_points),
        *map(float, limits),
    )
    stands[standing] = on_line
    return stands


@compiled(error_model="numpy")
def _on_lines(
    points_m: np.ndarray,
    covariance_m2: np.ndarray,
    weight: np.ndarray,
    min_points: int,
    radius_m: float,
    flatness_m: float,
    min_share: float,
    min_contrast: float,
    min_extent: float,
) -> np.ndarray:
    """Return which points lie on the line of their neighbours; bool [N]."""
    count = len(points_m)
    result = np.zeros(count, np.bool_)
    order = np.argsort(points_m[:, 0], kind="mergesort")
    first = 0
    near = np.empty(count, np.int64)
    for at in range(count):
        i = order[at]
        while points_m[order[first], 0] < points_m[i, 0] - radius_m:
            first += 1
        count_near = _neighbours(points_m, order, first, i, radius_m, near)
        if count_near >= min_points:
            limits = (radius_m, flatness_m, min_share, min_contrast, min_extent)
            result[i] = _is_on_line(points_m, covariance_m2, weight, i, near[:count_near], min_points, limits)
    return result


@compiled
def _neighbours(points_m: np.ndarray, order: np.ndarray, first: int, i: int, radius_m: float, near: np.ndarray) -> int:
    """Write the indices of the points within the radius of point `i` to `near`; return how many there are."""
    count = 0
    for k in range(first, len(order)):
        j = order[k]
        dx, dy = points_m[j, 0] - points_m[i, 0], points_m[j, 1] - points_m[i, 1]
        if dx > radius_m:
            break
        if dx * dx + dy * dy <= radius_m * radius_m:
            near[count] = j
            count += 1
    return count


@compiled(error_model="numpy")
def _is_on_line(points_m, covariance_m2, weight, i, near, min_points, limits):  # type: ignore[no-untyped-def]
    """Return whether point `i` lies in the strip of the line through its neighbours, and they stand out of a disc."""
    radius_m, flatness_m, min_share, min_contrast, min_extent = limits
    inside = np.ones(len(near), np.bool_)
    cx, cy, nx, ny, half_m = 0.0, 0.0, 0.0, 1.0, 0.0
    for _ in range(3):
        if np.count_nonzero(inside) < min_points:
            return False
        cx, cy, nx, ny = _weighted_line(points_m, weight, near[inside])
        half_m = _strip_m(covariance_m2, near, nx, ny, flatness_m)
        for k in range(len(near)):
            j = near[k]
            inside[k] = abs((points_m[j, 0] - cx) * nx + (points_m[j, 1] - cy) * ny) <= half_m
    along = (points_m[near[inside], 1] - cy) * nx - (points_m[near[inside], 0] - cx) * ny
    # a strip as wide as half the disc cannot stand out of it
    if len(along) < min_points or half_m > 0.5 * radius_m or along.max() - along.min() < min_extent * radius_m:
        return False
    share = weight[near[inside]].sum() / weight[near].sum()
    part = half_m / radius_m
    of_disc = 2.0 / math.pi * (math.asin(part) + part * math.sqrt(1.0 - part * part))
    own_m = abs((points_m[i, 0] - cx) * nx + (points_m[i, 1] - cy) * ny)
    return bool(own_m <= half_m and share >= min_share and share >= min_contrast * of_disc)


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
def _strip_m(covariance_m2, near, nx, ny, flatness_m):  # type: ignore[no-untyped-def]
    """Return two standard deviations across a line: the median of the points' own and the unevenness."""
    across = np.empty(len(near))
    for k in range(len(near)):
        c = covariance_m2[near[k]]
        across[k] = nx * nx * c[0, 0] + 2.0 * nx * ny * c[0, 1] + ny * ny * c[1, 1]
    return 2.0 * math.sqrt(np.median(across) + flatness_m * flatness_m)
