"""Mean detections of an always armed photon counter: between times of a period, and the time that reaches a count.

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
#: Nodes of a flux table in one standard deviation of the pulse, or in one mean delay of the tail.
NODES_PER_RMS = 32
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


class FluxTable(NamedTuple):
    """Mean detections since the start of a period, a cubic between nodes: 1e-8 of a pulse's photons off at most."""

    #: 0 .. T_rep, ascending.
    time_s: np.ndarray
    counts: np.ndarray
    rate_hz: np.ndarray


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


def flux_table(spad: SpadParams, pulses: Pulses) -> FluxTable:
    """Return the flux of one period, for `counts_at`, `time_at`; nodes only about pulses, `NODES_PER_RMS` of them."""
    rms_s, period_s = spad.timing_rms_s, spad.period_s
    if rms_s > WIDEST_PERIODS * period_s:
        rate_hz = spad.ambient_rate_hz + pulses.photons.sum() / period_s
        return FluxTable(np.array([0.0, period_s]), np.array([0.0, rate_hz * period_s]), np.full(2, rate_hz))
    time_s = _nodes(pulses.time_s, spad)
    rate_hz = np.full(len(time_s), spad.ambient_rate_hz)
    _add_rates(rate_hz, time_s, *pulses, *_shape(spad), period_s, _images(spad))
    counts = np.concatenate([[0.0], np.cumsum(counts_between(spad, pulses, time_s))])
    return FluxTable(time_s, counts, rate_hz)


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


def _nodes(delay_s: np.ndarray, spad: SpadParams) -> np.ndarray:
    rms_s, period_s = spad.timing_rms_s, spad.period_s
    size, reach = math.ceil(NODES_PER_RMS * period_s / rms_s), math.ceil(REACH * NODES_PER_RMS)
    centres = np.unique(np.rint(delay_s / period_s * size).astype(np.int64))
    step = max(int(size * spad.tail_s / period_s / NODES_PER_RMS), 1)
    later = np.arange(reach + 1, reach + _tail_reach_s(spad) / period_s * size, step).astype(np.int64)
    offsets = np.concatenate([np.arange(-reach, reach + 1), later])
    if size <= (len(offsets) - 1) * len(centres):
        return np.linspace(0.0, period_s, size + 1)
    near = (centres[:, None] + offsets).ravel() % size
    return np.append(np.unique(np.append(near, 0)) * (period_s / size), period_s)


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


@compiled
def _add_rates(  # type: ignore[no-untyped-def]
    rate_hz, time_s, delay_s, photons, rms_s, tail_share, ratio, period_s, images
):
    reach_s = REACH * rms_s
    later_s = reach_s + (TAIL_REACH * rms_s / ratio if tail_share > 0.0 else 0.0)
    for path in range(len(delay_s)):
        peak_hz = photons[path] * (1.0 - tail_share) / (math.sqrt(2.0 * math.pi) * rms_s)
        late_hz = photons[path] * tail_share * ratio / rms_s
        for image in range(-images, images + 1):
            centre = delay_s[path] + image * period_s
            first = np.searchsorted(time_s, centre - reach_s)
            for node in range(first, np.searchsorted(time_s, centre + later_s)):
                z = (time_s[node] - centre) / rms_s
                rate_hz[node] += peak_hz * math.exp(-0.5 * z * z)
                if tail_share > 0.0:
                    rate_hz[node] += late_hz * _delayed(z, ratio)


@compiled
def _cell_counts(u, gain, left, right):  # type: ignore[no-untyped-def]
    """Return counts from the start of a cell to its part u: a cubic of the cell's gain and the slopes at its ends."""
    return u * (left + u * (3.0 * gain - 2.0 * left - right + u * (left + right - 2.0 * gain)))


@compiled
def cell_of(value, edges):  # type: ignore[no-untyped-def]
    """Return the last cell between ascending edges that begins at or below a value; -1 before them all."""
    low, high = -1, len(edges)
    while high - low > 1:
        middle = (low + high) >> 1
        if edges[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@compiled
def counts_at(at_s, time_s, counts, rate_hz):  # type: ignore[no-untyped-def]
    """Return mean detections from the start of the period to a time within it; the last three are a `FluxTable`."""
    cell = min(max(cell_of(at_s, time_s), 0), len(time_s) - 2)
    width_s = time_s[cell + 1] - time_s[cell]
    u = (at_s - time_s[cell]) / width_s
    gain = counts[cell + 1] - counts[cell]
    return counts[cell] + _cell_counts(u, gain, rate_hz[cell] * width_s, rate_hz[cell + 1] * width_s)


@compiled
def time_at(wanted, time_s, counts, rate_hz):  # type: ignore[no-untyped-def]
    """Return the time within the period at which mean detections reach a number: the inverse of `counts_at`."""
    cell = min(max(cell_of(wanted, counts), 0), len(time_s) - 2)
    width_s, gain = time_s[cell + 1] - time_s[cell], counts[cell + 1] - counts[cell]
    rest = wanted - counts[cell]
    if not 0.0 < rest < gain:
        return time_s[cell] if rest <= 0.0 else time_s[cell + 1]
    left, right = rate_hz[cell] * width_s, rate_hz[cell + 1] * width_s
    low, high, u = 0.0, 1.0, rest / gain
    for _ in range(60):
        off = _cell_counts(u, gain, left, right) - rest
        if off > 0.0:
            high = u
        else:
            low = u
        slope = left + u * (2.0 * (3.0 * gain - 2.0 * left - right) + u * 3.0 * (left + right - 2.0 * gain))
        following = u - off / slope if slope > 0.0 else 0.5 * (low + high)
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - u) <= 1e-14:
            break
        u = following
    return time_s[cell] + u * width_s
