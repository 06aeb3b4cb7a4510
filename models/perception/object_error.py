"""Position error of a reported object, at the time it was measured: two distances, one definition for all figures.

- Face error: from the reported centre to the nearest visible face of the true box, to a visible scattering centre, or
  to the box's centre, whichever is nearest. Objects are matched by it: what a radar sees of a vehicle is a face.
- Centre error: from the reported centre to the centre of the true box. Never less than the face error; half the box
  more where a face is met exactly.
"""

from __future__ import annotations

import math

import numpy as np

from models.physics.mirror import segment_distance_m
from msgs.frames import Pose2
from msgs.perception import HiddenObject, SceneTruth, TruthObject
from msgs.units import s_from_ns

#: A visible point this near a side of its object's box shows that side.
ON_FACE_M = 0.1


def face_error_m(found: HiddenObject, truth: TruthObject, scene: SceneTruth) -> float:
    """Return the distance [m] of a reported centre to the nearest visible face or the centre of a true object."""
    faces_m = visible_faces_m(truth, scene)
    to_faces_m = segment_distance_m(_at_truth_time(found, truth, scene)[None], faces_m[:, 0], faces_m[:, 1])
    return min(float(to_faces_m.min(initial=np.inf)), centre_error_m(found, truth, scene))


def centre_error_m(found: HiddenObject, truth: TruthObject, scene: SceneTruth) -> float:
    """Return the distance [m] of a reported centre to the centre of a true object."""
    x_m, y_m = _at_truth_time(found, truth, scene)
    return math.hypot(x_m - truth.x_m, y_m - truth.y_m)


def visible_faces_m(truth: TruthObject, scene: SceneTruth) -> np.ndarray:
    """Return the sides [N, 2 ends, 2] of a true box on which visible points lie, and those points as sides of no length."""
    points_m = scene.hidden_points_m[scene.hidden_object == scene.objects.index(truth), :2].astype(np.float64)
    half = 0.5 * np.array([truth.length_m, truth.width_m])
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    corners_m = Pose2(truth.x_m, truth.y_m, truth.yaw_rad).apply(corners)
    sides_m = np.stack([corners_m, np.roll(corners_m, -1, axis=0)], axis=1)
    seen = (segment_distance_m(points_m, sides_m[:, 0], sides_m[:, 1]) <= ON_FACE_M).any(axis=0)
    return np.concatenate([sides_m[seen], np.repeat(points_m[:, None], 2, axis=1)])


def _at_truth_time(found: HiddenObject, truth: TruthObject, scene: SceneTruth) -> np.ndarray:
    """Reported centre [2], taken back by the true object's motion to the truth's time."""
    # an object without a stamp of its own was measured at the scene's
    elapsed_s = s_from_ns(found.stamp_ns - scene.stamp_ns) if found.stamp_ns else 0.0
    return np.array([found.x_m - elapsed_s * truth.velocity_x_mps, found.y_m - elapsed_s * truth.velocity_y_mps])
