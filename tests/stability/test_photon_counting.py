"""Hard cases of whole photon histograms: far tails of pulses, bins nobody reaches, phases of ticks, dark cells."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.special import ndtr

from models.physics.photons.counting import comb, expected_histogram
from models.physics.photons.dead_time import regained
from models.physics.photons.flux import counts_between, pulses_of
from msgs.values.lidar import SpadParams
from tests.stability.catalogue import Errors

EPS = 2.0**-52
mp.dps = 60


def worst(found: np.ndarray, wanted: list) -> float:
    return max(float(abs(mpf(float(one)) / other - 1)) for one, other in zip(found, wanted, strict=True))


@pytest.mark.hard("models.physics.photons.flux", "differences of the distribution", 1e-10, "",
                  "exp(-z^2 / 2) at z = 35 turns the rounding of delays, 100 ps wide pulses at 20 ns, into z^2 200 "
                  "eps")  # fmt: skip
def test_far_behind_a_pulse(errors: Errors) -> None:
    """Up to 35 standard deviations behind its delay a pulse has 1e-268 photons, 1 - 1 in doubles. Relative error."""
    spad = SpadParams(ambient_rate_hz=0.0)
    edges_s = 20e-9 + np.linspace(2.0, 35.0, 60) * spad.timing_rms_s
    z = [(mpf(float(one)) - mpf(20e-9)) / mpf(spad.timing_rms_s) for one in edges_s]
    tail = [mp.erfc(one / mp.sqrt(2)) / 2 for one in z]
    wanted = [one - other for one, other in pairwise(tail)]
    errors(
        naive=worst(np.diff(ndtr((edges_s - 20e-9) / spad.timing_rms_s)), wanted),
        ours=worst(counts_between(spad, pulses_of(spad, [20e-9], [1.0]), edges_s), wanted),
    )


@pytest.mark.hard("models.physics.photons.counting", "differences of the distribution", 450 * 600 * EPS / 2, "",
                  "the exponential turns an error of 600 counts, 450 sums of half a rounding, into a relative one of "
                  "p")  # fmt: skip
def test_bins_behind_total_pile_up(errors: Errors) -> None:
    """600 photons at 5 ns: what comes after is seen in one of 1e260 periods. Relative error."""
    spad = SpadParams(arming="gated")
    found = expected_histogram(spad, np.array([5e-9]), np.array([600.0]))[60:511]
    edges = [mpf(float(one)) for one in comb(spad).edges_s[0, 60:512]]
    survived = [mp.exp(-600 - mpf(spad.ambient_rate_hz) * one) for one in edges]
    wanted = [spad.pulses * (one - other) for one, other in pairwise(survived)]
    until = 1.0 - np.exp(-600.0 - spad.ambient_rate_hz * comb(spad).edges_s[0, 60:512])
    errors(naive=worst(spad.pulses * np.diff(until), wanted), ours=worst(found, wanted))


@pytest.mark.hard("models.physics.photons.counting", "period number times period, modulo the tick, in float64", 1e-12,
                  "ticks", "one rounding of a time under a tick")  # fmt: skip
def test_ticks_of_a_run_after_450_000_periods(errors: Errors) -> None:
    """Ticks lie anew in each period: every 33rd begins on one, and rounding puts it a whole tick late."""
    spad = msgspec.structs.replace(SpadParams(), tick_from="run")
    period = np.arange(450_000)
    ratio = Fraction(10**12, 15 * 10**6 * 55)
    wanted = -(period * ratio.numerator % ratio.denominator) % ratio.denominator / ratio.denominator
    naive = -np.fmod(period * spad.period_s, spad.tick_s) % spad.tick_s / spad.tick_s
    ours = comb(spad).edges_s[period % 33, 0] / spad.tick_s
    errors(naive=np.abs(naive - wanted).max(), ours=np.abs(ours - wanted).max())


@pytest.mark.hard("models.physics.photons.dead_time", "1 - (1 - e^-m) / m", 8 * EPS, "",
                  "a short series or two roundings next to a half")  # fmt: skip
def test_hardly_any_flux_in_a_cell(errors: Errors) -> None:
    """Who comes back within a dark cell is detected there with m / 2: the closed form is 0 / 0 at last. Relative."""
    counts = np.logspace(-18.0, -1.01, 50)
    wanted = [1 - (1 - mp.exp(-mpf(float(one)))) / mpf(float(one)) for one in counts]
    errors(naive=worst(1.0 + np.expm1(-counts) / counts, wanted), ours=worst(regained(counts), wanted))
