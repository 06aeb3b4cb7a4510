"""Scores of points against truth: dense F1, recovered F1 and Chamfer distance.

Counts are micro over frames and no frame is skipped: an empty prediction counts its misses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from models.scores.object_matching import assign_within
from msgs.values.perception import PathClass


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
        """2 TP / (2 TP + FP + FN); one if there is neither truth nor prediction."""
        wrong = self.false_positives + self.false_negatives
        return 1.0 if wrong == 0 else 2.0 * self.true_positives / (2.0 * self.true_positives + wrong)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


def match_points(predicted_m: np.ndarray, truth_m: np.ndarray, gate_m: float) -> np.ndarray:
    """Return one-to-one pairs (predicted, truth) [K, 2] within `gate_m`: as many as possible, then the nearest."""
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return np.zeros((0, 2), np.int64)
    distance_m = np.linalg.norm(predicted_m[:, None] - truth_m, axis=-1)
    return assign_within(distance_m, gate_m)


def dense_counts(
    predicted_m: np.ndarray,
    predicted_class: np.ndarray,
    truth_m: np.ndarray,
    truth_class: np.ndarray,
    gate_m: float = 2.0,
) -> dict[PathClass, Counts]:
    """Return the Stage-1 counts of one frame for each class: Hungarian one-to-one matching in metres."""
    counts = {}
    for path_class in PathClass:
        predicted, truth = predicted_m[predicted_class == path_class], truth_m[truth_class == path_class]
        matched = len(match_points(predicted, truth, gate_m))
        counts[path_class] = Counts(matched, len(predicted) - matched, len(truth) - matched)
    return counts


def recovered_counts(predicted_m: np.ndarray, truth_m: np.ndarray, tau_m: float = 1.0) -> Counts:
    """Return the Stage-2 counts of one frame, not one-to-one: truth points with a prediction nearer than `tau_m` are
    found, predictions with no truth that near are false."""
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return Counts(0, len(predicted_m), len(truth_m))
    to_truth, _ = cKDTree(truth_m).query(predicted_m)
    to_predicted, _ = cKDTree(predicted_m).query(truth_m)
    true_positives = int(np.count_nonzero(to_predicted < tau_m))
    return Counts(true_positives, int(np.count_nonzero(to_truth >= tau_m)), len(truth_m) - true_positives)


@dataclass(frozen=True)
class Chamfer:
    """Chamfer distance of one frame, mean(pred -> truth) + mean(truth -> pred): unsquared [m] and squared [m^2]."""

    metres: float
    square_metres: float


def chamfer(predicted_m: np.ndarray, truth_m: np.ndarray) -> Chamfer:
    """Return both variants for point sets [N, 2] and [M, 2]; zero if both are empty, infinite if one is."""
    if len(predicted_m) == 0 and len(truth_m) == 0:
        return Chamfer(0.0, 0.0)
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return Chamfer(math.inf, math.inf)
    to_truth, _ = cKDTree(truth_m).query(predicted_m)
    to_predicted, _ = cKDTree(predicted_m).query(truth_m)
    return Chamfer(float(to_truth.mean() + to_predicted.mean()), float(np.mean(to_truth**2) + np.mean(to_predicted**2)))
