"""Upper bounds of what echoes can add up to in any cell: magnitudes summed, never phases.

A cell is one of `range_bins` bins of one beam's Hann-windowed profile. An echo's factor along the sweep (squint) is
c_0 + c_1 T_1 + ... + c_4 T_4 over the chirp; each term has a range kernel of its own, taken as its largest within a
quarter of a bin.
The start of a chirp that still belongs to the previous one is bounded by the window's small values there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from scipy import fft

from models.physics.antenna import element_field, two_way_pattern
from models.physics.waveform import beat_frequency_hz
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.fmcw import departure
from sim_player.signal.switches import SignalEffects, column_weights, isotropic, sampled, sweep_ratio
from sim_player.trace.paths import Paths

#: Steps of a range bin in which echoes are gathered, and those of the slowly varying bound of the overlap.
STEPS, COARSE = 4, 16
#: Points within a step at which a kernel is looked at, and what may hide between them.
LOOKS, BETWEEN = 4, 1.02
TERMS = 5
#: Rounding of the patterns, relative to the array's peak.
ROUNDING = 1e-6
#: Longest tones come in blocks of so many bins, so that scenes share their kernels.
BLOCK_BINS = 256


@dataclass(frozen=True)
class SweptPattern:
    """Two-way pattern of P paths in B beams along the sweep: Chebyshev terms, complex64 [5, B, P]; mid-sweep [B, P]."""

    terms: np.ndarray
    middle: np.ndarray
    #: What the terms leave out at most, [P].
    remainder: np.ndarray

    def take(self, selection: np.ndarray) -> SweptPattern:
        """The pattern of some of the paths."""
        return SweptPattern(self.terms[:, :, selection], self.middle[:, selection], self.remainder[selection])

    def magnitudes(self) -> np.ndarray:
        """Bounds of the terms [terms, B, P]."""
        return self._with_remainder(np.abs(self.terms))

    def change(self, other: SweptPattern) -> np.ndarray:
        """Bounds [terms, B, P] of the difference of two patterns along the same sweep."""
        # where both squint, so does what they leave out, nearly alike: booked once
        return self._with_remainder(np.abs(self.terms - other.terms))

    def squint(self) -> np.ndarray:
        """Bounds [terms, B, P] of what the sweep adds to the pattern in its middle."""
        return self._with_remainder(np.abs(np.concatenate([(self.terms[0] - self.middle)[None], self.terms[1:]])))

    def _with_remainder(self, magnitude: np.ndarray) -> np.ndarray:
        magnitude[-1] += self.remainder.astype(np.float32)
        return magnitude


def swept_pattern(setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd) -> SweptPattern:
    """Pattern at the Chebyshev points of the sweep and in its middle, under the antenna's effects."""
    array = setup if effects.element_pattern else isotropic(setup)
    columns = column_weights(setup, effects, front_end)
    directions = departure(paths)

    def at(ratio: float | np.ndarray) -> np.ndarray:
        pattern = two_way_pattern(
            array, columns, paths.azimuth_rad, paths.elevation_rad, *directions, frequency_ratio=ratio
        )
        return pattern.astype(np.complex64)

    middle = at(1.0)
    if not effects.squint:
        return SweptPattern(middle[None], middle, np.zeros(len(paths)))
    # an echo comes in at the frequency at which it was sent: the further, the lower
    radar = setup.radar
    centre = sweep_ratio(radar, 0.5 * radar.chirp_period_s - paths.length_m / SPEED_OF_LIGHT_MPS)
    half_band = 0.5 * radar.bandwidth_hz / radar.carrier_hz
    points = np.cos(np.pi * (np.arange(TERMS) + 0.5) / TERMS)
    values = np.stack([at(centre + half_band * point) for point in points])
    # Chebyshev terms from the values at Chebyshev points: a discrete cosine transform
    weights = np.polynomial.chebyshev.chebvander(points, TERMS - 1).T * (2.0 / TERMS)
    weights[0] *= 0.5
    terms = np.einsum("mk,kbp->mbp", weights.astype(np.float32), values)
    return SweptPattern(terms, middle, _remainder(array, paths))


def _remainder(setup: RadarSetup, paths: Paths) -> np.ndarray:
    """Bound what the terms along the sweep may miss of each path's pattern, in any beam; [P].

    Each column turns by at most `swing` along the sweep: the terms left out and those they alias to stay under
    4 (J_5 + J_6 + ...) of the array's peak in that direction, J_5(x) + ... < x^5 / 3200 for x < 1.5. Plus rounding.
    """
    array, wavelength_m = setup.array, setup.radar.wavelength_m
    directions = [
        (paths.azimuth_rad, paths.elevation_rad),
        (paths.departure_azimuth_rad, paths.departure_elevation_rad),
    ]
    half = np.pi * setup.radar.bandwidth_hz / SPEED_OF_LIGHT_MPS
    across_m = 0.5 * (array.columns - 1) * array.column_spacing(wavelength_m)
    up_m = 0.5 * (array.rows - 1) * array.row_spacing(wavelength_m)
    swing = sum(half * (across_m * np.abs(np.sin(a) * np.cos(e)) + up_m * np.abs(np.sin(e))) for a, e in directions)
    peak = array.columns * array.rows * np.prod([element_field(setup.element, a, e) for a, e in directions], axis=0)
    return np.asarray(peak * (np.minimum(swing**5 / 800.0, 2.0) + ROUNDING))


class Envelope:
    """Sums magnitudes into cells for one radar."""

    def __init__(self, setup: RadarSetup, range_bins: int, longest_m: float) -> None:
        longest_bin = int(np.ceil(longest_m / (2.0 * setup.radar.range_bin_m) / BLOCK_BINS)) * BLOCK_BINS
        self.radar, self.range_bins = setup.radar, range_bins
        self._bins = max(longest_bin, range_bins) + COARSE

    def step(self, paths: Paths) -> np.ndarray:
        """The quarter of a range bin of every path, int64 [P]."""
        tone = beat_frequency_hz(self.radar, paths.length_m) * self.radar.chirp_period_s
        return np.minimum((STEPS * tone).astype(np.int64), STEPS * self._bins - 1)

    def of_terms(self, magnitude: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Bound [B, bins] of echoes whose terms along the sweep have magnitudes [terms, B, P]."""
        kernels = _kernels(self.radar, self.range_bins, self._bins)
        size = kernels.shape[1] * 2 - 2
        total = 0.0
        for term, kernel in zip(magnitude, kernels, strict=False):
            gathered = _gather(np.ascontiguousarray(term, np.float32), step, STEPS * self._bins)
            total = total + fft.rfft(gathered, size, axis=1) * kernel
        summed = fft.irfft(total, size, axis=1)[:, : STEPS * self.range_bins : STEPS]
        # the transform rounds: never below zero
        return np.asarray(np.maximum(summed, 0.0))

    def of_overlap(self, magnitude: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Bound of what the overlapped start of the chirp changes, [B, bins]; magnitudes [B, P]."""
        coarse = step // (STEPS * COARSE)
        gathered = _gather(np.ascontiguousarray(magnitude, np.float32), coarse, -(-self._bins // COARSE))
        return np.asarray(gathered @ _overlap_kernel(self.radar, self.range_bins, self._bins))


@njit(cache=True, nogil=True)
def _gather(magnitude, step, steps):  # type: ignore[no-untyped-def]
    rows, paths = magnitude.shape
    gathered = np.zeros((rows, steps))
    for row in range(rows):
        for path in range(paths):
            gathered[row, step[path]] += magnitude[row, path]
    return gathered


@lru_cache(maxsize=8)
def _kernels(radar: RadarParams, range_bins: int, tone_bins: int) -> np.ndarray:
    """Transforms of the largest |range kernel| of Hann x T_m within each quarter of a bin, complex [5, frequencies].

    Laid out so that a circular convolution with tones on quarter bins gives bin i at 4 i.
    """
    count = radar.samples_per_chirp
    fine = STEPS * LOOKS
    sample = np.arange(count) / count
    window = (1.0 - np.cos(2.0 * np.pi * sample)) / count
    slow = np.polynomial.chebyshev.chebvander(2.0 * sample - 1.0, TERMS - 1).T
    spectrum = np.abs(np.fft.fft(slow * window, fine * count, axis=1))
    # a tone in [s, s + 1] / STEPS seen from bin i: offsets (u - 1 .. u) / STEPS with u = STEPS i - s
    lag = np.arange(-STEPS * tone_bins, STEPS * range_bins + 1)
    start = LOOKS * (lag - 1)
    looks = [spectrum[:, (start + look) % (fine * count)] for look in range(LOOKS + 1)]
    upper = BETWEEN * np.maximum.reduce(looks)
    size = 2 * fft.next_fast_len(STEPS * (tone_bins + range_bins) // 2 + 1, real=True)
    laid = np.zeros((TERMS, size))
    laid[:, lag % size] = upper
    return np.asarray(fft.rfft(laid, axis=1))


@lru_cache(maxsize=8)
def _overlap_kernel(radar: RadarParams, range_bins: int, tone_bins: int) -> np.ndarray:
    """Largest change per unit magnitude by the overlapped start, own tone missing and the old one in its place.

    float64 [coarse steps, bins]. A Hann window's rise cut at share x of the chirp sums to A = x - sin(2 pi x) / 2 pi,
    and d bins off its tone it stays under h(x) / (pi d) (integrating by parts: the rise is monotone), h the window's
    value at the cut.
    """
    first = np.arange(0, tone_bins, COARSE, dtype=float)
    last = first + COARSE
    # the cut falls on the next sample
    share = np.minimum(last / (radar.bandwidth_hz * radar.chirp_period_s) + 1.0 / radar.samples_per_chirp, 0.5)
    area = share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi)
    height = 1.0 - np.cos(2.0 * np.pi * share)
    bins = np.arange(range_bins)[None]

    def cut(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        away = np.maximum(np.maximum(bins - high[:, None], low[:, None] - bins), 1e-9)
        # no farther than the next tone of a spectrum that repeats; tones beyond it may fall anywhere
        wrapped = np.maximum(np.minimum(away, radar.samples_per_chirp - away - COARSE), 1e-9)
        return np.minimum(area[:, None], height[:, None] / (np.pi * wrapped))

    back = radar.bandwidth_hz * radar.chirp_period_s
    passes = sampled(radar, (last - back) / radar.chirp_period_s) | sampled(
        radar, (first - back) / radar.chirp_period_s
    )
    return np.asarray(BETWEEN * (cut(first, last) + passes[:, None] * cut(first - back, last - back)))
