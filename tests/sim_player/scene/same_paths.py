"""Echoes of a whole world and of the part that echoes reach."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.paths.reach import reach_m, reachable_snapshot
from sim_player.scene.world import RadarState, World, snapshot
from sim_player.trace.echoes import Echoes
from sim_player.trace.effect_names import bit


def of_whole(world: World, time_s: float, radar: RadarState) -> Echoes:
    """Echoes of the whole world up to the reach."""
    echoes = trace_echoes(snapshot(world, time_s, radar), ALL_EFFECTS)
    return echoes.take(echoes.out_m + echoes.back_m <= 2.0 * reach_m(world.setup))


def of_part(world: World, time_s: float, radar: RadarState) -> Echoes:
    return trace_echoes(reachable_snapshot(world, time_s, radar), ALL_EFFECTS)


def assert_same_paths(part: Echoes, whole: Echoes) -> None:
    """Same paths in the same order; only what walls hide may be missing, under the noise (1e-13 sqrt(mW) before the
    array's gain of 1e3; the noise has 2e-7). Factors of several walls are multiplied in another order.
    """
    missing = whole.take(~np.isin(whole.chain, part.chain))
    assert ((missing.needs & np.uint32(bit("wall_transmission"))) > 0).all()
    assert np.abs(missing.weight).sum() < 1e-13
    whole = whole.take(np.isin(whole.chain, part.chain))
    assert np.array_equal(part.chain, whole.chain)
    for name in ("out_m", "back_m", "surface", "object_index", "needs", "order", "point", "depart", "arrive"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)), name
    for name in ("weight", "whole", "front", "rough", "foliage"):
        assert getattr(part, name) == pytest.approx(getattr(whole, name), rel=1e-12, abs=1e-25), name
