"""Echoes of one moving beam in single precision, compiled: what a live player can afford.

The same sum as `sim_player.signal.swept_echoes`, in the same slow-time terms, for a tolerance. All echoes lie in a
small part of the sampled band. So each instant of the sweep and each slow-time term is summed at a low rate, by a
non-uniform FFT; instants are joined there, and one interpolation a term brings the sum to the converter's rate. The
overlapped start of the chirp is exchanged in time (`sim_player.signal.compiled_starts`).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from models.compiled import compiled
from models.physics.waveform import beat_frequency_hz
from msgs.values.radar import RadarParams, RadarSetup
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.compiled_starts import StartSums, chebyshev_nodes, instants_of
from sim_player.signal.compiled_weights import EchoWeights
from sim_player.signal.swept_echoes import cardinal_functions, sweep_swing_rad
from sim_player.signal.switches import SignalEffects, overlap_samples
from sim_player.trace.paths import Paths

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
    overlaps = effects.chirp_overlap and len(paths) > 0
    ends = overlap_samples(radar, paths.length_m) if overlaps else np.zeros(0, np.int64)
    part = max(count // PARTS, 1)
    parts = -(-int(ends.max(initial=0)) // part)
    # the previous chirp's echo at x is this one's at x + 1
    span = 1.0 + parts * part / count
    instants = instants_of(swing_rad, span)
    weigh = EchoWeights(setup, paths, effects, front_end, beam)
    weights = weigh.at(instants)
    cycles = beat_frequency_hz(radar, paths.length_m) / radar.sample_rate_hz
    beats = _sum_tones(cycles, weights, instants, span, (count, step))
    if parts:
        start_sums = StartSums(radar, (part, parts), swing_rad)
        slow = start_sums.slow_factors(len(instants), span)
        start_sums.add(beats, slow, weights, weigh.previous_chirp(), cycles, ends)
    return beats, weigh.carrier, weigh.basis


def _sum_tones(
    cycles: np.ndarray, weights: np.ndarray, instants: np.ndarray, span: float, grid: tuple[int, int]
) -> np.ndarray:
    """Return sum_k l_k(n) sum_p w_krp exp(2 pi j x_p n) for n = 0..count - 1; complex64 [terms, count].

    `weights` float32 [2, instants, terms, paths]; `grid`: samples of the chirp and how many of them make one low-rate
    sample.
    """
    count, step = grid
    low = count // step + TAPS
    size = fft.next_fast_len(2 * low)
    # sample 0 of the low rate stands half the taps before the chirp; centred samples keep the kernel's transform large
    start = step * (low // 2 - TAPS // 2)
    centred = np.exp(2j * np.pi * ((cycles * start) % 1.0)).astype(np.complex64)
    sums = np.zeros((size, *weights.shape[1:3]), np.complex64)
    flat = weights.reshape(2, weights.shape[1] * weights.shape[2], len(cycles))
    _spread(sums.view(np.float32).reshape(size, -1), flat, centred, (cycles * step % 1.0) * size)
    spectrum = fft.ifft(sums, axis=0, norm="forward", overwrite_x=True)
    samples = _join(spectrum, _slow_factors(len(instants), span, grid, size))
    # few bands, so that beams share their taps
    highest = np.ceil(64.0 * step * float(cycles.max(initial=0.0))) / 64.0
    return _interpolate(samples, *_taps(step, highest), count)


@lru_cache(maxsize=32)
def _slow_factors(instants: int, span: float, grid: tuple[int, int], size: int) -> np.ndarray:
    """Return the polynomials of the instants at the low rate over the spreading kernel's transform."""
    count, step = grid
    low = count // step + TAPS
    share = (np.arange(low) - TAPS // 2) * (step / count)
    factors = cardinal_functions(chebyshev_nodes(instants, span), share, span) / _spreading_transform(low, size)
    return np.asarray(factors, np.float32)


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


@compiled(error_model="numpy", fastmath=True)
def _spread(grid, weights, centred, position):  # type: ignore[no-untyped-def]
    """Add each tone to the grid steps next to it, by exp(beta (sqrt(1 - z^2) - 1)); grid [size, 2 sums]."""
    size, columns = grid.shape
    tones = np.empty(columns, np.float32)
    for p in range(len(position)):
        first = int(np.floor(position[p])) - SPREAD // 2 + 1
        c, s = centred[p].real, centred[p].imag
        for i in range(columns // 2):
            re, im = weights[0, i, p], weights[1, i, p]
            tones[2 * i], tones[2 * i + 1] = re * c - im * s, re * s + im * c
        for j in range(SPREAD):
            z = 2.0 * (position[p] - (first + j)) / SPREAD
            kernel = np.float32(np.exp(2.3 * SPREAD * (np.sqrt(max(1.0 - z * z, 0.0)) - 1.0)))
            row = grid[(first + j) % size]
            for i in range(columns):
                row[i] += kernel * tones[i]


@compiled(error_model="numpy", fastmath=True)
def _join(spectrum, slow):  # type: ignore[no-untyped-def]
    """Instants joined by their polynomials, samples from the middle outwards put in order; float32 [2, terms, low]."""
    size, instants, terms = spectrum.shape
    low = slow.shape[1]
    half = low // 2
    out = np.zeros((2, terms, low), np.float32)
    for i in range(low):
        row = spectrum[size - half + i if i < half else i - half]
        for k in range(instants):
            for r in range(terms):
                out[0, r, i] += slow[k, i] * row[k, r].real
                out[1, r, i] += slow[k, i] * row[k, r].imag
    return out


@compiled(error_model="numpy", fastmath=True)
def _interpolate(samples, taps_re, taps_im, count):  # type: ignore[no-untyped-def]
    """The same at the full rate: sample step * m + q from the taps of phase q; complex64 [terms, count]."""
    terms, (step, taps) = samples.shape[1], taps_re.shape
    out = np.empty((terms, count), np.complex64)
    size = count // step
    re, im = np.empty(size, np.float32), np.empty(size, np.float32)
    for r in range(terms):
        for q in range(step):
            re[:], im[:] = np.float32(0.0), np.float32(0.0)
            for j in range(taps):
                a, b = taps_re[q, j], taps_im[q, j]
                near_re, near_im = samples[0, r, 1 + j : 1 + j + size], samples[1, r, 1 + j : 1 + j + size]
                for m in range(size):
                    re[m] += a * near_re[m] - b * near_im[m]
                    im[m] += a * near_im[m] + b * near_re[m]
            for m in range(size):
                out[r, step * m + q] = complex(re[m], im[m])
    return out
