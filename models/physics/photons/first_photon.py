"""Histograms of the first photon of every laser period: probabilities and draws.

A single-photon detector that is re-armed each period keeps its first detection alone. With mean counts m[i] in the
bins of a period the first photon falls into bin i with exp(-(m[0] + .. + m[i-1])) (1 - exp(-m[i])): early bins fill,
later ones are depleted (pile-up). Periods are independent here: the dead time ends before the next one begins.
"""

from __future__ import annotations

import numpy as np

from models.compiled import compiled


def first_photon_probability(mean_counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the probability of the first photon in each bin, float64 [..., bins], and of none at all [...].

    `mean_counts` [..., bins] of one period, signal and ambient light together. Raises `ValueError` where one is
    negative or not finite. Source: Poisson counts of Eqs. (11) and (12), first detection kept.
    """
    mean_counts = _checked(mean_counts)
    # counts before the bin are summed, not subtracted from those up to it
    until = np.cumsum(mean_counts, axis=-1)
    before = np.concatenate([np.zeros_like(until[..., :1]), until[..., :-1]], axis=-1)
    return np.exp(-before) * -np.expm1(-mean_counts), np.exp(-until[..., -1])


def first_photon_histogram(mean_counts: np.ndarray, periods: int | np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw the first photons of so many periods, int64 [..., bins], of mean counts [..., bins]: exact, bin after bin.

    `periods` [...] may differ from histogram to histogram. Of the periods without a photon so far each has one in the
    next bin with 1 - exp(-m): no probability is ever normalised, whatever the flux. Raises `ValueError` for counts as
    above, and unless `periods` has that shape and is 0 or more.
    """
    mean_counts, waiting = _checked(mean_counts), np.array(periods, np.int64)
    if mean_counts.ndim != waiting.ndim + 1 or mean_counts.shape[:-1] != waiting.shape:
        raise ValueError(f"mean_counts must have shape [bins] for each of periods, got {mean_counts.shape}")
    if (waiting < 0).any():
        raise ValueError(f"periods must not be negative, got {waiting.min()}")
    histogram = np.zeros(mean_counts.shape, np.int64)
    probability = -np.expm1(-mean_counts)
    bins = mean_counts.shape[-1]
    _draw(probability.reshape(-1, bins), waiting.reshape(-1), rng, histogram.reshape(-1, bins))
    return histogram


@compiled
def _draw(probability, waiting, rng, histogram):  # type: ignore[no-untyped-def]
    """Fill a histogram [rows, bins] bin after bin; changes `waiting` [rows]. Calls of numpy take 30 times as long."""
    for index in range(probability.shape[1]):
        for row in range(probability.shape[0]):
            histogram[row, index] = rng.binomial(waiting[row], probability[row, index])
            waiting[row] -= histogram[row, index]


def _checked(mean_counts: np.ndarray) -> np.ndarray:
    mean_counts = np.asarray(mean_counts, np.float64)
    if not (np.isfinite(mean_counts) & (mean_counts >= 0.0)).all():
        raise ValueError("mean_counts must be finite and not negative")
    return mean_counts
