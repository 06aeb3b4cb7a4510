"""Radial speeds as the object network reads them, worked out by hand."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.perception.objects.encoding import PEAK_CHANNELS, SPEED_CHANNELS, drawn_peaks, speed_channels
from msgs.values.perception import Peaks
from tests.models.perception.objects.object_scenes import AZIMUTH, BIN, COLUMN, ENCODING, ROW, SPEEDS, speed_map


def test_a_speed_stands_in_its_cell_alone() -> None:
    """40 dB: 8 m/s / 100 = 0.08 m/s, with 0.2 m/s of sway 0.215; -4 m/s are -0.8 units and (4 / 0.646)^2 = 38.3."""
    channels = speed_channels(SPEEDS, speed_map(-4.0))
    std_mps = math.hypot(0.08, 0.2)
    sigmas = (4.0 / (3.0 * std_mps)) ** 2
    np.testing.assert_allclose(channels[:, ROW, COLUMN], [-0.8, sigmas / (1.0 + sigmas), 0.2 / std_mps], rtol=1e-5)
    channels[:, ROW, COLUMN] = 0.0
    assert not channels.any()


def test_the_loudest_echo_of_a_cell_counts() -> None:
    ra_map = speed_map(-4.0)
    values, speeds = ra_map.values.copy(), ra_map.radial_speed_cmps
    assert speeds is not None
    speeds = speeds.copy()
    values[BIN - 1, AZIMUTH + 3], speeds[BIN - 1, AZIMUTH + 3] = 2.0 * values[BIN, AZIMUTH], 100
    both = msgspec.structs.replace(ra_map, values=values, radial_speed_cmps=speeds)
    assert speed_channels(SPEEDS, both)[0, ROW, COLUMN] == pytest.approx(0.2)


def test_what_may_stand_does_not_move() -> None:
    """1 m/s at 15 dB is less than its own deviation, 1.4 m/s; at 40 dB it is nearly five."""
    moves = SPEED_CHANNELS.index("moves")
    faint, loud = (speed_channels(SPEEDS, speed_map(1.0, snr_db))[moves, ROW, COLUMN] for snr_db in (15.0, 40.0))
    assert faint < 0.06
    assert loud > 0.7


def test_without_the_vehicle_s_own_motion_no_speed_is_one() -> None:
    assert not speed_channels(SPEEDS, speed_map(5.0, ego_compensated=False)).any()
    unmeasured = msgspec.structs.replace(speed_map(5.0), radial_speed_cmps=None)
    assert not speed_channels(SPEEDS, unmeasured).any()


def test_a_speed_beyond_any_road_user_is_bounded() -> None:
    assert speed_channels(SPEEDS, speed_map(300.0))[0, ROW, COLUMN] == 3.0


def test_peaks_stand_in_their_cells_with_what_they_are_off_its_centre() -> None:
    """Range bin 10.3, a fifth of a column left of column 16; of two in a cell the better; one beyond the map none."""
    cells, grid = ENCODING.cells, ENCODING.grid
    step_rad = cells.azimuth_rad[1] - cells.azimuth_rad[0]
    rows, columns = np.array([10.3, 9.6, 11.2, 600.0]), np.array([15.8, 16.1, 3.25, 8.0])
    peaks = Peaks(
        stamp_ns=0,
        scan_id=0,
        range_m=grid.range_at(rows),
        azimuth_rad=cells.azimuth_rad[0] + columns * step_rad,
        score=np.array([0.9, 0.6, 0.5, 0.8]),
        path_class=np.array([1, 1, 0, 0], np.uint8),
        covariance=np.tile(np.eye(2), (4, 1, 1)),
        peak_stamp_ns=np.zeros(4, np.int64),
        snr_db=np.full(4, 20.0),
        sensitivity_db=90.0,
    )
    drawn = drawn_peaks(ENCODING, peaks).reshape(2, len(PEAK_CHANNELS), -1, len(cells.azimuth_rad))
    np.testing.assert_allclose(drawn[1, :, 10, 16], [0.9, 0.3, -0.2], atol=1e-5)
    np.testing.assert_allclose(drawn[0, :, 11, 3], [0.5, 0.2, 0.25], atol=1e-5)
    assert np.count_nonzero(drawn[:, 0]) == 2
