"""Plane mirrors seen from above: reflection, wall lines, and which rays cross which wall segments.

Walls stand upright, so all geometry happens in the plane [m] and heights stay as they are. The same functions serve
the simulator (true place -> image) and recovery (image -> true place): a reflection is its own inverse.
"""

from __future__ import annotations

import numpy as np

#: Walls shorter than this have no direction worth speaking of.
SHORTEST_WALL_M = 1e-6


def reflect(points: np.ndarray, normal: np.ndarray, offset_m: float | np.ndarray) -> np.ndarray:
    """Mirror points in the line n.x + offset_m = 0, Eq. (19): x' = x - 2 (n.x + d) n / |n|^2.

    `points` [..., 2] or [..., 3] in metres (a third coordinate, the height, is kept); `normal` [2] or broadcastable
    to the points' leading axes.
    """
    points = np.asarray(points, np.float64)
    normal = np.asarray(normal, np.float64)
    plan = points[..., :2]
    distance = (np.sum(plan * normal, axis=-1) + offset_m) / np.sum(normal * normal, axis=-1)
    image = plan - 2.0 * distance[..., None] * normal
    return np.concatenate([image, points[..., 2:]], axis=-1)


def wall_from_ends(a: np.ndarray, b: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit normal [2] and offset [m] of the line through `a` and `b`, the normal pointing to the side of `towards`.

    Raises ValueError where the ends coincide. A point `towards` on the line itself leaves the left-hand normal.
    """
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
    """Where the lines origin -> target meet the lines a -> b: (along the ray, along the wall), each [N, M].

    Both run from 0 at the start to 1 at the end. Parallel pairs, and targets at the origin, are NaN: they meet
    nowhere or everywhere. `origin` [2] or [N, 2], `targets` [N, 2], `a` and `b` [M, 2], all in metres.
    """
    origin = np.broadcast_to(np.asarray(origin, np.float64), np.shape(targets))
    ray = np.asarray(targets, np.float64) - origin  # [N, 2]
    wall = np.asarray(b, np.float64) - a  # [M, 2]
    to_wall = np.asarray(a, np.float64)[None] - origin[:, None]  # [N, M, 2]
    turn = _cross(ray[:, None], wall[None])  # [N, M]
    # sine of the angle between them, so that the test knows neither's length
    lengths = np.hypot(ray[:, 0], ray[:, 1])[:, None] * np.hypot(wall[:, 0], wall[:, 1])[None]
    parallel = np.abs(turn) <= 1e-12 * lengths
    turn = np.where(parallel, np.nan, turn)
    return _cross(to_wall, wall[None]) / turn, _cross(to_wall, ray[:, None]) / turn


def crosses(
    origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray, clearance_m: float = 1e-6
) -> np.ndarray:
    """Which rays origin -> target are cut by which wall segments a -> b; bool [N, M].

    Walls include their ends (two walls that share a corner leave no gap, for `clearance_m` is added to each end);
    rays leave `clearance_m` off at each end, so a point that lies on a wall is not hidden by it. A ray along a wall
    is not cut: it sees the wall's edge, of no width.
    """
    along_ray, along_wall = crossing_parameters(origin, targets, a, b)
    return cut(along_ray, along_wall, origin, targets, a, b, clearance_m)


def cut(
    along_ray: np.ndarray,
    along_wall: np.ndarray,
    origin: np.ndarray,
    targets: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    clearance_m: float = 1e-6,
) -> np.ndarray:
    """`crosses` for those who hold the crossing parameters already; bool [N, M]."""
    ray = np.asarray(targets, np.float64) - origin
    wall = np.asarray(b, np.float64) - a
    ray_share = clearance_m / np.maximum(np.hypot(ray[:, 0], ray[:, 1]), clearance_m)[:, None]
    wall_share = clearance_m / np.maximum(np.hypot(wall[:, 0], wall[:, 1]), clearance_m)[None]
    # comparisons with NaN (parallel) are false: not cut
    inside_ray = (along_ray > ray_share) & (along_ray < 1.0 - ray_share)
    inside_wall = (along_wall >= -wall_share) & (along_wall <= 1.0 + wall_share)
    return inside_ray & inside_wall


def blocked(origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Which targets do not see the origin (or each its own, [N, 2]) because some wall a -> b is between; bool [N]."""
    if len(a) == 0:
        return np.zeros(len(targets), bool)
    return np.asarray(crosses(origin, targets, a, b).any(axis=1))


def specular_points(origin: np.ndarray, targets: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Where one wall a -> b mirrors targets towards the origin; [N, 2] in metres, NaN where it does not.

    The law of reflection by the image method: the specular point is where the line from the origin to the target's
    image cuts the wall. Origin and target must stand on the same side, and the point must lie within the ends.
    """
    targets = np.asarray(targets, np.float64)
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    normal, offset_m = wall_from_ends(a, b, origin)
    height = targets @ normal + offset_m
    origin_height = float(np.asarray(origin) @ normal + offset_m)
    image = reflect(targets, normal, offset_m)
    _, along_wall = crossing_parameters(origin, image, a[None], b[None])
    share = along_wall[:, 0]
    seen = (height > 0.0) & (origin_height > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(seen[:, None], a + share[:, None] * (b - a), np.nan)


def segment_distance_m(points_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of points [N, 2] from segments a -> b [W, 2]; [N, W]."""
    along = b - a
    from_a = points_m[:, None] - a
    share = np.sum(from_a * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-12)
    return np.linalg.norm(from_a - np.clip(share, 0.0, 1.0)[..., None] * along, axis=-1)


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """z component of the cross product of plane vectors [..., 2]."""
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
