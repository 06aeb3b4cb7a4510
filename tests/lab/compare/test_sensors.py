"""Three sensors side by side: energies, periods, the look of a point."""

from __future__ import annotations

import math

import msgspec
import pytest

from lab.compare.sensors import (
    GRID,
    LIDARS,
    LONG_GATES,
    LONG_RANGE_M,
    RADARS,
    TABLE_2,
    _peak_params,
    _radar_look,
    long_period,
    scan_energy_j,
)
from models.perception.find.cfar import PeakParams
from msgs.values.radar import ArrayParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.description import PRESETS


def test_a_scan_is_the_energy_of_all_beams_and_of_one_where_they_are_made_of_it() -> None:
    setup = RadarSetup()
    energy_j = setup.radar.transmit_power_w * 128 * setup.radar.chirp_period_s * 25
    assert scan_energy_j(setup) == pytest.approx(energy_j)
    digital = msgspec.structs.replace(setup, array=ArrayParams(steered_ways=1, phase_bits=0, digital=True))
    assert scan_energy_j(digital) == pytest.approx(energy_j / 25)


@pytest.mark.parametrize("name", [*RADARS, *LIDARS])
def test_equal_energy_is_the_x_band_scans(name: str) -> None:
    """To half a chirp of a beam; of equal power each has its own."""
    sensor = {**RADARS, **LIDARS}[name]
    wanted_j = scan_energy_j(PRESETS["xband"])
    assert sensor.energy_j("energy") == pytest.approx(wanted_j, rel=2e-3)
    if name in LIDARS:
        spad = LIDARS[name].spad
        own_j = spad.average_power_w * spad.measurement_time_s * GRID.azimuth_bins
        assert sensor.energy_j("power") == pytest.approx(own_j)


def test_the_long_period_reaches_beyond_the_grid_in_whole_bins() -> None:
    spad = long_period(TABLE_2)
    assert 0.5 * SPEED_OF_LIGHT_MPS / spad.repetition_rate_hz == pytest.approx(LONG_RANGE_M)
    assert spad.bins % LONG_GATES == 0
    assert TABLE_2.bins <= spad.bins < TABLE_2.bins + LONG_GATES
    assert (spad.arming, spad.gates, spad.average_power_w) == ("gated", LONG_GATES, TABLE_2.average_power_w)


def test_a_beam_of_eight_columns_is_nine_degrees_both_ways() -> None:
    """0.886 lambda / D of 8 half wavelengths is 12.7 deg one way, a root of two less and twice the lobes both ways."""
    ridges, peaks = _radar_look(RadarSetup())
    assert peaks.beam_width_deg == pytest.approx(12.69 / math.sqrt(2.0), abs=0.01)
    assert ridges.beam_cells == round(peaks.beam_width_deg / math.degrees(GRID.azimuth_step_rad))
    assert ridges.azimuth_lobe_db == 22.0
    default, wide = PeakParams(), _peak_params(2.0 * PeakParams().beam_width_deg)
    assert wide.azimuth_std_floor_deg == pytest.approx(2.0 * default.azimuth_std_floor_deg)
    assert wide.azimuth_std_limit_deg == pytest.approx(2.0 * default.azimuth_std_limit_deg)
    # no better than a cell, an even error within its width
    narrow = _peak_params(1e-3)
    cell_deg = math.degrees(GRID.azimuth_step_rad) / math.sqrt(12.0)
    assert (narrow.azimuth_std_floor_deg, narrow.azimuth_std_limit_deg) == pytest.approx((cell_deg, cell_deg))
