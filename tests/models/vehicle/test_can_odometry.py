"""A recorded drive as ego-motion: CAN log -> vehicle states -> odometry -> tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.perception.yaw_bias import read_states
from models.perception.track.odometry import OdometryPose, ScanOdometry, stationary_pose
from models.perception.track.tracker import Tracker
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Track
from msgs.values.vehicle import VehicleState
from tests.builders import example_object, example_view
from tests.captures import DATA, needs

REAL = DATA / "can_motec_subaru"
PERIOD_NS = 300_000_000

pytestmark = needs(REAL)


@pytest.fixture(scope="module")
def states() -> list[VehicleState]:
    return read_states(REAL / "can_sample.log", REAL / "sample_can_spec.dbc", Path("launch/can/motec_sample.yaml"))


@pytest.fixture(scope="module")
def driven(states: list[VehicleState]) -> list[VehicleState]:
    """States from the end of the longest silence on: full lock while parking makes 1.4 s of them not valid."""
    stamps_ns = [state.stamp_ns for state in states if state.valid]
    silence_ns, end_ns = max(zip(np.diff(stamps_ns).tolist(), stamps_ns[1:], strict=True))
    assert 1_000_000_000 < silence_ns < 2_000_000_000
    return [state for state in states if state.stamp_ns >= end_ns]


def placed(states: list[VehicleState]) -> list[tuple[int, OdometryPose]]:
    """The vehicle at every scan of a radar on it, where it is known."""
    odometry, waiting, found = ScanOdometry(), list(states), []
    for stamp_ns in range(states[0].stamp_ns, states[-1].stamp_ns, PERIOD_NS):
        # states of the next 50 ms have come too: they wait
        while waiting and waiting[0].stamp_ns <= stamp_ns + 50_000_000:
            odometry.add(waiting.pop(0))
        place = odometry.at(stamp_ns)
        if place is not None:
            found.append((stamp_ns, place))
    return found


@pytest.fixture(scope="module")
def places(driven: list[VehicleState]) -> list[tuple[int, Pose2]]:
    """Poses at the scans after that silence, all in one frame."""
    found = placed(driven)
    assert {place.frame for _, place in found} == {0}
    return [(stamp_ns, place.odom_from_vehicle) for stamp_ns, place in found]


@pytest.mark.slow
def test_a_silence_ends_the_frame_and_nothing_else_does(states: list[VehicleState]) -> None:
    frames = [place.frame for _, place in placed(states)]
    assert sorted(set(frames)) == [0, 1] or sorted(set(frames)) == [-1, 0, 1]
    assert frames == sorted(frames)


def test_way_and_heading_are_the_integrals_of_speed_and_yaw_rate(
    driven: list[VehicleState], places: list[tuple[int, Pose2]]
) -> None:
    """83 s of a real car: way and heading by the trapezoids of what was valid.

    Tolerance: 0.5 % of the way (chords of 0.3 s are shorter than their arcs, steps backwards count as way in both);
    heading by the bias, below 1e-3 rad/s, that standing taught, over 83 s.
    """
    valid = [state for state in driven if state.valid]
    time_s = np.array([1e-9 * (state.stamp_ns - driven[0].stamp_ns) for state in valid])
    way_m = np.trapezoid([abs(state.speed_mps) for state in valid], time_s)
    heading_rad = np.trapezoid([state.yaw_rate_rps for state in valid], time_s)
    at_m = np.array([[pose.x_m, pose.y_m] for _, pose in places])
    steps_m = np.hypot(*np.diff(at_m, axis=0).T)
    turned_rad = np.unwrap([pose.yaw_rad for _, pose in places])
    assert way_m > 1000.0
    assert steps_m.sum() == pytest.approx(way_m, rel=5e-3)
    assert turned_rad[-1] - turned_rad[0] == pytest.approx(heading_rad, abs=0.09)


def test_no_jumps(places: list[tuple[int, Pose2]]) -> None:
    """36 m/s at most and 1.25 rad/s, the range of the gyroscope: no step of 0.3 s is larger."""
    at_m = np.array([[pose.x_m, pose.y_m] for _, pose in places])
    turned_rad = np.unwrap([pose.yaw_rad for _, pose in places])
    assert np.hypot(*np.diff(at_m, axis=0).T).max() < 36.1 * 0.3
    assert np.abs(np.diff(turned_rad)).max() < 1.25 * 0.3


def _seen(stamp_ns: int, place_m: np.ndarray) -> BevFrame:
    one = example_object(x_m=float(place_m[0]), y_m=float(place_m[1]), cov_m2=((0.1, 0.0), (0.0, 0.1)))
    return example_view(rows=1, columns=1, stamp_ns=stamp_ns, objects=(one,))


def test_a_parked_car_stands_beside_the_drive(driven: list[VehicleState], places: list[tuple[int, Pose2]]) -> None:
    """Seen for 6 s of the fastest 20 with 0.3 m of noise: it stands with odometry, and flies where the ego is taken as
    standing. Bounds: 1 m/s, a few standard deviations of the filter; and half the slowest speed of the ego there."""
    speeds = [(state.stamp_ns, state.speed_mps) for state in driven if state.valid]
    fastest_ns = max(speeds, key=lambda one: one[1])[0]
    part = [one for one in places if -6_000_000_000 <= one[0] - fastest_ns <= 0]
    parked_m = part[-1][1].apply(np.array([25.0, 8.0]))
    slowest_mps = min(speed for stamp_ns, speed in speeds if part[0][0] <= stamp_ns <= part[-1][0])
    rng, odometry, waiting = np.random.default_rng(5), ScanOdometry(), list(driven)
    trackers = Tracker(), Tracker()
    told: list[tuple[Track, ...]] = []
    for stamp_ns, pose in part:
        while waiting and waiting[0].stamp_ns <= stamp_ns:
            odometry.add(waiting.pop(0))
        view = _seen(stamp_ns, pose.inverse().apply(parked_m) + 0.3 * rng.standard_normal(2))
        told = [trackers[0].step(view, odometry.at(stamp_ns)), trackers[1].step(view, stationary_pose())]
    ((moving,), standing_ego) = told
    assert np.hypot(moving.velocity_x_mps, moving.velocity_y_mps) < 1.0
    assert np.hypot(moving.x_m - 25.0, moving.y_m - 8.0) < 0.6
    assert all(np.hypot(one.velocity_x_mps, one.velocity_y_mps) > 0.5 * slowest_mps for one in standing_ego)
