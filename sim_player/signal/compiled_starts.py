"""Sums of tones that each stop at their own sample: what overlapping chirps change at the start of a beat, compiled.

An echo of delay tau fills the first tau f_s samples with the previous chirp's beat. The start is cut into parts. Parts
that a path fills whole are summed on a grid of frequencies, which is small, for a start is short; the part in which it
stops, sample by sample. Within a part the slow factor is a straight line.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from models.compiled import compiled
from msgs.values.radar import RadarParams
from sim_player.signal.swept_echoes import cardinal_functions, chebyshev_instants

#: Largest error of the interpolations, relative to an echo at the array's peak.
TOLERANCE = 1e-5
#: Grid steps that a tone is spread over, on a grid of twice the samples: to 1e-5.
SPREAD = 10
#: Swings of phase are rounded up to multiples of this.
SWING_STEP_RAD = 0.05


def instants_of(swing_rad: float, span: float) -> np.ndarray:
    """Return the Chebyshev instants of [0, span] for a phase that swings so much over a chirp."""
    # in steps, so that beams share their tables
    return _instants(math.ceil(swing_rad / SWING_STEP_RAD), span)


@lru_cache(maxsize=128)
def _instants(steps: int, span: float) -> np.ndarray:
    return chebyshev_instants(steps * SWING_STEP_RAD * span, TOLERANCE, span)


def chebyshev_nodes(count: int, span: float) -> np.ndarray:
    """Return so many Chebyshev instants of [0, span]."""
    return np.asarray(span * (0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count)))


class StartSums:
    """Overlapped starts of all chirps of a radar: `parts` of `part` samples."""

    def __init__(self, radar: RadarParams, grid: tuple[int, int], swing_rad: float) -> None:
        self._part, self._parts = grid
        self._turn = radar.bandwidth_hz / radar.sample_rate_hz
        self._count = radar.samples_per_chirp
        self._span = self._part * self._parts / self._count
        self._instants = instants_of(swing_rad, self._span)
        self._slow = _factors_at_borders(len(self._instants), self._parts, self._span)

    def slow_factors(self, instants: int, span: float) -> np.ndarray:
        """Return what brings weights at Chebyshev instants of [0, span] to those of the start and one chirp later."""
        return _factors_at_starts(instants, span, len(self._instants), self._span)

    def add(
        self,
        beats: np.ndarray,
        slow: np.ndarray,
        weights: np.ndarray,
        previous: tuple[np.ndarray, np.ndarray],
        cycles: np.ndarray,
        ends: np.ndarray,
    ) -> None:
        """Take this chirp's echoes off until their ends and put the previous chirp's in; beats [R, samples].

        `slow` [2 instants, K] brings weights float32 [2, K, R, P] to the instants of this chirp and of the one before,
        which `previous` corrects (`EchoWeights.previous_chirp`).
        """
        instants, (terms, paths) = len(self._instants), weights.shape[2:]
        values = (slow @ weights.reshape(2, slow.shape[1], terms * paths)).reshape(2, 2, instants, terms, paths)
        # both chirps, instants, terms, real and imaginary parts of one path side by side
        tones = np.empty((paths, 2, instants, terms, 2), np.float32)
        _turned(tones, values, *previous, self._instants)
        steps, table = _grid(self._count, self._part, self._parts, self._turn)
        grid = np.zeros((self._parts + 1, steps, tones[0].size), np.float32)
        length = self._part * self._parts
        rest = np.zeros((self._parts, 2, terms, 2, self._part), np.float32)
        _collect(grid, rest, tones.reshape(paths, -1), cycles, ends, self._slow)
        rows = np.empty((self._parts, 2, 2, terms, steps), np.complex64)
        _rows(rows, grid.reshape(self._parts + 1, steps, 2, instants, terms, 2), self._slow)
        sums = (rows.reshape(self._parts, -1, steps) @ table).reshape(self._parts, 2, 2, terms, self._part)
        ramp = np.arange(self._part, dtype=np.float32) / np.float32(self._part)
        both = sums[:, 0] + ramp * sums[:, 1] + (rest[..., 0, :] + 1j * rest[..., 1, :])
        both = both.transpose(1, 2, 0, 3).reshape(2, terms, length)
        # the previous chirp's beat is this one's less the bandwidth
        lower = np.exp(-2j * np.pi * ((self._turn * np.arange(length)) % 1.0)).astype(np.complex64)
        size = min(length, self._count)
        beats[:, :size] += (both[0] + lower * both[1])[:, :size]


@lru_cache(maxsize=32)
def _factors_at_borders(instants: int, parts: int, span: float) -> np.ndarray:
    """Return the polynomials of the instants at the borders of the parts, float32 [parts + 1, instants]."""
    borders = np.linspace(0.0, span, parts + 1)
    return np.asarray(cardinal_functions(chebyshev_nodes(instants, span), borders, span).T, np.float32)


@lru_cache(maxsize=32)
def _factors_at_starts(instants: int, span: float, near: int, near_span: float) -> np.ndarray:
    """Return the polynomials of all instants at those of the start and one chirp later, float32 [2 near, instants]."""
    nodes, at = chebyshev_nodes(instants, span), chebyshev_nodes(near, near_span)
    return np.asarray(cardinal_functions(nodes, np.append(at, at + 1.0), span).T, np.float32)


@lru_cache(maxsize=32)
def _grid(count: int, part: int, parts: int, turn: float) -> tuple[int, np.ndarray]:
    """Return the steps of a start's grid of frequencies, and its tones over the samples.

    Complex64 [parts, steps, part]. The kernel's own transform is divided out.
    """
    length = part * parts
    # the longest delay has the highest beat
    steps = int(np.ceil(2.0 * length * turn * length / count)) + SPREAD + 1
    node, weight = np.polynomial.legendre.leggauss(64)
    kernel = np.exp(2.3 * SPREAD * (np.sqrt(1.0 - node**2) - 1.0)) * weight * (0.5 * SPREAD)
    centred = np.arange(length) - length // 2
    transform = np.cos(np.multiply.outer(np.pi * centred / length, 0.5 * SPREAD * node)) @ kernel
    turns = np.multiply.outer(np.arange(steps) - SPREAD // 2, centred) / (2.0 * length)
    tones = np.exp(2j * np.pi * (turns % 1.0)) / transform
    return steps, np.ascontiguousarray(tones.reshape(steps, parts, part).swapaxes(0, 1), np.complex64)


@compiled(error_model="numpy", fastmath=True)
def _turned(tones, values, start, slope, instants):  # type: ignore[no-untyped-def]
    """Write values [2, chirps, instants, R, P] by path: this chirp's taken off, the previous one's corrected."""
    _, _, count, terms, paths = values.shape
    for p in range(paths):
        for k in range(count):
            turn = start[p] * (1.0 + slope[p] * instants[k])
            re, im = np.float32(turn.real), np.float32(turn.imag)
            for r in range(terms):
                tones[p, 0, k, r, 0], tones[p, 0, k, r, 1] = -values[0, 0, k, r, p], -values[1, 0, k, r, p]
                a, b = values[0, 1, k, r, p], values[1, 1, k, r, p]
                tones[p, 1, k, r, 0], tones[p, 1, k, r, 1] = a * re - b * im, a * im + b * re


@compiled(error_model="numpy", fastmath=True)
def _collect(grid, rest, tones, cycles, ends, slow):  # type: ignore[no-untyped-def]
    """Spread each tone over the grid of all parts that it fills, and sum it in the part in which it stops.

    Grid float32 [parts + 1, steps, columns]; rest float32 [parts, chirps, R, 2, part]; tones [P, columns].
    """
    parts, _, terms, _, part = rest.shape
    length, instants, columns = parts * part, slow.shape[1], tones.shape[1]
    middle, centred = length // 2, np.empty(columns, np.float32)
    tone_re, tone_im = np.empty(part, np.float32), np.empty(part, np.float32)
    for p in range(len(cycles)):
        filled = ends[p] // part
        turn = 2.0 * np.pi * cycles[p]
        if filled:
            c, s = np.float32(np.cos(turn * middle)), np.float32(np.sin(turn * middle))
            for i in range(columns // 2):
                re, im = tones[p, 2 * i], tones[p, 2 * i + 1]
                centred[2 * i], centred[2 * i + 1] = re * c - im * s, re * s + im * c
            position = 2.0 * length * cycles[p] + SPREAD // 2
            first = int(np.floor(position)) - SPREAD // 2 + 1
            for j in range(SPREAD):
                z = 2.0 * (position - (first + j)) / SPREAD
                kernel = np.float32(np.exp(2.3 * SPREAD * (np.sqrt(max(1.0 - z * z, 0.0)) - 1.0)))
                row = grid[filled - 1, first + j]
                for i in range(columns):
                    row[i] += kernel * centred[i]
        size = ends[p] - filled * part
        if not size:
            continue
        step, on = complex(np.cos(turn), np.sin(turn)), np.exp(1j * turn * filled * part)
        for i in range(size):
            tone_re[i], tone_im[i] = on.real, on.imag
            on *= step
        for chirp in range(2):
            for r in range(terms):
                a, b, c, d = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for k in range(instants):
                    at = 2 * ((chirp * instants + k) * terms + r)
                    here, on_line = slow[filled, k], (slow[filled + 1, k] - slow[filled, k]) / part
                    a, b = a + here * tones[p, at], b + here * tones[p, at + 1]
                    c, d = c + on_line * tones[p, at], d + on_line * tones[p, at + 1]
                _add_line(rest[filled, chirp, r], tone_re, tone_im, (a, b, c, d), size)
    # what fills a part fills all before it
    for filled in range(parts - 2, -1, -1):
        grid[filled] += grid[filled + 1]


@compiled(error_model="numpy", fastmath=True)
def _rows(rows, grid, slow):  # type: ignore[no-untyped-def]
    """Write the grid of each part under the slow factor at its start, and under the factor's rise over the part."""
    parts, _, _, terms, steps = rows.shape
    for b in range(parts):
        for chirp in range(2):
            for r in range(terms):
                for g in range(steps):
                    here, rise = complex(0.0, 0.0), complex(0.0, 0.0)
                    for k in range(slow.shape[1]):
                        value = complex(grid[b, g, chirp, k, r, 0], grid[b, g, chirp, k, r, 1])
                        here += slow[b, k] * value
                        rise += (slow[b + 1, k] - slow[b, k]) * value
                    rows[b, 0, chirp, r, g], rows[b, 1, chirp, r, g] = here, rise


@compiled(error_model="numpy", fastmath=True)
def _add_line(sums, tone_re, tone_im, line, size):  # type: ignore[no-untyped-def]
    """Add a tone times a straight line (value, rise a sample); sums [2, part]."""
    a, b, c, d = line
    for i in range(size):
        u, v = a + c * np.float32(i), b + d * np.float32(i)
        sums[0, i] += u * tone_re[i] - v * tone_im[i]
        sums[1, i] += u * tone_im[i] + v * tone_re[i]
