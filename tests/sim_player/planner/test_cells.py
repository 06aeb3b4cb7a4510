"""Cells of the planner's law: floors by hand, and bounds that survive the step from beams to map."""

from __future__ import annotations

import numpy as np
import pytest

from msgs.values.radar import BeamGrid, RadarSetup, RangeAzimuthGrid
from sim_player.planner.cells import cells_of
from sim_player.planner.purposes import Purpose

CELLS = cells_of(RadarSetup())


def test_floor_is_noise_or_what_stands_next_door() -> None:
    """One strong cell: 10 - 2 - 3 within one beam (half of 12.7 deg) and one bin; noise elsewhere."""
    profiles = np.zeros((25, 8))
    profiles[12, 4] = 10.0
    floor = CELLS.floor(profiles, np.ones(8), 2.0, 3.0)[:25]
    np.testing.assert_allclose(floor[11:14, 3:6], 5.0)
    np.testing.assert_allclose(floor[:11], 1.0)
    np.testing.assert_allclose(floor[:, :3], 1.0)
    on_map = CELLS.floor(profiles, np.full(8, 1e-9))[25:, 4]
    strongest, azimuth_deg = on_map > 0.9999 * on_map.max(), np.degrees(RangeAzimuthGrid().azimuth_rad)
    assert strongest[np.abs(azimuth_deg) < 6.0].all()
    assert not strongest[np.abs(azimuth_deg) > 7.0].any()


def test_a_single_beam_has_no_neighbour() -> None:
    """No beam stands within half a beam of it: its floor is its own signal, 10 - 2 - 3, next door in range alone."""
    profile = np.zeros((1, 8))
    profile[0, 4] = 10.0
    floor = cells_of(RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,)))).floor(profile, np.ones(8), 2.0, 3.0)
    np.testing.assert_allclose(floor[0], [1.0, 1.0, 1.0, 5.0, 5.0, 5.0, 1.0, 1.0])


def test_beams_in_one_direction_are_neighbours() -> None:
    profiles = np.zeros((2, 8))
    profiles[0, 4] = 10.0
    floor = cells_of(RadarSetup(beams=BeamGrid(azimuth_deg=(3.0, 3.0)))).floor(profiles, np.ones(8), 2.0, 3.0)
    np.testing.assert_allclose(floor[:2, 4], 5.0)


def test_peaks_stand_alone_over_the_threshold() -> None:
    """One strong cell: 10 - 2 - 3 in it; 13 dB over a noise rms of 1 everywhere else, next door too."""
    profiles = np.zeros((25, 8))
    profiles[12, 4] = 10.0
    floor = CELLS.floor(profiles, np.ones(8), 2.0, 3.0, Purpose.PEAKS)[:25]
    assert floor[12, 4] == pytest.approx(5.0)
    floor[12, 4] = 10.0 ** (13.0 / 20.0)
    np.testing.assert_allclose(floor, 10.0 ** (13.0 / 20.0))


def test_noise_of_the_map_is_that_of_its_beams_added_up() -> None:
    """White noise through the inversion: rms of 4,000 draws against the floor of an empty map, 3 %."""
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((2, 25, 4000)) * np.sqrt(0.5)
    measured = np.sqrt(np.mean(np.abs(CELLS.values(draws[0] + 1j * draws[1])) ** 2, axis=1))
    empty = CELLS.floor(np.zeros((25, 1)), np.ones(1))[:, 0]
    np.testing.assert_allclose(measured, empty, rtol=0.06)
    assert np.median(np.abs(measured / empty - 1.0)) < 0.02


def test_what_bounds_the_beams_bounds_the_map() -> None:
    rng = np.random.default_rng(1)
    magnitude = rng.exponential(1.0, (25, 64))
    signal = magnitude * np.exp(2j * np.pi * rng.random((25, 64)))
    assert (np.abs(CELLS.values(signal)) <= CELLS.bounds(magnitude) * (1.0 + 1e-6)).all()


def test_beams_by_their_share_keep_the_map() -> None:
    """All beams changed by the share, as bad as signs allow: the worst azimuth changes by its own noise, no more."""
    worst = CELLS.bounds(np.full((25, 1), CELLS.map_share))[25:, 0] / CELLS.floor(np.zeros((25, 1)), np.ones(1))[25:, 0]
    assert worst.max() == pytest.approx(1.0)
