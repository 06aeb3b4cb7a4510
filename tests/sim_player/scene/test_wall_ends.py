"""Ends of walls that are one."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.scene import wall_ends
from sim_player.scene.wall_ends import SAME_END_M, corners_of


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


@pytest.mark.parametrize("turned", [(False, False), (False, True), (True, False), (True, True)])
def test_two_arcs_leave_their_corner_on_circles_of_their_own(turned: tuple[bool, bool]) -> None:
    """Whichever end of each stands there: 1 / bend to the left of the way on which an arc leaves is its centre."""
    apex, far, curvature = np.array([3.0, 1.0]), np.array([[8.0, 2.0], [2.0, 7.0]]), np.array([0.05, -0.08])
    chord = far - apex
    left = np.stack([-chord[:, 1], chord[:, 0]], axis=1) / np.hypot(*chord.T)[:, None]
    depth = np.sqrt(1.0 / curvature**2 - 0.25 * (chord**2).sum(axis=1)) * np.sign(curvature)
    centre = apex + 0.5 * chord + depth[:, None] * left
    near, back = np.tile(apex, (2, 1)), np.array(turned)[:, None]
    a, b = np.where(back, far, near), np.where(back, near, far)
    corners = corners_of(a, b, np.where(turned, -curvature, curvature), np.ones(2, bool))
    assert sorted(corners.pairs.tolist()) == [[0, 1], [1, 0]]
    for walls, row in zip(corners.pairs, corners.geometry, strict=True):
        np.testing.assert_allclose(row[:2], apex)
        for wall, along, long, bend in zip(walls, (row[2:4], row[4:6]), row[6:8], row[8:], strict=True):
            assert np.hypot(*along) == pytest.approx(1.0)
            assert along @ chord[wall] > 0.0
            assert long == pytest.approx(np.hypot(*chord[wall]))
            np.testing.assert_allclose(apex + np.array([-along[1], along[0]]) / bend, centre[wall])
