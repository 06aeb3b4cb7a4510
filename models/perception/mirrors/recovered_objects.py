"""Hidden objects from recovered points: clusters, boxes of the visible points, scores, covariances.

The centre is that of the visible face, which the radar measures, not moved inwards by a guess of the class.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from models.perception.find.score_calibration import ScoreTable, calibrated, check_table
from models.perception.mirrors.clustering import dbscan, fits_box
from models.perception.mirrors.mirror_table import wall_arrays
from models.perception.mirrors.recovery import Recovered
from models.perception.mirrors.rejection import OPEN_VIEW_MARGIN_M, in_open_view
from models.physics.plane import segment_distance_m
from msgs.values.arrays import require_positive
from msgs.values.frames import polar_from_xy
from msgs.values.perception import HiddenObject, Wall

#: A uniform face of length L has variance L^2 / 12 along it.
UNIFORM_FACE = 12.0
#: Largest number of point pairs that may join fragments, nearest first: the pairs of two hundred points.
MAX_PAIRS = 20_000


#: Fragments no further apart than this plus one sigma belong together, if they fit in one vehicle.
EPS_M = 2.5
VEHICLE_LENGTH_M = 5.5
VEHICLE_WIDTH_M = 2.5
#: Least joint score of an object, and least SNR of one of a single point.
MIN_SCORE = 0.54
SINGLE_MIN_SNR_DB = 15.0
#: An object that no wall hides should have been detected directly: it needs more evidence.
OPEN_VIEW_MIN_POINTS = 3
OPEN_VIEW_MIN_SCORE = 0.765
#: Longer than any vehicle: a wall seen in a mirror.
MAX_LENGTH_M = 14.0
#: A line this long that starts at a wall's end is the building's next face.
FACE_LENGTH_M = 6.5
#: This few points, this near in image range and no stronger than that within a beam of a larger object, are part of it.
SATELLITE_POINTS = 2
SATELLITE_RANGE_M = 1.5
SATELLITE_DB = 3.0
#: Or this near in line with one of so many points, if the longest vehicle reaches so far.
SIDE_POINTS = 4
SIDE_GAP_M = 4.0
SIDE_WIDTH_M = 1.2
SIDE_LENGTH_M = 12.5
#: Least size of a reported box: that of a bicycle.
MIN_LENGTH_M = 1.5
MIN_WIDTH_M = 0.8


class ObjectParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Conditions under which recovered points form an object, as far as sensors differ in them."""

    min_points: int = 2
    #: Least score of an object of a single point.
    single_min_score: float = 0.45
    #: An object this much weaker than another at the same range is its side lobe.
    lobe_db: float = 22.0
    #: Width of a beam, within which points of a larger object are near in azimuth.
    satellite_beam_deg: float = 9.0
    #: From the joint score to the share of such objects that are true; empty: the joint score itself.
    score_table: ScoreTable = ()

    def __post_init__(self) -> None:
        require_positive("objects.min_points", self.min_points)
        check_table("objects.score_table", self.score_table)


def form_objects(recovered: Recovered, walls: list[Wall], params: ObjectParams) -> tuple[HiddenObject, ...]:
    """Return the objects of hidden points, best score first (then x, then y), ids in that order."""
    labels = merge_fragments(recovered, dbscan(recovered.points_m, EPS_M, 1))
    clusters = [recovered.take(labels == label) for label in range(int(labels.max(initial=-1)) + 1)]
    clusters = [cluster for cluster in clusters if _is_object(cluster, walls, params)]
    clusters = _without_satellites(_without_lobes(clusters, params.lobe_db), params)
    boxes = [_box(cluster, params) for cluster in clusters]
    boxes.sort(key=lambda box: (-box.score, box.x_m, box.y_m))
    return tuple(msgspec.structs.replace(box, id=index) for index, box in enumerate(boxes))


def merge_fragments(recovered: Recovered, labels: np.ndarray) -> np.ndarray:
    """Join clusters, nearest first, within eps plus one sigma that fit in one vehicle; labels [N] renumbered."""
    labels = labels.copy()
    points_m, covariance_m2 = recovered.points_m, recovered.image_covariance_m2
    first, second = np.triu_indices(len(points_m), k=1)
    difference = points_m[first] - points_m[second]
    distance_m = np.hypot(difference[:, 0], difference[:, 1])
    variance = np.einsum("pi,pij,pj->p", difference, covariance_m2[first] + covariance_m2[second], difference)
    sigma_m = np.sqrt(variance) / np.maximum(distance_m, 1e-9)
    near = np.flatnonzero((distance_m <= EPS_M + sigma_m) & (labels[first] != labels[second]))
    for pair in near[np.argsort(distance_m[near], kind="stable")][:MAX_PAIRS]:
        i, j = first[pair], second[pair]
        if labels[i] == labels[j]:
            continue
        union = (labels == labels[i]) | (labels == labels[j])
        slack_m = float(sigma_m[pair])
        if fits_box(points_m[union], VEHICLE_LENGTH_M + slack_m, VEHICLE_WIDTH_M + slack_m):
            labels[union] = labels[union].min()
    return np.searchsorted(np.unique(labels), labels)


def _is_object(cluster: Recovered, walls: list[Wall], params: ObjectParams) -> bool:
    """Return whether a cluster has evidence, the length of a vehicle, and is no next face of a building."""
    extent_m = float(np.linalg.norm(cluster.points_m[:, None] - cluster.points_m, axis=-1).max())
    if extent_m > MAX_LENGTH_M or not _has_evidence(cluster, walls, params):
        return False
    return not (extent_m > FACE_LENGTH_M and _starts_at_wall_end(cluster, walls))


def _has_evidence(cluster: Recovered, walls: list[Wall], params: ObjectParams) -> bool:
    """Return whether a cluster has enough points or one strong one; more are required where no wall hides it."""
    score = joint_score(cluster.score)
    strong = (cluster.score >= params.single_min_score) & (cluster.snr_db >= SINGLE_MIN_SNR_DB)
    enough = score >= MIN_SCORE if len(cluster) >= params.min_points else bool(strong.any())
    centre_m = cluster.points_m.mean(axis=0, keepdims=True)
    if enough and in_open_view(centre_m, walls, OPEN_VIEW_MARGIN_M)[0]:
        return len(cluster) >= OPEN_VIEW_MIN_POINTS and score >= OPEN_VIEW_MIN_SCORE
    return enough


def joint_score(scores: np.ndarray) -> float:
    """Return the probability that at least one of the points is real, 1 - prod(1 - s)."""
    return float(1.0 - np.prod(1.0 - np.clip(scores, 0.0, 1.0)))


def _starts_at_wall_end(cluster: Recovered, walls: list[Wall]) -> bool:
    """Return whether a cluster is a narrow line whose end touches the end of a wall: the face round the corner."""
    centre = cluster.points_m.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov(cluster.points_m.T))
    reach = (cluster.points_m - centre) @ axes[:, 1]
    narrow = np.ptp((cluster.points_m - centre) @ axes[:, 0]) <= 1.5
    tips = centre + np.array([reach.min(), reach.max()])[:, None] * axes[:, 1]
    arrays = wall_arrays(walls)
    corners = np.concatenate([arrays.a, arrays.b])
    return bool(narrow and (segment_distance_m(tips, corners, corners) <= 2.5).any())


def _without_lobes(clusters: list[Recovered], lobe_db: float) -> list[Recovered]:
    """Return the clusters that are not the azimuth side lobe of a far stronger one at the same image range."""
    ranges = [float(np.average(polar_from_xy(cluster.images_m)[0], weights=cluster.score)) for cluster in clusters]
    powers = [float(cluster.snr_db.max()) for cluster in clusters]
    return [
        cluster
        for cluster, range_m, power in zip(clusters, ranges, powers, strict=True)
        if not any(
            other > power + lobe_db and abs(other_range - range_m) <= 1.0
            for other, other_range in zip(powers, ranges, strict=True)
        )
    ]


def _without_satellites(clusters: list[Recovered], params: ObjectParams) -> list[Recovered]:
    """Return the clusters that are no satellite of one twice as large: few points, in its beam or along its side."""
    return [
        cluster
        for cluster in clusters
        if len(cluster) > SATELLITE_POINTS
        or not any(
            len(other) >= 2 * len(cluster) and (_in_one_beam(cluster, other, params) or _along_side(cluster, other))
            for other in clusters
        )
    ]


def _along_side(cluster: Recovered, other: Recovered) -> bool:
    """Return whether a cluster continues a long one in line, over a gap, within the length of the longest vehicle."""
    if len(other) < SIDE_POINTS:
        return False
    centre = other.points_m.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov(other.points_m.T))
    reach = (np.vstack([other.points_m, cluster.points_m]) - centre) @ axes[:, ::-1]
    own, stray = reach[: len(other), 0], reach[len(other) :]
    gap_m = np.maximum(stray[:, 0] - own.max(), own.min() - stray[:, 0])
    in_line = (gap_m <= SIDE_GAP_M) & (np.abs(stray[:, 1]) <= SIDE_WIDTH_M)
    return bool(spread[1] > 4.0 * spread[0] and in_line.all() and np.ptp(reach[:, 0]) <= SIDE_LENGTH_M)


def _in_one_beam(cluster: Recovered, other: Recovered, params: ObjectParams) -> bool:
    """Return whether each point of a cluster has one of the other, as strong, at its image range in its beam."""
    range_m, azimuth_rad = polar_from_xy(cluster.images_m)
    other_range_m, other_azimuth_rad = polar_from_xy(other.images_m)
    near = np.abs(range_m[:, None] - other_range_m) <= SATELLITE_RANGE_M
    near &= np.abs(azimuth_rad[:, None] - other_azimuth_rad) <= math.radians(params.satellite_beam_deg)
    near &= other.snr_db >= cluster.snr_db[:, None] - SATELLITE_DB
    return bool(near.any(axis=1).all())


def _box(cluster: Recovered, params: ObjectParams) -> HiddenObject:
    """Return the oriented box of the points and the covariance of its centre; without spread, across the ray."""
    weights = cluster.score * 10.0 ** (cluster.snr_db / 20.0)
    weights = weights / weights.sum()
    centre = weights @ cluster.points_m
    spread = cluster.points_m - centre
    scatter = (spread * weights[:, None]).T @ spread
    own = np.einsum("n,nij->ij", weights, cluster.image_covariance_m2)
    common = np.einsum("n,nij->ij", weights, cluster.wall_covariance_m2)
    face, axes = np.linalg.eigh(scatter - own)
    yaw_rad = math.atan2(axes[1, 1], axes[0, 1]) if face[1] > 0.0 else _across_ray(cluster, weights)
    length_m, width_m = np.sqrt(UNIFORM_FACE * np.maximum(face[::-1], 0.0))
    # each point errs on its own and falls anywhere on the face; the wall errs once for all of them
    covariance = float(np.sum(weights**2)) * (own + scatter) + common
    (xx, xy), (_, yy) = covariance.tolist()
    return HiddenObject(
        id=0,
        x_m=float(centre[0]),
        y_m=float(centre[1]),
        length_m=float(np.clip(length_m, MIN_LENGTH_M, MAX_LENGTH_M)),
        width_m=float(np.clip(width_m, MIN_WIDTH_M, MAX_LENGTH_M)),
        # a box has no front: the same axis in (-pi/2, pi/2]
        yaw_rad=math.pi / 2.0 - (math.pi / 2.0 - yaw_rad) % math.pi,
        score=float(calibrated(params.score_table, np.array([joint_score(cluster.score)]))[0]),
        cov_m2=((xx, xy), (xy, yy)),
        stamp_ns=int(cluster.stamp_ns[0]) + int(np.mean(cluster.stamp_ns - cluster.stamp_ns[0])),
        points=len(cluster),
    )


def _across_ray(cluster: Recovered, weights: np.ndarray) -> float:
    """Return the direction across the last segment, wall to object: that of a face towards the mirror."""
    range_m, azimuth_rad = polar_from_xy(cluster.images_m)
    # turn the image's cross-range direction through the same mirror: the map image -> position keeps lengths
    step = 1e-3 * range_m[:, None] * np.stack([-np.sin(azimuth_rad), np.cos(azimuth_rad)], axis=1)
    normal = cluster.images_m - cluster.points_m
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    folded = weights @ (step - 2.0 * np.sum(step * normal, axis=1)[:, None] * normal)
    return math.atan2(folded[1], folded[0])
