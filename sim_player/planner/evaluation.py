"""Evaluation of what echoes add up to in every range bin of every beam, phases and all, with a bound of its error.

Terms along the sweep (`sim_player.planner.sweep_terms`) are gathered on a grid of half range bins and convolved with
the spectra of Hann window x T_m: the kernel level in single precision, with no more terms than needed. The start of a
chirp that still belongs to the last one changes the bins slowly, so it is evaluated at every few bins in closed form
and interpolated.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from scipy import fft

from msgs.values.radar import RadarParams
from sim_player.planner.sweep_terms import MAX_TERMS, SweepTerms
from sim_player.signal.switches import sampled

#: Steps of the grid in a range bin; width of the gridding kernel in steps and its shape.
OVERSAMPLING, WIDTH, SHAPE = 2, 8, 18.4
#: Rounding in single precision: of a transform by the root of all that is in it squared, of an echo by its own size.
ROUNDING = 1e-6
#: The grid reaches so many bins beyond the range bins at most: echoes farther off fall under the window's skirts.
BEYOND_BINS = 128
#: Bins between two at which the overlapped start is evaluated, those beyond either end, taps to either side.
COARSE, GUARD, TAPS = 8, 80, 10
#: Bound of the overlap's closed form, relative: interpolation; an integral for a sum, by the tone's distance squared.
CLOSED_FORM, MIDPOINT = 1e-3, 1.2 / 24.0

#: What of an echo is evaluated.
NOTHING, WHOLE, SQUINT = 0, 1, 2


def evaluate(radar: RadarParams, echoes: SweepTerms, part: np.ndarray, range_bins: int) -> np.ndarray:
    """Return the profiles of parts of the echoes (int [P]: none, all or the squint of each); complex64 [B, bins].

    Overlap left out. `error` bounds what is missing.
    """
    beams = echoes.middle.shape[1]
    part = np.where(echoes.tone < range_bins + BEYOND_BINS, part, NOTHING)
    if not part.any():
        return np.zeros((beams, range_bins), np.complex64)
    most = int(echoes.count[part != NOTHING].max())
    margin = WIDTH // 2
    size = OVERSAMPLING * (range_bins + BEYOND_BINS) + 2 * margin
    kernels = _kernels(radar.samples_per_chirp, range_bins, size)
    grid = np.zeros((most, size, beams), np.complex64)
    _gather(
        grid,
        echoes.terms,
        echoes.middle,
        echoes.count,
        OVERSAMPLING * echoes.tone,
        margin,
        part,
        radar.samples_per_chirp // 2 / radar.samples_per_chirp / OVERSAMPLING,
    )
    spectrum = _weighted_sum(fft.fft(grid, kernels.shape[1], axis=1), kernels[:most])
    profiles = fft.ifft(spectrum, axis=0)[: OVERSAMPLING * range_bins : OVERSAMPLING].T
    count = radar.samples_per_chirp
    turns = np.exp(-2j * np.pi * (np.arange(range_bins) * (count // 2) % count) / count)
    return np.asarray(profiles * turns.astype(np.complex64))


def error(radar: RadarParams, echoes: SweepTerms, part: np.ndarray, range_bins: int) -> np.ndarray:
    """Return a bound of what `evaluate` misses in any beam, float64 [bins]: terms left out, rounding, far echoes."""
    strength = np.where(part == WHOLE, echoes.strength, np.where(part == SQUINT, echoes.squint_strength, 0.0))
    near = echoes.tone < range_bins + BEYOND_BINS
    left = echoes.remainder * (part != NOTHING)
    cell = np.minimum(echoes.tone.astype(np.int64), range_bins + BEYOND_BINS - 1)
    gathered = np.bincount(cell, left * near, range_bins + BEYOND_BINS)
    # echoes of one bin may add up, those of different bins are different samples of the transform
    rounded = float(np.linalg.norm(np.bincount(cell, strength * near)))
    far = float((strength + echoes.remainder)[~near].sum()) * float(skirt(radar, 0)[0])
    return np.asarray(gathered @ _skirts(radar, range_bins) + ROUNDING * rounded + far)


@lru_cache(maxsize=8)
def _skirts(radar: RadarParams, range_bins: int) -> np.ndarray:
    """Return what a tone of each bin of the grid leaves in each range bin at most, float64 [grid bins, bins]."""
    one_side = skirt(radar, range_bins)
    middle = len(one_side) // 2
    off = np.arange(range_bins)[None] - np.arange(range_bins + BEYOND_BINS)[:, None]
    return one_side[middle + off]


class HeadChange:
    """Evaluates what overlapping chirps change, of any of some echoes; one that changes under `least` is bounded only.

    Own echoes are cut off at the start of the chirp; the last chirp's take their place, a band away.
    """

    def __init__(self, radar: RadarParams, echoes: SweepTerms, range_bins: int, least: float) -> None:
        strength = echoes.strength + echoes.remainder
        self._most = strength * head_area(echoes.head)
        self._mine = np.flatnonzero(self._most > least)
        mine, bins = self._mine, np.arange(range_bins)
        tone, head = echoes.tone[mine], echoes.head[mine]
        longest = float(head.max(initial=1e-3))
        step = max(min(COARSE, int(0.5 / longest)), 1)
        at = np.arange(-GUARD, range_bins + GUARD + step, step, dtype=np.float64)
        # at the end of the overlapped start: what is cut off farther than a few bins away depends on that alone
        table = np.polynomial.chebyshev.chebvander(2.0 * head - 1.0, echoes.terms.shape[1] - 1)
        self._field = _fields(echoes.terms, mine, table.astype(np.float32))
        strong = strength[mine].astype(np.float64)
        # a sum of samples is the integral from half a sample before the first to half a sample before the end
        cut = np.maximum(head - 0.5 / radar.samples_per_chirp, 0.0)
        self._closed, self._loose = _head_forms(
            tone, cut, at, strong, echoes.swing_rad[mine], 2.0 * np.pi / radar.samples_per_chirp
        )
        turn = np.exp(1j * np.pi * longest * (at - at[0]))
        self._closed *= turn.astype(np.complex64)
        self._matrix = _interpolation(range_bins, step)
        self._back = np.exp(-1j * np.pi * longest * (bins - at[0])).astype(np.complex64)
        last = _last_chirp(radar, tone, head, at)
        self._last_field = echoes.terms[mine].sum(axis=1) * _last_turn(radar, tone)[:, None]
        self._last = last * turn.astype(np.complex64)
        # its pattern is taken at the end of the sweep, up to half a start too early
        self._loose += (strong * np.minimum(4.0 * echoes.swing_rad[mine] * head + 0.02, 2.0))[:, None] * np.abs(last)
        self._nearest = np.clip(np.rint((bins - at[0]) / step).astype(int), 1, len(at) - 2)

    def __call__(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the change by some of the echoes, bool [P], complex64 [B, bins], and a bound of its error [bins]."""
        inside = mask[self._mine]
        coarse = self._last_field[inside].T @ self._last[inside] - self._field[inside].T @ self._closed[inside]
        change = (coarse @ self._matrix) * self._back
        loose = inside.astype(np.float32) @ self._loose
        near = np.maximum.reduce([loose[self._nearest + side] for side in (-1, 0, 1)])
        most = np.where(mask, self._most, 0.0)
        most[self._mine] = 0.0
        return change, near + most.sum()


@njit(cache=True, nogil=True, fastmath=True)
def _fields(terms, mine, table):  # type: ignore[no-untyped-def]
    """Sums over the terms with a weight for each path; complex64 [paths, B]."""
    out = np.zeros((len(mine), terms.shape[2]), np.complex64)
    for index in range(len(mine)):
        for term in range(terms.shape[1]):
            for beam in range(terms.shape[2]):
                out[index, beam] += table[index, term] * terms[mine[index], term, beam]
    return out


def head_area(share: np.ndarray) -> np.ndarray:
    """Return the sum of a Hann window's first share of the chirp: what is cut off at the tone itself."""
    return np.asarray(share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi))


def head_height(share: np.ndarray) -> np.ndarray:
    """Return the window where it is cut: d bins off the tone its cut stays under this over pi d."""
    return np.asarray(1.0 - np.cos(2.0 * np.pi * share))


def _last_turn(radar: RadarParams, tone: np.ndarray) -> np.ndarray:
    """Return what turns an echo's beat into the last chirp's where that one begins, and 0 where no sample holds it.

    2 pi f_c tau - pi S tau^2 at tau - T_c, less the same at tau: complex64 [P].
    """
    back = radar.bandwidth_hz * radar.chirp_period_s
    turns = (-radar.carrier_hz * radar.chirp_period_s) % 1.0 + tone - 0.5 * back
    passes = sampled(radar, (tone - back) / radar.chirp_period_s)
    return (np.exp(2j * np.pi * (turns % 1.0)) * passes).astype(np.complex64)


def _last_chirp(radar: RadarParams, tone: np.ndarray, head: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return what the last chirp's unit echo, a band away, leaves in some bins, complex64 [P, bins]: where it is cut.

    Summed by parts, a window that rises from zero leaves h(X) exp(2 pi j d X) / (2 j N sin(pi d / N)).
    """
    count = radar.samples_per_chirp
    off = tone[:, None] - radar.bandwidth_hz * radar.chirp_period_s - at
    phase = 2.0 * np.pi * ((off * (head - 0.5 / count)[:, None]) % 1.0)
    height = head_height(head)[:, None]
    return np.asarray(height * np.exp(1j * phase) / (2j * count * np.sin(np.pi * off / count)), np.complex64)


@njit(cache=True, nogil=True, fastmath=True)
def _head_forms(tone, head, at, strength, swing, turn_rad):  # type: ignore[no-untyped-def]
    """Integrals of (1 - cos 2 pi x) exp(2 pi j d x) over [0, X], d = tone - bin, complex64 [P, bins], and bounds of
    the errors of a signal of this strength, float32 [P, bins].

    The pattern p is taken at X. It turns by 2 s at most over the sweep: integrating (1 - cos)(p(x) - p(X)) by parts
    twice leaves 4 s X^2 / d^2 at most, and never more than 10 / 3 s X^4.
    """
    out = np.empty((len(tone), len(at)), np.complex64)
    error = np.empty((len(tone), len(at)), np.float32)
    step = at[1] - at[0]
    for path in range(len(tone)):
        share = head[path]
        first = 2.0 * np.pi * (tone[path] - at[0]) * share
        re, im = np.cos(first), np.sin(first)
        turn_re, turn_im = np.cos(2.0 * np.pi * step * share), -np.sin(2.0 * np.pi * step * share)
        side_re, side_im = np.cos(2.0 * np.pi * share), np.sin(2.0 * np.pi * share)
        turns = 4.4 * swing[path] * share * share
        most = 3.7 * swing[path] * share**4
        for index in range(len(at)):
            off = tone[path] - at[index]
            if min(abs(off), abs(off - 1.0), abs(off + 1.0)) < 1e-3:
                # beside the poles, where the integral is smooth
                off += 2e-3
            here = 1.0 / (2.0 * np.pi * off)
            up, down = 0.5 / (2.0 * np.pi * (off + 1.0)), 0.5 / (2.0 * np.pi * (off - 1.0))
            shift = 2.0 * np.pi * (off - (tone[path] - at[index])) * share
            now_re, now_im = re - shift * im, im + shift * re
            # (exp(j a) - 1) / j = sin a - j (cos a - 1)
            up_re, up_im = now_re * side_re - now_im * side_im, now_im * side_re + now_re * side_im
            down_re, down_im = now_re * side_re + now_im * side_im, now_im * side_re - now_re * side_im
            sum_re = here * now_im - up * up_im - down * down_im
            sum_im = -here * (now_re - 1.0) + up * (up_re - 1.0) + down * (down_re - 1.0)
            out[path, index] = np.complex64(complex(sum_re, sum_im))
            inexact = CLOSED_FORM + MIDPOINT * (off * turn_rad) ** 2
            loose = min(turns / (off * off), most) + inexact * np.sqrt(sum_re * sum_re + sum_im * sum_im)
            error[path, index] = strength[path] * loose
            re, im = re * turn_re - im * turn_im, re * turn_im + im * turn_re
    return out, error


@lru_cache(maxsize=8)
def _interpolation(range_bins: int, step: int) -> np.ndarray:
    """Return the matrix from every `step`-th bin to all, float32 [coarse, bins]: Kaiser-windowed cardinal sines."""
    at = np.arange(-GUARD, range_bins + GUARD + step, step, dtype=np.float64)
    off = (np.arange(range_bins)[None] - at[:, None]) / step
    inside = np.sqrt(np.maximum(1.0 - np.square(off / TAPS), 0.0))
    return np.asarray(np.sinc(off) * np.i0(10.0 * inside) / np.i0(10.0) * (np.abs(off) < TAPS), np.float32)


@njit(cache=True, nogil=True, fastmath=True)
def _gather(grid, terms, middle, count, position, margin, part, turns):  # type: ignore[no-untyped-def]
    _, _, beams = grid.shape
    taps = np.empty(WIDTH, np.float32)
    value = np.empty(beams, np.complex64)
    for path in range(len(count)):
        if part[path] == 0:
            continue
        first = int(np.floor(position[path])) - WIDTH // 2 + 1
        for tap in range(WIDTH):
            off = 2.0 * (position[path] - first - tap) / WIDTH
            taps[tap] = np.exp(SHAPE * (np.sqrt(max(1.0 - off * off, 0.0)) - 1.0))
        angle = 2.0 * np.pi * position[path] * turns
        centre = np.complex64(complex(np.cos(angle), np.sin(angle)))
        for term in range(count[path]):
            for beam in range(beams):
                value[beam] = terms[path, term, beam]
            if term == 0 and part[path] == 2:
                for beam in range(beams):
                    value[beam] -= middle[path, beam]
            for beam in range(beams):
                value[beam] *= centre
            for tap in range(WIDTH):
                row = grid[term, first + tap + margin]
                for beam in range(beams):
                    row[beam] += taps[tap] * value[beam]


@njit(cache=True, nogil=True, fastmath=True)
def _weighted_sum(spectra, kernels):  # type: ignore[no-untyped-def]
    """Sums over the terms of spectra [terms, frequencies, beams] times kernels [terms, frequencies]."""
    terms, frequencies, beams = spectra.shape
    out = np.zeros((frequencies, beams), np.complex64)
    for term in range(terms):
        for index in range(frequencies):
            factor = kernels[term, index]
            for beam in range(beams):
                out[index, beam] += factor * spectra[term, index, beam]
    return out


@lru_cache(maxsize=8)
def _kernels(count: int, range_bins: int, size: int) -> np.ndarray:
    """Return the transforms of the kernels that carry the grid to the bins, complex64 [terms, frequencies].

    As `sim_player.signal.levels` lays them out, of Hann window x T_m over the gridding kernel's transform.
    """
    margin = WIDTH // 2
    length = fft.next_fast_len(size + OVERSAMPLING * range_bins)
    sample = np.arange(count) / count
    slow = np.polynomial.chebyshev.chebvander(2.0 * sample - 1.0, MAX_TERMS - 1).T
    slow = slow * (1.0 - np.cos(2.0 * np.pi * sample)) / (_gridding_transform(count) * count)
    table = fft.ifft(slow, OVERSAMPLING * count, axis=1, norm="forward")
    lag = np.arange(-(size - 1), OVERSAMPLING * (range_bins - 1) + 1)
    step = -lag - margin
    half = (step * (count // 2)) % (OVERSAMPLING * count) / (OVERSAMPLING * count)
    laid = np.zeros((MAX_TERMS, length), np.complex128)
    laid[:, lag % length] = table[:, step % (OVERSAMPLING * count)] * np.exp(-2j * np.pi * half)
    return fft.fft(laid, axis=1).astype(np.complex64)


def _gridding_transform(count: int) -> np.ndarray:
    """Return the transform of the gridding kernel at the centred samples, float64 [count], by Gauss's quadrature."""
    node, weight = np.polynomial.legendre.leggauss(96)
    kernel = np.exp(SHAPE * (np.sqrt(1.0 - np.square(node)) - 1.0)) * weight * 0.5 * WIDTH
    turns = np.pi * WIDTH * (np.arange(count) - count // 2) / (OVERSAMPLING * count)
    return np.asarray(np.cos(np.multiply.outer(turns, node)) @ kernel)


@lru_cache(maxsize=8)
def skirt(radar: RadarParams, range_bins: int) -> np.ndarray:
    """Return the largest |spectrum| of Hann window x T_m, any m, that a tone within a bin of one has so many bins off.

    Float64 [2 reach + 1], falling to either side; the reach is all range bins.
    """
    count, fine = radar.samples_per_chirp, 8
    sample = np.arange(count) / count
    slow = np.polynomial.chebyshev.chebvander(2.0 * sample - 1.0, MAX_TERMS - 1).T
    spectrum = np.abs(fft.rfft(slow * (1.0 - np.cos(2.0 * np.pi * sample)) / count, fine * count, axis=1)).max(axis=0)
    falling = np.maximum.accumulate(spectrum[::-1])[::-1]
    reach = range_bins + BEYOND_BINS
    one_side = falling[np.maximum(fine * (np.arange(reach) - 1), 0)]
    return np.concatenate([one_side[:0:-1], one_side])


@lru_cache(maxsize=8)
def hann_skirt(radar: RadarParams, reach: int) -> np.ndarray:
    """Return what a tone within half a bin of one leaves of a Hann window from 0 to `reach` bins off; float32."""
    count, fine = radar.samples_per_chirp, 8
    window = (1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)) / count
    spectrum = np.abs(fft.rfft(window, fine * count))
    falling = np.maximum.accumulate(spectrum[::-1])[::-1]
    return falling[np.maximum(fine * np.arange(reach + 1) - fine // 2, 0)].astype(np.float32)
