"""Plane mirrors seen from above: reflection, wall lines, and crossings of rays with wall segments.

Walls stand upright, so all geometry happens in the plane [m] and heights stay as they are. The same functions serve
the simulator (true position -> image) and recovery (image -> true position): a reflection is its own inverse.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled

#: Walls shorter than this have no well-defined direction.
SHORTEST_WALL_M = 1e-6
#: Length by which rays are shortened and walls extended at each end for crossing tests.
CLEARANCE_M = 1e-6


def reflect(points: np.ndarray, normal: np.ndarray, offset_m: float | np.ndarray) -> np.ndarray:
    """Mirror points [..., 2 or 3] in the line n.x + offset_m = 0, Eq. (19): x' = x - 2 (n.x + d) n / |n|^2."""
    points = np.asarray(points, np.float64)
    normal = np.asarray(normal, np.float64)
    plan = points[..., :2]
    distance = (np.sum(plan * normal, axis=-1) + offset_m) / np.sum(normal * normal, axis=-1)
    image = plan - 2.0 * distance[..., None] * normal
    return np.concatenate([image, points[..., 2:]], axis=-1)


@compiled(error_model="numpy")
def mirrored(x, y, nx, ny, offset_m):  # type: ignore[no-untyped-def]
    """Return `reflect` of one point of the plane, for callers that are compiled themselves."""
    distance = (x * nx + y * ny + offset_m) / (nx * nx + ny * ny)
    return x - 2.0 * distance * nx, y - 2.0 * distance * ny


def wall_from_ends(a: np.ndarray, b: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, float]:
    """Return unit normal [2] towards a point and offset [m] of the line through `a` and `b`; ValueError: coincident."""
    a, b, towards = (np.asarray(point, np.float64) for point in (a, b, towards))
    along = b - a
    length_m = float(np.hypot(along[0], along[1]))
    if not length_m > SHORTEST_WALL_M:
        raise ValueError(f"wall must be longer than {SHORTEST_WALL_M:g} m, got ends {a.tolist()} and {b.tolist()}")
    normal = np.array([-along[1], along[0]]) / length_m
    if (towards - a) @ normal < 0.0:
        normal = -normal
    # the middle of the wall: half the rounding of either end
    return normal, float(-(normal @ (0.5 * (a + b))))


def crossing_parameters(
    origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the lines origin -> target meet the lines a -> b: shares (along the ray, along the wall), each [N,
    M].

    NaN where parallel or without length. `origin` [2] or [N, 2], `targets` [N, 2], `a` and `b` [M, 2], metres.
    """
    return _crossings(*_plain(origin, targets, a, b))


@compiled(error_model="numpy")
def _crossings(origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along_ray, along_wall = np.empty((len(targets), len(a))), np.empty((len(targets), len(a)))
    for n in range(len(targets)):
        for m in range(len(a)):
            along_ray[n, m], along_wall[n, m] = _shares(*_ray_and_wall(origin, targets, a, b, n, m))
    return along_ray, along_wall


def _plain(
    origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rays and walls as arrays of one layout, for which the kernels are compiled."""
    start = np.broadcast_to(np.asarray(origin, np.float64), np.shape(targets))
    copies = (np.array(array, np.float64, order="C") for array in (start, targets, a, b))
    return tuple(copies)  # type: ignore[return-value]


@compiled
def _ray_and_wall(origin, targets, a, b, n, m):  # type: ignore[no-untyped-def]
    """Return the coordinates of one ray and one wall."""
    return origin[n, 0], origin[n, 1], targets[n, 0], targets[n, 1], a[m, 0], a[m, 1], b[m, 0], b[m, 1]


@compiled(error_model="numpy")
def _shares(ox, oy, tx, ty, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Return `crossing_parameters` of one ray o -> t and one wall a -> b."""
    rx, ry, wx, wy = tx - ox, ty - oy, bx - ax, by - ay
    turn = rx * wy - ry * wx
    # sine of the angle between them, so that the test is independent of both lengths
    if abs(turn) <= 1e-12 * (math.hypot(rx, ry) * math.hypot(wx, wy)):
        return math.nan, math.nan
    return ((ax - ox) * wy - (ay - oy) * wx) / turn, ((ax - ox) * ry - (ay - oy) * rx) / turn


def crosses(
    origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray, clearance_m: float = CLEARANCE_M
) -> np.ndarray:
    """Return which rays origin -> target are blocked by which wall segments a -> b; bool [N, M].

    Walls are longer by `clearance_m` and rays shorter at each end; a ray along a wall is not blocked.
    """
    return _all_cuts(*_plain(origin, targets, a, b), clearance_m)


@compiled(error_model="numpy")
def _all_cuts(origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray, clearance_m: float) -> np.ndarray:
    out = np.empty((len(targets), len(a)), np.bool_)
    for n in range(len(targets)):
        for m in range(len(a)):
            out[n, m] = segments_cross(*_ray_and_wall(origin, targets, a, b, n, m), clearance_m)
    return out


@compiled(error_model="numpy")
def segments_cross(ox, oy, tx, ty, ax, ay, bx, by, clearance_m):  # type: ignore[no-untyped-def]
    """Return `crosses` of one ray o -> t and one wall a -> b, for callers that are compiled themselves."""
    rx, ry, wx, wy = tx - ox, ty - oy, bx - ax, by - ay
    turn = rx * wy - ry * wx
    across = (ax - ox) * wy - (ay - oy) * wx
    # most rays end before the wall's line or lead away from it: no division for them
    if not (0.0 < across < turn or turn < across < 0.0):
        return False
    along_ray, along_wall = _shares(ox, oy, tx, ty, ax, ay, bx, by)
    ray_share = clearance_m / max(math.hypot(rx, ry), clearance_m)
    wall_share = clearance_m / max(math.hypot(wx, wy), clearance_m)
    # comparisons with NaN (parallel) are false: not blocked
    return ray_share < along_ray < 1.0 - ray_share and -wall_share <= along_wall <= 1.0 + wall_share


def blocked(origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return whether each target is hidden from the origin (or its own, [N, 2]) by any wall a -> b; bool [N]."""
    if len(a) == 0:
        return np.zeros(len(targets), bool)
    return np.asarray(crosses(origin, targets, a, b).any(axis=1))


def specular_points(origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return where one wall a -> b mirrors targets towards the origin by the image method; [N, 2], NaN where none."""
    targets = np.asarray(targets, np.float64)
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    normal, offset_m = wall_from_ends(a, b, origin)
    height = targets @ normal + offset_m
    origin_height = float(np.asarray(origin) @ normal + offset_m)
    image = reflect(targets, normal, offset_m)
    _, along_wall = crossing_parameters(origin, image, a[None], b[None])
    share = along_wall[:, 0]
    visible = (height > 0.0) & (origin_height > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(visible[:, None], a + share[:, None] * (b - a), np.nan)
