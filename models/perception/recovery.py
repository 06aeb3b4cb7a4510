"""From mirror images to true places: which wall an image belongs to, Eq. (19), its covariance, and what is hidden.

An image is the echo of something in front of a wall, seen behind it. Its wall is the one its own ray passes through;
folding it back in that wall gives the place it stands. A folded place counts as hidden unless what is seen directly
explains it: it lies on a wall, at a direct return, on the far side of a visible object, or at an object in plain sight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np

from models.perception.clustering import NOISE, dbscan, fits_box
from models.physics.mirror import crosses, crossing_parameters, reflect, segment_distance_m
from msgs.arrays import require_positive
from msgs.frames import polar_from_xy, xy_from_polar
from msgs.perception import HiddenPoint, PathClass, Peaks, Wall

RADAR = np.zeros(2)
#: Wall index of an image whose nearest direct return belongs to no wall (published fallback, eta = 1).
NO_WALL = -1


class RecoveryParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How images find their wall and which folded places count as hidden."""

    #: `crossing`: the wall the image's own ray passes through. `buddy`: that of the direct return nearest in angle.
    association: Literal["crossing", "buddy"] = "crossing"
    #: An image stands at least this far behind its wall.
    min_depth_m: float = 1.0
    #: Walls reach this much further than their outermost return, and by two sigma of where the ray meets them.
    end_margin_m: float = 1.0
    max_margin_m: float = 4.0
    #: A path is cut by a wall it passes by more than this.
    cut_depth_m: float = 1.0
    #: A wall with this many returns of a long wall behind it hides nothing and mirrors nothing.
    seen_through_points: int = 3
    #: Places this near a wall or a direct return are that wall or return.
    same_place_m: float = 1.0
    #: Direct returns count as the same thing if at most this much weaker than the image.
    comparable_db: float = 6.0
    #: What is one vehicle: direct returns this near each other, and all that fits in a box of this size with them.
    vehicle_eps_m: float = 2.5
    vehicle_length_m: float = 5.5
    vehicle_width_m: float = 2.6

    def __post_init__(self) -> None:
        for name in ("min_depth_m", "max_margin_m", "cut_depth_m", "same_place_m", "vehicle_eps_m"):
            require_positive(f"recovery.{name}", getattr(self, name))


@dataclass(frozen=True)
class WallArrays:
    """Walls as arrays: normals [W, 2], offsets [W], ends a and b [W, 2], uncertainties [W]."""

    normal: np.ndarray
    offset_m: np.ndarray
    a: np.ndarray
    b: np.ndarray
    angle_std_rad: np.ndarray
    offset_std_m: np.ndarray

    def __len__(self) -> int:
        return len(self.offset_m)

    @property
    def length_m(self) -> np.ndarray:
        """Lengths of the segments [W]."""
        return np.linalg.norm(self.b - self.a, axis=1)

    def select(self, keep: np.ndarray) -> WallArrays:
        """The walls of a mask or an index."""
        return WallArrays(**{name: getattr(self, name)[keep] for name in self.__dataclass_fields__})

    def distance_m(self, points_m: np.ndarray) -> np.ndarray:
        """Signed distance of points [N, 2] from each wall's line, positive on the radar's side; [N, W]."""
        return points_m @ self.normal.T + self.offset_m

    def trimmed(self, trim_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Ends drawn in by `trim_m`, by a quarter of the wall at most: what surely is wall."""
        length_m = np.maximum(self.length_m, 1e-9)[:, None]
        inward = np.minimum(trim_m / length_m, 0.25) * (self.b - self.a)
        return self.a + inward, self.b - inward


@dataclass(frozen=True)
class DirectReturns:
    """Direct returns of a scan: points [N, 2], power over noise [N], cluster and wall of each (-1: none) [N]."""

    points_m: np.ndarray
    snr_db: np.ndarray
    cluster: np.ndarray
    wall: np.ndarray


@dataclass(frozen=True)
class Recovered:
    """Images folded back: true places and where they appeared [N, 2], with all that objects are formed from.

    The covariance [N, 2, 2] of a place comes from the image's own error and, common to all points of one wall, from
    the wall's.
    """

    points_m: np.ndarray
    images_m: np.ndarray
    image_covariance_m2: np.ndarray
    wall_covariance_m2: np.ndarray
    wall: np.ndarray
    score: np.ndarray
    snr_db: np.ndarray
    stamp_ns: np.ndarray

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def covariance_m2(self) -> np.ndarray:
        """Covariance of each place [N, 2, 2], positive definite."""
        return self.image_covariance_m2 + self.wall_covariance_m2

    def select(self, keep: np.ndarray) -> Recovered:
        """The points of a mask or an index."""
        return Recovered(**{name: getattr(self, name)[keep] for name in self.__dataclass_fields__})

    def as_hidden_points(self) -> tuple[HiddenPoint, ...]:
        """The values that travel."""
        rows = zip(self.points_m.tolist(), self.images_m.tolist(), self.score.tolist(), self.wall.tolist(), strict=True)
        return tuple(
            HiddenPoint(x_m=x, y_m=y, score=score, image_x_m=image_x, image_y_m=image_y, wall=wall)
            for (x, y), (image_x, image_y), score, wall in rows
        )


@dataclass(frozen=True)
class ReflectionState:
    """What ResidualReflectNet sees: images [N, 2], their K nearest direct returns [N, K, 2] and state [N, 6].

    The state is (o', n, b, eta) of section 3.1.2.
    """

    images_m: np.ndarray
    patch_m: np.ndarray
    state: np.ndarray


#: A learned correction of folded places: offsets [N, 2] in metres, Eq. (18).
Residual = Callable[[ReflectionState], np.ndarray]


def wall_arrays(walls: list[Wall]) -> WallArrays:
    """Walls side by side as arrays."""
    return WallArrays(
        normal=np.array([wall.normal for wall in walls], np.float64).reshape(-1, 2),
        offset_m=np.array([wall.offset_m for wall in walls], np.float64),
        a=np.array([wall.ends_m[0] for wall in walls], np.float64).reshape(-1, 2),
        b=np.array([wall.ends_m[1] for wall in walls], np.float64).reshape(-1, 2),
        angle_std_rad=np.array([wall.angle_std_rad for wall in walls], np.float64),
        offset_std_m=np.array([wall.offset_std_m for wall in walls], np.float64),
    )


def cartesian_covariance(range_m: np.ndarray, azimuth_rad: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariances [N, 2, 2] in metres of polar ones (range [m], azimuth [rad]): J C J'."""
    cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
    jacobian = np.stack([np.stack([cos, -range_m * sin], -1), np.stack([sin, range_m * cos], -1)], -2)
    return jacobian @ covariance @ jacobian.transpose(0, 2, 1)


def recover(images: Peaks, walls: list[Wall], returns: DirectReturns, params: RecoveryParams) -> Recovered:
    """Fold the mirrored peaks back through their walls, Eq. (19); peaks without a wall are left out."""
    mirrored = np.flatnonzero(images.path_class == PathClass.MIRRORED)
    range_m, azimuth_rad = images.range_m[mirrored], images.azimuth_rad[mirrored]
    points_m = xy_from_polar(range_m, azimuth_rad)
    polar = images.covariance[mirrored]
    arrays = wall_arrays(walls)
    if params.association == "crossing":
        opaque = ~seen_through(arrays, returns, params)
        wall = associate_crossing(points_m, np.sqrt(polar[:, 1, 1]), arrays, params, opaque)
        used = np.flatnonzero(wall != NO_WALL)
    else:
        arrays, wall = associate_buddy(points_m, arrays, returns)
        used = np.arange(len(wall)) if len(returns.points_m) else np.arange(0)
    covariance = cartesian_covariance(range_m, azimuth_rad, polar)
    return _folded(images, mirrored[used], points_m[used], covariance[used], arrays, wall[used], len(walls))


def _folded(
    images: Peaks,
    index: np.ndarray,
    points_m: np.ndarray,
    covariance_m2: np.ndarray,
    arrays: WallArrays,
    wall: np.ndarray,
    wall_count: int,
) -> Recovered:
    """Eq. (19) and its covariance for images that have found their wall."""
    normal, offset_m = arrays.normal[wall], arrays.offset_m[wall]
    own, common = fold_covariance(points_m, covariance_m2, arrays, wall)
    return Recovered(
        points_m=reflect(points_m, normal, offset_m),
        images_m=points_m,
        image_covariance_m2=own,
        wall_covariance_m2=common,
        wall=np.where(wall < wall_count, wall, NO_WALL),
        score=images.score[index],
        snr_db=images.snr_db[index],
        stamp_ns=images.peak_stamp_ns[index],
    )


def fold_covariance(
    points_m: np.ndarray, covariance_m2: np.ndarray, arrays: WallArrays, wall: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances [N, 2, 2] of folded places: from the images' own errors, and from their walls'.

    o = p - 2 d n with d = n.(p - m) - e for a wall through m. Its own part is M C M with M = I - 2 n n'; a turn of
    the wall about its middle by delta moves o by -2 [(t.(p - m)) n + d t] delta, a shift e along n by 2 n e.
    """
    normal = arrays.normal[wall]
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    mirror = np.eye(2) - 2.0 * normal[:, :, None] * normal[:, None, :]
    own = mirror @ covariance_m2 @ mirror
    from_middle = points_m - 0.5 * (arrays.a + arrays.b)[wall]
    height = np.sum(normal * from_middle, axis=1)[:, None]
    reach = np.sum(tangent * from_middle, axis=1)[:, None]
    turn = 2.0 * (reach * normal + height * tangent) * arrays.angle_std_rad[wall][:, None]
    shift = 2.0 * normal * arrays.offset_std_m[wall][:, None]
    common = turn[:, :, None] * turn[:, None, :] + shift[:, :, None] * shift[:, None, :]
    return own, common


def seen_through(walls: WallArrays, returns: DirectReturns, params: RecoveryParams) -> np.ndarray:
    """Which walls have `seen_through_points` returns of another one, longer than a vehicle, behind them; bool [W].

    What is seen behind a line proves that the line is no wall: a row of vehicles, or a wall drawn too long.
    """
    transparent = np.zeros(len(walls), bool)
    on_long = np.flatnonzero(np.append(walls.length_m > params.vehicle_length_m, False)[returns.wall])
    if len(walls) == 0 or len(on_long) == 0:
        return transparent
    points_m = returns.points_m[on_long]
    a, b = walls.trimmed(params.end_margin_m)
    behind = crosses(RADAR, points_m, a, b) & (walls.distance_m(points_m) < -params.cut_depth_m)  # [N, W]
    for other in np.unique(returns.wall[on_long]):
        counts = behind[returns.wall[on_long] == other].sum(axis=0)
        transparent |= counts >= params.seen_through_points
    return transparent


def associate_crossing(
    images_m: np.ndarray,
    azimuth_std_rad: np.ndarray,
    walls: WallArrays,
    params: RecoveryParams,
    opaque: np.ndarray | None = None,
) -> np.ndarray:
    """Wall of each image [N]: the last one its ray passes through, `NO_WALL` for none.

    The image must stand behind the wall, and no other wall may cut the way from the radar to the wall or from there
    to the true place. Rays that pass just off a wall's end count by a margin that grows with the angular error;
    a wall truly passed comes before one narrowly missed. Of several passed the last is the mirror: that its returns
    came at all shows that the nearer ones do not reach this far. Walls that are not `opaque` [W] count for nothing.
    """
    if len(walls) == 0 or len(images_m) == 0:
        return np.full(len(images_m), NO_WALL)
    along_ray, along_wall = crossing_parameters(RADAR, images_m, walls.a, walls.b)  # [N, W]
    along_ray, along_wall = np.nan_to_num(along_ray, nan=-1.0), np.nan_to_num(along_wall, nan=-1.0)
    range_m, _ = polar_from_xy(images_m)
    to_wall_m = along_ray * range_m[:, None]
    incidence = np.abs(images_m @ walls.normal.T) / np.maximum(range_m, 1e-9)[:, None]
    sideways_m = to_wall_m * azimuth_std_rad[:, None] / np.maximum(incidence, 0.1)
    margin_m = np.minimum(params.end_margin_m + 2.0 * sideways_m, params.max_margin_m)
    missed_m = np.maximum(np.maximum(-along_wall, along_wall - 1.0), 0.0) * walls.length_m
    possible = (
        (walls.distance_m(images_m) < -params.min_depth_m)
        & (along_ray > 0.0)
        & (along_ray < 1.0)
        & (missed_m <= margin_m)
    )
    opaque = np.ones(len(walls), bool) if opaque is None else opaque
    possible &= opaque & ~_cut_paths(images_m, along_ray, walls, opaque, params)
    # the sides of vehicles are poor mirrors: only where nothing longer offers itself
    later = 1e3 * (missed_m > 0.0) + 2e3 * (walls.length_m <= params.vehicle_length_m)
    cost = np.where(possible, later + missed_m - to_wall_m, np.inf)
    chosen = cost.argmin(axis=1)
    return np.where(np.isfinite(cost.min(axis=1)), chosen, NO_WALL)


def _cut_paths(
    images_m: np.ndarray, along_ray: np.ndarray, walls: WallArrays, opaque: np.ndarray, params: RecoveryParams
) -> np.ndarray:
    """Paths radar -> wall -> true place that a third wall cuts, for each image and wall; bool [N, W]."""
    shape = along_ray.shape
    mirror_m = (along_ray[..., None] * images_m[:, None]).reshape(-1, 2)  # where the ray meets the wall
    of_each_wall = np.broadcast_to(images_m[:, None], (*shape, 2))
    place_m = reflect(of_each_wall, walls.normal, walls.offset_m).reshape(-1, 2)
    a, b = walls.trimmed(params.end_margin_m)
    # a vehicle's side is too short to be sure that a path does not pass beside it
    long_enough = opaque & (walls.length_m > params.vehicle_length_m)
    cut = np.zeros((len(mirror_m), len(walls)), bool)
    for origin, end in ((RADAR, mirror_m), (mirror_m, place_m)):
        deep = (np.abs(walls.distance_m(end)) > params.cut_depth_m) & long_enough
        cut |= crosses(origin, end, a, b) & deep
    # the wall itself is where the path turns
    own = np.tile(np.eye(len(walls), dtype=bool), (shape[0], 1))
    return (cut & ~own).any(axis=1).reshape(shape)


def associate_buddy(images_m: np.ndarray, walls: WallArrays, returns: DirectReturns) -> tuple[WallArrays, np.ndarray]:
    """The published way: the wall of the direct return nearest in angle; walls and the index of each image's [N].

    A return on no wall stands for one of its own through it, normal along its ray; such walls are appended.
    """
    if len(returns.points_m) == 0:
        return walls, np.full(len(images_m), NO_WALL)
    buddy = nearest_in_angle(images_m, returns.points_m)
    wall = returns.wall[buddy]
    lonely = np.flatnonzero(wall == NO_WALL)
    points_m = returns.points_m[buddy[lonely]]
    range_m = np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-9)
    extended = WallArrays(
        normal=np.concatenate([walls.normal, -points_m / range_m[:, None]]),
        offset_m=np.concatenate([walls.offset_m, range_m]),
        a=np.concatenate([walls.a, points_m]),
        b=np.concatenate([walls.b, points_m]),
        angle_std_rad=np.concatenate([walls.angle_std_rad, np.full(len(lonely), math.radians(10.0))]),
        offset_std_m=np.concatenate([walls.offset_std_m, np.full(len(lonely), 0.1)]),
    )
    wall = wall.copy()
    wall[lonely] = len(walls) + np.arange(len(lonely))
    return extended, wall


def nearest_in_angle(images_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Index of the point [M, 2] whose polar angle is nearest to each image's [N]; ties: the first."""
    image_rad = np.arctan2(images_m[:, 1], images_m[:, 0])
    point_rad = np.arctan2(points_m[:, 1], points_m[:, 0])
    return np.abs(image_rad[:, None] - point_rad).argmin(axis=1)


def reflection_state(
    recovered: Recovered, walls: list[Wall], returns: DirectReturns, neighbours: int = 16
) -> ReflectionState:
    """Inputs of ResidualReflectNet: the nearest direct returns in the cluster of each image's buddy, and its state.

    Patches are padded by repeating the buddy; an image of a buddy in no cluster (eta = 1) has the buddy alone.
    """
    count = len(recovered)
    patch_m = np.zeros((count, neighbours, 2))
    state = np.zeros((count, 6))
    if count == 0:
        return ReflectionState(recovered.images_m, patch_m, state)
    buddy = nearest_in_angle(recovered.images_m, returns.points_m)
    for i, image_m in enumerate(recovered.images_m):
        patch_m[i] = returns.points_m[buddy[i]]
        cluster = returns.cluster[buddy[i]]
        if cluster != NOISE:
            points_m = returns.points_m[returns.cluster == cluster]
            order = np.argsort(np.sum((points_m - image_m) ** 2, axis=1), kind="stable")[:neighbours]
            patch_m[i, : len(order)] = points_m[order]
    lonely = recovered.wall == NO_WALL
    arrays = wall_arrays(walls)
    own = returns.points_m[buddy]
    normal, offset_m = -own / np.linalg.norm(own, axis=1, keepdims=True), np.linalg.norm(own, axis=1)
    on_wall = ~lonely
    normal[on_wall], offset_m[on_wall] = (
        arrays.normal[recovered.wall[on_wall]],
        arrays.offset_m[recovered.wall[on_wall]],
    )
    state[:] = np.column_stack([recovered.images_m, normal, offset_m, lonely])
    return ReflectionState(recovered.images_m, patch_m, state)


def corrected(recovered: Recovered, offsets_m: np.ndarray) -> Recovered:
    """Folded places plus a learned residual, Eq. (18)."""
    return replace(recovered, points_m=recovered.points_m + offsets_m)


def hidden_mask(recovered: Recovered, walls: list[Wall], returns: DirectReturns, params: RecoveryParams) -> np.ndarray:
    """Which folded places nothing in direct sight explains; bool [N].

    Explained are places on a wall, at a direct return of like strength, and those that fit in one vehicle with a
    group of direct returns of like strength: another side of a visible object, for objects are solid. A place in open
    view without any such return stays: what hides it need not have been seen.
    """
    arrays = wall_arrays(walls)
    explained = _on_wall(recovered.points_m, arrays, params.same_place_m)
    if len(returns.points_m):
        distance_m = np.linalg.norm(recovered.points_m[:, None] - returns.points_m, axis=-1)  # [N, M]
        alike = returns.snr_db >= recovered.snr_db[:, None] - params.comparable_db
        explained |= (alike & (distance_m <= params.same_place_m)).any(axis=1)
        explained |= _on_visible_vehicle(recovered, arrays, returns, params)
    return ~explained


def _on_visible_vehicle(
    recovered: Recovered, walls: WallArrays, returns: DirectReturns, params: RecoveryParams
) -> np.ndarray:
    """Places that are another side of a visible vehicle; bool [N].

    A visible vehicle is a group of direct returns off the long walls that fits in its box. A place belongs to it if
    it fits in too, within its own error, and no long wall stands before it.
    """
    long_walls = walls.length_m > params.vehicle_length_m + 1.0
    loose = np.flatnonzero(~np.append(long_walls, False)[returns.wall])
    labels = dbscan(returns.points_m[loose], params.vehicle_eps_m, 2)
    sigma_m = np.sqrt(np.linalg.eigvalsh(recovered.image_covariance_m2)[:, 1])
    explained = np.zeros(len(recovered), bool)
    for label in range(int(labels.max(initial=NOISE)) + 1):
        group = _with_whole_walls(loose[labels == label], returns)
        points_m = returns.points_m[group]
        near = np.abs(recovered.points_m - points_m.mean(axis=0)).max(axis=1) <= 2.0 * params.vehicle_length_m
        near &= recovered.snr_db <= returns.snr_db[group].max() + params.comparable_db
        for i in np.flatnonzero(near & ~explained):
            together = np.vstack([points_m, recovered.points_m[i]])
            length_m, width_m = params.vehicle_length_m + sigma_m[i], params.vehicle_width_m + sigma_m[i]
            explained[i] = fits_box(together, length_m, width_m)
    return explained & ~behind_walls(recovered.points_m, walls.select(long_walls), params.cut_depth_m)


def _with_whole_walls(group: np.ndarray, returns: DirectReturns) -> np.ndarray:
    """The returns of a group and all others on its walls: a missed return does not make two things of one front."""
    walls = np.unique(returns.wall[group])
    return np.union1d(group, np.flatnonzero(np.isin(returns.wall, walls[walls != NO_WALL])))


def behind_walls(points_m: np.ndarray, walls: WallArrays, depth_m: float) -> np.ndarray:
    """Points [N, 2] the radar does not see because a wall, passed by more than `depth_m`, stands between; bool [N]."""
    if len(walls) == 0:
        return np.zeros(len(points_m), bool)
    cut = crosses(RADAR, points_m, walls.a, walls.b) & (walls.distance_m(points_m) < -depth_m)
    return np.logical_or.reduce(cut, axis=1)


def in_open_view(points_m: np.ndarray, walls: list[Wall], margin_m: float) -> np.ndarray:
    """Points [N, 2] that no wall hides, each lengthened by `margin_m` at both ends; bool [N]."""
    arrays = wall_arrays(walls)
    outward = margin_m * (arrays.b - arrays.a) / np.maximum(arrays.length_m, 1e-9)[:, None]
    longer = replace(arrays, a=arrays.a - outward, b=arrays.b + outward)
    return ~behind_walls(points_m, longer, 0.0)


def _on_wall(points_m: np.ndarray, walls: WallArrays, reach_m: float) -> np.ndarray:
    """Places within `reach_m` of a wall; bool [N]."""
    return np.logical_or.reduce(segment_distance_m(points_m, walls.a, walls.b) <= reach_m, axis=1)
