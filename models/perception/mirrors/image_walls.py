"""Association of images with the wall that mirrored them, or with two walls where a corner mirrored them twice.

The first mirror is a wall that the image's ray passes through; what blocks the folded rest is the second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from models.perception.mirrors.mirror_table import NO_WALL, RADAR, Hits, WallArrays, behind, hits
from models.physics.mirror import crosses, reflect
from msgs.values.arrays import require_positive
from msgs.values.frames import polar_from_xy

#: Least depth of an image behind its wall: nearer it is the wall itself.
MIN_DEPTH_M = 1.0
#: Walls reach this much further than their outermost return, and by two sigma of where the ray meets them.
END_MARGIN_M = 0.3
MAX_MARGIN_M = 4.0
#: The certain part of a wall ends this much before the outermost return.
TRIM_M = 1.0
#: A wall blocks a path that passes it by more than this: more than the error of either.
CUT_DEPTH_M = 1.0
#: A wall with this many returns of a long wall behind it hides nothing and mirrors nothing.
SEEN_THROUGH_POINTS = 3


class RecoveryParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the association of images with walls and of the rejection of folded positions."""

    #: `crossing`: the wall the image's own ray passes through. `buddy`: that of the direct return nearest in angle.
    association: Literal["crossing", "buddy"] = "crossing"
    #: Images that two walls mirrored are folded twice.
    second_order: bool = True
    #: Folded positions that neither a wall nor a vehicle hides form no objects: a sensor that detects their image
    #: detects themselves too.
    reject_in_open_view: bool = False
    #: Positions this near a wall or a direct return are that wall or return.
    same_place_m: float = 1.0
    #: Or so many standard deviations of the folded position further.
    same_place_sigmas: float = 0.0
    #: What moves does not explain what stands, nor the reverse: radial speeds over ground on either side of this.
    moving_mps: float | None = None
    #: One vehicle: all positions that fit in a box of this size.
    vehicle_length_m: float = 5.5
    vehicle_width_m: float = 2.6

    def __post_init__(self) -> None:
        require_positive("recovery.same_place_m", self.same_place_m)


@dataclass(frozen=True)
class DirectReturns:
    """Direct returns of a scan: points [N, 2], power over noise [N], cluster and wall of each (-1: none) [N]."""

    points_m: np.ndarray
    snr_db: np.ndarray
    cluster: np.ndarray
    wall: np.ndarray
    #: Radial speeds over ground [N], NaN where not measured; None: of none.
    radial_speed_mps: np.ndarray | None = None


def seen_through(walls: WallArrays, returns: DirectReturns, params: RecoveryParams) -> np.ndarray:
    """Return which walls have `SEEN_THROUGH_POINTS` returns of another one behind them, so are none; bool [W]."""
    transparent = np.zeros(len(walls), bool)
    on_long = np.flatnonzero(np.append(walls.length_m > params.vehicle_length_m, False)[returns.wall])
    if len(walls) == 0 or len(on_long) == 0:
        return transparent
    points_m = returns.points_m[on_long]
    a, b = walls.trimmed(TRIM_M)
    deep = crosses(RADAR, points_m, a, b) & (walls.distance_m(points_m) < -CUT_DEPTH_M)  # [N, W]
    for other in np.unique(returns.wall[on_long]):
        counts = deep[returns.wall[on_long] == other].sum(axis=0)
        transparent |= counts >= SEEN_THROUGH_POINTS
    return transparent


def associate_crossing(
    images_m: np.ndarray,
    azimuth_std_rad: np.ndarray,
    walls: WallArrays,
    params: RecoveryParams,
    opaque: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and second mirror of each image, each [N]; `NO_WALL` for none.

    The image lies behind the wall and both legs are free. Rays just off an end count by their angular error; of several
    crossed walls the last is the mirror. Walls that are not `opaque` [W] are ignored. A wall longer than a vehicle that
    blocks the second leg is the second mirror.
    """
    nothing = np.full(len(images_m), NO_WALL)
    if len(walls) == 0 or len(images_m) == 0:
        return nothing, nothing
    opaque = np.ones(len(walls), bool) if opaque is None else opaque
    crossings = RayWallCrossings.of(images_m, azimuth_std_rad, walls)
    missed_m, to_wall_m = crossings.missed_m, crossings.to_wall_m
    margin_m = np.minimum(END_MARGIN_M + 2.0 * crossings.sideways_m, MAX_MARGIN_M)
    possible = opaque & crossings.behind(MIN_DEPTH_M) & (missed_m <= margin_m)
    paths = _MirrorPaths.of(images_m, crossings.met, walls, opaque, params)
    possible &= ~paths.is_blocked(np.broadcast_to(RADAR, paths.mirror_m.shape), paths.mirror_m)
    whole = possible & ~paths.is_blocked(paths.mirror_m, paths.position_m)
    # the sides of vehicles are poor mirrors: used only where no longer wall fits
    preference = 1e3 * (missed_m > 0.0) + 2e3 * (walls.length_m <= params.vehicle_length_m) + missed_m - to_wall_m
    second = np.full(whole.shape, NO_WALL)
    if params.second_order:
        sure = (missed_m == 0.0) & (walls.length_m > params.vehicle_length_m)
        rows, columns = np.nonzero(possible & ~whole & sure)
        second[rows, columns] = paths.second(rows, columns)
    cost = np.where(whole, preference, np.where(second != NO_WALL, preference, np.inf))
    first = _cheapest(cost)
    return first, np.where(first == NO_WALL, NO_WALL, second[np.arange(len(first)), first])


def _cheapest(cost: np.ndarray) -> np.ndarray:
    """Return the index of the least finite cost in each row [N], `NO_WALL` where there is none."""
    return np.where(np.isfinite(cost.min(axis=1)), cost.argmin(axis=1), NO_WALL)


@dataclass(frozen=True)
class RayWallCrossings:
    """Crossings of the ray of each image with each wall or its line beyond the ends, arrays [N, W]."""

    met: Hits
    #: Distance beyond the wall's ends.
    missed_m: np.ndarray
    #: From the radar; NaN where they never meet.
    to_wall_m: np.ndarray
    #: One sigma of the crossing's position along the wall.
    sideways_m: np.ndarray
    #: Depth of the image behind the mirror.
    depth_m: np.ndarray

    @classmethod
    def of(cls, images_m: np.ndarray, azimuth_std_rad: np.ndarray, walls: WallArrays) -> RayWallCrossings:
        """Return the images [N, 2] in metres with their angular errors [N], and walls."""
        met = hits(RADAR, images_m, walls)
        range_m, _ = polar_from_xy(images_m)
        incidence = np.abs(np.einsum("ni,nwi->nw", images_m, met.normal)) / np.maximum(range_m, 1e-9)[:, None]
        to_wall_m = met.along_ray * range_m[:, None]
        return cls(
            met=met,
            missed_m=met.missed_m(walls.length_m),
            to_wall_m=to_wall_m,
            sideways_m=to_wall_m * azimuth_std_rad[:, None] / np.maximum(incidence, 0.1),
            depth_m=behind(images_m[:, None], met.normal, met.offset_m),
        )

    def behind(self, depth_m: float) -> np.ndarray:
        """Return whether the image lies over `depth_m` behind a wall that its ray crosses before it; bool [N, W]."""
        return (self.depth_m > depth_m) & (self.met.along_ray > 0.0) & (self.met.along_ray < 1.0)


@dataclass(frozen=True)
class _MirrorPaths:
    """Paths radar -> wall -> folded position of each image by each wall, [N, W, 2], and the walls that block."""

    mirror_m: np.ndarray
    position_m: np.ndarray
    walls: WallArrays
    opaque: np.ndarray
    params: RecoveryParams

    @classmethod
    def of(
        cls, images_m: np.ndarray, met: Hits, walls: WallArrays, opaque: np.ndarray, params: RecoveryParams
    ) -> _MirrorPaths:
        mirror_m = np.nan_to_num(met.along_ray)[..., None] * images_m[:, None]
        position_m = reflect(np.broadcast_to(images_m[:, None], mirror_m.shape), met.normal, met.offset_m)
        return cls(mirror_m, np.nan_to_num(position_m), walls, opaque, params)

    def is_blocked(self, origin_m: np.ndarray, end_m: np.ndarray) -> np.ndarray:
        """Return whether a wall other than their own blocks the segments [N, W, 2]; bool [N, W]."""
        own = np.broadcast_to(np.arange(len(self.walls)), origin_m.shape[:2]).ravel()
        cuts = self._blocked_by(origin_m.reshape(-1, 2), end_m.reshape(-1, 2), own)
        return np.asarray(cuts.any(axis=1)).reshape(origin_m.shape[:2])

    def _blocked_by(self, origin_m: np.ndarray, end_m: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return which walls longer than a vehicle block segments [M, 2] that touch the wall `own` [M]; bool [M, W]."""
        a, b = self.walls.trimmed(TRIM_M)
        sure = self.opaque & (self.walls.length_m > self.params.vehicle_length_m)
        deep = np.abs(self.walls.distance_m(end_m)) > CUT_DEPTH_M
        return crosses(origin_m, end_m, a, b) & deep & sure & (np.arange(len(self.walls)) != own[:, None])

    def second(self, image: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Return the second mirror of images [M] by their `first` [M]: the next wall on a path whose rest is free."""
        start, end = self.mirror_m[image, first], self.position_m[image, first]
        met = hits(start, end, self.walls)
        crossed = (met.along_ray > 1e-6) & (met.along_ray < 1.0) & (met.missed_m(self.walls.length_m) == 0.0)
        crossed &= self.opaque & (self.walls.length_m > self.params.vehicle_length_m)
        crossed &= behind(end[:, None], met.normal, met.offset_m) > MIN_DEPTH_M
        crossed &= np.arange(len(self.walls)) != first[:, None]
        nearest = _cheapest(np.where(crossed, met.along_ray, np.inf))
        row = np.arange(len(image))
        turn = start + np.nan_to_num(met.along_ray[row, nearest])[:, None] * (end - start)
        position = reflect(end, met.normal[row, nearest], met.offset_m[row, nearest])
        free = ~self._blocked_by(turn, np.nan_to_num(position), nearest).any(axis=1)
        return np.where(free, nearest, NO_WALL)


def associate_buddy(images_m: np.ndarray, walls: WallArrays, returns: DirectReturns) -> tuple[WallArrays, np.ndarray]:
    """Associate images with the wall of the direct return nearest in angle (published rule); walls, index [N].

    A return on no wall gets an own one, normal to its ray, which is appended.
    """
    if len(returns.points_m) == 0:
        return walls, np.full(len(images_m), NO_WALL)
    buddy = nearest_in_angle(images_m, returns.points_m)
    wall = returns.wall[buddy]
    unassigned = np.flatnonzero(wall == NO_WALL)
    points_m = returns.points_m[buddy[unassigned]]
    normal, offset_m = facing_radar(points_m)
    extended = WallArrays(
        normal=np.concatenate([walls.normal, normal]),
        offset_m=np.concatenate([walls.offset_m, offset_m]),
        a=np.concatenate([walls.a, points_m]),
        b=np.concatenate([walls.b, points_m]),
        angle_std_rad=np.concatenate([walls.angle_std_rad, np.full(len(unassigned), math.radians(10.0))]),
        offset_std_m=np.concatenate([walls.offset_std_m, np.full(len(unassigned), 0.1)]),
        curvature_per_m=np.concatenate([walls.curvature_per_m, np.zeros(len(unassigned))]),
    )
    wall = wall.copy()
    wall[unassigned] = len(walls) + np.arange(len(unassigned))
    return extended, wall


def facing_radar(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normals [N, 2] and offsets [N] of walls through points [N, 2], facing the radar; at the radar, back."""
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])
    away = np.where(range_m[:, None] > 0.0, points_m, [1.0, 0.0])
    return -away / np.hypot(away[:, 0], away[:, 1])[:, None], range_m


def nearest_in_angle(images_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Return the index of the point [M, 2] whose polar angle is nearest to each image's [N]; ties: the first."""
    image_rad = np.arctan2(images_m[:, 1], images_m[:, 0])
    point_rad = np.arctan2(points_m[:, 1], points_m[:, 0])
    apart_rad = np.abs(image_rad[:, None] - point_rad)
    # behind the radar angles jump by a turn
    return np.minimum(apart_rad, 2.0 * math.pi - apart_rad).argmin(axis=1)
