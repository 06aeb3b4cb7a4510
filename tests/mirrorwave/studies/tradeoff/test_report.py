"""The median of a row's times and its interval, and its cells."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorwave.studies.report import Interval
from mirrorwave.studies.tradeoff.report import _median, _signed, _with_interval


def test_the_interval_of_a_median_is_that_of_drawn_frames() -> None:
    """Frames of 1, 3 and 2 ms: draws that have the first alone, the second alone, all once, and twice the third."""
    samples_ms = np.array([[1.0, 0.5, 9.0], [3.0, 3.0, 3.0], [2.0, 1.0, 2.0]])
    weights = np.array([[3, 0, 0], [0, 3, 0], [1, 1, 1], [0, 1, 2]])
    median = _median(samples_ms, weights)
    assert median.value == 2.0
    low_ms, high_ms = np.percentile([1.0, 3.0, 2.0, 2.0], (2.5, 97.5))
    assert (median.low, median.high) == pytest.approx((low_ms, high_ms))


def test_cells_have_three_digits_and_a_sign_where_they_are_differences() -> None:
    interval = Interval(value=0.12345, low=-0.1, high=0.2)
    assert (_with_interval(interval), _signed(interval)) == ("0.123 [-0.100, 0.200]", "+0.123 [-0.100, +0.200]")
    assert _signed(Interval(value=0.1, low=None, high=None)) == "-"
