"""Ground truth from a LiDAR slice: direct points, points seen only in a wall, and the positions of their images.

Everything is in the plane, in the radar's frame with the radar at the origin. Walls are straight segments fitted
to the slice; everything else in it is an object, which hides all behind the hull of its points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial import cKDTree

from models.perception.mirrors.clustering import NOISE, dbscan
from models.perception.mirrors.walls import WallParams, find_walls
from models.physics.mirror import crosses, reflect, specular_points, wall_from_ends
from models.physics.plane import segment_distance_m

Segment = tuple[tuple[float, float], tuple[float, float]]
ORIGIN = np.zeros(2)
#: Maximum gap between points of one object, and maximum length of one; a longer cluster is hulled in pieces.
OBJECT_GAP_M, LONGEST_OBJECT_M, PIECE_M = 0.6, 15.0, 3.0
#: Within this distance before a point, sight is not blocked.
CLEARANCE_M = 0.3
#: Walls whose ends come this near form a corner.
CORNER_M = 0.6
#: The shortest side that counts as a wall if it turns the corner of one.
SHORT_SIDE_M = 1.2
#: Hypotheses of each search for a wall, and the share of a shortest wall's squares that must be filled.
WALL_ROUNDS, WALL_FILL = 600, 0.5
#: Distance of a wall's points from it, the largest gap in a wall, and the least height of one over the ground: above
#: cars and vans, below most walls.
INLIER_M, MAX_GAP_M, MIN_HEIGHT_M = 0.12, 2.0, 2.4
#: Points with fewer others within reach are stray, and farther ones are left out.
MIN_NEIGHBOURS, NEIGHBOUR_M, MAX_RANGE_M = 3, 0.5, 110.0


class SliceParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Labelled part of the cloud, and its resolution."""

    #: Height of the slice, half above the antenna and half below.
    thickness_m: Annotated[float, Meta(gt=0.0)] = 0.3
    #: One labelled point in a square of this size, the mean of its points.
    spacing_m: Annotated[float, Meta(gt=0.0)] = 0.2


class Disc(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A position in the plane and its surroundings."""

    x_m: float
    y_m: float
    radius_m: Annotated[float, Meta(gt=0.0)]


class WallRules(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Criteria of a wall in a slice: straight, long and tall. `given_m` adds walls by hand; points in `objects` are of
    an object, however straight."""

    min_length_m: Annotated[float, Meta(gt=0.0)] = 3.0
    given_m: tuple[Segment, ...] = ()
    objects: tuple[Disc, ...] = ()

    def __post_init__(self) -> None:
        for index, (a, b) in enumerate(self.given_m):
            if not math.dist(a, b) > INLIER_M:
                raise ValueError(f"walls.given_m[{index}] must be longer than {INLIER_M:g} m, got {a} to {b}")


class PointLabel(IntEnum):
    """Class of a point of the slice; a wall's point also says whether it is visible."""

    LOS = 0
    HIDDEN = 1
    WALL = 2


@dataclass(frozen=True, eq=False)
class SliceLabels:
    """N labelled points, W walls and K images, all in the radar's frame in the plane.

    `wall_of_point` [N] is -1 off walls. `image_m` [K, 2] is the mirror image of point `image_point` [K] in wall
    `image_wall` [K], seen on a path free of everything else.
    """

    points_m: np.ndarray
    visible: np.ndarray
    wall_of_point: np.ndarray
    walls_m: np.ndarray
    image_m: np.ndarray
    image_point: np.ndarray
    image_wall: np.ndarray
    #: Isolated points that were left out.
    stray: int = 0

    @property
    def label(self) -> np.ndarray:
        """`PointLabel` of each point [N]."""
        hidden = np.where(self.visible, PointLabel.LOS, PointLabel.HIDDEN)
        return np.where(self.wall_of_point >= 0, PointLabel.WALL, hidden)

    @property
    def los_m(self) -> np.ndarray:
        """All directly visible points, of walls and objects."""
        return self.points_m[self.visible]

    @property
    def wall_m(self) -> np.ndarray:
        """All points on walls, visible or not."""
        return self.points_m[self.wall_of_point >= 0]

    @property
    def hidden_m(self) -> np.ndarray:
        """Points of objects that are not directly visible."""
        return self.points_m[self.label == PointLabel.HIDDEN]


def cut_slice(cloud_m: np.ndarray, params: SliceParams) -> tuple[np.ndarray, int]:
    """Return points [M, 2] of a cloud [N, 3] about the antenna's height, one a square, and the number of stray ones.

    Raises ValueError if no point is left.
    """
    within = (np.abs(cloud_m[:, 2]) <= 0.5 * params.thickness_m) & (
        np.hypot(cloud_m[:, 0], cloud_m[:, 1]) <= MAX_RANGE_M
    )
    plan_m = cloud_m[within, :2]
    if len(plan_m) == 0:
        raise ValueError(
            f"cloud must hold points within {0.5 * params.thickness_m:g} m of the radar's height, has none"
        )
    neighbours = cKDTree(plan_m).query_ball_point(plan_m, NEIGHBOUR_M, return_length=True) - 1
    kept = plan_m[neighbours >= MIN_NEIGHBOURS]
    if len(kept) == 0:
        raise ValueError(f"slice must hold points with {MIN_NEIGHBOURS} others near, all {len(plan_m)} are stray")
    return thinned(kept, params.spacing_m), len(plan_m) - len(kept)


def thinned(points_m: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return the mean of the points [N, 2] in each square of a grid, [M, 2], in the order of the grid."""
    _, owner, count = np.unique(
        np.floor(points_m / spacing_m).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    sums = [np.bincount(owner.ravel(), weights=points_m[:, axis]) for axis in (0, 1)]
    return np.stack(sums, axis=1) / count[:, None]


def label_slice(
    cloud_m: np.ndarray, ground_z_m: float, slice_params: SliceParams, rules: WallRules, seed: int = 0
) -> SliceLabels:
    """Return labels of the slice of a cloud [N, 3] in the radar's frame; `ground_z_m` is relative to the antenna."""
    points_m, stray = cut_slice(cloud_m, slice_params)
    walls_m, wall_of_point = fit_walls(points_m, cloud_m, ground_z_m, slice_params.spacing_m, rules, seed)
    free = np.flatnonzero(wall_of_point < 0)
    cluster = dbscan(points_m[free], OBJECT_GAP_M, 3)
    keep = np.ones(len(points_m), bool)
    keep[free[cluster == NOISE]] = False
    edges_m = _hull_edges(points_m[free], cluster)
    points_m, wall_of_point = points_m[keep], wall_of_point[keep]
    visible = in_sight(np.zeros_like(points_m), points_m, wall_of_point, walls_m, edges_m)
    labels = SliceLabels(
        points_m, visible, wall_of_point, walls_m, np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int),
        stray + int(np.count_nonzero(~keep)),
    )  # fmt: skip
    return _with_images(labels, edges_m)


def fit_walls(
    points_m: np.ndarray, cloud_m: np.ndarray, ground_z_m: float, spacing_m: float, rules: WallRules, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return ends [W, 2, 2] of the walls in a slice [N, 2], corners closed, and each point's wall [N] (-1: none)."""
    free = np.ones(len(points_m), bool)
    for disc in rules.objects:
        free &= np.hypot(*(points_m - [disc.x_m, disc.y_m]).T) > disc.radius_m
    candidates = points_m[free]
    walls_m = np.array(rules.given_m, np.float64).reshape(-1, 2, 2)
    # the ends of a container are shorter than any isolated wall: they count if they turn a wall's corner
    for min_length_m in (rules.min_length_m, min(SHORT_SIDE_M, rules.min_length_m)):
        remaining = candidates[_nearest_wall(candidates, walls_m) < 0]
        pieces = _straight(remaining, min_length_m, spacing_m, seed)
        tall = [_height_m(cloud_m, ends) - ground_z_m >= MIN_HEIGHT_M for ends in pieces]
        at_corner = [min_length_m == rules.min_length_m or _turns_corner(ends, walls_m) for ends in pieces]
        walls_m = np.concatenate([walls_m, pieces[np.array(tall, bool) & np.array(at_corner, bool)]])
    walls_m = _corners_closed(walls_m)
    wall_of_point = np.full(len(points_m), -1, np.int64)
    wall_of_point[free] = _nearest_wall(candidates, walls_m)
    return walls_m, wall_of_point


def _straight(points_m: np.ndarray, min_length_m: float, spacing_m: float, seed: int) -> np.ndarray:
    """Return ends [F, 2, 2] of the straight runs of points [N, 2] in the slice."""
    params = WallParams(
        error_model="euclidean", inlier_m=INLIER_M, min_length_m=min_length_m, max_gap_m=MAX_GAP_M,
        min_inliers=max(int(WALL_FILL * min_length_m / spacing_m), 4), min_offset_m=0.05, max_walls=1000,
        rounds=WALL_ROUNDS, joined=False, curved=False, seed=seed,
    )  # fmt: skip
    walls, _ = find_walls(points_m, np.zeros((len(points_m), 2, 2)), np.zeros(len(points_m), np.int64), params)
    return np.array([wall.ends_m for wall in walls], np.float64).reshape(-1, 2, 2)


def _nearest_wall(points_m: np.ndarray, walls_m: np.ndarray) -> np.ndarray:
    """Return the index of the wall that each point [N, 2] lies on, -1 if none."""
    if not len(walls_m) or not len(points_m):
        return np.full(len(points_m), -1)
    distance_m = segment_distance_m(points_m, walls_m[:, 0], walls_m[:, 1])
    nearest = np.argmin(distance_m, axis=1)
    return np.where(distance_m[np.arange(len(points_m)), nearest] <= 2.0 * INLIER_M, nearest, -1)


def _turns_corner(ends_m: np.ndarray, walls_m: np.ndarray) -> bool:
    """Return whether an end of a piece [2, 2] meets an end of any wall [W, 2, 2]."""
    distance_m = np.linalg.norm(ends_m[:, None] - walls_m.reshape(1, -1, 2), axis=-1)
    return bool(distance_m.min(initial=math.inf) <= CORNER_M)


def _height_m(cloud_m: np.ndarray, ends_m: np.ndarray) -> float:
    """Return the height of the cloud over a wall's foot."""
    low, high = ends_m.min(axis=0) - 0.25, ends_m.max(axis=0) + 0.25
    near = cloud_m[((cloud_m[:, :2] >= low) & (cloud_m[:, :2] <= high)).all(axis=1)]
    on = segment_distance_m(near[:, :2], ends_m[:1], ends_m[1:])[:, 0] <= 0.25
    return float(np.quantile(near[on, 2], 0.98)) if on.any() else -math.inf


def _corners_closed(walls_m: np.ndarray) -> np.ndarray:
    """Return walls extended to the corners that they nearly form: no sight passes a slit of a hand's breadth."""
    closed = walls_m.copy()
    for index, (a, b) in enumerate(walls_m):
        normal, offset_m = wall_from_ends(a, b, ORIGIN)
        for other, (c, d) in enumerate(walls_m):
            other_normal, other_offset_m = wall_from_ends(c, d, ORIGIN)
            turn = normal[0] * other_normal[1] - normal[1] * other_normal[0]
            if other == index or abs(turn) < 0.3:
                continue
            corner = np.linalg.solve(np.stack([normal, other_normal]), -np.array([offset_m, other_offset_m]))
            far_m = np.hypot(*(closed[index] - corner).T)
            end = int(np.argmin(far_m))
            if far_m[end] <= CORNER_M and segment_distance_m(corner[None], c[None], d[None])[0, 0] <= CORNER_M:
                closed[index, end] = corner
    return closed


def _hull_edges(points_m: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """Return edges [E, 2, 2] of the hulls of all clusters; a cluster too large for one object is hulled in pieces."""
    edges = [np.zeros((0, 2, 2))]
    for label in range(int(cluster.max(initial=NOISE)) + 1):
        members = points_m[cluster == label]
        for part in _parts(members):
            hull = convex_hull(part)
            edges.append(np.stack([hull, np.roll(hull, -1, axis=0)], axis=1))
    return np.concatenate(edges)


def _parts(points_m: np.ndarray) -> list[np.ndarray]:
    """Return a cluster, or its pieces if it is longer than any object."""
    if np.ptp(points_m, axis=0).max() <= LONGEST_OBJECT_M:
        return [points_m]
    _, owner = np.unique(np.floor(points_m / PIECE_M).astype(int), axis=0, return_inverse=True)
    return [points_m[owner.ravel() == index] for index in range(int(owner.max()) + 1)]


def convex_hull(points_m: np.ndarray) -> np.ndarray:
    """Return corners [H, 2] of the convex hull, counter-clockwise (monotone chain); two ends for points on a line."""
    ordered = np.unique(points_m, axis=0)
    if len(ordered) < 3:
        return ordered

    def chain(points: np.ndarray) -> list[np.ndarray]:
        kept: list[np.ndarray] = []
        for point in points:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-1] - kept[-2], point - kept[-1]
                if ax * by - ay * bx > 0.0:
                    break
                kept.pop()
            kept.append(point)
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def in_sight(
    origin_m: np.ndarray, targets_m: np.ndarray, own_wall: np.ndarray, walls_m: np.ndarray, edges_m: np.ndarray
) -> np.ndarray:
    """Return whether targets [N, 2] see their origins [N, 2] past walls [W, 2, 2] and hulls' edges [E, 2, 2]; bool [N].

    A point's own wall (-1: none) never blocks it, nor does anything within `CLEARANCE_M` before it: fits and hulls
    are that uncertain.
    """
    away = targets_m - origin_m
    length_m = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
    short_m = origin_m + away * np.maximum(1.0 - CLEARANCE_M / length_m, 0.0)[:, None]
    blocked = crosses(origin_m, short_m, walls_m[:, 0], walls_m[:, 1])
    blocked[own_wall[:, None] == np.arange(len(walls_m))] = False
    return np.asarray(~blocked.any(axis=1) & ~crosses(origin_m, short_m, edges_m[:, 0], edges_m[:, 1]).any(axis=1))


def _with_images(labels: SliceLabels, edges_m: np.ndarray) -> SliceLabels:
    """Return the labels with the images of hidden points in every wall that shows them."""
    hidden = np.flatnonzero(labels.label == PointLabel.HIDDEN)
    points_m = labels.points_m[hidden]
    images: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for index, (a, b) in enumerate(labels.walls_m):
        normal, offset_m = wall_from_ends(a, b, ORIGIN)
        at_m = specular_points(ORIGIN, points_m, a, b)
        shown = np.flatnonzero(np.isfinite(at_m[:, 0]))
        shown = shown[_both_segments_free(at_m[shown], points_m[shown], index, labels.walls_m, edges_m)]
        image_m = reflect(points_m[shown], normal, offset_m)
        images.append((image_m, hidden[shown], np.full(len(shown), index)))
    if not images:
        return labels
    image_m, image_point, image_wall = (np.concatenate(column) for column in zip(*images, strict=True))
    return replace(labels, image_m=image_m, image_point=image_point, image_wall=image_wall)


def _both_segments_free(
    at_m: np.ndarray, points_m: np.ndarray, wall: int, walls_m: np.ndarray, edges_m: np.ndarray
) -> np.ndarray:
    """Return whether points [N, 2] are seen via their specular points [N, 2] on a wall; bool [N]."""
    own = np.full(len(at_m), wall)
    out = in_sight(np.zeros_like(at_m), at_m, own, walls_m, edges_m)
    return out & in_sight(at_m, points_m, own, walls_m, edges_m)
