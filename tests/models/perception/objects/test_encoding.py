"""Radial speeds as the object network reads them, worked out by hand."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.perception.objects.encoding import SPEED_CHANNELS, speed_channels
from tests.models.perception.objects.object_scenes import AZIMUTH, BIN, COLUMN, ROW, SPEEDS, speed_map


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
