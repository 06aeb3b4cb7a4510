"""Hard cases of counting photons: no light, all light, single counts among 1e12, events on the edges of bins."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from mpmath import mp, mpf

from models.physics.photons.first_photon import first_photon_probability
from tests.models.physics.photons.histograms import bins_of_ticks, mean_counts_of
from tests.stability.catalogue import Errors

EPS = 2.0**-52
mp.dps = 60


def exact(mean_counts: np.ndarray) -> list[mpf]:
    """The same law in 60 digits."""
    before, found = mpf(0), []
    for one in mean_counts.tolist():
        found.append(mp.exp(-before) * (1 - mp.exp(-mpf(one))))
        before += mpf(one)
    return found


def differences(mean_counts: np.ndarray) -> np.ndarray:
    """The naive form: how much the distribution grows from bin to bin."""
    return np.diff(1.0 - np.exp(-np.cumsum(mean_counts)), prepend=0.0)


def worst(found: np.ndarray, wanted: list[mpf]) -> float:
    return max(float(abs(mpf(float(one)) / other - 1)) for one, other in zip(found, wanted, strict=True))


@pytest.mark.hard("models.physics.photons.first_photon", "differences of the distribution", 8 * EPS, "",
                  "four roundings of a half each, and the exponential's")  # fmt: skip
def test_hardly_any_light(errors: Errors) -> None:
    """1e-18 counts a bin: 1 - e^{-m} of doubles is zero. Relative error of the probabilities."""
    mean_counts = np.full(64, 1e-18)
    errors(
        naive=worst(differences(mean_counts), exact(mean_counts)),
        ours=worst(first_photon_probability(mean_counts)[0], exact(mean_counts)),
    )


@pytest.mark.hard("models.physics.photons.first_photon", "differences of the distribution", 600 * EPS, "",
                  "the exponential turns a relative error of 600 counts, 64 sums of half a rounding at most, into "
                  "one of p")  # fmt: skip
def test_total_pile_up(errors: Errors) -> None:
    """600 counts a period: late bins are seen in one of 1e260 periods, and all of them are told apart from never."""
    mean_counts = np.full(64, 600.0 / 64)
    errors(
        naive=worst(differences(mean_counts), exact(mean_counts)),
        ours=worst(first_photon_probability(mean_counts)[0], exact(mean_counts)),
    )


@pytest.mark.hard("tests.models.physics.photons.histograms", "-log(1 - h / n)", 8 * EPS, "",
                  "a quotient of whole numbers below 2^53 and log1p, one rounding each")  # fmt: skip
def test_one_count_in_a_million_million_periods(errors: Errors) -> None:
    """Pile-up undone where there is none: 1 - 1e-12 has four digits of the count left. Relative error."""
    histogram, periods = np.arange(1, 9), 10**12
    before = np.cumsum(histogram) - histogram
    wanted = [-mp.log(1 - mpf(int(one)) / (periods - int(gone))) for one, gone in zip(histogram, before, strict=True)]
    errors(
        naive=worst(-np.log(1.0 - histogram / (periods - before)), wanted),
        ours=worst(mean_counts_of(histogram, periods), wanted),
    )


@pytest.mark.hard("tests.models.physics.photons.histograms", "sums of counts in float32", 1e-9, "",
                  "whole numbers below 2^63: only quotient and logarithm round; counts are given")  # fmt: skip
def test_the_last_of_a_million_million_counts(errors: Errors) -> None:
    """1e12 periods of which 1,000 are left for the last bin, which takes half. Relative error of its mean count."""
    histogram, periods = np.array([10**12 - 1000, 500]), 10**12
    left = np.float32(periods) - np.cumsum(histogram.astype(np.float32))[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        naive = -np.log(1.0 - np.float32(500) / left)
    wanted = np.log(2.0)
    errors(
        naive=float(abs(naive / wanted - 1.0)), ours=abs(float(mean_counts_of(histogram, periods)[1]) / wanted - 1.0)
    )


@pytest.mark.hard("tests.models.physics.photons.histograms", "floor(tick x 55 ps / bin width) in float64", 0.0,
                  "of the events on an edge", "a ratio of whole numbers")  # fmt: skip
def test_events_on_the_edges_of_bins(errors: Errors) -> None:
    """55 ps ticks, bins of 1 / (512 x 15 MHz): every 625th tick is an edge, and rounding puts it on either side."""
    ratio = Fraction(10**12, 512 * 15 * 10**6 * 55)
    edges = np.arange(0, 400_000) * 625
    wanted = np.arange(0, 400_000) * 264 % 512
    naive = np.floor(edges * 55e-12 / (1.0 / 15e6 / 512)).astype(np.int64) % 512
    errors(naive=np.mean(naive != wanted), ours=np.mean(bins_of_ticks(edges, ratio, 512) != wanted))
