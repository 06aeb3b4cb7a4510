"""Scores that are probabilities: a monotone table from a network's score to the share of such peaks that are true."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Knots (score, probability), both rising within 0..1 and linear between; no knots leave scores as they are.
ScoreTable = tuple[tuple[float, float], ...]


def check_table(name: str, table: Sequence[Sequence[float]]) -> None:
    """Raise `ValueError` naming the field unless the knots rise in both columns, from 0 to 1 at most."""
    knots = np.asarray(table, np.float64).reshape(-1, 2)
    if not (np.isfinite(knots).all() and (knots >= 0.0).all() and (knots <= 1.0).all()):
        raise ValueError(f"{name} must lie in 0..1, got {knots.tolist()}")
    if len(knots) == 1 or (np.diff(knots, axis=0) <= 0.0).any():
        raise ValueError(f"{name} must be empty or rise in score and in probability, got {knots.tolist()}")


def calibrated(table: ScoreTable, score: np.ndarray) -> np.ndarray:
    """Return the probabilities [N] of scores [N]; scores beyond the table take its ends."""
    if not table:
        return score
    knots = np.array(table)
    return np.interp(score, knots[:, 0], knots[:, 1])


def score_of(table: ScoreTable, probability: float) -> float:
    """Return the score that has a probability, the inverse of `calibrated`."""
    if not table:
        return probability
    knots = np.array(table)
    return float(np.interp(probability, knots[:, 1], knots[:, 0]))
