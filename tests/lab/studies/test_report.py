"""Shared parts of the studies' reports: quantiles that their samples carry, tables, numbers that JSON holds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.studies.report import Times, finite, quantiles_ms
from mirrorwave.plots.markdown import table


@pytest.mark.parametrize(
    ("count", "known"),
    [(1, ()), (2, ("p50",)), (19, ("p50",)), (20, ("p50", "p90")), (199, ("p50", "p90")), (200, ("p50", "p90", "p99"))],
)
def test_a_quantile_needs_samples(count: int, known: tuple[str, ...]) -> None:
    """Of 0, 1, ... n - 1 ms a quantile q is q (n - 1) ms."""
    times = quantiles_ms(np.arange(float(count)))
    wanted = {name: share * (count - 1) if name in known else None for name, share in SHARES.items()}
    assert times == Times(**{name: None if value is None else pytest.approx(value) for name, value in wanted.items()})


SHARES = {"p50": 0.5, "p90": 0.9, "p99": 0.99}


def test_what_is_no_number_is_null_and_a_table_has_its_columns() -> None:
    assert (finite(2.5), finite(math.nan), finite(-math.inf)) == (2.5, None, None)
    assert table(["a", "b"], [["1", "2"]]) == ["| a | b |", "| --- | --- |", "| 1 | 2 |"]
