"""Calibration table from scores to probabilities."""

from __future__ import annotations

import numpy as np
from scipy.optimize import isotonic_regression

from models.perception.find.score_calibration import ScoreTable

#: Minimum reports of a group: the standard error of a group's share stays below 0.1.
GROUP = 30


def fit_table(score: np.ndarray, is_true: np.ndarray, groups: int = 20) -> ScoreTable:
    """Return the knots of the monotone table: mean score and share of true ones of groups of equal size, isotonic.

    Groups that would fall are pooled (isotonic regression), so the table rises strictly: ranks stay. Below the first
    group it falls to (0, 0), above the last it rises to (1, 1). Empty if there are too few for two groups.
    Raises `ValueError` if scores leave 0..1.
    """
    if not ((score >= 0.0) & (score <= 1.0)).all():
        raise ValueError(f"score must lie in 0..1, got {score.min()}..{score.max()}")
    groups = min(groups, len(score) // GROUP)
    if groups < 2:
        return ()
    order = np.argsort(score, kind="stable")
    parts = np.array_split(order, groups)
    # one more of each kind (Laplace): no group is more certain than its size allows
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
