"""Numbers of the evaluation's report."""

from __future__ import annotations

import math

import numpy as np

from lab.evaluate.method_report import _spelled, interval_text


def test_numbers_that_json_lacks_are_spelled() -> None:
    assert interval_text((0.12345, 0.1, 0.2)) == "0.123 [0.1, 0.2]"
    assert interval_text((math.nan, 0.1, 0.2)) == "-"
    assert _spelled(np.array([[[1.0, math.inf]]])) == [[[1.0, "inf"]]]
