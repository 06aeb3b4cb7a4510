"""Compiled weights of echoes: terms of slow time against their table, and what is left out of a beam."""

from __future__ import annotations

import numpy as np

from msgs.values.radar import RadarSetup
from sim_player.scene.front_end import NO_FAULTS
from sim_player.signal.compiled_weights import EchoWeights
from sim_player.signal.fmcw import beam_weights, slow_time_table
from sim_player.signal.switches import PLAIN
from sim_player.trace.path_table import Paths
from tests.sim_player.signal.test_levels import one_path, some_paths

SETUP, BEAM = RadarSetup(), 12


def weights_of(paths: Paths, tolerance: float) -> tuple[EchoWeights, np.ndarray]:
    radar = SETUP.radar
    turn = 4.0 * np.pi * paths.radial_speed_mps * radar.chirp_period_s / radar.wavelength_m
    slow = slow_time_table(radar, turn)
    weigh = EchoWeights(SETUP, (paths, PLAIN), NO_FAULTS, BEAM, slow, np.array([0.5]), tolerance, np.float64)
    return weigh, slow.shares(turn)


def test_weights_are_those_of_the_pattern_times_the_shares() -> None:
    """300 echoes up to 30 m/s at mid-sweep: Eq. (1) by NumPy, the phase that an echo's terms share aside; sines and
    series to 1e-9.
    """
    paths = some_paths(300, 90.0, two_ways=True, speed_mps=30.0)
    weigh, shares = weights_of(paths, 0.0)
    order = np.argsort(-paths.length_m, kind="stable")
    np.testing.assert_array_equal(weigh.length_m, paths.length_m[order])
    wanted = (np.abs(beam_weights(SETUP, paths, slice(BEAM, BEAM + 1))) * shares)[:, order]
    found = (weigh.weights[0] + 1j * weigh.weights[1])[0]
    found, wanted = (terms * np.exp(-1j * np.angle(terms[:1])) for terms in (found, wanted))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-8 * np.abs(wanted).max())


def test_echoes_without_power_in_a_beam_are_left_out() -> None:
    """One ahead, one in the null at asin(1 / 4) of the beam ahead, which has no phase steps, one behind."""
    paths = Paths.joined([one_path(30.0), one_path(20.0, np.degrees(np.arcsin(0.25))), one_path(10.0, 120.0)])
    np.testing.assert_array_equal(weights_of(paths, 1e-5)[0].length_m, [30.0])
    np.testing.assert_array_equal(weights_of(paths, 0.0)[0].length_m, [30.0, 20.0])
