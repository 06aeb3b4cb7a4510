"""Calibration of elements: phases that do not repeat, set-ups of other beams."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contrib.boards.phaser_model import (
    ELEMENT_BEAMS,
    PhaserCalibration,
    PhaserParams,
    beam_table,
    element_table,
    radar_setup,
)
from contrib.calibrate.element_calibration import board_calibration, element_responses
from msgs.values.radar import BeamGrid, RadarSetup

PARAMS = PhaserParams()
RANGE_M = 20.0


def setup(params: PhaserParams = PARAMS) -> RadarSetup:
    return radar_setup(params, ELEMENT_BEAMS, element_table(params).weights)


def chirps(elements: np.ndarray, way_m: np.ndarray | float = RANGE_M, seed: int = 0, scans: int = 4) -> np.ndarray:
    """Mean chirps [scans, 8, samples] of elements with a response each, on noise of one code."""
    radar = setup().radar
    count = radar.samples_per_chirp
    tone = np.exp(2j * np.pi * RANGE_M / radar.range_bin_m * np.arange(count) / count)
    field = np.exp(2j * np.pi * (way_m - RANGE_M) / radar.wavelength_m) * np.ones(8)
    noise = np.random.default_rng(seed).standard_normal((2, scans, 8, count))
    return np.asarray(100.0 * (elements * field)[:, None] * tone + noise[0] + 1j * noise[1])


@pytest.mark.parametrize("first_element_left", [False, True])
def test_a_near_reflector_aside_gives_the_elements_own_phases(first_element_left: bool) -> None:
    """Layout: 20 m away, 30 deg to the left, ways to the elements by Pythagoras; own phases and gains of the elements.
    Beats carry conj(element), so the phases to add are arg of the beats'. Tolerance 0.5 deg, 0.5 %: noise 40 dB down.
    """
    params = msgspec.structs.replace(PARAMS, first_element_left=first_element_left)
    place_m = 0.015 * (np.arange(8) - 3.5) * (-1.0 if first_element_left else 1.0)
    aside = np.radians(30.0)
    way_m = np.hypot(RANGE_M * np.cos(aside), RANGE_M * np.sin(aside) - place_m)
    own_deg = np.array([0.0, 40.0, -70.0, 120.0, 10.0, -150.0, 80.0, 25.0])
    gains = np.array([1.0, 0.8, 0.9, 0.7, 0.6, 0.5, 0.55, 0.65])
    radar_set = setup(params)
    responses = element_responses(radar_set, chirps(gains * np.exp(1j * np.radians(own_deg)), way_m), (15.0, 25.0))
    assert responses.range_m == pytest.approx(RANGE_M, abs=0.05)
    found = board_calibration(radar_set, responses, aside)
    off_deg = (np.array(found.phases_deg) - own_deg + 180.0) % 360.0 - 180.0
    # one phase for all is free: the first element's
    assert np.abs(off_deg - off_deg[0]).max() < 0.5
    level = np.array(found.gains) * gains * 10.0 ** (np.repeat(found.channel_gains_db, 4) / 20.0)
    assert np.abs(level / level.mean() - 1.0).max() < 0.005
    assert min(found.channel_gains_db) == 0.0


def test_phases_that_do_not_repeat_are_refused() -> None:
    """Bursts that begin at a random phase: amplitudes are sound, phases between elements are not."""
    values = chirps(np.ones(8)) * np.exp(2j * np.pi * np.random.default_rng(1).random((4, 8, 1)))
    with pytest.raises(ValueError, match="phases must repeat from scan to scan within 5 deg"):
        element_responses(setup(), values, (15.0, 25.0))


def test_a_flank_is_no_reflector() -> None:
    with pytest.raises(ValueError, match=r"the profile only falls or rises from 20.3 to 25 m"):
        element_responses(setup(), chirps(np.ones(8)), (20.3, 25.0))


def test_beams_of_the_whole_array_are_refused() -> None:
    beams = BeamGrid()
    whole = radar_setup(PARAMS, beams, beam_table(PARAMS, PhaserCalibration(), beams).weights)
    with pytest.raises(ValueError, match=r"record with radar_driver.cn0566.single_elements=true"):
        element_responses(whole, np.zeros((4, 25, 1024)), (15.0, 25.0))
