"""Mounting and clock from walls: returns of known walls, drawn with polar errors, along known drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from contrib.calibrate.mounting import Motion, Sighting, _Problem, solve_mounting
from msgs.values.frames import Pose2, polar_from_xy, xy_from_polar
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from sim_player.drive import Drive

START_NS, PERIOD_S, LATE_S = 1_763_750_000_123_456_789, 0.3, 0.08
TRUE, PRIOR = Pose2(1.4, 0.2, math.radians(2.0)), Pose2(1.2, 0.0, 0.0)
RANGE_STD_M, AZIMUTH_STD_RAD = 0.06, math.radians(1.0)
YARD = np.array([[[75.0, -40.0], [75.0, 45.0]], [[5.0, 14.0], [50.0, 14.0]], [[10.0, -16.0], [60.0, -22.0]]])
TIME_S = np.arange(-4.0, 40.0, 0.05)


def drive(speed: float = 2.0, yaw_rate: float = 0.25, mean_rate: float = 0.0) -> Drive:
    """4 m/s and some yaw rate, both swinging by so much."""
    return Drive(
        TIME_S,
        4.0 + speed * np.sin(2.0 * np.pi * TIME_S / 7.0),
        mean_rate + yaw_rate * np.sin(2.0 * np.pi * TIME_S / 9.0),
    )


def states(way: Drive, duration_s: float, late_s: float = LATE_S, bias_rps: float = 0.0) -> list[VehicleState]:
    times = np.arange(-2.0, duration_s + 2.0, 0.02)
    speed, yaw_rate = way.speed_at(times), way.yaw_rate_at(times) + bias_rps
    return [
        VehicleState(stamp_ns=START_NS + ns_from_s(float(t) + late_s), speed_mps=float(v), yaw_rate_rps=float(w))
        for t, v, w in zip(times, speed, yaw_rate, strict=True)
    ]


def sightings(way: Drive, scans: int, seed: int = 0, mounted: Pose2 = TRUE) -> list[Sighting]:
    """Every wall of the yard of which enough lies within 50 deg and 60 m, scan by scan."""
    rng = np.random.default_rng([seed, 3])
    covariance = np.diag([RANGE_STD_M**2, AZIMUTH_STD_RAD**2])
    found = []
    for scan in range(scans):
        radar_from_world = (way.pose(scan * PERIOD_S) @ mounted).inverse()
        for a, b in YARD:
            points = radar_from_world.apply(a + np.linspace(0.0, 1.0, 16)[:, None] * (b - a))
            range_m, azimuth_rad = polar_from_xy(points)
            seen = (range_m < 60.0) & (np.abs(azimuth_rad) < math.radians(50.0))
            if seen.sum() < 4:
                continue
            range_m = range_m[seen] + RANGE_STD_M * rng.standard_normal(seen.sum())
            azimuth_rad = azimuth_rad[seen] + AZIMUTH_STD_RAD * rng.standard_normal(seen.sum())
            cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
            jacobian = np.stack([np.stack([cos, -range_m * sin], -1), np.stack([sin, range_m * cos], -1)], -2)
            ends = points[seen][[0, -1]]
            along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
            found.append(
                Sighting(
                    stamp_ns=START_NS + ns_from_s(scan * PERIOD_S),
                    normal=np.array([-along[1], along[0]]),
                    ends_m=ends,
                    points_m=xy_from_polar(range_m, azimuth_rad),
                    covariance_m2=jacobian @ covariance @ np.swapaxes(jacobian, 1, 2),
                )
            )
    return found


@pytest.mark.parametrize("seed", range(2))
def test_errors_put_in_are_found(seed: int) -> None:
    """0.2 m, 2 deg and 80 ms; tolerance: three told standard deviations, and 0.1 m, 0.4 deg, 15 ms."""
    way = drive()
    one = solve_mounting(sightings(way, 60, seed), states(way, 18.0), PRIOR)
    for known, true, limit in (
        (one.x_m, TRUE.x_m, 0.1),
        (one.y_m, TRUE.y_m, 0.1),
        (one.yaw_rad, TRUE.yaw_rad, math.radians(0.4)),
        (one.clock_offset_s, -LATE_S, 0.015),
    ):
        assert known.observed
        assert abs(known.value - true) < min(limit, 3.0 * known.std)
    assert one.rms_m < 0.7 * one.rms_before_m
    # points lie off their walls by their own errors
    assert one.rms_sigmas == pytest.approx(1.0, abs=0.25)


def test_bias_of_the_yaw_rate_is_no_obstacle() -> None:
    """A gyroscope off by 0.5 deg/s turns the odometry by 9 deg over the drive; known bias: none; tolerance 0.3 deg."""
    way = drive()
    one = solve_mounting(sightings(way, 60), states(way, 18.0, bias_rps=math.radians(0.5)), PRIOR)
    assert math.degrees(one.yaw_rate_bias_rps) == pytest.approx(0.5, abs=0.05)
    assert math.degrees(one.yaw_rad.value) == pytest.approx(2.0, abs=0.3)


def test_a_straight_drive_tells_yaw_alone() -> None:
    """At constant speed straight on, lever arm and clock only move the walls: both stay as given, yaw is found."""
    way = drive(speed=0.0, yaw_rate=0.0)
    one = solve_mounting(sightings(way, 40), states(way, 12.0), PRIOR)
    assert one.yaw_rad.observed
    assert math.degrees(one.yaw_rad.value) == pytest.approx(2.0, abs=0.3)
    assert not any(known.observed for known in (one.x_m, one.y_m, one.clock_offset_s))
    assert (one.x_m.value, one.y_m.value, one.clock_offset_s.value) == (PRIOR.x_m, PRIOR.y_m, 0.0)


def test_a_circle_does_not_tell_the_clock() -> None:
    """At constant speed and yaw rate a shift in time is a turn of the world."""
    way = drive(speed=0.0, yaw_rate=0.0, mean_rate=0.12)
    one = solve_mounting(sightings(way, 40), states(way, 12.0), PRIOR)
    assert not one.clock_offset_s.observed
    assert one.clock_offset_s.value == 0.0


def test_what_is_known_is_held() -> None:
    way = drive()
    seen, said = sightings(way, 40), states(way, 12.0)
    one = solve_mounting(seen, said, TRUE, known_pose=True)
    assert one.vehicle_from_radar.yaw_rad == pytest.approx(TRUE.yaw_rad, abs=1e-12)
    assert (one.x_m.value, one.y_m.value, one.yaw_rad.std) == (TRUE.x_m, TRUE.y_m, 0.0)
    assert one.clock_offset_s.value == pytest.approx(-LATE_S, abs=0.015)
    one = solve_mounting(seen, said, PRIOR, clock_offset_s=-LATE_S)
    assert one.clock_offset_s.value == -LATE_S
    assert one.yaw_rad.value == pytest.approx(TRUE.yaw_rad, abs=math.radians(0.4))


def test_drives_that_do_not_serve_are_refused() -> None:
    way = drive()
    still = Drive(TIME_S, 0.0 * TIME_S, 0.0 * TIME_S)
    with pytest.raises(ValueError, match=r"must move 3 m or turn 10 deg .* got 0.00 m"):
        solve_mounting(sightings(still, 20), states(still, 6.0), PRIOR)
    with pytest.raises(ValueError, match="at least 10 scans with states, got 5"):
        solve_mounting(sightings(way, 5), states(way, 6.0), PRIOR)
    with pytest.raises(ValueError, match="got 0"):
        solve_mounting([], states(way, 6.0), PRIOR)
    with pytest.raises(ValueError, match="at least 2 valid states, got 0"):
        solve_mounting(sightings(way, 20), [], PRIOR)


def test_the_longest_stretch_of_states_counts() -> None:
    """A second of silence cuts the odometry; repeated and invalid states do not."""
    said = states(drive(), 10.0, late_s=0.0)
    cut = [one for one in said if not 3.0 < (one.stamp_ns - START_NS) * 1e-9 < 4.0]
    motion = Motion([*cut, cut[-1], VehicleState(stamp_ns=START_NS, speed_mps=99.0, valid=False)])
    assert motion.time_s[0] == 0.0
    assert motion.time_s[-1] == pytest.approx(8.0, abs=0.05)
    assert (np.diff(motion.time_s) > 0.0).all()


def test_poses_of_states_are_those_of_the_drive() -> None:
    """Trapezoids at 50 Hz against steps of a millisecond over 12 s: 5 mm, 0.05 deg."""
    way = drive()
    motion = Motion(states(way, 12.0, late_s=0.0))
    at = motion.seconds(np.array([START_NS, START_NS + ns_from_s(12.0)]))
    first, last = (Pose2(*pose) for pose in motion.poses(at).tolist())
    moved, true = first.inverse() @ last, way.pose(12.0)
    assert math.hypot(moved.x_m - true.x_m, moved.y_m - true.y_m) < 5e-3
    assert abs(moved.yaw_rad - true.yaw_rad) < math.radians(0.05)


@pytest.mark.parametrize(("rest_s", "bias_rps"), [(2.0, 0.03), (0.5, 0.0)])
def test_the_bias_at_rest_is_of_the_rest_alone(rest_s: float, bias_rps: float) -> None:
    """Backwards at 2 m/s turning at -0.3 rad/s, a rest that says 0.03 rad/s, forwards turning at 0.2 rad/s: 0.03, where
    the rest lasts a second. Backwards is no rest.
    """
    times_s = np.arange(0.0, 8.0, 0.02)
    part = np.digitize(times_s, [3.0, 3.0 + rest_s])
    speed, yaw_rate = np.array([-2.0, 0.0, 2.0])[part], np.array([-0.3, 0.03, 0.2])[part]
    motion = Motion(
        [
            VehicleState(stamp_ns=START_NS + ns_from_s(float(t)), speed_mps=float(v), yaw_rate_rps=float(w))
            for t, v, w in zip(times_s, speed, yaw_rate, strict=True)
        ]
    )
    assert motion.rest_bias_rps == pytest.approx(bias_rps, abs=1e-12)


@pytest.mark.parametrize(("yaw_deg", "variance_m2"), [(45.0, 0.1), (-45.0, 1.9), (0.0, 1.0)])
def test_errors_turn_with_the_radar(yaw_deg: float, variance_m2: float) -> None:
    """A point's covariance [[1, 0.9], [0.9, 1]] is the radar's: a wall across x is met along (1, -1) / sqrt(2) by one
    that is turned by 45 deg, where 1 - 0.9 m^2 is left of it.
    """
    motion = Motion(states(drive(), 1.0, late_s=0.0))
    problem = _Problem(
        motion=motion,
        prior=np.zeros(6),
        prior_std=np.ones(6),
        scan_time_s=np.zeros(1),
        scan=np.zeros(1, int),
        points_m=np.array([[5.0, 0.0]]),
        covariance_m2=np.array([[[1.0, 0.9], [0.9, 1.0]]]),
        wall=np.zeros(1, int),
        pivot_m=np.array([[5.0, 0.0]]),
        normal_rad=np.zeros(1),
        flatness_m=0.0,
    )
    unknowns = np.array([0.0, 0.0, math.radians(yaw_deg), 0.0, 0.0, 1.0, 0.0, 0.0])
    assert problem.std_m(unknowns)[0] ** 2 == pytest.approx(variance_m2)
