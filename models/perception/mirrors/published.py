"""The specification's back end: plain clusters and lines, buddy association, every image folded back, none rejected."""

from __future__ import annotations

import numpy as np

from models.perception.mirrors.clustering import NOISE, dbscan
from models.perception.mirrors.image_walls import DirectReturns, RecoveryParams
from models.perception.mirrors.lines import fit_line
from models.perception.mirrors.mirror_table import NO_WALL
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks, Wall

#: Released settings of inference.
CLUSTER_EPS_M, CLUSTER_MIN_POINTS = 4.0, 2
ROUNDS, INLIER_M, MIN_INLIERS = 200, 0.3, 2
#: Direct returns nearer ahead than this share of the nearest image are ignored.
NEAREST_SHARE = 0.2
#: An image belongs to the wall of the direct return nearest in angle; one mirror each.
BUDDY = RecoveryParams(association="buddy", second_order=False)


def published_structure(
    peaks: Peaks, cluster_eps_m: float = CLUSTER_EPS_M, cluster_min_points: int = CLUSTER_MIN_POINTS
) -> tuple[DirectReturns, list[Wall]]:
    """Return the direct returns with their clusters, and the lines through them."""
    points_m = xy_from_polar(peaks.range_m, peaks.azimuth_rad)
    direct = _not_too_near(points_m, peaks.path_class)
    labels = dbscan(points_m[direct], cluster_eps_m, cluster_min_points)
    walls, wall_of_point = published_walls(points_m[direct], labels)
    return DirectReturns(points_m[direct], peaks.snr_db[direct], labels, wall_of_point), walls


def _not_too_near(points_m: np.ndarray, path_class: np.ndarray) -> np.ndarray:
    """Return the indices of the direct returns at least `NEAREST_SHARE` as far ahead as the nearest image."""
    nearest_m = points_m[path_class == PathClass.MIRRORED, 0].min(initial=np.inf)
    ahead = points_m[:, 0] >= NEAREST_SHARE * nearest_m if np.isfinite(nearest_m) else np.ones(len(points_m), bool)
    return np.flatnonzero((path_class == PathClass.LOS) & ahead)


def published_walls(points_m: np.ndarray, labels: np.ndarray) -> tuple[list[Wall], np.ndarray]:
    """Return the lines of clusters of points [N, 2] by inliers, and each point's (`NO_WALL`: none), int64 [N]."""
    rng = np.random.default_rng(0)
    walls: list[Wall] = []
    wall_of_point = np.full(len(points_m), NO_WALL, np.int64)
    for label in range(int(labels.max(initial=NOISE)) + 1):
        left = np.flatnonzero(labels == label)
        while len(inliers := left[_largest_inlier_set(points_m[left], rng)]) >= MIN_INLIERS:
            wall_of_point[inliers] = len(walls)
            walls.append(_fitted(points_m[inliers]))
            left = np.setdiff1d(left, inliers)
    return walls, wall_of_point


def _largest_inlier_set(points_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return which points [N] lie on the line through two of them that has the most; none where no two differ."""
    first, second = np.triu_indices(len(points_m), k=1)
    if len(first) > ROUNDS:
        sampled = np.sort(rng.choice(len(first), ROUNDS, replace=False))
        first, second = first[sampled], second[sampled]
    along = points_m[second] - points_m[first]
    length_m = np.linalg.norm(along, axis=1)
    apart = length_m > 1e-6
    if not apart.any():
        return np.zeros(len(points_m), bool)
    first, along = first[apart], along[apart] / length_m[apart, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    distance_m = np.abs(normal @ points_m.T - np.sum(normal * points_m[first], axis=1)[:, None])  # [H, N]
    inliers = distance_m <= INLIER_M
    return np.asarray(inliers[inliers.sum(axis=1).argmax()])


def _fitted(points_m: np.ndarray) -> Wall:
    """Return the least-squares line through points as a wall from the first to the last of them."""
    normal, offset_m, _, _ = fit_line(points_m, np.broadcast_to(np.eye(2), (len(points_m), 2, 2)))
    tangent = np.array([-normal[1], normal[0]])
    reach = points_m @ tangent
    (ax, ay), (bx, by) = (np.array([[reach.min()], [reach.max()]]) * tangent - offset_m * normal).tolist()
    return Wall(
        normal=(float(normal[0]), float(normal[1])),
        offset_m=float(offset_m),
        ends_m=((ax, ay), (bx, by)),
        inliers=len(points_m),
    )
