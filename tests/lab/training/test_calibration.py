from __future__ import annotations

import numpy as np
import pytest

from lab.training.calibration import fit_table
from models.perception.find.score_calibration import calibrated, check_table


def drawn(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """An overconfident detector: a peak with score s is true with probability s^2."""
    rng = np.random.default_rng(seed)
    score = rng.uniform(0.2, 1.0, count)
    return score, rng.random(count) < score**2


def test_table_finds_the_law_that_outcomes_follow() -> None:
    """4000 peaks in 20 groups: a share's standard error is below 0.036, the table within three of them of s^2."""
    table = fit_table(*drawn(4000, seed=0))
    check_table("table", table)
    score = np.linspace(0.3, 0.95, 14)
    np.testing.assert_allclose(calibrated(table, score), score**2, atol=0.11)


def test_ranks_stay() -> None:
    rng = np.random.default_rng(3)
    score = np.sort(rng.uniform(0.2, 1.0, 500))
    # outcomes that fall with the score: the pooled table still rises
    table = fit_table(score, rng.random(500) < 1.0 - score)
    assert (np.diff(calibrated(table, score)) > 0.0).all()


def test_too_few_peaks_give_no_table() -> None:
    assert fit_table(*drawn(59, seed=0)) == ()
    assert fit_table(np.zeros(0), np.zeros(0, bool)) == ()
    with pytest.raises(ValueError, match=r"score must lie in 0\.\.1"):
        fit_table(np.array([0.5, 2.0]), np.array([True, False]))
