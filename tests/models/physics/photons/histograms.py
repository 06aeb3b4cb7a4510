"""References of photon histograms: mean counts of first photons (the inverse of pile-up), bins of whole ticks."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def mean_counts_of(histogram: np.ndarray, periods: int) -> np.ndarray:
    """Return the likeliest mean counts per bin and period, float64 [bins], of first photons int64 [bins].

    The inverse of pile-up. Infinite in the bin that took all that were left; NaN behind it. Raises `ValueError`
    if counts are negative or more than there were periods.
    """
    histogram = np.asarray(histogram, np.int64)
    taken = np.cumsum(histogram)
    if (histogram < 0).any() or (len(taken) and taken[-1] > periods):
        raise ValueError(f"histogram must be counts of at most {periods} periods, got {histogram.sum()}")
    # whole numbers until here: in floats the difference of 1e12 and its neighbour would be lost
    waiting = (periods - taken + histogram).astype(np.float64)
    share = np.divide(histogram, waiting, out=np.full(len(waiting), np.nan), where=waiting > 0.0)
    full = share == 1.0
    return np.where(full, np.inf, -np.log1p(-np.where(full, 0.0, share)))


def bins_of_ticks(ticks: np.ndarray, ticks_per_bin: Fraction, bins: int) -> np.ndarray:
    """Return the histogram bin of timestamps in whole ticks, int64 of the same shape, the period being so many bins.

    The ratio is exact: with 55 ps and 1 / (512 x 15 MHz) every 264th bin edge is a tick, and an event there belongs to
    the later bin. Raises `ValueError` if ticks are negative or so many that the product leaves 64 bits.
    """
    ticks = np.asarray(ticks, np.int64)
    factor, minimum, maximum = ticks_per_bin.denominator, int(ticks.min(initial=0)), int(ticks.max(initial=0))
    if minimum < 0 or maximum * factor > np.iinfo(np.int64).max:
        raise ValueError(
            f"ticks must be 0 or more and fit 64 bits times {factor}, got {minimum if minimum < 0 else maximum}"
        )
    return np.asarray(ticks * factor // ticks_per_bin.numerator % bins)
