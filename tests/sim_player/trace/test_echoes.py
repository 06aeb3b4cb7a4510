"""Echoes: which routes are joined."""

from __future__ import annotations

import numpy as np

from sim_player.trace.echoes import same_target


def test_every_route_out_meets_every_route_back_of_its_target() -> None:
    """Targets reached by several routes, by one and by none, in no order: all pairs of one target, each once."""
    out, back = np.array([7, 2, 7, 5, 0]), np.array([2, 7, 4, 7, 2, 7])
    pairs = sorted(zip(*(indices.tolist() for indices in same_target(out, back)), strict=True))
    assert pairs == [(0, 1), (0, 3), (0, 5), (1, 0), (1, 4), (2, 1), (2, 3), (2, 5)]
    assert all(len(indices) == 0 for indices in same_target(out, np.array([], np.int64)))
