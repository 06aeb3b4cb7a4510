"""Upper bounds of what echoes can add up to in any cell: magnitudes summed, never phases.

A cell is one of `range_bins` bins of one beam's Hann-windowed profile. An echo's factor along the sweep (squint) is
c_0 + c_1 T_1 + c_2 T_2 over the chirp; each term has a range kernel of its own, bounded here over half bins. The start
of a chirp that still belongs to the previous one is bounded by the window's small values there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from models.physics.antenna import two_way_pattern
from models.physics.waveform import beat_frequency_hz
from msgs.radar import RadarParams, RadarSetup
from sim_player.fmcw import departure
from sim_player.front_end import FrontEnd
from sim_player.paths import Paths
from sim_player.signal_effects import SignalEffects, column_weights, isotropic, sampled

#: Steps of a range bin in which echoes are gathered.
STEPS = 2
#: Points within a step at which a kernel is looked at, and what may hide between them.
LOOKS, BETWEEN = 8, 1.02
#: The third Chebyshev term stands for all that follow.
REMAINDER = 1.15
TERMS = 3


@dataclass(frozen=True)
class SweptPattern:
    """Two-way pattern of P paths in B beams along the sweep: Chebyshev terms, complex [3, B, P]; and mid-sweep [B, P]."""

    terms: np.ndarray
    middle: np.ndarray


def swept_pattern(setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd) -> SweptPattern:
    """Pattern at the Chebyshev points of the sweep and in its middle, under the antenna's effects."""
    array = setup if effects.element_pattern else isotropic(setup)
    columns = column_weights(setup, effects, front_end)

    def at(ratio: float) -> np.ndarray:
        return two_way_pattern(
            array, columns, paths.azimuth_rad, paths.elevation_rad, *departure(paths), frequency_ratio=ratio
        )

    middle = at(1.0)
    terms = np.zeros((TERMS, *middle.shape), np.complex128)
    terms[0] = middle
    if effects.squint:
        # three points hold a quadratic: the outer ones at +-sqrt(3)/2 of the half band
        reach = 0.5 * np.sqrt(3.0)
        half = 0.5 * setup.radar.bandwidth_hz / setup.radar.carrier_hz
        low, high = at(1.0 - reach * half), at(1.0 + reach * half)
        terms[0] = (low + middle + high) / 3.0
        terms[1] = (high - low) / np.sqrt(3.0)
        terms[2] = (high + low - 2.0 * middle) / 3.0
    return SweptPattern(terms, middle)


class Envelope:
    """Sums magnitudes into cells for one radar; the kernels are shared by all scenes."""

    def __init__(self, setup: RadarSetup, range_bins: int, effects: SignalEffects, longest_m: float) -> None:
        self.radar, self.range_bins = setup.radar, range_bins
        # whole blocks, so that scenes share their kernels
        longest_bin = int(np.ceil(longest_m / (2.0 * setup.radar.range_bin_m) / 256.0)) * 256
        self._steps = STEPS * (max(longest_bin, range_bins) + 1)
        self._kernels = _kernels(setup.radar, range_bins, self._steps)
        self._overlap = _overlap_kernel(setup.radar, range_bins, self._steps)
        self._overlaps = effects.chirp_overlap

    def step(self, paths: Paths) -> np.ndarray:
        """The half range bin of every path, int64 [P]."""
        tone = beat_frequency_hz(self.radar, paths.length_m) * self.radar.chirp_period_s
        return np.minimum((STEPS * tone).astype(np.int64), self._steps - 1)

    def of_terms(self, magnitude: np.ndarray, step: np.ndarray, overlaps: bool | None = None) -> np.ndarray:
        """Bound [B, bins] of echoes whose terms have magnitudes [3, B, P] (or [B, P]: no squint)."""
        terms = magnitude if magnitude.ndim == 3 else magnitude[None]
        total = np.zeros((terms.shape[1], self.range_bins))
        for index, term in enumerate(terms):
            if not term.any():
                continue
            gathered = _gather(np.ascontiguousarray(term), step, self._steps)
            factor = REMAINDER if index == TERMS - 1 else 1.0
            total += factor * (gathered @ self._kernels[index])
            if self._overlaps if overlaps is None else overlaps:
                total += gathered @ self._overlap
        return total

    def of_overlap(self, magnitude: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Bound of what the overlapped start of the chirp changes, [B, bins]; magnitudes [B, P]."""
        return np.asarray(_gather(np.ascontiguousarray(magnitude), step, self._steps) @ self._overlap)


def noise_free_floor(profiles: np.ndarray, unknown: np.ndarray, noise_rms: np.ndarray, sigmas: float) -> np.ndarray:
    """Lower bound of the law's denominator in every cell: noise rms, or what surely stands nearby.

    The strongest of |profiles| - `unknown` - `sigmas` noise rms within one range bin and one beam (half a beamwidth on
    the 5 deg grid).
    """
    sure = np.abs(profiles) - unknown - sigmas * noise_rms
    padded = np.pad(sure, 1, constant_values=-np.inf)
    rows, bins = profiles.shape
    near = [padded[i : i + rows, j : j + bins] for i in range(3) for j in range(3)]
    return np.maximum(np.max(near, axis=0), noise_rms)


@njit(cache=True, nogil=True)
def _gather(magnitude, step, steps):  # type: ignore[no-untyped-def]
    rows, paths = magnitude.shape
    gathered = np.zeros((rows, steps))
    for row in range(rows):
        for path in range(paths):
            gathered[row, step[path]] += magnitude[row, path]
    return gathered


@lru_cache(maxsize=8)
def _kernels(radar: RadarParams, range_bins: int, steps: int) -> np.ndarray:
    """Largest |range kernel| of Hann x T_m for tones within each half bin, float64 [3, steps, bins]."""
    count, span = radar.samples_per_chirp, max(steps // STEPS, range_bins) + 1
    fine = STEPS * LOOKS
    sample = np.arange(count) / count
    window = (1.0 - np.cos(2.0 * np.pi * sample)) / count
    slow = np.polynomial.chebyshev.chebvander(2.0 * sample - 1.0, TERMS - 1).T
    # |transform| on a grid of `fine` points a bin, from -span to +span bins
    spectrum = np.abs(np.fft.fft(slow * window, fine * count, axis=1))
    offset = np.arange(-fine * span, fine * span + 1)
    table = spectrum[:, offset % (fine * count)]
    # the largest over one step: tone in [s, s + 1] / STEPS, bin i: offset i - tone
    most = np.maximum.reduce([table[:, k : table.shape[1] - LOOKS + k] for k in range(LOOKS + 1)])
    start = fine * (np.arange(range_bins)[None] + span) - LOOKS * (np.arange(steps)[:, None] + 1)
    return BETWEEN * most[:, np.clip(start, 0, most.shape[1] - 1)]


@lru_cache(maxsize=8)
def _overlap_kernel(radar: RadarParams, range_bins: int, steps: int) -> np.ndarray:
    """Largest change per unit magnitude by the overlapped start: own tone missing, the old one in its place.

    A Hann window's rise cut at share x of the chirp sums to A = x - sin(2 pi x) / 2 pi, and at d bins off its tone it
    stays under h(x) / (pi d) (integrating by parts, the rise being monotone), h the window's value at the cut.
    """
    tone = (np.arange(steps) + 1.0) / STEPS
    beat_hz = tone / radar.chirp_period_s
    # the cut falls on the next sample
    share = np.minimum(beat_hz / radar.bandwidth_hz + 1.0 / radar.samples_per_chirp, 0.5)
    area = share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi)
    height = 1.0 - np.cos(2.0 * np.pi * share)
    bins = np.arange(range_bins)

    def cut(at: np.ndarray) -> np.ndarray:
        # up to one step nearer than the middle says
        away = np.maximum(np.abs(bins[None] - at[:, None]) - 1.0 / STEPS, 1e-9)
        wrapped = np.minimum(away, radar.samples_per_chirp - away)
        return np.minimum(area[:, None], height[:, None] / (np.pi * wrapped))

    old = tone - radar.bandwidth_hz * radar.chirp_period_s
    passes = sampled(radar, old / radar.chirp_period_s)
    return np.asarray(BETWEEN * (cut(tone) + passes[:, None] * cut(old)))
