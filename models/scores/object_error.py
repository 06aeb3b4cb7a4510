"""Position errors of a reported object, at the time it was measured: one definition for all figures.

Face error: to the nearest visible face of the true box, visible scattering centre, or its centre; objects are matched
by it. Centre error: of the boxes' centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.physics.plane import segment_distance_m
from msgs.values.frames import Pose2
from msgs.values.perception import HiddenObject, SceneTruth, Track, TruthObject
from msgs.values.units import s_from_ns

#: A visible point this near a side of its object's box shows that side.
ON_FACE_M = 0.1


def as_object(track: Track) -> HiddenObject:
    """Return a track as an object measured at the stamp of its scan; its size is not known."""
    return HiddenObject(
        id=track.id,
        x_m=track.x_m,
        y_m=track.y_m,
        length_m=4.0,
        width_m=2.0,
        yaw_rad=0.0,
        score=1.0,
        cov_m2=track.cov_m2,
    )


@dataclass(frozen=True)
class ObjectDistances:
    """Distances [R, N] in metres of R reported objects to N true ones, each moved to the time of the report."""

    #: Face error.
    error_m: np.ndarray
    #: Centre error.
    centre_m: np.ndarray
    #: To the true box, zero inside.
    box_m: np.ndarray
    #: Squared Mahalanobis distance of the point that a report means, of a visible face or the centre, whichever is
    #: nearest by its covariance; no unit.
    mahalanobis2: np.ndarray


def object_distances(
    objects: Sequence[HiddenObject], truth: SceneTruth, true_objects: Sequence[TruthObject]
) -> ObjectDistances:
    """Measure every reported object against every wanted object of the truth."""
    shape = (len(objects), len(true_objects), 4)
    faces_m = [_visible_faces_m(true_object, truth) for true_object in true_objects]
    rows = [
        _distances_m(report, true_object, faces_m[j], truth)
        for report in objects
        for j, true_object in enumerate(true_objects)
    ]
    return ObjectDistances(*np.moveaxis(np.array(rows, np.float64).reshape(shape), -1, 0))


def _visible_faces_m(truth: TruthObject, scene: SceneTruth) -> np.ndarray:
    """Return sides [N, 2 ends, 2] of the box with visible points, and those points as sides of no length."""
    points_m = scene.hidden_points_m[scene.hidden_object == scene.objects.index(truth), :2].astype(np.float64)
    half = 0.5 * np.array([truth.length_m, truth.width_m])
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    corners_m = Pose2(truth.x_m, truth.y_m, truth.yaw_rad).apply(corners)
    sides_m = np.stack([corners_m, np.roll(corners_m, -1, axis=0)], axis=1)
    visible = (segment_distance_m(points_m, sides_m[:, 0], sides_m[:, 1]) <= ON_FACE_M).any(axis=0)
    return np.concatenate([sides_m[visible], np.repeat(points_m[:, None], 2, axis=1)])


def _distances_m(
    report: HiddenObject, truth: TruthObject, faces_m: np.ndarray, scene: SceneTruth
) -> tuple[float, float, float, float]:
    """Return face and centre error, distance to the box and squared Mahalanobis distance at the report's time."""
    # an object without a stamp of its own was measured at the scene's
    elapsed_s = s_from_ns(report.stamp_ns - scene.stamp_ns) if report.stamp_ns else 0.0
    moved_m = elapsed_s * np.array([truth.velocity_x_mps, truth.velocity_y_mps])
    at_m = np.array([[report.x_m, report.y_m]]) - moved_m
    vehicle = Pose2(truth.x_m, truth.y_m, truth.yaw_rad).inverse()
    in_box_m = vehicle.apply(at_m)[0]
    outside_m = np.maximum(np.abs(in_box_m) - 0.5 * np.array([truth.length_m, truth.width_m]), 0.0)
    to_centre_m = float(np.linalg.norm(in_box_m))
    centre_m = float(np.linalg.norm(vehicle.apply(np.array([report.box_centre_m]) - moved_m)))
    to_faces_m = segment_distance_m(at_m, faces_m[:, 0], faces_m[:, 1])
    error_m = float(min(to_centre_m, to_faces_m.min(initial=np.inf)))
    marks_m = np.concatenate([faces_m, np.full((1, 2, 2), [truth.x_m, truth.y_m])]) - at_m
    return error_m, centre_m, float(np.linalg.norm(outside_m)), _mahalanobis2(marks_m, np.array(report.cov_m2))


def _mahalanobis2(sides_m: np.ndarray, covariance_m2: np.ndarray) -> float:
    """Return the least squared Mahalanobis distance of sides [N, 2 ends, 2] from the origin."""
    variances, axes = np.linalg.eigh(covariance_m2)
    # a report that claims to be exact is not: a centimetre
    white = sides_m @ axes / np.sqrt(np.maximum(variances, 1e-4))
    return float(segment_distance_m(np.zeros((1, 2)), white[:, 0], white[:, 1]).min()) ** 2
