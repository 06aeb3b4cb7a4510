"""Sums of echoes at a low rate, compiled: what beats of one chirp, at rest and in motion, are made of.

Each instant of the sweep and row (a beam, or a slow-time term) is summed at a low rate by a non-uniform FFT, and one
interpolation a row raises it to the converter's. To 1e-11 of the strongest echo in double precision, 1e-5 in single.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from models.compiled import compiled
from models.physics.waveform import beat_frequency_hz
from msgs.values.radar import RadarParams
from sim_player.signal.swept_echoes import cardinal_functions, chebyshev_nodes

#: Grid steps that a tone is spread over, on a grid of twice the samples, and taps of the interpolation, by precision.
SPREAD, TAPS = {"float32": 7, "float64": 14}, {"float32": 14, "float64": 24}
#: Real numbers of a precision, and least singular value of the fit of the taps.
KIND, LEAST = {"float32": np.float32, "float64": np.float64}, {"float32": 1e-9, "float64": 1e-14}
#: The low rate is this many times the band of the echoes, or more.
OVERSAMPLING = 2.0


def decimation(radar: RadarParams, longest_m: float) -> int:
    """Return by how much the rate can be lowered, a power of two; 1 where echoes fill more than half of the band."""
    # a tone's skirts by the slow factor, and the taps' own
    widest = float(beat_frequency_hz(radar, np.array(longest_m))) * radar.chirp_period_s + 32.0
    factor = max(radar.samples_per_chirp // int(OVERSAMPLING * widest), 1)
    return 1 << (factor.bit_length() - 1)


class ToneSums:
    """Sums over one chirp of tones with slow factors, of several groups of paths; `rows` of them."""

    def __init__(self, radar: RadarParams, longest_m: float, rows: int, precision: str) -> None:
        self._count, self._precision = radar.samples_per_chirp, precision
        self._step = decimation(radar, longest_m)
        self._highest = float(beat_frequency_hz(radar, np.array(longest_m))) / radar.sample_rate_hz
        self._low = self._count // self._step + TAPS[precision]
        self._samples = np.zeros((2, rows, self._low), KIND[precision])

    def add(self, cycles: np.ndarray, weights: np.ndarray, span: float = 1.0) -> None:
        """Add sum_k l_k(n) sum_p w_krp exp(2 pi j x_p n), l_k the polynomials of Chebyshev instants over `span` chirps.

        `cycles` a sample [P]; `weights` of the precision [2, instants, rows, P], real parts first.
        """
        _, instants, rows, paths = weights.shape
        taps, low = TAPS[self._precision], self._low
        size = fft.next_fast_len(2 * low)
        # sample 0 of the low rate stands half the taps before the chirp; centred samples keep the kernel's transform
        # large
        start = self._step * (low // 2 - taps // 2)
        centred = np.exp(2j * np.pi * ((cycles * start) % 1.0))
        grid = np.zeros((size, 2 * instants * rows), weights.dtype)
        position = (cycles * self._step % 1.0) * size
        flat = weights.reshape(2, instants * rows, paths)
        _spread(grid, flat, centred.astype(f"c{2 * weights.itemsize}"), position, SPREAD[self._precision])
        sums = grid.view(f"c{2 * weights.itemsize}").reshape(size, instants, rows)
        spectrum = fft.ifft(sums, axis=0, norm="forward", overwrite_x=True)
        _join(self._samples, spectrum, _slow_factors(instants, span, (self._count, self._step), size, self._precision))

    def beats(self) -> np.ndarray:
        """Return the sums at the converter's rate, complex of the precision [rows, samples]."""
        _, rows, _ = self._samples.shape
        out = np.empty((rows, self._count), f"c{2 * self._samples.itemsize}")
        if self._step == 1:
            inside = self._samples[:, :, TAPS[self._precision] // 2 :][:, :, : self._count]
            out.real, out.imag = inside
            return out
        # few bands, so that beams share their taps
        highest = np.ceil(64.0 * self._step * self._highest) / 64.0
        _interpolate(out, self._samples, *_taps(self._step, highest, self._precision))
        return out


@lru_cache(maxsize=32)
def _slow_factors(instants: int, span: float, grid: tuple[int, int], size: int, precision: str) -> np.ndarray:
    """Return the polynomials of the instants at the low rate over the spreading kernel's transform."""
    count, step = grid
    low = count // step + TAPS[precision]
    share = (np.arange(low) - TAPS[precision] // 2) * (step / count)
    transform = _spreading_transform(low, size, SPREAD[precision])
    factors = cardinal_functions(chebyshev_nodes(instants, span), share, span) / transform
    return np.asarray(factors, KIND[precision])


@lru_cache(maxsize=8)
def _spreading_transform(low: int, size: int, spread: int) -> np.ndarray:
    """Return the transform of the spreading kernel at the centred samples, float64 [low]."""
    node, weight = np.polynomial.legendre.leggauss(64)
    kernel = np.exp(2.3 * spread * (np.sqrt(1.0 - node**2) - 1.0)) * weight * (0.5 * spread)
    turns = 2.0 * np.pi * (np.arange(low) - low // 2) / size
    return np.asarray(np.cos(np.multiply.outer(turns, 0.5 * spread * node)) @ kernel)


@lru_cache(maxsize=32)
def _taps(step: int, highest: float, precision: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the taps that raise the rate by `step`, real and imaginary [step, taps]: least squares over the band."""
    taps = TAPS[precision]
    tone = np.linspace(-0.01, highest + 0.01, 8 * taps)
    near = np.exp(2j * np.pi * np.multiply.outer(tone, np.arange(taps) - (taps // 2 - 1)))
    wanted = np.exp(2j * np.pi * np.multiply.outer(tone, np.arange(step) / step))
    fit = np.linalg.lstsq(near, wanted, rcond=LEAST[precision])[0].T
    return np.ascontiguousarray(fit.real, KIND[precision]), np.ascontiguousarray(fit.imag, KIND[precision])


@compiled(error_model="numpy", fastmath=True)
def _spread(grid, weights, centred, position, spread):  # type: ignore[no-untyped-def]
    """Add each tone to the grid steps next to it, by exp(beta (sqrt(1 - z^2) - 1)); grid [size, 2 sums]."""
    size, columns = grid.shape
    # the kernel's value stands in an array for its precision
    tones, kernel = np.empty(columns, grid.dtype), np.empty(1, grid.dtype)
    for p in range(len(position)):
        first = int(np.ceil(position[p] - 0.5 * spread))
        c, s = centred[p].real, centred[p].imag
        for i in range(columns // 2):
            re, im = weights[0, i, p], weights[1, i, p]
            tones[2 * i], tones[2 * i + 1] = re * c - im * s, re * s + im * c
        for j in range(spread):
            z = 2.0 * (position[p] - (first + j)) / spread
            kernel[0] = np.exp(2.3 * spread * (np.sqrt(max(1.0 - z * z, 0.0)) - 1.0))
            row, factor = grid[(first + j) % size], kernel[0]
            for i in range(columns):
                row[i] += factor * tones[i]


@compiled(error_model="numpy", fastmath=True)
def _join(out, spectrum, slow):  # type: ignore[no-untyped-def]
    """Add instants joined by their polynomials, samples from the middle outwards put in order; out [2, rows, low]."""
    size, instants, rows = spectrum.shape
    low = slow.shape[1]
    half = low // 2
    for i in range(low):
        row = spectrum[size - half + i if i < half else i - half]
        for k in range(instants):
            for r in range(rows):
                out[0, r, i] += slow[k, i] * row[k, r].real
                out[1, r, i] += slow[k, i] * row[k, r].imag


@compiled(error_model="numpy", fastmath=True)
def _interpolate(out, samples, taps_re, taps_im):  # type: ignore[no-untyped-def]
    """Write the same at the full rate: sample step * m + q from the taps of phase q; out [rows, samples]."""
    (rows, count), (step, taps) = out.shape, taps_re.shape
    size = count // step
    re, im = np.empty(size, taps_re.dtype), np.empty(size, taps_re.dtype)
    for r in range(rows):
        for q in range(step):
            re[:], im[:] = 0.0, 0.0
            for j in range(taps):
                a, b = taps_re[q, j], taps_im[q, j]
                near_re, near_im = samples[0, r, 1 + j : 1 + j + size], samples[1, r, 1 + j : 1 + j + size]
                for m in range(size):
                    re[m] += a * near_re[m] - b * near_im[m]
                    im[m] += a * near_im[m] + b * near_re[m]
            for m in range(size):
                out[r, step * m + q] = complex(re[m], im[m])
