"""Radial speeds over ground: from vehicle states, and from the detections themselves."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.perception.target_lists.ego_doppler import over_ground, radar_velocity
from msgs.values.detections import RadarDetections
from msgs.values.frames import Pose2
from msgs.values.vehicle import VehicleState
from tests.models.perception.target_lists.street import SENSOR, detections, standing_speeds, street_points

VELOCITY_MPS = np.array([9.0, 0.5])


def moving_street(velocity_mps: np.ndarray = VELOCITY_MPS) -> RadarDetections:
    message = detections(street_points())
    return msgspec.structs.replace(message, radial_speed_mps=standing_speeds(message, velocity_mps))


def test_what_stands_has_no_speed_over_ground_without_a_vehicle_state() -> None:
    np.testing.assert_allclose(over_ground(moving_street(), SENSOR, None), 0.0, atol=1e-6)


def test_ambiguous_speeds_are_unfolded() -> None:
    """An interval of 4 m/s at 9 m/s: the spread of directions tells the right multiple."""
    message, sensor = moving_street(), msgspec.structs.replace(SENSOR, speed_period_mps=4.0)
    folded = message.radial_speed_mps - 4.0 * np.round(message.radial_speed_mps / 4.0)
    speeds = over_ground(msgspec.structs.replace(message, radial_speed_mps=folded), sensor, None)
    np.testing.assert_allclose(speeds, 0.0, atol=1e-6)


def test_a_moving_object_keeps_its_own_speed() -> None:
    message = moving_street()
    speeds = message.radial_speed_mps.copy()
    speeds[-11:] += 3.0
    result = over_ground(msgspec.structs.replace(message, radial_speed_mps=speeds), SENSOR, None)
    np.testing.assert_allclose(result[-11:], 3.0, atol=0.02)


def test_the_vehicle_state_counts_where_there_is_one() -> None:
    """Four detections show no velocity; a state does, at a radar that is mounted off the axle and turned."""
    pose = Pose2(3.0, 1.0, np.pi / 2.0)
    state = VehicleState(stamp_ns=0, speed_mps=10.0, yaw_rate_rps=0.5)
    np.testing.assert_allclose(radar_velocity(state, pose), [1.5, -9.5], atol=1e-12)
    few = detections([[10.0, 3.0], [20.0, -5.0], [15.0, 0.0], [5.0, 5.0]], vehicle_from_radar=pose)
    few = msgspec.structs.replace(few, radial_speed_mps=standing_speeds(few, np.array([1.5, -9.5])))
    np.testing.assert_allclose(over_ground(few, SENSOR, state), 0.0, atol=1e-9)
    assert np.isnan(over_ground(few, SENSOR, None)).all()


@pytest.mark.parametrize("over", [True, False])
def test_speeds_over_ground_stay(over: bool) -> None:
    speeds = np.full(4, 2.0)
    message = detections([[10.0, 0.0]] * 4, radial_speed_mps=speeds, over_ground=over)
    result = over_ground(message, SENSOR, VehicleState(stamp_ns=0, speed_mps=1.0))
    np.testing.assert_allclose(result, 2.0 if over else 3.0, atol=0.01)
