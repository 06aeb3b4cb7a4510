"""The exponential tail of a pulse against scipy's exponentially modified Gaussian, and its wrapping over the period."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.stats import exponnorm, norm

from models.physics.photons.counting import draw_histogram, expected_histogram
from models.physics.photons.flux import counts_between, pulses_of, share_within
from msgs.values.lidar import SpadParams

DELAY_S = 20e-9


def with_tail(tail_share: float, tail_s: float) -> SpadParams:
    return SpadParams(tail_share=tail_share, tail_s=tail_s, ambient_rate_hz=0.0, tick_s=0.0)


def until(spad: SpadParams, time_s: np.ndarray) -> np.ndarray:
    """Share of a pulse until a time, by scipy; one period long."""
    rms_s = spad.timing_rms_s
    late = exponnorm.cdf(time_s, spad.tail_s / rms_s, DELAY_S, rms_s)
    return (1.0 - spad.tail_share) * norm.cdf(time_s, DELAY_S, rms_s) + spad.tail_share * late


@pytest.mark.parametrize(("tail_share", "tail_s"), [(0.4, 0.3e-9), (1.0, 1e-9), (0.3, 1e-13), (0.5, 85e-12)])
def test_a_tail_is_the_exponentially_modified_gaussian(tail_share: float, tail_s: float) -> None:
    """Counts of 75 ps cells from 1 ns before the delay to 10 ns after it; tails end within the period. To 1e-13."""
    spad = with_tail(tail_share, tail_s)
    edges_s = DELAY_S + np.linspace(-1e-9, 10e-9, 147)
    found = counts_between(spad, pulses_of(spad, [DELAY_S], [1.0]), edges_s)
    assert found == pytest.approx(np.diff(until(spad, edges_s)), abs=1e-13)
    assert share_within(spad, 1e-9) == pytest.approx(np.diff(until(spad, DELAY_S + np.array([-1e-9, 1e-9])))[0])


@pytest.mark.parametrize("tail_s", [0.3e-9, 20e-9, 66e-9])
def test_photons_are_conserved_however_often_a_tail_wraps(tail_s: float) -> None:
    """A tail as long as the period reaches 40 periods on, e^-40 of it beyond."""
    spad = with_tail(0.7, tail_s)
    pulses = pulses_of(spad, [DELAY_S, 60e-9], [1.0, 2.0])
    assert counts_between(spad, pulses, np.linspace(0.0, spad.period_s, 300)).sum() == pytest.approx(3.0, rel=1e-13)


def test_draws_have_the_expected_tail() -> None:
    """177,000 photons: chi-square per bin of those with 20 expected or more, 1 but for counting (sd 0.21)."""
    spad = msgspec.structs.replace(with_tail(0.4, 1e-9), arming="gated")
    paths = np.array([DELAY_S]), np.array([0.5])
    expected, counted = expected_histogram(spad, *paths), draw_histogram(spad, *paths, np.random.default_rng(2))
    some = expected > 20.0
    assert some.sum() > 40
    assert np.mean(np.square(counted - expected)[some] / expected[some]) < 1.5


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"tail_share": 0.3}, r"tail_s must be at least 0\.001 of the pulse"),
        ({"tail_share": 1.1, "tail_s": 1e-9}, r"tail_share must lie in 0\.\.1"),
        ({"tail_share": float("nan"), "tail_s": 1e-9}, r"tail_share must lie in 0\.\.1"),
        ({"tail_s": 1e-7}, "tail_s must not exceed the period"),
    ],
)
def test_a_tail_that_is_none_is_refused(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SpadParams(**fields)
