"""Calibration table from scores to probabilities."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.optimize import isotonic_regression

from lab.measures.point_scores import match_points
from lab.training.data.frames import Frame
from models.perception.find.detectors import Detector
from models.perception.find.score_calibration import ScoreTable
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass

#: Maximum distance of a true peak from a truth point of its class, one to one.
GATE_M = 2.0
#: Minimum peaks of a group: the standard error of a group's share stays below 0.1.
GROUP = 30


def peak_outcomes(detector: Detector, frames: Iterable[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """Return the score [N] of every peak in the frames, and whether it is true [N]."""
    score: list[np.ndarray] = []
    is_true: list[np.ndarray] = []
    for frame in frames:
        peaks, labels = detector.detect(frame.ra_map), frame.labels
        hit = np.zeros(len(peaks.score), bool)
        found_m = xy_from_polar(peaks.range_m, peaks.azimuth_rad)
        truth_m = xy_from_polar(labels.range_m, labels.azimuth_rad)
        for path_class in PathClass:
            of_class = np.flatnonzero(peaks.path_class == path_class)
            pairs = match_points(found_m[of_class], truth_m[labels.path_class == path_class], GATE_M)
            hit[of_class[pairs[:, 0]]] = True
        score.append(peaks.score)
        is_true.append(hit)
    return np.concatenate([np.zeros(0), *score]), np.concatenate([np.zeros(0, bool), *is_true])


def fit_table(score: np.ndarray, is_true: np.ndarray, groups: int = 20) -> ScoreTable:
    """Return the knots of the monotone table: mean score and share of true peaks of groups of equal size, isotonic.

    Groups that would fall are pooled (isotonic regression), so the table rises strictly: ranks stay. Below the first
    group it falls to (0, 0), above the last it rises to (1, 1). Empty if there are too few peaks for two groups.
    Raises `ValueError` if scores leave 0..1.
    """
    if not ((score >= 0.0) & (score <= 1.0)).all():
        raise ValueError(f"score must lie in 0..1, got {score.min()}..{score.max()}")
    groups = min(groups, len(score) // GROUP)
    if groups < 2:
        return ()
    order = np.argsort(score, kind="stable")
    parts = np.array_split(order, groups)
    # one more peak of each kind (Laplace): no group is more certain than its size allows
    share = np.array([(is_true[part].sum() + 1.0) / (len(part) + 2.0) for part in parts])
    weight = np.array([len(part) for part in parts], np.float64)
    fitted = isotonic_regression(share, weights=weight)
    knots = [(0.0, 0.0)]
    for first, last in zip(fitted.blocks[:-1], fitted.blocks[1:], strict=True):
        at = float(score[np.concatenate(parts[first:last])].mean())
        knot = round(at, 6), round(float(fitted.x[first]), 6)
        # shares that differ by less than the stored precision are equal
        if knots[-1][0] < knot[0] < 1.0 and knots[-1][1] < knot[1] < 1.0:
            knots.append(knot)
    return (*knots, (1.0, 1.0))
