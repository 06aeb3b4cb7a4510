"""The median of a row's times and its interval, and its cells."""

from __future__ import annotations

import numpy as np
import pytest

from lab.studies.report import Interval, Times
from lab.tradeoff.row_report import Report, Row, _median, _signed, _with_interval, markdown
from lab.tradeoff.row_runs import BEFORE, PARTS


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


def test_rows_of_the_page_are_the_fastest_first_and_failed_ones_last() -> None:
    def row(name: str, p50: float | None) -> Row:
        times = None if p50 is None else Times(p50=p50, p90=None, p99=None)
        one = Interval(value=0.5, low=0.4, high=0.6)
        names = ("object_f1", "object_recall_25_db", "false_objects_per_scan", "object_loss_per_scan")
        accuracy = dict.fromkeys((*names, "recovered_f1_1m", "dense_macro_f1"), one)
        return Row(
            name=name, switch="s", value="v", params={}, over="", failed=None if times else "why", end_to_end_ms=times,
            accuracy=accuracy, stages_ms=dict.fromkeys((*PARTS, BEFORE), Times(p50=1.0, p90=None, p99=None)),
        )  # fmt: skip

    report = Report(
        command="c", machine="m", versions={}, seed=1, frames=1, repeats=1, deadline_ms=300.0,
        rows=[row("slow", 90.0), row("none", None), row("quick", 10.0)],
    )  # fmt: skip
    names = [
        line.split("|")[1].strip()
        for line in markdown(report).splitlines()
        if line.startswith("| ") and "---" not in line
    ]
    assert names == ["row", "quick", "slow", "none"]
