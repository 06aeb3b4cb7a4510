"""Selections: the weakest go as far as the law allows, and never by what was not evaluated."""

from __future__ import annotations

import numpy as np

from sim_player.planner.evaluation import HeadChange, error, evaluate
from sim_player.planner.selection import (
    ANYTHING,
    BLOCK,
    Selection,
    _head_skirts,
    _largest,
    _tightest,
    _weakest,
    _weakest_heads,
    select,
)
from tests.sim_player.planner.test_evaluation import BINS, RMS, SETUP, place


def chosen(allowed: np.ndarray, worst: float) -> tuple[Selection, int]:
    """A selection where the evaluated change is called `worst` times what is allowed at least; number of questions."""
    _, terms = place(0)
    heads, asked = HeadChange(SETUP.radar, terms, BINS, 1e-3 * float(RMS.min())), [0]

    def ratio(change: np.ndarray, loose: np.ndarray) -> np.ndarray:
        asked[0] += 1
        return np.maximum(((np.abs(change) + loose) / allowed).max(axis=0), worst)

    def change_of(part: np.ndarray, overlaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        change, loose = heads(overlaps)
        return evaluate(SETUP.radar, terms, part, BINS) + change, error(SETUP.radar, terms, part, BINS) + loose

    return select(SETUP.radar, terms, change_of, allowed, ratio), asked[0]


def test_much_goes_where_much_is_allowed() -> None:
    some, _ = chosen(np.broadcast_to(0.1 * RMS, (25, BINS)), 0.0)
    more, _ = chosen(np.broadcast_to(RMS, (25, BINS)), 0.0)
    every, _ = chosen(np.full((25, BINS), ANYTHING), 0.0)
    assert 0 < some.dropped.sum() < more.dropped.sum() < every.dropped.sum() == len(every.dropped)
    assert more.squints.sum() < some.squints.sum()
    assert not (some.dropped & (some.squints | some.overlaps)).any()


def test_what_never_fits_leaves_everything() -> None:
    """A change that is always too large is asked for a few times, then nothing is left out."""
    kept, asked = chosen(np.broadcast_to(RMS, (25, BINS)), 2.0)
    assert not kept.dropped.any()
    assert kept.squints.all()
    assert kept.overlaps.all()
    assert not kept.change.any()
    assert 1 < asked < 10


def test_the_weakest_go_until_their_powers_fill_a_bin() -> None:
    """Two paths in a bin of share 8, one in a bin of 5: squints of 3, 4 and 5 go (9 + 16, and 25), of whole paths
    6 (25 + 36 of 64), but neither 7 nor the third, whose bin is full.
    """
    ratios, cell = np.array([3.0, 4.0, 5.0, 6.0, 7.0, 1.0]), np.array([0, 0, 1])
    squints, kept = _weakest(ratios, cell, np.array([0, 1, 2, 3, 4, 5]), np.array([8.0, 5.0]))
    assert (squints.tolist(), kept.tolist()) == ([False] * 3, [False, True, True])
    # a path whose squint must stay does not go as a whole
    squints, kept = _weakest(np.array([9.0, 1.0]), np.array([0]), np.array([0, 1]), np.array([8.0]))
    assert (squints.tolist(), kept.tolist()) == ([True], [True])


def test_overlaps_go_while_they_fit_every_block() -> None:
    """Shares of 5: 3 and 4 fill the first block to its end; the third path would be too much there."""
    ratios = np.array([[3.0, 1.0], [4.0, 0.0], [1.0, 0.0], [0.0, 4.0]])
    assert _weakest_heads(ratios, np.array([0, 1, 2, 3]), 5.0).tolist() == [True, True, False, True]
    assert _weakest_heads(ratios, np.array([3, 2, 1, 0]), 5.0).tolist() == [False, True, True, True]


def test_skirts_over_the_limits_of_the_bins_near_a_tone() -> None:
    """One beam with limits of 1, 1/2 and 1/4, a window of 1 and 1/2 beside it; a tone past the end has its side."""
    factors = _tightest(np.array([[1.0, 2.0, 4.0]], np.float32), np.array([1.0, 0.5], np.float32), 5)
    assert factors[:, 0].tolist() == [1.0, 2.0, 4.0, 2.0, 0.0]
    magnitude = np.array([[3.0, 1.0], [1.0, 5.0]], np.float32)
    per_bin = np.array([[1.0, 2.0], [10.0, 1.0]], np.float32)
    assert _largest(magnitude, per_bin, np.array([0, 1])).tolist() == [3.0, 10.0]


def test_the_start_of_a_chirp_changes_blocks_by_its_slope_over_their_distance() -> None:
    """A tone in the middle of the first block: its area there, 4 / 8 in the next (8 bins off) and 4 / 24 after that."""
    out = _head_skirts(
        np.array([0.5 * BLOCK]), np.array([2.0]), np.array([3.0]), np.array([4.0]), np.array([1.0, 10.0, 100.0])
    )
    np.testing.assert_allclose(out[0], [6.0, 10.0, 2.0 * 100.0 / 6.0], rtol=1e-6)
