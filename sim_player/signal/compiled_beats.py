"""Echoes of one moving beam in single precision, compiled: what a live player can afford.

The same sum as `sim_player.signal.swept_echoes`, in the same slow-time terms, for a tolerance. All echoes lie in a
small part of the sampled band. So each instant of the sweep and each slow-time term is summed at a low rate, by a
non-uniform FFT; instants are joined there, and one interpolation a term brings the sum to the converter's rate. The
overlapped start of the chirp is taken off in time.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from scipy import fft

from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz, beat_phase_rad, doppler_turn_rad
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.fmcw import slow_time_table
from sim_player.signal.swept_echoes import (
    cardinal_functions,
    chebyshev_instants,
    sweep_swing_rad,
)
from sim_player.signal.switches import (
    SignalEffects,
    column_weights,
    isotropic,
    overlap_samples,
    previous_length_m,
    sampled,
    sweep_ratio,
)
from sim_player.trace.paths import Paths

#: Largest error of the interpolations, relative to an echo at the array's peak.
TOLERANCE = 1e-5
#: Grid steps that a tone is spread over, on a grid of twice the samples; taps of the interpolation. Each to 1e-5 or
#: less.
SPREAD, TAPS = 10, 10
#: The low rate is this many times the band of the echoes, or more.
OVERSAMPLING = 2.0
#: Parts of a chirp, in each of which the overlapped start takes the slow factor for a straight line.
PARTS = 128


def decimation(radar: RadarParams, length_m: np.ndarray) -> int:
    """Return by how much the rate can be lowered, a power of two; 0 where the band of the echoes is too wide."""
    tone_bin = beat_frequency_hz(radar, length_m) * radar.chirp_period_s
    # a tone's skirts by the slow factor, and the taps' own
    widest = float(tone_bin.max(initial=0.0)) + 32.0
    factor = radar.samples_per_chirp // int(OVERSAMPLING * widest)
    return 1 << (factor.bit_length() - 1) if factor else 0


def compiled_terms(
    setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd, beam: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the echoes of one beam: beats complex64 [terms, samples], carrier [chirps], basis [terms, chirps].

    ValueError where the echoes fill more than half of the sampled band (`decimation`).
    """
    radar, count = setup.radar, setup.radar.samples_per_chirp
    step = decimation(radar, paths.length_m)
    if not step:
        raise ValueError(
            f"length_m must leave half of the sampled band free, got a longest of {paths.length_m.max():g} m"
        )
    swing_rad = sweep_swing_rad(setup, paths, effects)
    instants = chebyshev_instants(swing_rad, TOLERANCE)
    weigh = _Weights(setup, paths, effects, front_end, beam)
    weights = weigh.at(instants, previous=False)
    cycles = beat_frequency_hz(radar, paths.length_m) / radar.sample_rate_hz
    beats = _sum_tones(cycles, weights, instants, count, step)
    if effects.chirp_overlap and len(paths):
        ends = overlap_samples(radar, paths.length_m)
        # the start is a short stretch of the sweep: few instants
        part = max(count // PARTS, 1)
        parts = -(-int(ends.max(initial=0)) // part)
        span = parts * part / count
        near = chebyshev_instants(swing_rad * span, TOLERANCE, span)
        borders = np.arange(parts + 1) * (part / count)
        slow = np.ascontiguousarray(cardinal_functions(near, borders, span).T, np.float32)
        _add_starts(beats, -weigh.at(near, previous=False), cycles, ends, slow, part)
        cycles = beat_frequency_hz(radar, previous_length_m(radar, paths.length_m)) / radar.sample_rate_hz
        passes = np.flatnonzero(sampled(radar, cycles * radar.sample_rate_hz))
        if len(passes):
            _add_starts(beats, weigh.at(near, previous=True)[passes], cycles[passes], ends[passes], slow, part)
    return beats, weigh.carrier, weigh.basis


class _Weights:
    """Recorded weights of all echoes of a beam: antenna, phase of the beat, Doppler in slow-time terms."""

    def __init__(self, setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd, beam: int) -> None:
        self._setup = setup if effects.element_pattern else isotropic(setup)
        self._paths, self._effects = paths, effects
        self._columns = column_weights(setup, effects, front_end)[beam] / np.sqrt(setup.array.columns)
        element = self._setup.element
        self._ways = [
            (
                np.sin(azimuth_rad) * np.cos(elevation_rad),
                np.sin(elevation_rad),
                element_field(element, azimuth_rad, elevation_rad),
            )
            for azimuth_rad, elevation_rad in (
                (paths.azimuth_rad, paths.elevation_rad),
                (paths.departure_azimuth_rad, paths.departure_elevation_rad),
            )
        ]
        radar = setup.radar
        speed = paths.radial_speed_mps if effects.motion else np.zeros(len(paths))
        self._turn = doppler_turn_rad(radar, speed)
        # along the sweep a migrating path's Doppler follows the frequency
        margin = 1.0 + radar.bandwidth_hz / radar.carrier_hz * (1.0 if effects.range_migration else 0.0)
        self.carrier, self.basis, self._slow = slow_time_table(radar, self._turn, margin)

    def at(self, instants: np.ndarray, previous: bool) -> np.ndarray:
        """Return the weights at instants (shares of the chirp) of the own or the previous chirp's echo.

        Complex64 [paths, terms, instants].
        """
        radar, paths = self._setup.radar, self._paths
        since_sent_s = (instants[:, None] + previous) * radar.chirp_period_s - paths.length_m / SPEED_OF_LIGHT_MPS
        ratio = sweep_ratio(radar, since_sent_s) if self._effects.squint else np.ones_like(since_sent_s)
        length_m = previous_length_m(radar, paths.length_m) if previous else paths.length_m
        recorded = np.conj(paths.amplitude) * np.exp(1j * beat_phase_rad(radar, length_m))
        factor = np.conj(self._pattern(ratio)) * recorded
        turn = np.broadcast_to(self._turn, since_sent_s.shape)
        if self._effects.motion and self._effects.range_migration:
            turn = turn * (1.0 + radar.chirp_slope_hz_per_s * since_sent_s / radar.carrier_hz)
            # the distance moved since the chirp's start
            factor *= np.exp(1j * turn * instants[:, None])
        return _outer(factor, self._slow(turn))

    def _pattern(self, ratio: np.ndarray) -> np.ndarray:
        """Return the two-way pattern at frequency ratios [instants, P]; complex128."""
        array, wavelength_m = self._setup.array, self._setup.radar.wavelength_m
        across = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m)
        up = 2.0 * np.pi / wavelength_m * array.row_spacing(wavelength_m)
        rows = np.full(array.rows, 1.0 / np.sqrt(array.rows), np.complex128)
        (sine, rise, element), (sine_out, rise_out, element_out) = self._ways
        receive = _array_sum(self._columns, across * sine, ratio) * _array_sum(rows, up * rise, ratio).real
        if array.steered_ways == 1:
            return np.asarray(receive * (element * element_out))
        if np.array_equal(sine, sine_out) and np.array_equal(rise, rise_out):
            return np.asarray(receive**2 * (element * element_out))
        transmit = _array_sum(self._columns, across * sine_out, ratio) * _array_sum(rows, up * rise_out, ratio).real
        return np.asarray(receive * transmit * (element * element_out))


def _sum_tones(cycles: np.ndarray, weights: np.ndarray, instants: np.ndarray, count: int, step: int) -> np.ndarray:
    """Return sum_k l_k(n) sum_p w_prk exp(2 pi j x_p n) for n = 0..count - 1; complex64 [terms, count]."""
    low = count // step + TAPS
    size = fft.next_fast_len(2 * low)
    # sample 0 of the low rate stands half the taps before the chirp; centred samples keep the kernel's transform large
    start = step * (low // 2 - TAPS // 2)
    centred = np.exp(2j * np.pi * ((cycles * start) % 1.0)).astype(np.complex64)
    grid = np.zeros((len(instants), weights.shape[1], size), np.complex64)
    _spread(grid, weights, centred, (cycles * step % 1.0) * size)
    spectrum = fft.ifft(grid, axis=2, norm="forward", overwrite_x=True)
    share = (np.arange(low) - TAPS // 2) * (step / count)
    slow = (cardinal_functions(instants, share) / _spreading_transform(low, size)).astype(np.float32)
    samples = _join(spectrum, slow)
    return _interpolate(samples, *_taps(step, float(cycles.max(initial=0.0)) * step), count)


@lru_cache(maxsize=8)
def _spreading_transform(low: int, size: int) -> np.ndarray:
    """Return the transform of the spreading kernel at the centred samples, float64 [low]."""
    node, weight = np.polynomial.legendre.leggauss(64)
    kernel = np.exp(2.3 * SPREAD * (np.sqrt(1.0 - node**2) - 1.0)) * weight * (0.5 * SPREAD)
    turns = 2.0 * np.pi * (np.arange(low) - low // 2) / size
    return np.asarray(np.cos(np.multiply.outer(turns, 0.5 * SPREAD * node)) @ kernel)


@lru_cache(maxsize=32)
def _taps(step: int, highest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the real and imaginary parts of the taps that raise the rate by `step`, float32 [step, TAPS].

    Least squares over the band of tones, 0 to `highest` cycles per low-rate sample and some skirts.
    """
    tone = np.linspace(-0.01, highest + 0.01, 8 * TAPS)
    near = np.exp(2j * np.pi * np.multiply.outer(tone, np.arange(TAPS) - (TAPS // 2 - 1)))
    wanted = np.exp(2j * np.pi * np.multiply.outer(tone, np.arange(step) / step))
    taps = np.linalg.lstsq(near, wanted, rcond=1e-9)[0].T
    return np.ascontiguousarray(taps.real, np.float32), np.ascontiguousarray(taps.imag, np.float32)


@njit(cache=True, nogil=True, fastmath=True)
def _array_sum(weights, phase_rad, ratio):  # type: ignore[no-untyped-def]
    """Sum_m w_m exp(j (m - (M - 1) / 2) phase ratio): elements in a row, centred; [instants, P]."""
    instants, paths = ratio.shape
    last = len(weights) - 1
    out = np.empty((instants, paths), np.complex128)
    for k in range(instants):
        for p in range(paths):
            half_rad = 0.5 * phase_rad[p] * ratio[k, p]
            half = complex(np.cos(half_rad), np.sin(half_rad))
            turn = half * half
            total = weights[last]
            back = complex(1.0, 0.0)
            for m in range(last - 1, -1, -1):
                total = total * turn + weights[m]
                back *= half
            out[k, p] = total * back.conjugate()
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _outer(factor, share):  # type: ignore[no-untyped-def]
    """Factor [instants, P] times the share of each slow-time term [terms, instants, P]; [P, terms, instants]."""
    terms, instants, paths = share.shape
    out = np.empty((paths, terms, instants), np.complex64)
    for k in range(instants):
        for p in range(paths):
            for r in range(terms):
                out[p, r, k] = factor[k, p] * share[r, k, p]
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _spread(grid, weights, centred, position):  # type: ignore[no-untyped-def]
    """Add each tone to the grid steps next to it, by exp(beta (sqrt(1 - z^2) - 1))."""
    instants, terms, size = grid.shape
    kernel = np.empty(SPREAD, np.float32)
    for p in range(len(position)):
        first = int(np.floor(position[p])) - SPREAD // 2 + 1
        for j in range(SPREAD):
            z = 2.0 * (position[p] - (first + j)) / SPREAD
            kernel[j] = np.exp(2.3 * SPREAD * (np.sqrt(max(1.0 - z * z, 0.0)) - 1.0))
        for k in range(instants):
            for r in range(terms):
                tone = weights[p, r, k] * centred[p]
                for j in range(SPREAD):
                    grid[k, r, (first + j) % size] += tone * kernel[j]


@njit(cache=True, nogil=True, fastmath=True)
def _join(spectrum, slow):  # type: ignore[no-untyped-def]
    """Instants joined by their polynomials; samples from the middle outwards put in order; [terms, low]."""
    instants, terms, size = spectrum.shape
    low = slow.shape[1]
    half = low // 2
    out = np.zeros((terms, low), np.complex64)
    for k in range(instants):
        for r in range(terms):
            for i in range(half):
                out[r, i] += slow[k, i] * spectrum[k, r, size - half + i]
            for i in range(half, low):
                out[r, i] += slow[k, i] * spectrum[k, r, i - half]
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _interpolate(samples, taps_re, taps_im, count):  # type: ignore[no-untyped-def]
    """The same at the full rate: sample step * m + q from the taps of phase q; [terms, count]."""
    terms, (step, taps) = len(samples), taps_re.shape
    out = np.empty((terms, count), np.complex64)
    for r in range(terms):
        for m in range(count // step):
            for q in range(step):
                re, im = np.float32(0.0), np.float32(0.0)
                for j in range(taps):
                    value = samples[r, m + 1 + j]
                    re += taps_re[q, j] * value.real - taps_im[q, j] * value.imag
                    im += taps_re[q, j] * value.imag + taps_im[q, j] * value.real
                out[r, step * m + q] = complex(re, im)
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _add_starts(beats, weights, cycles, ends, slow, part):  # type: ignore[no-untyped-def]
    """Add tones that stop at their own sample; weights [P, terms, instants], slow [borders of parts, instants]."""
    paths, terms, instants = weights.shape
    fine_re, fine_im = np.empty(part, np.float32), np.empty(part, np.float32)
    re, im = np.zeros((terms, len(slow) * part), np.float32), np.zeros((terms, len(slow) * part), np.float32)
    for p in range(paths):
        turn = 2.0 * np.pi * cycles[p]
        step, on = complex(np.cos(turn), np.sin(turn)), complex(1.0, 0.0)
        for i in range(part):
            fine_re[i], fine_im[i] = on.real, on.imag
            on *= step
        for r in range(terms):
            start, after = complex(1.0, 0.0), complex(0.0, 0.0)
            for k in range(instants):
                after += slow[0, k] * weights[p, r, k]
            for border in range(1, -(-ends[p] // part) + 1):
                before, after = after, complex(0.0, 0.0)
                for k in range(instants):
                    after += slow[border, k] * weights[p, r, k]
                first = (border - 1) * part
                size = min(part, ends[p] - first)
                value, slope = before * start, (after - before) * start / part
                a, b = np.float32(value.real), np.float32(value.imag)
                c, d = np.float32(slope.real), np.float32(slope.imag)
                row_re, row_im = re[r, first : first + size], im[r, first : first + size]
                for i in range(size):
                    u, v = a + c * np.float32(i), b + d * np.float32(i)
                    row_re[i] += u * fine_re[i] - v * fine_im[i]
                    row_im[i] += u * fine_im[i] + v * fine_re[i]
                start *= on
    for r in range(terms):
        for n in range(min(re.shape[1], beats.shape[1])):
            beats[r, n] += complex(re[r, n], im[r, n])
