"""Selection of what paths may go without: which are dropped, and which keep squint and overlap.

In each range bin the weakest go, as many as have powers that add up to a share of what the law allows there. What all
of it adds up to is then evaluated, phases and all (`sim_player.planner.evaluation`); around range bins where that does
not fit, the share is lowered until it does. Nothing is taken on trust: the last evaluation holds for the selection that
is returned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from models.compiled import compiled
from msgs.values.radar import RadarParams
from sim_player.planner.evaluation import (
    BEYOND_BINS,
    NOTHING,
    SQUINT,
    WHOLE,
    hann_skirt,
    head_area,
    head_height,
)
from sim_player.planner.sweep_terms import SweepTerms

#: Rms of all changes in a range bin over what the law allows, at first, and what is aimed at where it was too much.
FIRST_SHARE, AIM = 0.45, 0.5
#: The same of what goes without overlap, which reaches all range bins.
HEAD_SHARE = 0.2
#: Bins to either side in which the share is lowered, and in which a path's skirts are looked at.
AROUND, REACH = 3, 32
ROUNDS = 4
#: Range bins that share a look at the overlap, which changes slowly from bin to bin.
BLOCK = 16
#: What is allowed where the law asks nothing, sqrt(mW).
ANYTHING = 1e30

#: Change by parts of the echoes (int [P]) and by the overlap of some (bool [P]), and a bound of its error [bins].
Evaluated = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Selection:
    """Paths that are left out, those that squint and those that overlap, bool [P]; change of all that, and its error.

    Change complex64 [B, bins], error float64 [bins].
    """

    dropped: np.ndarray
    squints: np.ndarray
    overlaps: np.ndarray
    change: np.ndarray
    error: np.ndarray


def keep_all(echoes: SweepTerms, range_bins: int) -> Selection:
    """Return the selection that leaves nothing out."""
    every = np.ones(len(echoes), bool)
    nothing = np.zeros((echoes.middle.shape[1], range_bins), np.complex64)
    return Selection(~every, every, every.copy(), nothing, np.zeros(range_bins))


def select(
    radar: RadarParams,
    echoes: SweepTerms,
    change_of: Evaluated,
    allowed: np.ndarray,
    ratio: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Selection:
    """Return a selection whose change fits everywhere.

    `change_of` evaluates parts of the echoes and the overlap of some; `allowed` [B, bins] is the largest change in the
    cells of the beams; `ratio` gives a change and its error [bins] over what is allowed, the largest of every range
    bin. Falls back on `keep_all`.
    """
    bins = allowed.shape[1]
    candidates = _Candidates(radar, echoes, change_of, allowed)
    share, head_share = np.full(bins, FIRST_SHARE), HEAD_SHARE
    for last in (*(False,) * ROUNDS, True):
        selection = candidates.within(share, head_share)
        over = ratio(selection.change, selection.error)
        if (over <= 1.0).all():
            return selection
        if last:
            break
        lower = np.where(over > 1.0, AIM / np.maximum(over, 1.0), 1.0)
        padded = np.pad(lower, AROUND, mode="edge")
        share *= np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND + 1).min(axis=1)
        head_share *= 0.5
    return keep_all(echoes, bins)


class _Candidates:
    """Paths with the largest ratio of each one's change to what is allowed."""

    def __init__(self, radar: RadarParams, echoes: SweepTerms, change_of: Evaluated, allowed: np.ndarray) -> None:
        self._echoes, self._bins, self._change_of = echoes, allowed.shape[1], change_of
        inverse = (1.0 / allowed).astype(np.float32)
        per_bin = _tightest(inverse, hann_skirt(radar, REACH), self._bins + BEYOND_BINS)
        cell = np.minimum(np.rint(echoes.tone).astype(np.int64), self._bins + BEYOND_BINS - 1)
        self._squint = _largest(echoes.squint_magnitude, per_bin, cell)
        self._whole = np.maximum(_largest(echoes.magnitude, per_bin, cell), self._squint)
        self._cell = np.minimum(cell, self._bins - 1)
        self._head = _head_ratios(echoes, allowed)

    def within(self, share: np.ndarray, head_share: float) -> Selection:
        """Return the selection of the weakest, their rms within a share [bins] of what is allowed, and its change."""
        overlaps = ~_weakest_heads(self._head, np.argsort(self._head.max(axis=1)), head_share)
        # a path goes as a whole only where its overlap may go
        whole = np.where(overlaps, np.float32(np.inf), self._whole)
        ratios = np.concatenate([self._squint, whole])
        # of the same ratio, as those without terms have, squint goes first
        squints, kept = _weakest(ratios, self._cell, np.argsort(ratios, kind="stable"), share)
        # a third kind of path would cost a signal of its own: what overlaps squints, and then the other way round
        swept = (squints | overlaps) & kept
        overlaps = swept & bool((overlaps & kept).any())
        part = np.where(kept, np.where(swept, NOTHING, SQUINT), WHOLE)
        change, error = self._change_of(part, ~overlaps)
        return Selection(dropped=~kept, squints=swept, overlaps=overlaps, change=-change, error=error)


def _head_ratios(echoes: SweepTerms, allowed: np.ndarray) -> np.ndarray:
    """Return the largest change by each path's overlap over what is allowed in blocks of bins, float32 [P, blocks]."""
    lowest = allowed.min(axis=0)
    blocks = -(-len(lowest) // BLOCK)
    padded = np.pad(lowest, (0, blocks * BLOCK - len(lowest)), constant_values=ANYTHING)
    least = padded.reshape(blocks, BLOCK).min(axis=1)
    return _head_skirts(
        echoes.tone, echoes.strength, head_area(echoes.head), head_height(echoes.head) / (2.0 * np.pi), 1.0 / least
    )


@compiled(fastmath=True)
def _head_skirts(tone, strength, area, slope, inverse):  # type: ignore[no-untyped-def]
    out = np.empty((len(tone), len(inverse)), np.float32)
    for path in range(len(tone)):
        for block in range(len(inverse)):
            off = abs(tone[path] - BLOCK * (block + 0.5)) - 0.5 * BLOCK
            change = min(slope[path] / max(off, 0.5), area[path])
            out[path, block] = strength[path] * change * inverse[block]
    return out


@compiled
def _weakest_heads(ratios, order, share):  # type: ignore[no-untyped-def]
    """Mask of the weakest paths whose powers stay within share^2 in every block; bool [P]."""
    mask = np.zeros(len(order), np.bool_)
    power = np.zeros(ratios.shape[1])
    for path in order:
        fits = True
        for block in range(len(power)):
            fits = fits and power[block] + ratios[path, block] ** 2 <= share * share
        if fits:
            mask[path] = True
            for block in range(len(power)):
                power[block] += ratios[path, block] ** 2
    return mask


@compiled
def _weakest(ratios, cell, order, share):  # type: ignore[no-untyped-def]
    """Masks of the paths that keep squint, and of those that stay: the first half of `ratios` is what the squint of
    each changes, the second what all of it does; the weakest go, as long as powers stay within share^2 of each bin.
    """
    paths = len(cell)
    squints, kept = np.ones(paths, np.bool_), np.ones(paths, np.bool_)
    power = np.zeros(len(share))
    for index in order:
        path = index % paths
        at = cell[path]
        if index >= paths and squints[path]:
            continue
        more = power[at] + ratios[index] * ratios[index]
        if more <= share[at] * share[at]:
            power[at] = more
            if index < paths:
                squints[path] = False
            else:
                kept[path] = False
    return squints, kept


@compiled(fastmath=True)
def _tightest(inverse, skirt, cells):  # type: ignore[no-untyped-def]
    """Largest skirt over limit that a tone in each of `cells` bins meets in each beam, float32 [cells, B]."""
    beams, bins = inverse.shape
    reach = len(skirt) - 1
    turned = np.ascontiguousarray(inverse.T)
    out = np.zeros((cells, beams), np.float32)
    for cell in range(cells):
        for near in range(max(cell - reach, 0), min(cell + reach + 1, bins)):
            factor = skirt[abs(near - cell)]
            for beam in range(beams):
                out[cell, beam] = max(out[cell, beam], factor * turned[near, beam])
    return out


@compiled(fastmath=True)
def _largest(magnitude, per_bin, cell):  # type: ignore[no-untyped-def]
    """Largest product of a path's magnitudes [P, B] and its bin's factors; [P]."""
    out = np.zeros(len(cell), np.float32)
    for path in range(len(cell)):
        for beam in range(magnitude.shape[1]):
            out[path] = max(out[path], magnitude[path, beam] * per_bin[cell[path], beam])
    return out
