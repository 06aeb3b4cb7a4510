"""First photons of a period against closed forms, statistics and their own inverse."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from models.physics.photons.first_photon import first_photon_histogram, first_photon_probability
from tests.models.physics.photons.histograms import bins_of_ticks, mean_counts_of

#: Table 2: 15 MHz, 512 bins, 55 ps a tick; 1e12 / (512 * 15e6 * 55) ticks a bin.
TICKS_PER_BIN = Fraction(10**12, 512 * 15 * 10**6 * 55)


def test_constant_light_decays_geometrically() -> None:
    """m a bin: p[i] = e^{-i m} (1 - e^{-m}), none: e^{-n m}; sum 1 to rounding."""
    p, none = first_photon_probability(np.full(512, 2.0 / 512))
    index = np.arange(512)
    np.testing.assert_allclose(p, np.exp(-index * 2.0 / 512) * (1.0 - np.exp(-2.0 / 512)), rtol=1e-12)
    assert none == pytest.approx(np.exp(-2.0), rel=1e-12)
    assert p.sum() + none == pytest.approx(1.0, abs=1e-13)


def test_ambient_light_of_the_specification_has_its_median_at_23_ns() -> None:
    """3e7 counts a second: half of all first photons come within ln 2 / 3e7 = 23.1 ns of the period's start."""
    bin_s = 1.0 / (15e6 * 512)
    p, _ = first_photon_probability(np.full(512, 3e7 * bin_s))
    assert np.searchsorted(np.cumsum(p), 0.5) * bin_s == pytest.approx(np.log(2.0) / 3e7, abs=bin_s)


def test_many_histograms_at_once_are_each_their_own() -> None:
    mean_counts = np.random.default_rng(0).random((3, 4, 20))
    p, none = first_photon_probability(mean_counts)
    for i in range(3):
        one, nothing = first_photon_probability(mean_counts[i, 2])
        np.testing.assert_array_equal(p[i, 2], one)
        assert none[i, 2] == nothing


def test_draws_have_the_probabilities() -> None:
    """Three laws in one call, of 2e4, 1e5 and 3e9 periods. Chi-square of 20 seeds over bins and none: none of the
    p-values under 1e-4, and in each row evenly spread (Kolmogorov-Smirnov).
    """
    mean_counts = np.array([[0.01], [0.3], [1e-3]]) * np.random.default_rng(1).random(30)
    periods = np.array([20_000, 100_000, 3_000_000_000])
    p, none = first_photon_probability(mean_counts)
    expected, values = periods[:, None] * np.column_stack([p, none]), []
    assert expected.min() > 1.0
    for seed in range(20):
        drawn = first_photon_histogram(mean_counts, periods, np.random.default_rng(seed))
        seen = np.column_stack([drawn, periods - drawn.sum(axis=1)])
        values.append(chi2.sf(np.sum((seen - expected) ** 2 / expected, axis=1), p.shape[1]))
    assert np.min(values) > 1e-4
    assert all(kstest(row, "uniform").pvalue > 0.01 for row in np.transpose(values))


def test_pile_up_is_undone() -> None:
    """1e9 periods, counts from 0.001 to 0.2 a bin: mean counts come back within five of their own errors."""
    mean_counts = np.linspace(0.001, 0.2, 40)
    drawn = first_photon_histogram(mean_counts, 10**9, np.random.default_rng(2))
    waiting = 1e9 * np.exp(-np.concatenate([[0.0], np.cumsum(mean_counts)[:-1]]))
    error = np.sqrt(np.expm1(mean_counts) / waiting)
    assert (np.abs(mean_counts_of(drawn, 10**9) - mean_counts) < 5.0 * error).all()


def test_same_seed_same_photons() -> None:
    one, two = (first_photon_histogram(np.full(64, 0.1), 1000, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_ticks_of_the_specification_comb_the_bins() -> None:
    """130.2 / 55 = 2.37: bins hold two ticks or three, 264 ticks fall into 625 / 264 as many; order stays."""
    bins = bins_of_ticks(np.arange(1212), TICKS_PER_BIN, 512)
    assert set(np.bincount(bins)[:511]) == {2, 3}
    assert (np.diff(bins) >= 0).all()
    assert bins_of_ticks(np.array([0, 2, 3, 625]), TICKS_PER_BIN, 512).tolist() == [0, 0, 1, 264]


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (lambda: first_photon_probability(np.array([0.1, -1e-9])), "mean_counts must be finite and not negative"),
        (lambda: first_photon_probability(np.array([np.nan])), "mean_counts must be finite"),
        (lambda: first_photon_histogram(np.ones((2, 2)), 1, np.random.default_rng()), r"shape \[bins\]"),
        (lambda: first_photon_histogram(np.ones(2), -1, np.random.default_rng()), "periods must not be negative"),
        (lambda: mean_counts_of(np.array([3, 4]), 6), "counts of at most 6 periods, got 7"),
        (lambda: mean_counts_of(np.array([-1]), 6), "histogram must be counts"),
        (lambda: bins_of_ticks(np.array([-1]), TICKS_PER_BIN, 512), "ticks must be 0 or more"),
        (lambda: bins_of_ticks(np.array([2**62]), TICKS_PER_BIN, 512), "ticks must be 0 or more and fit 64 bits"),
    ],
)
def test_what_is_no_count_is_refused(call, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        call()
