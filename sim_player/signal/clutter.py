"""Echoes of what fills the air, as signals: complex Gaussian draws with a range profile, a beam pattern and a Doppler.

Half range bins and directions half a beam apart are independent. Over a beam's chirps a draw fades by the spread of the
drops' speeds, exp(-(t / tau)^2 / 2), tau = lambda / (4 pi sigma_v): 2.4 ms at 10 GHz. Beams of a steered array are
drawn apart (from 3 tau on), those of a digital one share draws. Squint and overlap do not act on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft

from models.physics.antenna import column_response
from models.physics.waveform import doppler_turn_rad, tone_profile
from msgs.values.radar import RadarParams, RadarSetup
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS, Terms
from sim_player.signal.switches import SignalEffects, column_weights

#: Standard deviation of the drops' radial speeds: turbulence carries them alike (Nathanson, Radar Design Principles).
SPEED_SPREAD_MPS = 1.0
#: Cells of a range bin, and range bins that hold drops: as far as echoes are traced.
CELLS_PER_BIN = 2
CELLS = CELLS_PER_BIN * RANGE_BINS * 3 // 2
#: Range bins to either side from which a profile's power counts cell by cell where a bound is enough.
NEAR_BINS = 4
#: Directions, evenly over the sine of azimuth: two for each column at least.
MIN_DIRECTIONS = 128
#: Share of the power that the terms of slow time may leave out, which then has the speed of the others.
LEFT_OUT = 1e-2
#: The same of a beam's own terms, which are not those of a plan with fewer paths: under any budget.
NOT_HELD = 1e-4


@dataclass(frozen=True)
class Clutter:
    """Mean echoes of the air around a radar."""

    #: Power of each direction and cell for columns of unit gain, mW, float64 [directions, CELLS].
    power_mw: np.ndarray
    #: Mean velocity of the air in the radar's frame, [2].
    velocity_mps: np.ndarray

    def beam_power_mw(self, setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd) -> np.ndarray:
        """Return the mean power of each beam and cell, mW, [beams, CELLS]."""
        return np.abs(_pattern(setup, effects, front_end, len(self.power_mw))) ** 2 @ self.power_mw


def direction_sines(setup: RadarSetup) -> np.ndarray:
    """Return the sines of azimuth that stand for directions, [directions]."""
    count = max(MIN_DIRECTIONS, 2 * setup.array.columns)
    return (np.arange(count) + 0.5) * (2.0 / count) - 1.0


def cell_range_m(radar: RadarParams) -> np.ndarray:
    """Return the ranges of the cells, [CELLS]."""
    return np.arange(CELLS) * (radar.range_bin_m / CELLS_PER_BIN)


def profile_power_mw(setup: RadarSetup, clutter: Clutter, effects: SignalEffects, front_end: FrontEnd) -> np.ndarray:
    """Return the mean power of a Hann-windowed profile after the mean over chirps, mW, [beams, RANGE_BINS]."""
    basis = slow_time_basis(setup.radar)
    turned = basis * _carrier(setup.radar, _speeds(setup, clutter))[:, None]
    coherent = np.sum(np.abs(turned.mean(axis=2)) ** 2, axis=1)
    tones = _tone_powers(setup.radar.samples_per_chirp, RANGE_BINS)
    power_mw = clutter.beam_power_mw(setup, effects, front_end)[:, : len(tones)]
    return np.asarray(coherent[:, None] * (power_mw @ tones))


def profile_bound_mw(setup: RadarSetup, clutter: Clutter, effects: SignalEffects, front_end: FrontEnd) -> np.ndarray:
    """Return a bound of the same at a tenth of the work: what lies beyond `NEAR_BINS` counts as if it lay there."""
    tones = _tone_powers(setup.radar.samples_per_chirp, RANGE_BINS)
    reach, middle = CELLS_PER_BIN * NEAR_BINS, RANGE_BINS // 2
    shape = tones[CELLS_PER_BIN * middle - reach : CELLS_PER_BIN * middle + reach + 1, middle]
    pattern = np.abs(_pattern(setup, effects, front_end, len(clutter.power_mw))) ** 2
    power_mw = np.pad(pattern @ clutter.power_mw[:, : len(tones)], ((0, 0), (reach, reach)))
    steps = CELLS_PER_BIN * RANGE_BINS
    near_mw = sum(part * power_mw[:, at : at + steps : CELLS_PER_BIN] for at, part in enumerate(shape))
    # a Hann window has its nulls at whole bins
    beyond = tones[CELLS_PER_BIN * middle + reach + 1, middle]
    return np.asarray(near_mw + beyond * power_mw.sum(axis=1, keepdims=True))


def clutter_profiles(
    setup: RadarSetup, clutter: Clutter, effects: SignalEffects, front_end: FrontEnd, seed: int
) -> np.ndarray:
    """Return draws of all beams of the first scan as Hann-windowed profiles, complex128 [beams, RANGE_BINS]."""
    basis = slow_time_basis(setup.radar)
    shares = (basis * _carrier(setup.radar, _speeds(setup, clutter))[:, None]).mean(axis=2)
    tones = _tones(setup.radar.samples_per_chirp, RANGE_BINS)
    drawn = drawn_cells(setup, clutter, effects, front_end, seed)[:, :, : len(tones)]
    return np.asarray(np.einsum("br,brc->bc", shares, drawn) @ tones)


def with_clutter(setup: RadarSetup, terms: Terms, clutter: Clutter, cells: np.ndarray, beam: int) -> Terms:
    """Return the terms of a beam with its drawn cells, in their own slow time where it holds them."""
    beats, carrier, basis = terms
    count = setup.radar.samples_per_chirp
    # draws need no more digits than noise
    own = fft.ifft(cells.astype(np.complex64), CELLS_PER_BIN * count, axis=1, norm="forward")[:, :count]
    turned = _carrier(setup.radar, _speeds(setup, clutter)[beam : beam + 1])[0] * np.conj(carrier)
    slow = slow_time_basis(setup.radar) * turned
    share = slow @ _inverse(basis.tobytes(), len(basis), basis.dtype)
    if np.sum(np.abs(slow - share @ basis) ** 2) <= NOT_HELD * len(carrier):
        return beats + share.T.astype(np.complex64) @ own, carrier, basis
    own = own.astype(beats.dtype)
    return np.concatenate([beats, own, 1j * own]), carrier, np.concatenate([basis, slow.real, slow.imag])


@lru_cache(maxsize=32)
def _inverse(basis: bytes, terms: int, kind: np.dtype) -> np.ndarray:
    """Return the pseudo-inverse of terms of slow time, which many beams share, [chirps, terms]."""
    return np.linalg.pinv(np.frombuffer(basis, kind).reshape(terms, -1))


def drawn_cells(
    setup: RadarSetup, clutter: Clutter, effects: SignalEffects, front_end: FrontEnd, seed: int, scan: int = 0
) -> np.ndarray:
    """Return the draws of a scan, sqrt(mW), complex128 [beams, slow terms, CELLS]: `seed` and `scan` name them."""
    terms, pattern = len(slow_time_basis(setup.radar)), _pattern(setup, effects, front_end, len(clutter.power_mw))
    if setup.array.digital:
        draws = _normal([seed, 31, scan], (terms, *clutter.power_mw.shape))
        return np.stack([pattern @ (row * np.sqrt(clutter.power_mw)) for row in draws], axis=1)
    field = np.sqrt(np.abs(pattern) ** 2 @ clutter.power_mw)
    draws = np.stack([_normal([seed, 31, scan, beam], (terms, CELLS)) for beam in range(len(field))])
    return np.asarray(draws * field[:, None])


def correlation_time_s(radar: RadarParams) -> float:
    """Return tau, after which the echo of a volume has a correlation of exp(-1/2) with itself."""
    return radar.wavelength_m / (4.0 * math.pi * SPEED_SPREAD_MPS)


def slow_time_basis(radar: RadarParams) -> np.ndarray:
    """Return the terms of slow time whose independent draws add up to the fading of the drops, [terms, chirps]."""
    return _slow_time_basis(radar.chirps_per_beam, radar.repetition_interval_s / correlation_time_s(radar))


@lru_cache(maxsize=8)
def _slow_time_basis(chirps: int, step: float) -> np.ndarray:
    """Karhunen and Loeve's: eigenvectors of the covariance times the roots of their power."""
    time = step * np.arange(chirps)
    power, vectors = np.linalg.eigh(np.exp(-0.5 * np.subtract.outer(time, time) ** 2))
    terms = int(np.searchsorted(np.cumsum(power[::-1]), (1.0 - LEFT_OUT) * chirps)) + 1
    vectors = vectors[:, ::-1][:, :terms]
    # eigenvectors have no sign of their own: the first chirp's, or the first step's, is positive
    leading = vectors[np.abs(vectors).argmax(axis=0), np.arange(terms)]
    kept = power[::-1][:terms]
    return np.asarray((vectors * np.sign(leading) * np.sqrt(kept * (chirps / kept.sum()))).T)


def _speeds(setup: RadarSetup, clutter: Clutter) -> np.ndarray:
    """Return the mean radial speed that each beam sees, [beams]."""
    azimuth_rad = setup.beams.azimuth_rad
    return np.cos(azimuth_rad) * clutter.velocity_mps[0] + np.sin(azimuth_rad) * clutter.velocity_mps[1]


def _carrier(radar: RadarParams, speed_mps: np.ndarray) -> np.ndarray:
    """Return the Doppler of speeds over the chirps of a beam, counted from its middle, complex128 [speeds, chirps]."""
    chirp = np.arange(radar.chirps_per_beam) - 0.5 * (radar.chirps_per_beam - 1)
    return np.exp(1j * np.multiply.outer(doppler_turn_rad(radar, speed_mps), chirp))


def _pattern(setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, directions: int) -> np.ndarray:
    """Return the two-way field of the columns alone, complex128 [beams, directions]."""
    sines = (np.arange(directions) + 0.5) * (2.0 / directions) - 1.0
    response = column_response(setup.array, setup.radar.wavelength_m, np.arcsin(sines), np.zeros(directions))
    one_way = column_weights(setup, effects, front_end) @ response.T / np.sqrt(setup.array.columns)
    return np.asarray(one_way**setup.array.steered_ways)


@lru_cache(maxsize=4)
def _tones(samples: int, range_bins: int) -> np.ndarray:
    """Return the Hann-windowed profiles of the cells that reach some bins, complex128 [cells, range_bins]."""
    cells = min(CELLS_PER_BIN * (range_bins + 8), CELLS)
    return tone_profile(samples, np.arange(cells) / CELLS_PER_BIN, range_bins)


@lru_cache(maxsize=4)
def _tone_powers(samples: int, range_bins: int) -> np.ndarray:
    """Return the power of the same, float64 [cells, range_bins]."""
    return np.square(np.abs(_tones(samples, range_bins)))


def _normal(seed: list[int], shape: tuple[int, ...]) -> np.ndarray:
    """Return circular complex normal draws of unit power."""
    draws = np.random.default_rng(seed).standard_normal((2, *shape))
    return np.asarray((draws[0] + 1j * draws[1]) * math.sqrt(0.5))
