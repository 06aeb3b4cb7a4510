"""What the mask adds to probabilities, fitted to reports by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from lab.training.evidence.scoring import _shift


@pytest.mark.parametrize("logit", [-1.5, 0.0, 0.8])
def test_the_shift_makes_the_mean_probability_the_share_of_hits(logit: float) -> None:
    """1,000 reports of even odds, as many hits as the logit says: the one report that is added moves it by 0.002."""
    hits = round(1000 * expit(logit))
    assert _shift(np.full(1000, 0.5), np.arange(1000) < hits) == pytest.approx(logit, abs=0.011)


def test_without_reports_nothing_is_shifted() -> None:
    assert _shift(np.zeros(0), np.zeros(0)) == 0.0
