"""Selections: the weakest go as far as the law allows, and never by what was not evaluated."""

from __future__ import annotations

import numpy as np

from sim_player.planner.evaluation import HeadChange, error, evaluate
from sim_player.planner.selection import ANYTHING, Selection, select
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
