"""Evaluation of what echoes add up to in every range bin of every beam, phases and all, with a bound of its error.

Terms along the sweep (`sim_player.planner.sweep_terms`) are gathered on a grid of half range bins and convolved with
the spectra of Hann window x T_m: the kernel level in single precision, with no more terms than needed. The start of a
chirp that still belongs to the last one changes the bins slowly, so it is evaluated at every few bins in closed form
and interpolated.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from models.compiled import compiled
from msgs.values.radar import RadarParams
from sim_player.planner.sweep_terms import MAX_TERMS, SweepTerms
from sim_player.signal.switches import sampled

#: Steps of the grid in a range bin; width of the gridding kernel in steps and its shape.
OVERSAMPLING, WIDTH, SHAPE = 2, 8, 18.4
#: Rounding in single precision: of an echo where it stands, by its size; of a transform in all bins, by the root of all
#: that is in it squared. Measured are 6e-7, and 6e-10 in the median bin, 4e-8 at most.
ROUNDING, SPREAD = 1e-6, 1e-7
#: The grid reaches so many bins beyond the range bins at most: echoes farther off fall under the window's skirts.
BEYOND_BINS = 128
#: The grid begins and ends at multiples of so many bins; echoes are followed so many bins beyond.
BLOCK_BINS, REACH_BINS = 64, 128
#: Bins between two at which the overlapped start is evaluated, those beyond either end, taps to either side.
COARSE, GUARD, TAPS = 16, 128, 8
#: Shape of the window of that interpolation, which leaves exp(-shape), and the most of a turn from one to the next.
COARSE_SHAPE, COARSE_TURN = 9.4, 0.625
#: Bound of the overlap's closed form, relative: interpolation and rounding; an integral for a sum, by the tone's
#: distance squared.
CLOSED_FORM, MIDPOINT = 2e-4, 1.2 / 24.0
#: Bins to either side of a pole of the closed form where it is taken at twice the distance.
BESIDE_POLE = 1e-3

#: What of an echo is evaluated.
NOTHING, WHOLE, SQUINT, STEADY = 0, 1, 2, 3


def evaluate(radar: RadarParams, echoes: SweepTerms, part: np.ndarray, range_bins: int) -> np.ndarray:
    """Return the profiles of parts of the echoes (int [P]: none, all, squint alone, all but that); complex64 [B, bins].

    Overlap left out. `error` bounds what is missing.
    """
    beams, count = echoes.middle.shape[1], radar.samples_per_chirp
    part = np.where(echoes.tone < range_bins + BEYOND_BINS, part, NOTHING)
    used = np.where(part == STEADY, np.minimum(echoes.count, 1), echoes.count)
    most = int(used[part != NOTHING].max(initial=0))
    profiles = np.zeros((beams, range_bins), np.complex64)
    if most == 0:
        return profiles
    start, end, band = _band(echoes.tone[part != NOTHING], range_bins)
    grid = np.zeros((most, OVERSAMPLING * (end - start) + WIDTH, beams), np.complex64)
    turns = count // 2 / count / OVERSAMPLING
    position, margin = OVERSAMPLING * echoes.tone, WIDTH // 2 - OVERSAMPLING * start
    _gather(grid, echoes.terms, echoes.middle, echoes.count, position, margin, part, turns)
    kernels = _kernels(count, len(band), grid.shape[1], band.start - start)
    spectrum = _weighted_sum(fft.fft(grid, kernels.shape[1], axis=1), kernels[:most])
    inside = fft.ifft(spectrum, axis=0)[: OVERSAMPLING * len(band) : OVERSAMPLING].T
    back = np.exp(-2j * np.pi * (np.asarray(band) * (count // 2) % count) / count)
    profiles[:, band.start : band.stop] = inside * back.astype(np.complex64)
    return profiles


def _band(tone: np.ndarray, range_bins: int) -> tuple[int, int, range]:
    """Return the first bin and the end of whole blocks around all tones, and the range bins that they reach.

    In whole blocks, so that scenes share their kernels.
    """
    first, last = (int(tone.min()) // BLOCK_BINS, int(tone.max()) // BLOCK_BINS) if len(tone) else (0, 0)
    start, end = first * BLOCK_BINS, (last + 1) * BLOCK_BINS
    return start, end, range(max(start - REACH_BINS, 0), min(end + REACH_BINS, range_bins))


def error(radar: RadarParams, echoes: SweepTerms, part: np.ndarray, range_bins: int) -> np.ndarray:
    """Return a bound of what `evaluate` misses in any beam, float64 [bins]: terms left out, rounding, far echoes."""
    if not part.any():
        return np.zeros(range_bins)
    strength = np.where(part == SQUINT, echoes.magnitudes[1].max(axis=1), echoes.full) * (part != NOTHING)
    near = echoes.tone < range_bins + BEYOND_BINS
    left = echoes.remainder * (part != NOTHING) + ROUNDING * strength
    cell = np.minimum(echoes.tone.astype(np.int64), range_bins + BEYOND_BINS - 1)
    gathered = np.bincount(cell, left * near, range_bins + BEYOND_BINS).astype(np.float32)
    # echoes of one bin may add up, those of different bins are different samples of the transform
    spread = SPREAD * float(np.linalg.norm(np.bincount(cell, strength * near)))
    far = float(strength[~near].sum()) * float(skirt(radar, 0)[0])
    bound = gathered @ skirts(radar, range_bins) + spread + far
    band = _band(echoes.tone[near & (part != NOTHING)], range_bins)[2]
    beyond = np.ones(range_bins)
    beyond[band.start : band.stop] = 0.0
    one_side = skirt(radar, range_bins)
    return np.asarray(bound + beyond * (float(strength[near].sum()) * one_side[len(one_side) // 2 + REACH_BINS]))


@lru_cache(maxsize=8)
def skirts(radar: RadarParams, range_bins: int) -> np.ndarray:
    """Return what a tone of each bin of the grid leaves in each range bin at most, float32 [grid bins, bins]."""
    one_side = skirt(radar, range_bins)
    middle = len(one_side) // 2
    off = np.arange(range_bins)[None] - np.arange(range_bins + BEYOND_BINS)[:, None]
    return one_side[middle + off].astype(np.float32)


class HeadChange:
    """Evaluates what overlapping chirps change, of any of some echoes; the weakest are bounded only, `spare` in all.

    Own echoes are cut off at the start of the chirp; the last chirp's take their place, a band away.
    """

    def __init__(self, radar: RadarParams, echoes: SweepTerms, range_bins: int, spare: float) -> None:
        # what is cut off, and what takes its place
        area = 2.0 * head_area(echoes.head)
        self._most = echoes.full * area
        asked = ~_weakest_within(self._most, spare) & (echoes.count > 0)
        # of these the terms alone leave something out, of their slope up to the square of their number as much
        self._most[asked] = (echoes.remainder * area * (1.0 + np.square(echoes.count) * echoes.head))[asked]
        steps = np.clip(2.0 ** np.floor(np.log2(COARSE_TURN / np.maximum(echoes.head, 1e-3))), 1, COARSE).astype(int)
        self._shape = (echoes.middle.shape[1], range_bins)
        self._groups = [
            _HeadGroup(radar, echoes, np.flatnonzero(asked & (steps == step)), int(step), range_bins)
            for step in np.unique(steps[asked])
        ]

    def __call__(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the change by some of the echoes, bool [P], complex64 [B, bins], and a bound of its error [bins]."""
        change, loose = np.zeros(self._shape, np.complex64), np.full(self._shape[1], self._most[mask].sum())
        for group in self._groups:
            more, error = group.change(mask)
            change, loose = change + more, loose + error
        return change, loose


class _HeadGroup:
    """Echoes whose overlapped starts are short enough to be evaluated at every so many bins."""

    def __init__(self, radar: RadarParams, echoes: SweepTerms, mine: np.ndarray, step: int, range_bins: int) -> None:
        self._mine, bins = mine, np.arange(range_bins)
        strong = echoes.full[mine]
        tone, head = echoes.tone[mine], echoes.head[mine]
        longest = float(head.max())
        at = np.arange(-GUARD, range_bins + GUARD + step, step, dtype=np.float64)
        # a sum of samples is the integral from half a sample before the first to half a sample before the end
        cut = np.maximum(head - 0.5 / radar.samples_per_chirp, 0.0)
        # value and slope at that end: what is cut off farther than a few bins away depends on the value alone
        values, slopes = _end_tables(cut, echoes.terms.shape[1])
        self._field, self._slope_field = (_fields(echoes.terms, mine, table) for table in (values, slopes))
        turn_rad = np.pi * longest * step
        self._closed, self._slope, self._loose = _head_forms(
            tone, cut, at, turn_rad, strong, echoes.swing_rad[mine], 2.0 * np.pi / radar.samples_per_chirp
        )
        self._factors, self._step = _interpolation(range_bins, step), step
        self._back = np.exp(-1j * np.pi * longest * (bins - at[0])).astype(np.complex64)
        self._last_field = echoes.terms[mine].sum(axis=1) * _last_turn(radar, tone)[:, None]
        # its pattern is taken at the end of the sweep, up to half a start too early
        early = strong * np.minimum(4.0 * echoes.swing_rad[mine] * head + 0.02, 2.0)
        back = radar.bandwidth_hz * radar.chirp_period_s
        self._last = _last_forms(tone - back, head, at, turn_rad, radar.samples_per_chirp, early, self._loose)
        self._nearest = np.clip(np.rint((bins - at[0]) / step).astype(int), 1, len(at) - 2)

    def change(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `HeadChange` of those of this group."""
        asked = mask[self._mine]
        inside = slice(None) if asked.all() else asked
        cut_off = self._field[inside].T @ self._closed[inside] + self._slope_field[inside].T @ self._slope[inside]
        coarse = self._last_field[inside].T @ self._last[inside] - cut_off
        loose = asked.astype(np.float32) @ self._loose
        near = np.maximum.reduce([loose[self._nearest + side] for side in (-1, 0, 1)])
        return _interpolated(coarse, self._factors, self._back, self._step), near


@compiled(fastmath=True)
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


def _last_turn(radar: RadarParams, tone: np.ndarray) -> np.ndarray:
    """Return what turns an echo's beat into the last chirp's where that one begins, and 0 where no sample holds it.

    2 pi f_c tau - pi S tau^2 at tau - T_c, less the same at tau: complex64 [P].
    """
    back = radar.bandwidth_hz * radar.chirp_period_s
    turns = (-radar.carrier_hz * radar.chirp_period_s) % 1.0 + tone - 0.5 * back
    passes = sampled(radar, (tone - back) / radar.chirp_period_s)
    return (np.exp(2j * np.pi * (turns % 1.0)) * passes).astype(np.complex64)


@compiled
def _weakest_within(most, spare):  # type: ignore[no-untyped-def]
    """Mask of the weakest whose sum stays within `spare`, bool [P]."""
    mask, left = np.zeros(len(most), np.bool_), spare
    for path in np.argsort(most):
        left -= most[path]
        if left < 0.0:
            break
        mask[path] = True
    return mask


@compiled(fastmath=True)
def _last_forms(off, head, at, turn_rad, count, early, loose):  # type: ignore[no-untyped-def]
    """What the last chirp's unit echo leaves in the bins `at`, `off` from 0, where it is cut; complex64 [P, bins].

    Each next bin is turned by `turn_rad` more. Summed by parts, a window that rises from zero leaves
    h(X) exp(2 pi j d X) / (2 j N sin(pi d / N)). Adds `early` times its magnitude to `loose`.
    """
    out = np.empty((len(off), len(at)), np.complex64)
    step = at[1] - at[0]
    for path in range(len(off)):
        share = head[path] - 0.5 / count
        height = (1.0 - np.cos(2.0 * np.pi * head[path])) / (2.0 * count)
        phase = 2.0 * np.pi * (((off[path] - at[0]) * share) % 1.0) - 0.5 * np.pi
        re, im = height * np.cos(phase), height * np.sin(phase)
        turn = turn_rad - 2.0 * np.pi * step * share
        turn_re, turn_im = np.cos(turn), np.sin(turn)
        for index in range(len(at)):
            inverse = 1.0 / np.sin(np.pi * (off[path] - at[index]) / count)
            out[path, index] = np.complex64(complex(re * inverse, im * inverse))
            loose[path, index] += early[path] * height * abs(inverse)
            re, im = re * turn_re - im * turn_im, re * turn_im + im * turn_re
    return out


def _end_tables(share: np.ndarray, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Return T_m and its slope over the chirp where a share of the chirp ends, float32 [P, terms] each."""
    at = 2.0 * share - 1.0
    values = np.polynomial.chebyshev.chebvander(at, terms - 1)
    # T_m' = m U_(m-1), U_m = 2 T_m + U_(m-2)
    second = np.zeros((terms + 1, len(at)))
    for order in range(terms - 1):
        second[order + 2] = (1.0 if order == 0 else 2.0) * values[:, order] + second[order]
    slopes = 2.0 * np.arange(terms) * second[1:].T
    return values.astype(np.float32), slopes.astype(np.float32)


@compiled(fastmath=True)
def _head_forms(tone, head, at, turn_rad, strength, swing, sample_rad):  # type: ignore[no-untyped-def]
    """Integrals over [0, X] of (1 - cos 2 pi x) exp(2 pi j d x) and of the same times x - X, d = tone - bin, complex64
    [P, bins] each, every next bin turned by `turn_rad` more; bounds of the errors of a signal of this strength,
    float32 [P, bins].

    The pattern p is taken as p(X) + p'(X) (x - X). It turns by 2 s at most over the sweep: what is left is at most
    2 s^2 (X - x)^2; integrated by parts twice, 3 s^2 X^3 / d^2 at most, and never more than 1.5 s^2 X^5.
    """
    out = np.empty((len(tone), len(at)), np.complex64)
    slope = np.empty((len(tone), len(at)), np.complex64)
    error = np.empty((len(tone), len(at)), np.float32)
    step = at[1] - at[0]
    for path in range(len(tone)):
        share = head[path]
        first = 2.0 * np.pi * (tone[path] - at[0]) * share
        re, im = np.cos(first), np.sin(first)
        back_re, back_im = np.cos(2.0 * np.pi * step * share), -np.sin(2.0 * np.pi * step * share)
        side_re, side_im = np.cos(2.0 * np.pi * share), np.sin(2.0 * np.pi * share)
        turn_re, turn_im, more_re, more_im = 1.0, 0.0, np.cos(turn_rad), np.sin(turn_rad)
        shift = 4.0 * np.pi * share * BESIDE_POLE
        shift_re, shift_im = np.cos(shift), np.sin(shift)
        squared = swing[path] * swing[path] * share**3
        for index in range(len(at)):
            off = tone[path] - at[index]
            inexact = CLOSED_FORM + MIDPOINT * (off * sample_rad) ** 2
            now_re, now_im = re, im
            if min(abs(off), abs(off - 1.0), abs(off + 1.0)) < BESIDE_POLE:
                # where the integrals are smooth; their forms cancel too much for an angle that is not exact
                off += 2.0 * BESIDE_POLE
                now_re, now_im = re * shift_re - im * shift_im, im * shift_re + re * shift_im
                inexact += 1.1 * shift
            sum_re, sum_im, slope_re, slope_im = 0.0, 0.0, 0.0, 0.0
            for side in range(-1, 2):
                # (exp(2 pi j d X) - 1) / (2 pi j d) = e, and (X - e) / (2 pi j d)
                angle_re = now_re if side == 0 else now_re * side_re - side * now_im * side_im
                angle_im = now_im if side == 0 else now_im * side_re + side * now_re * side_im
                here = 1.0 / (2.0 * np.pi * (off + side))
                part_re, part_im = here * angle_im, here * (1.0 - angle_re)
                factor = 1.0 if side == 0 else -0.5
                sum_re += factor * part_re
                sum_im += factor * part_im
                slope_re -= factor * here * part_im
                slope_im -= factor * here * (share - part_re)
            out[path, index] = np.complex64(
                complex(sum_re * turn_re - sum_im * turn_im, sum_re * turn_im + sum_im * turn_re)
            )
            slope[path, index] = np.complex64(
                complex(slope_re * turn_re - slope_im * turn_im, slope_re * turn_im + slope_im * turn_re)
            )
            loose = min(3.0 * squared / (off * off), 1.5 * squared * share * share)
            error[path, index] = strength[path] * (loose + inexact * np.sqrt(sum_re * sum_re + sum_im * sum_im))
            re, im = re * back_re - im * back_im, re * back_im + im * back_re
            turn_re, turn_im = turn_re * more_re - turn_im * more_im, turn_re * more_im + turn_im * more_re
    return out, slope, error


@lru_cache(maxsize=8)
def _interpolation(range_bins: int, step: int) -> np.ndarray:
    """Return the factors of the nearest of every `step`-th bin, float32 [bins, 2 taps]: Kaiser-windowed cardinal
    sines.
    """
    bins = np.arange(range_bins)
    off = (bins % step)[:, None] / step - np.arange(1 - TAPS, TAPS + 1)
    inside = np.sqrt(np.maximum(1.0 - np.square(off / TAPS), 0.0))
    return np.asarray(np.sinc(off) * np.i0(COARSE_SHAPE * inside) / np.i0(COARSE_SHAPE), np.float32)


@compiled(fastmath=True)
def _interpolated(coarse, factors, back, step):  # type: ignore[no-untyped-def]
    """Values at all bins from those at every so many, from `GUARD` bins before the first on, turned back; [B, bins]."""
    beams, (bins, taps) = len(coarse), factors.shape
    out = np.empty((beams, bins), np.complex64)
    for beam in range(beams):
        for cell in range(bins):
            first = (cell + GUARD) // step + 1 - taps // 2
            value = np.complex64(0.0)
            for tap in range(taps):
                value += factors[cell, tap] * coarse[beam, first + tap]
            out[beam, cell] = value * back[cell]
    return out


@compiled(fastmath=True)
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
        for term in range(min(count[path], 1) if part[path] == 3 else count[path]):
            for beam in range(beams):
                value[beam] = terms[path, term, beam] if part[path] != 3 else middle[path, beam]
            if term == 0 and part[path] == 2:
                for beam in range(beams):
                    value[beam] -= middle[path, beam]
            for beam in range(beams):
                value[beam] *= centre
            for tap in range(WIDTH):
                row = grid[term, first + tap + margin]
                for beam in range(beams):
                    row[beam] += taps[tap] * value[beam]


@compiled(fastmath=True)
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


@lru_cache(maxsize=64)
def _kernels(count: int, bins: int, size: int, first: int) -> np.ndarray:
    """Return the transforms of the kernels that carry a grid of so many steps to so many bins, complex64 [terms,
    frequencies]; `first`: the first bin over the grid's.

    As `sim_player.signal.levels` lays them out, of Hann window x T_m over the gridding kernel's transform.
    """
    length = fft.next_fast_len(size + OVERSAMPLING * bins)
    lag = np.arange(-(size - 1), OVERSAMPLING * (bins - 1) + 1)
    step = -lag - WIDTH // 2 - OVERSAMPLING * first
    half = (step * (count // 2)) % (OVERSAMPLING * count) / (OVERSAMPLING * count)
    laid = np.zeros((MAX_TERMS, length), np.complex128)
    laid[:, lag % length] = _spectra(count)[:, step % (OVERSAMPLING * count)] * np.exp(-2j * np.pi * half)
    return fft.fft(laid, axis=1).astype(np.complex64)


@lru_cache(maxsize=2)
def _spectra(count: int) -> np.ndarray:
    """Return the spectra of Hann window x T_m over the gridding kernel's transform, at half bins [terms, 2 count]."""
    sample = np.arange(count) / count
    slow = np.polynomial.chebyshev.chebvander(2.0 * sample - 1.0, MAX_TERMS - 1).T
    slow = slow * (1.0 - np.cos(2.0 * np.pi * sample)) / (_gridding_transform(count) * count)
    return np.asarray(fft.ifft(slow, OVERSAMPLING * count, axis=1, norm="forward"))


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
