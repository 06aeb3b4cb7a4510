"""Mean detections of an always armed photon counter between times of a period.

The flux is periodic. A path adds its photons as a Gaussian about its delay, `timing_rms_s` wide and wrapped over the
period, of which `tail_share` come later still by an exponential delay; ambient light adds a constant rate. `counting`
draws and expects histograms from it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from models.compiled import compiled
from msgs.values.lidar import SpadParams

#: Standard deviations after which a Gaussian is zero in doubles.
REACH = 38.5
#: Mean delays after which a tail is below the rounding of its pulse, e^-40.
TAIL_REACH = 40.0
#: A rate of more photons overflows.
MAX_PHOTONS = 1e100
#: From here on exp(y^2) erfc(y) is its asymptotic series.
_LARGE_Y = 25.0
#: Above so many periods a wrapped Gaussian is constant: its first harmonic is exp(-2 pi^2 2^2) = 5e-35.
WIDEST_PERIODS = 2.0


class Pulses(NamedTuple):
    """Signal pulses of one period: all have one width."""

    #: Delay within the period, float64 [P].
    time_s: np.ndarray
    #: Mean detected photons a pulse, float64 [P].
    photons: np.ndarray


def pulses_of(spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray) -> Pulses:
    """Return the pulses of paths [P], delays taken modulo the period; paths without photons are left out.

    Raises `ValueError` unless both are of one length, finite and not negative, photons no more than `MAX_PHOTONS`.
    """
    delay_s, photons = np.asarray(delay_s, np.float64), np.asarray(photons, np.float64)
    if delay_s.ndim != 1 or delay_s.shape != photons.shape:
        raise ValueError(f"delay_s and photons must both have shape [paths], got {delay_s.shape} and {photons.shape}")
    for name, values in (("delay_s", delay_s), ("photons", photons)):
        wrong = ~(np.isfinite(values) & (values >= 0.0))
        if wrong.any():
            raise ValueError(f"{name} must be finite and not negative, got {float(values[wrong][0])!r}")
    if photons.max(initial=0.0) > MAX_PHOTONS:
        raise ValueError(f"photons must not exceed {MAX_PHOTONS:g} a pulse, got {float(photons.max())!r}")
    some = photons > 0.0
    return Pulses(np.fmod(delay_s[some], spad.period_s), photons[some])


def counts_between(spad: SpadParams, pulses: Pulses, edges_s: np.ndarray) -> np.ndarray:
    """Return mean detections between neighbouring edges within a period, float64 [edges - 1]; edges ascend.

    Each is a difference of tails on the pulse's own side, so that it keeps its digits far from the pulse.
    """
    counts = spad.ambient_rate_hz * np.diff(edges_s)
    if spad.timing_rms_s > WIDEST_PERIODS * spad.period_s:
        return np.asarray(counts + pulses.photons.sum() / spad.period_s * np.diff(edges_s))
    _add_pulses(counts, edges_s, *pulses, *_shape(spad), spad.period_s, _images(spad))
    return counts


def _images(spad: SpadParams) -> int:
    """Return the number of periods to either side from which a pulse reaches into this one."""
    return math.ceil((REACH * spad.timing_rms_s + _tail_reach_s(spad)) / spad.period_s)


def _shape(spad: SpadParams) -> tuple[float, float, float]:
    """Return the standard deviation of a pulse, the share of its tail, and that deviation over the mean delay."""
    if spad.tail_share == 0.0:
        return spad.timing_rms_s, 0.0, 1.0
    return spad.timing_rms_s, spad.tail_share, spad.timing_rms_s / spad.tail_s


def _tail_reach_s(spad: SpadParams) -> float:
    return TAIL_REACH * spad.tail_s if spad.tail_share > 0.0 else 0.0


def share_within(spad: SpadParams, half_s: float) -> float:
    """Return the share of a path's photons within so many seconds to either side of its delay, without wrapping."""
    rms_s, tail_share, ratio = _shape(spad)
    before, behind = (_outside(z, tail_share, ratio) for z in (-half_s / rms_s, half_s / rms_s))
    return float(1.0 - before - behind)


@compiled
def _scaled_erfc(y):  # type: ignore[no-untyped-def]
    """Return exp(y^2) erfc(y) of a positive number."""
    if y < _LARGE_Y:
        return math.exp(y * y) * math.erfc(y)
    x = 0.5 / (y * y)
    return (1.0 - x * (1.0 - x * (3.0 - x * (15.0 - x * 105.0)))) / (y * math.sqrt(math.pi))


@compiled
def _delayed(z, ratio):  # type: ignore[no-untyped-def]
    """Return the share of a tail's photons that are due z standard deviations after the path's delay and still to come.

    `ratio` is the standard deviation over the mean exponential delay.
    """
    y = math.sqrt(0.5) * (ratio - z)
    if y > 0.0:
        return 0.5 * math.exp(-0.5 * z * z) * _scaled_erfc(y)
    return 0.5 * math.exp(0.5 * ratio * ratio - ratio * z) * math.erfc(y)


@compiled
def _outside(z, tail_share, ratio):  # type: ignore[no-untyped-def]
    """Return the share of a pulse on the far side of z: before it where z is negative, else after it."""
    gaussian = 0.5 * math.erfc(math.sqrt(0.5) * abs(z))
    if tail_share == 0.0:
        return gaussian
    delayed = tail_share * _delayed(z, ratio)
    return max(gaussian - delayed, 0.0) if z < 0.0 else gaussian + delayed


@compiled
def _add_pulses(  # type: ignore[no-untyped-def]
    counts, edges_s, delay_s, photons, rms_s, tail_share, ratio, period_s, images
):
    reach_s = REACH * rms_s
    later_s = reach_s + (TAIL_REACH * rms_s / ratio if tail_share > 0.0 else 0.0)
    for path in range(len(delay_s)):
        for image in range(-images, images + 1):
            centre = delay_s[path] + image * period_s
            first = max(np.searchsorted(edges_s, centre - reach_s) - 1, 0)
            last = min(np.searchsorted(edges_s, centre + later_s), len(edges_s) - 1)
            if first >= last:
                continue
            z = (edges_s[first] - centre) / rms_s
            tail = _outside(z, tail_share, ratio)
            for cell in range(first, last):
                next_z = (edges_s[cell + 1] - centre) / rms_s
                next_tail = _outside(next_z, tail_share, ratio)
                # tails of one side are subtracted; across the middle both are missing from 1
                share = 1.0 - tail - next_tail if z < 0.0 <= next_z else abs(next_tail - tail)
                counts[cell] += photons[path] * share
                z, tail = next_z, next_tail
