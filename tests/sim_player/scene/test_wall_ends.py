"""Ends of walls that are one."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.scene import wall_ends
from sim_player.scene.wall_ends import SAME_END_M


def test_few_and_many_ends_are_paired_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    corners = rng.uniform(-50.0, 50.0, (60, 2))
    # each corner once, twice or thrice, within a third of the tolerance or just beyond it
    ends = np.repeat(corners, rng.integers(1, 4, len(corners)), 0)
    ends += rng.choice([0.0, SAME_END_M / 3.0, 1.5 * SAME_END_M], len(ends))[:, None] * [1.0, 0.0]
    few = wall_ends._same(ends)
    monkeypatch.setattr(wall_ends, "FEW_ENDS", 0)
    many = wall_ends._same(ends)
    assert len(few[0]) > len(ends)
    for ours, theirs in zip(few, many, strict=True):
        assert np.array_equal(ours, theirs)
