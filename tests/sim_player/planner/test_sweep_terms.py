"""Terms along the sweep against the pattern at instants of the sweep."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.antenna import two_way_pattern
from msgs.values.radar import ArrayParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.planner.sweep_terms import sweep_terms
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare
from sim_player.signal.fmcw import departure
from sim_player.signal.switches import column_weights, sweep_ratio
from sim_player.trace.ray_tracing import trace
from tests.sim_player.planner.test_evaluation import NO_OVERLAP, NO_SWEEP


@pytest.mark.parametrize("steered_ways", [1, 2])
@pytest.mark.parametrize("tolerance", [1e-9, 1e-7])
def test_terms_leave_out_what_they_say(steered_ways: int, tolerance: float) -> None:
    """Every path of a place at five instants: |pattern - terms| within the remainder and float32's rounding."""
    setup = RadarSetup(array=ArrayParams(steered_ways=steered_ways))
    paths = trace(prepare(random_place(11, 0), 0), 0.0, ALL_EFFECTS)
    found = sweep_terms(setup, paths, NO_OVERLAP, NO_FAULTS, tolerance)
    weights = column_weights(setup, NO_OVERLAP, NO_FAULTS)
    radar, delay_s = setup.radar, paths.length_m / SPEED_OF_LIGHT_MPS
    for share in (0.0, 0.2, 0.5, 0.9, 1.0):
        ratio = sweep_ratio(radar, share * radar.chirp_period_s - delay_s)
        pattern = two_way_pattern(
            setup, weights, paths.azimuth_rad, paths.elevation_rad, *departure(paths), frequency_ratio=ratio
        )
        table = np.polynomial.chebyshev.chebvander([2.0 * share - 1.0], found.terms.shape[1] - 1)[0]
        swept = np.abs(np.einsum("pkb,k->bp", found.terms, table))
        expected = np.abs(pattern * paths.amplitude)
        rounding = 2e-6 * np.abs(paths.amplitude) * np.abs(pattern).max()
        assert (np.abs(swept - expected) <= found.remainder + rounding).all()


def test_weak_paths_need_fewer_terms() -> None:
    paths = trace(prepare(random_place(11, 0), 0), 0.0, ALL_EFFECTS)
    fine, coarse = (sweep_terms(RadarSetup(), paths, NO_OVERLAP, NO_FAULTS, tolerance) for tolerance in (1e-9, 1e-7))
    assert (coarse.count <= fine.count).all()
    assert coarse.count.sum() < fine.count.sum()


def test_without_squint_one_term_says_all() -> None:
    paths = trace(prepare(random_place(11, 0), 0), 0.0, ALL_EFFECTS)
    found = sweep_terms(RadarSetup(), paths, NO_SWEEP, NO_FAULTS, 0.0)
    assert (found.count == 1).all()
    assert not found.remainder.any()
    np.testing.assert_array_equal(found.terms[:, 0], found.middle)
    assert not found.squint_magnitude.any()
