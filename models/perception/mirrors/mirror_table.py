"""Walls as mirrors: straight and curved segments (an arc is its tangent where a ray meets it), met by rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from models.physics.mirror import crosses, crossing_parameters
from msgs.values.array_table import ArrayTable
from msgs.values.perception import Wall

RADAR = np.zeros(2)
#: Wall index of an image that has none.
NO_WALL = -1
#: A place is of a wall within this of its line and ends.
OF_WALL_M = 0.8


@dataclass(frozen=True)
class WallArrays(ArrayTable):
    """Walls as arrays [W]: chord normals, offsets, ends a and b, errors, curvatures (positive: hollow to the radar)."""

    normal: np.ndarray
    offset_m: np.ndarray
    a: np.ndarray
    b: np.ndarray
    angle_std_rad: np.ndarray
    offset_std_m: np.ndarray
    curvature_per_m: np.ndarray

    @cached_property
    def length_m(self) -> np.ndarray:
        """Lengths of the chords [W]."""
        return np.linalg.norm(self.b - self.a, axis=1)

    def distance_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return the signed distances [N, W] of points [N, 2] from each chord, positive on the radar's side."""
        return points_m @ self.normal.T + self.offset_m

    def trimmed(self, trim_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends drawn in by `trim_m`, by a quarter of the wall at most: the certain part of the wall."""
        length_m = np.maximum(self.length_m, 1e-9)[:, None]
        inward = np.minimum(trim_m / length_m, 0.25) * (self.b - self.a)
        return self.a + inward, self.b - inward


@dataclass(frozen=True)
class Hits:
    """Intersections of rays with walls: shares of ray and chord, NaN for none [N, W]; the tangent mirror there."""

    along_ray: np.ndarray
    along_wall: np.ndarray
    #: Unit normals [N, W, 2] and offsets [N, W].
    normal: np.ndarray
    offset_m: np.ndarray

    def missed_m(self, length_m: np.ndarray) -> np.ndarray:
        """Return the distance [N, W] beyond the ends of chords of `length_m` [W] of each hit; infinite: none."""
        share = np.maximum(np.maximum(-self.along_wall, self.along_wall - 1.0), 0.0)
        return np.where(np.isnan(share), np.inf, share * length_m)

    def mirrors(self, wall: np.ndarray, walls: WallArrays) -> tuple[np.ndarray, np.ndarray]:
        """Return normals [N, 2] and offsets [N] of mirrors that rays meet in walls [N]; of a missed arc its chord."""
        row = np.arange(len(wall))
        meets = ~np.isnan(self.along_ray[row, wall])
        normal = np.where(meets[:, None], self.normal[row, wall], walls.normal[wall])
        return normal, np.where(meets, self.offset_m[row, wall], walls.offset_m[wall])


def wall_arrays(walls: list[Wall]) -> WallArrays:
    """Return the walls side by side as arrays."""
    return WallArrays(
        normal=np.array([wall.normal for wall in walls], np.float64).reshape(-1, 2),
        offset_m=np.array([wall.offset_m for wall in walls], np.float64),
        a=np.array([wall.ends_m[0] for wall in walls], np.float64).reshape(-1, 2),
        b=np.array([wall.ends_m[1] for wall in walls], np.float64).reshape(-1, 2),
        angle_std_rad=np.array([wall.angle_std_rad for wall in walls], np.float64),
        offset_std_m=np.array([wall.offset_std_m for wall in walls], np.float64),
        curvature_per_m=np.array([wall.curvature_per_m for wall in walls], np.float64),
    )


def hits(origin: np.ndarray, targets: np.ndarray, walls: WallArrays) -> Hits:
    """Intersect rays from `origin` ([2] or [N, 2]) towards `targets` [N, 2] with each wall's line or arc."""
    along_ray, along_wall = crossing_parameters(origin, targets, walls.a, walls.b)
    shape = along_ray.shape
    normal = np.broadcast_to(walls.normal, (*shape, 2)).copy()
    offset_m = np.broadcast_to(walls.offset_m, shape).copy()
    for index in np.flatnonzero(walls.curvature_per_m):
        wall = walls.take(np.array([index]))
        ray_share, hit_m, normal[:, index] = _on_arc(origin, targets, along_ray[:, index], wall)
        chord = wall.b[0] - wall.a[0]
        along_ray[:, index], along_wall[:, index] = ray_share, (hit_m - wall.a[0]) @ chord / (chord @ chord)
        offset_m[:, index] = -np.sum(normal[:, index] * hit_m, axis=1)
    return Hits(along_ray, along_wall, normal, offset_m)


def _on_arc(
    origin: np.ndarray, targets: np.ndarray, near: np.ndarray, wall: WallArrays
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the share of the rays and point where they meet the circle nearest to `near` on the chord; its normal.

    NaN: never. From the chord's middle k (s^2 + d^2 - h^2) = 2 d sqrt(1 - k^2 h^2): no centre at infinity.
    """
    curvature, half_m = wall.curvature_per_m[0], 0.5 * wall.length_m[0]
    rise = np.sqrt(max(1.0 - (curvature * half_m) ** 2, 0.0))
    middle, normal = 0.5 * (wall.a[0] + wall.b[0]), wall.normal[0]
    start = np.broadcast_to(origin, targets.shape) - middle
    ray = targets - middle - start
    second = curvature * np.sum(ray**2, axis=1)
    first = curvature * np.sum(start * ray, axis=1) - rise * (ray @ normal)
    constant = curvature * (np.sum(start**2, axis=1) - half_m**2) - 2.0 * rise * (start @ normal)
    root = first**2 - second * constant
    # of the same sign as the term it is added to: neither root is a difference of like numbers
    away = -first - np.copysign(np.sqrt(np.where(root >= 0.0, root, np.nan)), first)
    shares = np.stack([_quotient(constant, away), _quotient(away, second)])
    nearest = np.nan_to_num(np.abs(shares - near), nan=np.inf).argmin(axis=0)
    share = shares[nearest, np.arange(len(targets))]
    at = start + share[:, None] * ray
    return share, middle + at, rise * normal - curvature * at


def _quotient(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Return the quotients [N], NaN where they would be larger than any share along a ray."""
    fits = np.abs(below) > 1e-12 * np.abs(above)
    return np.where(fits, above / np.where(fits, below, 1.0), np.nan)


def mirrors_met(images_m: np.ndarray, wall: np.ndarray, walls: WallArrays) -> tuple[np.ndarray, np.ndarray]:
    """Return normals [N, 2] and offsets [N] of the mirrors that walls [N] are to rays towards images [N, 2]."""
    return hits(RADAR, images_m, walls).mirrors(wall, walls)


def behind(points_m: np.ndarray, normal: np.ndarray, offset_m: np.ndarray) -> np.ndarray:
    """Return the depth of points [..., 2] behind mirrors, positive there."""
    return -(np.sum(points_m * normal, axis=-1) + offset_m)


def behind_walls(points_m: np.ndarray, walls: WallArrays, depth_m: float) -> np.ndarray:
    """Return whether a wall hides points [N, 2] that lie more than `depth_m` behind it from the radar; bool [N]."""
    if len(walls) == 0:
        return np.zeros(len(points_m), bool)
    blocked = crosses(RADAR, points_m, walls.a, walls.b) & (walls.distance_m(points_m) < -depth_m)
    return np.logical_or.reduce(blocked, axis=1)


def nearest_walls(points_m: np.ndarray, walls: WallArrays) -> np.ndarray:
    """Return the nearest wall within reach of each point [N, 2], -1 for none, int64 [N]."""
    if not len(walls):
        return np.full(len(points_m), -1)
    chord = (walls.b - walls.a) / np.maximum(walls.length_m, 1e-9)[:, None]
    along_m = points_m @ chord.T - np.sum(walls.a * chord, axis=1)
    beyond_m = np.maximum(np.maximum(-along_m, along_m - walls.length_m), 0.0)
    off_m = np.where(beyond_m < OF_WALL_M, np.abs(walls.distance_m(points_m)), np.inf)
    nearest = off_m.argmin(axis=1)
    return np.where(off_m[np.arange(len(nearest)), nearest] < OF_WALL_M, nearest, -1)
