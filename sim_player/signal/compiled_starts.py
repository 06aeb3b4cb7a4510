"""Sums of tones that each stop at their own sample: what overlapping chirps change at the start of a beat, compiled.

The start is cut into parts. What fills a part whole is summed on a small grid of frequencies; where a path stops, its
beat is the part's own tone times little, a few values that add up from the part's end. The slow factor is linear.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from models.compiled import compiled
from msgs.values.radar import RadarParams
from sim_player.signal.compiled_weights import BLOCK, sine_cosine
from sim_player.signal.swept_echoes import cardinal_functions, chebyshev_instants, chebyshev_nodes

#: Largest error of the interpolations, relative to an echo at the array's peak.
TOLERANCE = 1e-5
#: Grid steps that a tone is spread over, on a grid of twice the samples: to 1e-5.
SPREAD = 7
#: Swings of phase are rounded up to multiples of this.
SWING_STEP_RAD = 0.05
#: Parts of a chirp; values that say a beat in the part in which it stops.
PARTS, NODES = 128, 6


def instants_of(swing_rad: float, span: float) -> np.ndarray:
    """Return the Chebyshev instants of [0, span] for a phase that swings so much over a chirp."""
    # in steps, so that beams share their tables
    return _instants(math.ceil(swing_rad / SWING_STEP_RAD), span)


@lru_cache(maxsize=128)
def _instants(steps: int, span: float) -> np.ndarray:
    return chebyshev_instants(steps * SWING_STEP_RAD * span, TOLERANCE, span)


class StartSums:
    """Overlapped starts of all chirps of a radar, for echoes that end at samples up to `last`."""

    def __init__(self, radar: RadarParams, last: int, swing_rad: float) -> None:
        self._count = radar.samples_per_chirp
        self._part = max(self._count // PARTS, 1)
        self._parts = -(-last // self._part)
        self._turn = radar.bandwidth_hz / radar.sample_rate_hz
        self._span = self._part * self._parts / self._count
        self._instants = instants_of(swing_rad, self._span)
        self._slow = _factors_at_borders(len(self._instants), self._parts, self._span)

    @property
    def span(self) -> float:
        """Chirps over which weights must be known: the previous chirp's echo at x is this one's at x + 1."""
        return 1.0 + self._span

    def correction(
        self, weights: np.ndarray, previous: tuple[np.ndarray, np.ndarray], cycles: np.ndarray, ends: np.ndarray
    ) -> np.ndarray:
        """Return the samples to add: previous chirp's echoes until their ends less this one's; complex64 [R, samples].

        `weights` float32 [2, K, R, P] at Chebyshev instants over `span`, `previous` as of `EchoWeights.previous_chirp`;
        the last to end come first.
        """
        instants, (terms, paths) = len(self._instants), weights.shape[2:]
        slow = _factors_at_starts(weights.shape[1], self.span, instants, self._span)
        # instants, real and imaginary parts, both chirps' terms of one path side by side
        tones = np.empty((paths, instants, 2, 2 * terms), np.float32)
        _turned(tones, weights, slow, *previous, self._instants)
        steps, table = _grid(self._count, self._part, self._parts, self._turn)
        grid = np.zeros((self._parts + 1, steps, *tones.shape[1:]), np.float32)
        sums = np.zeros((2, 2 * terms, self._part * self._parts), np.float32)
        _spread_whole(grid, tones, cycles, ends, (self._part, self._part * self._parts))
        _add_whole(sums, grid, table, self._slow)
        _add_ends(sums, tones, (cycles, ends), self._slow, _within(self._part), self._turn / self._count)
        own, last = (sums[0] + 1j * sums[1]).reshape(2, terms, -1)
        # the previous chirp's beat is this one's less the bandwidth
        lower = np.exp(-2j * np.pi * ((self._turn * np.arange(own.shape[1])) % 1.0)).astype(np.complex64)
        return np.asarray((own + lower * last)[:, : self._count])


@lru_cache(maxsize=8)
def _within(part: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants that say a beat in a part, and their polynomials at its samples, float32 [nodes, part]."""
    node = chebyshev_nodes(NODES)
    return node, cardinal_functions(node, np.arange(part) / part).astype(np.float32)


@lru_cache(maxsize=32)
def _factors_at_borders(instants: int, parts: int, span: float) -> np.ndarray:
    """Return the polynomials of the instants at the borders of the parts, float32 [parts + 1, instants]."""
    borders = np.linspace(0.0, span, parts + 1)
    return np.asarray(cardinal_functions(chebyshev_nodes(instants, span), borders, span).T, np.float32)


@lru_cache(maxsize=32)
def _factors_at_starts(instants: int, span: float, near: int, near_span: float) -> np.ndarray:
    """Return the polynomials of all instants at those of the start and one chirp later, float32 [2, near, instants]."""
    nodes, at = chebyshev_nodes(instants, span), chebyshev_nodes(near, near_span)
    factors = cardinal_functions(nodes, np.append(at, at + 1.0), span).T
    return np.asarray(factors.reshape(2, near, instants), np.float32)


@lru_cache(maxsize=32)
def _grid(count: int, part: int, parts: int, turn: float) -> tuple[int, np.ndarray]:
    """Return the steps of a start's grid of frequencies, and its tones, float32 [parts, steps, 2, part]."""
    length = part * parts
    # the longest delay has the highest beat
    steps = int(np.ceil(2.0 * length * turn * length / count)) + SPREAD + 2
    node, weight = np.polynomial.legendre.leggauss(64)
    kernel = np.exp(2.3 * SPREAD * (np.sqrt(1.0 - node**2) - 1.0)) * weight * (0.5 * SPREAD)
    centred = np.arange(length) - length // 2
    transform = np.cos(np.multiply.outer(np.pi * centred / length, 0.5 * SPREAD * node)) @ kernel
    turns = np.multiply.outer(np.arange(steps) - SPREAD // 2 - 1, centred) / (2.0 * length)
    tones = (np.exp(2j * np.pi * (turns % 1.0)) / transform).reshape(steps, parts, part).swapaxes(0, 1)
    return steps, np.ascontiguousarray(np.stack([tones.real, tones.imag], axis=2), np.float32)


@compiled(error_model="numpy", fastmath=True)
def _turned(tones, weights, slow, start, slope, instants):  # type: ignore[no-untyped-def]
    """Write the weights at the start's instants by path: this chirp's taken off, the previous one's corrected."""
    paths, count, _, columns = tones.shape
    terms, far = columns // 2, weights.shape[1]
    re, im = np.empty((2, BLOCK), np.float32), np.empty((2, BLOCK), np.float32)
    turn_re, turn_im = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    for first in range(0, paths, BLOCK):
        size = min(BLOCK, paths - first)
        for k in range(count):
            for p in range(size):
                turn = start[first + p] * (1.0 + slope[first + p] * instants[k])
                turn_re[p], turn_im[p] = turn.real, turn.imag
            for r in range(terms):
                re[:], im[:] = np.float32(0.0), np.float32(0.0)
                for f in range(far):
                    from_re, from_im = weights[0, f, r][first : first + size], weights[1, f, r][first : first + size]
                    for chirp in range(2):
                        factor, sum_re, sum_im = slow[chirp, k, f], re[chirp], im[chirp]
                        for p in range(size):
                            sum_re[p] += factor * from_re[p]
                            sum_im[p] += factor * from_im[p]
                for p in range(size):
                    a, b, c, s = re[1, p], im[1, p], turn_re[p], turn_im[p]
                    tones[first + p, k, 0, r], tones[first + p, k, 1, r] = -re[0, p], -im[0, p]
                    tones[first + p, k, 0, terms + r] = a * c - b * s
                    tones[first + p, k, 1, terms + r] = a * s + b * c


@compiled(error_model="numpy", fastmath=True)
def _spread_whole(grid, tones, cycles, ends, sizes):  # type: ignore[no-untyped-def]
    """Spread each tone over the grid of all parts that it fills; grid [parts + 1, steps, ...]."""
    part, length = sizes
    _, instants, _, columns = tones.shape
    centred = np.empty(tones.shape[1:], np.float32)
    flat, cells = centred.reshape(-1), grid.reshape(grid.shape[0], grid.shape[1], -1)
    for p in range(len(cycles)):
        filled = ends[p] // part
        if not filled:
            continue
        turn = 2.0 * np.pi * cycles[p] * (length // 2)
        c, s = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        for k in range(instants):
            re, im, to_re, to_im = tones[p, k, 0], tones[p, k, 1], centred[k, 0], centred[k, 1]
            for q in range(columns):
                to_re[q], to_im[q] = re[q] * c - im[q] * s, re[q] * s + im[q] * c
        position = 2.0 * length * cycles[p] + SPREAD // 2 + 1
        first = int(np.ceil(position - 0.5 * SPREAD))
        for j in range(SPREAD):
            z = 2.0 * (position - (first + j)) / SPREAD
            kernel = np.float32(np.exp(2.3 * SPREAD * (np.sqrt(max(1.0 - z * z, 0.0)) - 1.0)))
            row = cells[filled - 1, first + j]
            for i in range(len(flat)):
                row[i] += kernel * flat[i]
    # what fills a part fills all before it
    for filled in range(grid.shape[0] - 3, -1, -1):
        grid[filled] += grid[filled + 1]


@compiled(error_model="numpy", fastmath=True)
def _add_whole(sums, grid, table, slow):  # type: ignore[no-untyped-def]
    """Add the tones that fill a part, under the slow factor at its start and its rise over the part."""
    parts, steps, _, part = table.shape
    instants, columns = slow.shape[1], sums.shape[1]
    # real and imaginary parts at the start, and of the rise a sample
    line, total = np.empty((4, columns), np.float32), np.empty((columns, 4, part), np.float32)
    for b in range(parts):
        total[:] = np.float32(0.0)
        for g in range(steps):
            line[:] = np.float32(0.0)
            for k in range(instants):
                here, rise = slow[b, k], (slow[b + 1, k] - slow[b, k]) / np.float32(part)
                for c in range(2):
                    value = grid[b, g, k, c]
                    for q in range(columns):
                        line[c, q] += here * value[q]
                        line[2 + c, q] += rise * value[q]
            tone_re, tone_im = table[b, g, 0], table[b, g, 1]
            for q in range(columns):
                for c in range(0, 4, 2):
                    re, im, sum_re, sum_im = line[c, q], line[c + 1, q], total[q, c], total[q, c + 1]
                    for i in range(part):
                        sum_re[i] += re * tone_re[i] - im * tone_im[i]
                        sum_im[i] += re * tone_im[i] + im * tone_re[i]
        for q in range(columns):
            for c in range(2):
                out = sums[c, q, b * part :]
                for i in range(part):
                    out[i] += total[q, c, i] + np.float32(i) * total[q, 2 + c, i]


@compiled(error_model="numpy", fastmath=True)
def _add_ends(sums, tones, paths, slow, local, rate):  # type: ignore[no-untyped-def]
    """Add each tone in the part in which it stops, up to its last sample there; the last to stop come first.

    `local`: instants of a part [nodes], and their polynomials at its samples [nodes, part]; `rate`: cycles a sample of
    an echo that is a sample late.
    """
    cycles, ends = paths
    node, near = local
    count, (_, instants, _, columns) = len(node), tones.shape
    part = near.shape[1]
    held, line = np.empty((count, 2, columns), np.float32), np.empty((4, columns), np.float32)
    total = np.empty((2, columns), np.float32)
    at = 0
    while at < len(ends):
        filled = ends[at] // part
        if not ends[at] % part:
            # stops at a border: no part is left
            at += 1
            continue
        middle = rate * (filled + 0.5) * part
        held[:] = np.float32(0.0)
        for i in range(part - 1, -1, -1):
            last = filled * part + i
            while at < len(ends) and ends[at] == last + 1:
                line[:] = np.float32(0.0)
                for k in range(instants):
                    here, rise = slow[filled, k], slow[filled + 1, k] - slow[filled, k]
                    for half in range(2):
                        value = tones[at, k, half]
                        for q in range(columns):
                            line[half, q] += here * value[q]
                            line[2 + half, q] += rise * value[q]
                for n in range(count):
                    turns = (cycles[at] - middle) * (filled + node[n]) * part
                    sine, cosine = sine_cosine(2.0 * np.pi * turns)
                    s, c, x = np.float32(sine), np.float32(cosine), np.float32(node[n])
                    held_re, held_im = held[n, 0], held[n, 1]
                    for q in range(columns):
                        re, im = line[0, q] + x * line[2, q], line[1, q] + x * line[3, q]
                        held_re[q] += re * c - im * s
                        held_im[q] += re * s + im * c
                at += 1
            total[:] = np.float32(0.0)
            for n in range(count):
                factor = near[n, i]
                for half in range(2):
                    for q in range(columns):
                        total[half, q] += factor * held[n, half, q]
            turn = middle * last
            sine, cosine = sine_cosine(2.0 * np.pi * (turn - np.floor(turn)))
            s, c = np.float32(sine), np.float32(cosine)
            for q in range(columns):
                sums[0, q, last] += total[0, q] * c - total[1, q] * s
                sums[1, q, last] += total[0, q] * s + total[1, q] * c
