"""Scores against truth: dense F1, recovered F1 and Chamfer distance, and the matching of hidden objects.

Counts are micro over frames and no frame is skipped: an empty prediction counts its misses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from models.physics.mirror import segment_distance_m
from msgs.frames import Pose2
from msgs.perception import HiddenObject, PathClass, SceneTruth, TruthObject
from msgs.units import s_from_ns

#: Cost of a forbidden pair: larger than any sum of allowed ones.
FORBIDDEN = 1e9
#: A visible point this near a side of its object's box shows that side.
ON_FACE_M = 0.1


@dataclass(frozen=True)
class Counts:
    """True positives, false positives, false negatives; they add over frames."""

    true_positives: int = 0
    false_positives: int = 0
    false_negatives: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.true_positives + other.true_positives,
            self.false_positives + other.false_positives,
            self.false_negatives + other.false_negatives,
        )

    @property
    def precision(self) -> float:
        """Share of predictions that are true; zero without predictions."""
        return _share(self.true_positives, self.true_positives + self.false_positives)

    @property
    def recall(self) -> float:
        """Share of the truth that was found; zero without truth."""
        return _share(self.true_positives, self.true_positives + self.false_negatives)

    @property
    def f1(self) -> float:
        """2 TP / (2 TP + FP + FN); one where there was nothing to find and nothing was claimed."""
        wrong = self.false_positives + self.false_negatives
        return 1.0 if wrong == 0 else 2.0 * self.true_positives / (2.0 * self.true_positives + wrong)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


def match_points(predicted_m: np.ndarray, truth_m: np.ndarray, gate_m: float) -> np.ndarray:
    """One-to-one pairs (predicted, truth) [K, 2] within `gate_m`: as many as possible, then the nearest."""
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return np.zeros((0, 2), np.int64)
    distance_m = np.linalg.norm(predicted_m[:, None] - truth_m, axis=-1)
    return assign_within(distance_m, gate_m)


def assign_within(distance_m: np.ndarray, gate_m: float) -> np.ndarray:
    """Assign rows to columns one to one within a gate: as many as possible, then the nearest; pairs [K, 2]."""
    if distance_m.size == 0:
        return np.zeros((0, 2), np.int64)
    rows, columns = linear_sum_assignment(np.where(distance_m <= gate_m, distance_m, FORBIDDEN))
    allowed = distance_m[rows, columns] <= gate_m
    return np.stack([rows[allowed], columns[allowed]], axis=1)


def dense_counts(
    predicted_m: np.ndarray,
    predicted_class: np.ndarray,
    truth_m: np.ndarray,
    truth_class: np.ndarray,
    gate_m: float = 2.0,
) -> dict[PathClass, Counts]:
    """Stage-1 counts of one frame for each class: Hungarian one-to-one matching in metres."""
    counts = {}
    for path_class in PathClass:
        predicted, truth = predicted_m[predicted_class == path_class], truth_m[truth_class == path_class]
        matched = len(match_points(predicted, truth, gate_m))
        counts[path_class] = Counts(matched, len(predicted) - matched, len(truth) - matched)
    return counts


def macro_f1(frames: Iterable[dict[PathClass, Counts]]) -> float:
    """Mean over the classes of the F1 of their counts summed over frames."""
    total = {path_class: Counts() for path_class in PathClass}
    for frame in frames:
        for path_class in PathClass:
            total[path_class] += frame[path_class]
    return sum(counts.f1 for counts in total.values()) / len(total)


def recovered_counts(predicted_m: np.ndarray, truth_m: np.ndarray, tau_m: float = 1.0) -> Counts:
    """Stage-2 counts of one frame, not one-to-one: truth points with a prediction nearer than `tau_m` are found,
    predictions with no truth that near are false."""
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return Counts(0, len(predicted_m), len(truth_m))
    to_truth, _ = cKDTree(truth_m).query(predicted_m)
    to_predicted, _ = cKDTree(predicted_m).query(truth_m)
    found = int(np.count_nonzero(to_predicted < tau_m))
    return Counts(found, int(np.count_nonzero(to_truth >= tau_m)), len(truth_m) - found)


@dataclass(frozen=True)
class Chamfer:
    """Chamfer distance of one frame, mean(pred -> truth) + mean(truth -> pred): unsquared [m] and squared [m^2]."""

    metres: float
    square_metres: float


def chamfer(predicted_m: np.ndarray, truth_m: np.ndarray) -> Chamfer:
    """Both variants for point sets [N, 2] and [M, 2]; zero where both are empty, infinite where one is."""
    if len(predicted_m) == 0 and len(truth_m) == 0:
        return Chamfer(0.0, 0.0)
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return Chamfer(math.inf, math.inf)
    to_truth, _ = cKDTree(truth_m).query(predicted_m)
    to_predicted, _ = cKDTree(predicted_m).query(truth_m)
    return Chamfer(float(to_truth.mean() + to_predicted.mean()), float(np.mean(to_truth**2) + np.mean(to_predicted**2)))


@dataclass(frozen=True)
class ObjectDistances:
    """Distances [R, N] in metres of R reported objects to N true ones, each moved to the time of the report."""

    #: The position error: to the nearest visible face of its box or to its centre, whichever is nearer.
    error_m: np.ndarray
    centre_m: np.ndarray
    #: To its box, zero inside.
    box_m: np.ndarray


@dataclass(frozen=True)
class ObjectMatch:
    """Hidden objects held against truth: pairs with errors, objects that are nothing, hidden truths not found."""

    #: (id of the object, id of the truth, position error in metres).
    matched: tuple[tuple[int, int, float], ...]
    #: Distance of each pair's centres in metres.
    centre_m: tuple[float, ...]
    unmatched_objects: tuple[int, ...]
    missed_truths: tuple[int, ...]


def match_objects(objects: Sequence[HiddenObject], truth: SceneTruth, gate_m: float = 1.0) -> ObjectMatch:
    """Match one to one by the distance of an object's centre to the truth's centre or to a visible face of its box.

    The truth is moved with its velocity to the time the object was measured. Only hidden truths are asked for; an
    object at a truth in plain sight is unmatched.
    """
    hidden = [one for one in truth.objects if one.hidden]
    distances = object_distances(objects, truth, hidden)
    pairs = assign_within(distances.error_m, gate_m)
    return ObjectMatch(
        matched=tuple((objects[i].id, hidden[j].id, float(distances.error_m[i, j])) for i, j in pairs),
        centre_m=tuple(float(distances.centre_m[i, j]) for i, j in pairs),
        unmatched_objects=tuple(one.id for i, one in enumerate(objects) if i not in pairs[:, 0]),
        missed_truths=tuple(one.id for j, one in enumerate(hidden) if j not in pairs[:, 1]),
    )


def object_distances(
    objects: Sequence[HiddenObject], truth: SceneTruth, wanted: Sequence[TruthObject]
) -> ObjectDistances:
    """Measure every reported object against every wanted object of the truth."""
    shape = (len(objects), len(wanted), 3)
    faces_m = [_visible_faces_m(one, truth) for one in wanted]
    rows = [_distances_m(one, other, faces_m[j], truth) for one in objects for j, other in enumerate(wanted)]
    return ObjectDistances(*np.moveaxis(np.array(rows, np.float64).reshape(shape), -1, 0))


def _visible_faces_m(truth: TruthObject, scene: SceneTruth) -> np.ndarray:
    """Sides [N, 2 ends, 2] of the box on which visible points lie, those points themselves as sides of no length."""
    points_m = scene.hidden_points_m[scene.hidden_object == scene.objects.index(truth), :2].astype(np.float64)
    half = 0.5 * np.array([truth.length_m, truth.width_m])
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    corners_m = Pose2(truth.x_m, truth.y_m, truth.yaw_rad).apply(corners)
    sides_m = np.stack([corners_m, np.roll(corners_m, -1, axis=0)], axis=1)
    seen = (segment_distance_m(points_m, sides_m[:, 0], sides_m[:, 1]) <= ON_FACE_M).any(axis=0)
    return np.concatenate([sides_m[seen], np.repeat(points_m[:, None], 2, axis=1)])


def _distances_m(
    found: HiddenObject, truth: TruthObject, faces_m: np.ndarray, scene: SceneTruth
) -> tuple[float, float, float]:
    """Position error, distance of centres and distance to the box, at the found object's time."""
    # an object without a stamp of its own was measured at the scene's
    elapsed_s = s_from_ns(found.stamp_ns - scene.stamp_ns) if found.stamp_ns else 0.0
    moved_m = elapsed_s * np.array([truth.velocity_x_mps, truth.velocity_y_mps])
    at_m = np.array([[found.x_m, found.y_m]]) - moved_m
    in_box_m = Pose2(truth.x_m, truth.y_m, truth.yaw_rad).inverse().apply(at_m)[0]
    outside_m = np.maximum(np.abs(in_box_m) - 0.5 * np.array([truth.length_m, truth.width_m]), 0.0)
    centre_m = float(np.linalg.norm(in_box_m))
    to_faces_m = segment_distance_m(at_m, faces_m[:, 0], faces_m[:, 1])
    return float(min(centre_m, to_faces_m.min(initial=np.inf))), centre_m, float(np.linalg.norm(outside_m))
