"""Terms along the sweep against the pattern at instants of the sweep."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.special import jv

from models.physics.antenna import two_way_pattern
from msgs.values.radar import ArrayParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.paths.ray_tracing import BASIC_EFFECTS, trace
from sim_player.planner.sweep_terms import MAX_TERMS, _needed, _reach_m, sweep_terms
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare
from sim_player.signal.fmcw import departure
from sim_player.signal.switches import PLAIN, column_weights, sweep_ratio
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


def test_a_chirp_begins_with_the_last_ones_echoes() -> None:
    """For as long as an echo is on its way: 13 % of the chirp at 109 m."""
    paths = trace(prepare(random_place(11, 0), 0), 0.0, BASIC_EFFECTS)
    effects = msgspec.structs.replace(PLAIN, chirp_overlap=True)
    head = sweep_terms(RadarSetup(), paths, effects, NO_FAULTS, 1e-7).head
    np.testing.assert_allclose(head, 0.1337 * 0.5 * paths.length_m / 109.42, atol=2e-4)


def test_without_squint_one_term_says_all() -> None:
    paths = trace(prepare(random_place(11, 0), 0), 0.0, ALL_EFFECTS)
    found = sweep_terms(RadarSetup(), paths, NO_SWEEP, NO_FAULTS, 0.0)
    assert (found.count == 1).all()
    assert not found.remainder.any()
    np.testing.assert_array_equal(found.terms[:, 0], found.middle)
    assert not found.magnitudes[1].any()


@pytest.mark.parametrize("swing_rad", [0.05, 0.5, 1.0, 2.0])
def test_terms_are_the_fewest_that_the_bessel_functions_need(swing_rad: float) -> None:
    """K terms leave out 4 (J_K + J_K+1 + ...) of an echo of 3: never more than what is said, and what is said is
    at most a quarter more, or with one term fewer it was over the tolerance.
    """
    tail = np.array([3.0 * 4.0 * np.abs(jv(np.arange(terms, 60), swing_rad)).sum() for terms in range(MAX_TERMS + 1)])
    for tolerance in (1.0, 1e-2, 1e-4):
        (count,), (left,) = _needed(np.array([3.0]), np.array([swing_rad]), np.array([tolerance]))
        assert tail[count] <= left <= max(tolerance, 1.25 * tail[count])
        assert count == 1 or 1.25 * tail[count - 1] > tolerance
    # what is weaker than the tolerance needs none, and all of it is left out
    count, left = _needed(np.array([3.0, 3.0]), np.full(2, swing_rad), np.array([3.0, 2.999]))
    assert (count.tolist()[0], left.tolist()[0], count.tolist()[1] > 0) == (0, 3.0, True)


@pytest.mark.parametrize(("steered_ways", "reach_m"), [(2, 0.5 * 7 * 0.02 * (0.6 + 0.2)), (1, 0.5 * 7 * 0.02 * 0.6)])
def test_half_the_array_reaches_along_both_directions(steered_ways: int, reach_m: float) -> None:
    """Eight columns 20 mm apart in one row: 70 mm to either side, times the sines out and back."""
    setup = RadarSetup(array=ArrayParams(columns=8, rows=1, column_spacing_m=0.02, steered_ways=steered_ways))
    across, up = np.array([[-0.6], [0.2]]), np.array([[0.5], [0.5]])
    assert _reach_m(setup, across, up, steered_ways == 2)[0] == pytest.approx(reach_m)
