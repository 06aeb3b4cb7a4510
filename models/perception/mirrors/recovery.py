"""Recovery of true positions from mirror images: Eq. (19) for one wall, two walls and curved ones, with covariance.

`models.perception.mirrors.image_walls` selects the wall, `models.perception.mirrors.rejection` the hidden positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from models.perception.mirrors.clustering import NOISE
from models.perception.mirrors.image_walls import (
    DirectReturns,
    RecoveryParams,
    associate_buddy,
    associate_crossing,
    facing_radar,
    nearest_in_angle,
    seen_through,
)
from models.perception.mirrors.mirror_table import NO_WALL, WallArrays, hits, wall_arrays
from models.physics.mirror import reflect
from msgs.values.array_table import ArrayTable
from msgs.values.frames import xy_from_polar
from msgs.values.perception import HiddenPoint, PathClass, Peaks, Wall


@dataclass(frozen=True)
class Recovered(ArrayTable):
    """Images folded back: true and apparent positions [N, 2], with all data that objects are formed from.

    A position's covariance is the image's own error and the wall's, common to all points of one wall.
    """

    points_m: np.ndarray
    images_m: np.ndarray
    image_covariance_m2: np.ndarray
    wall_covariance_m2: np.ndarray
    wall: np.ndarray
    #: Second mirror of images by two walls, `NO_WALL` for the others.
    second: np.ndarray
    score: np.ndarray
    snr_db: np.ndarray
    stamp_ns: np.ndarray
    #: Over ground, of the image; NaN where not measured.
    radial_speed_mps: np.ndarray

    @property
    def covariance_m2(self) -> np.ndarray:
        """Covariance of each position [N, 2, 2], positive definite."""
        return self.image_covariance_m2 + self.wall_covariance_m2

    @property
    def largest_std_m(self) -> np.ndarray:
        """Standard deviation of each position along the worst direction [N]."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance_m2)[:, 1]))

    def as_hidden_points(self) -> tuple[HiddenPoint, ...]:
        """Return the message values."""
        rows = zip(self.points_m.tolist(), self.images_m.tolist(), self.score.tolist(), self.wall.tolist(), strict=True)
        return tuple(
            HiddenPoint(x_m=x, y_m=y, score=score, image_x_m=image_x, image_y_m=image_y, wall=wall)
            for (x, y), (image_x, image_y), score, wall in rows
        )


@dataclass(frozen=True)
class ReflectionState:
    """Inputs of ResidualReflectNet: images [N, 2], their K nearest direct returns, state (o', n, b, eta) [N, 6]."""

    images_m: np.ndarray
    patch_m: np.ndarray
    state: np.ndarray


#: Direct returns in a patch (section 3.3).
NEIGHBOURS = 16
#: Learned correction of folded positions: offsets [N, 2] in metres, Eq. (18).
Residual = Callable[[ReflectionState], np.ndarray]


def cartesian_covariance(range_m: np.ndarray, azimuth_rad: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the covariances [N, 2, 2] in metres of polar ones (range [m], azimuth [rad]): J C J'."""
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
        first, second = associate_crossing(points_m, np.sqrt(polar[:, 1, 1]), arrays, params, opaque)
    else:
        arrays, first = associate_buddy(points_m, arrays, returns)
        second = np.full(len(first), NO_WALL)
    used = np.flatnonzero(first != NO_WALL)
    covariance = cartesian_covariance(range_m, azimuth_rad, polar)
    positions = folded(points_m[used], covariance[used], arrays, first[used], second[used])
    index = mirrored[used]
    return Recovered(
        points_m=positions.points_m,
        images_m=points_m[used],
        image_covariance_m2=positions.own_m2,
        wall_covariance_m2=positions.common_m2,
        wall=np.where(first[used] < len(walls), first[used], NO_WALL),
        second=second[used],
        score=images.score[index],
        snr_db=images.snr_db[index],
        stamp_ns=images.peak_stamp_ns[index],
        radial_speed_mps=np.full(len(index), np.nan)
        if images.radial_speed_mps is None
        else images.radial_speed_mps[index],
    )


@dataclass(frozen=True)
class Folded:
    """Folded positions [N, 2] and the covariances [N, 2, 2] from the images' own errors and from the walls'."""

    points_m: np.ndarray
    own_m2: np.ndarray
    common_m2: np.ndarray


def folded(
    points_m: np.ndarray, covariance_m2: np.ndarray, arrays: WallArrays, first: np.ndarray, second: np.ndarray
) -> Folded:
    """Fold images [N, 2] about their first wall and, where there is one, their second; Eq. (19) for each."""
    if len(points_m) == 0:
        return Folded(points_m, covariance_m2, covariance_m2)
    start = np.zeros_like(points_m)
    once, turn_m = _fold(start, Folded(points_m, covariance_m2, np.zeros_like(covariance_m2)), arrays, first)
    again = np.flatnonzero(second != NO_WALL)
    if len(again):
        part = Folded(once.points_m[again], once.own_m2[again], once.common_m2[again])
        twice, _ = _fold(turn_m[again], part, arrays, second[again])
        once.points_m[again], once.own_m2[again], once.common_m2[again] = twice.points_m, twice.own_m2, twice.common_m2
    return once


def _fold(origin_m: np.ndarray, apparent: Folded, arrays: WallArrays, wall: np.ndarray) -> tuple[Folded, np.ndarray]:
    """Fold apparent points seen from `origin_m` [N, 2] about the mirror that each ray meets; also return where it meets
    it.

    o = p - 2 d n with d = n.(p - m) - e for a wall through m. The image's own part is A C A' with A = I - 2 n n' for
    straight walls. A turn of the wall about its middle by delta moves o by -2 [(t.(p - m)) n + d t] delta, a shift e
    along n by 2 n e. On an arc of curvature k the ray's own turn by dtheta meets a normal turned by
    -k rho dtheta / (u.n), rho the distance to the wall along the ray's direction u.
    """
    met = hits(origin_m, apparent.points_m, arrays)
    ray_share = np.nan_to_num(met.along_ray[np.arange(len(wall)), wall])
    normal, offset_m = met.mirrors(wall, arrays)
    ray = apparent.points_m - origin_m
    turn_m = origin_m + ray_share[:, None] * ray
    mirror = np.eye(2) - 2.0 * normal[:, :, None] * normal[:, None, :]
    # the normal turns with the ray's direction: across = change of that direction with the image's position
    length_m = np.maximum(np.hypot(ray[:, 0], ray[:, 1]), 1e-9)
    across = np.stack([-ray[:, 1], ray[:, 0]], axis=1) / length_m[:, None] ** 2
    slant = np.minimum(np.sum(ray * normal, axis=1) / length_m, -0.05)
    bend = -arrays.curvature_per_m[wall] * ray_share * length_m / slant
    moved = mirror + (bend[:, None] * _turned(apparent.points_m - turn_m, normal))[:, :, None] * across[:, None, :]
    own = moved @ apparent.own_m2 @ moved.transpose(0, 2, 1)
    common = mirror @ apparent.common_m2 @ mirror + _wall_part(apparent.points_m, normal, arrays, wall)
    return Folded(reflect(apparent.points_m, normal, offset_m), own, common), turn_m


def _turned(from_pivot_m: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the derivative of folded positions [N, 2] by the turn of their mirrors about a point [m/rad]; [N, 2]."""
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    height = np.sum(normal * from_pivot_m, axis=1)[:, None]
    reach = np.sum(tangent * from_pivot_m, axis=1)[:, None]
    return -2.0 * (reach * normal + height * tangent)


def _wall_part(points_m: np.ndarray, normal: np.ndarray, arrays: WallArrays, wall: np.ndarray) -> np.ndarray:
    """Return the covariance [N, 2, 2] that the errors of their walls give folded positions."""
    turn = _turned(points_m - 0.5 * (arrays.a + arrays.b)[wall], normal) * arrays.angle_std_rad[wall][:, None]
    shift = 2.0 * normal * arrays.offset_std_m[wall][:, None]
    return np.asarray(turn[:, :, None] * turn[:, None, :] + shift[:, :, None] * shift[:, None, :])


def reflection_state(recovered: Recovered, walls: list[Wall], returns: DirectReturns) -> ReflectionState:
    """Return the inputs of ResidualReflectNet: direct returns nearest to each image's buddy in its cluster, its state.

    Patches are padded by the buddy; of one in no cluster (eta = 1) it stands alone.
    """
    count = len(recovered)
    patch_m = np.zeros((count, NEIGHBOURS, 2))
    state = np.zeros((count, 6))
    if count == 0:
        return ReflectionState(recovered.images_m, patch_m, state)
    buddy = nearest_in_angle(recovered.images_m, returns.points_m)
    for i, image_m in enumerate(recovered.images_m):
        patch_m[i] = returns.points_m[buddy[i]]
        cluster = returns.cluster[buddy[i]]
        if cluster != NOISE:
            points_m = returns.points_m[returns.cluster == cluster]
            order = np.argsort(np.sum((points_m - image_m) ** 2, axis=1), kind="stable")[:NEIGHBOURS]
            patch_m[i, : len(order)] = points_m[order]
    without_wall = recovered.wall == NO_WALL
    arrays = wall_arrays(walls)
    own = returns.points_m[buddy]
    normal, offset_m = facing_radar(own)
    on_wall = ~without_wall
    normal[on_wall], offset_m[on_wall] = (
        arrays.normal[recovered.wall[on_wall]],
        arrays.offset_m[recovered.wall[on_wall]],
    )
    state[:] = np.column_stack([recovered.images_m, normal, offset_m, without_wall])
    return ReflectionState(recovered.images_m, patch_m, state)


def corrected(recovered: Recovered, offsets_m: np.ndarray) -> Recovered:
    """Return the folded positions plus a learned residual, Eq. (18)."""
    return replace(recovered, points_m=recovered.points_m + offsets_m)
