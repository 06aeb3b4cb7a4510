"""Hard cases of tracking: a covariance that must stay one, time that stands, jumps or runs backwards, headings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.tracking.odometry import Odometry, OdometryParams, stationary_pose
from models.perception.tracking.tracker import MEASURED, Estimate, Tracker, motion_noise
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, Track
from msgs.values.vehicle import VehicleState, ego_motion
from tests.stability.catalogue import Errors

EPOCH_NS = 1_763_750_000_123_456_789
YEAR_NS = 31_557_600_000_000_000


def frame(stamp_ns: int, x_m: float, y_m: float) -> BevFrame:
    one = HiddenObject(
        id=0, x_m=x_m, y_m=y_m, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=0.9, cov_m2=((0.1, 0.0), (0.0, 0.1))
    )
    return BevFrame(
        stamp_ns=stamp_ns, scan_id=0, objects=(one,), los_points_m=np.zeros((0, 2), np.float32),
        grid=BevGrid(rows=1, columns=1), visibility=np.zeros((1, 1), np.uint8),
    )  # fmt: skip


def lack(covariance: np.ndarray) -> float:
    """How far below zero the smallest eigenvalue lies, or zero; infinite for what is no number."""
    if not np.isfinite(covariance).all():
        return math.inf
    return max(-float(np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0]), 0.0)


def short_form(covariance: np.ndarray, place_covariance: np.ndarray) -> np.ndarray:
    """(I - K H) P, as it is first written."""
    gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + place_covariance)
    return np.asarray((np.eye(4) - gain @ MEASURED) @ covariance)


def vague(rng: np.random.Generator) -> np.ndarray:
    """A covariance [4, 4] with standard deviations from 1e-2 to 1e4, in random axes: one that float64 can hold."""
    axes, _ = np.linalg.qr(rng.standard_normal((4, 4)))
    covariance = (axes * 10.0 ** rng.uniform(-4.0, 8.0, 4)) @ axes.T
    return np.asarray(0.5 * (covariance + covariance.T))


@pytest.mark.hard(
    where="models.perception.tracking.tracker.Estimate.updated",
    naive="(I - K H) P",
    bound=0.0,
    unit="of 2,000 updates",
    source="a covariance stays positive definite",
)
def test_sharp_place_of_a_vague_object(errors: Errors) -> None:
    """A place known to 1 mm of an object known to 10 km at worst: what is left is a difference of large numbers."""
    rng = np.random.default_rng(4)
    sharp = 1e-6 * np.eye(2)
    naive = ours = 0
    for _ in range(2000):
        before = vague(rng)
        after = Estimate(0, np.zeros(4), before).updated(np.zeros(2), sharp).covariance
        ours += lack(after) > 0.0
        naive += lack(short_form(before, sharp)) > 0.0
    errors(naive=naive, ours=ours)


@pytest.mark.slow
@pytest.mark.hard(
    where="models.perception.tracking.tracker.Estimate",
    naive="(I - K H) P",
    bound=0.0,
    unit="smallest eigenvalue below zero",
    source="a covariance stays positive definite",
)
def test_twenty_thousand_scans_of_a_standing_object(errors: Errors) -> None:
    """An hour and forty minutes, seen to 1e-4 m along and 100 m across, never moving: nothing but rounding is added."""
    turn = np.array([[math.cos(0.6), -math.sin(0.6)], [math.sin(0.6), math.cos(0.6)]])
    thin = turn @ np.diag([1e-8, 1e4]) @ turn.T
    start = np.diag([1e8, 1e8, 64.0, 64.0])
    ours, naive, worst_naive = Estimate(0, np.zeros(4), start), start, 0.0
    worst = 0.0
    step = np.eye(4) + 0.3 * np.eye(4, k=2)
    for scan in range(1, 20_001):
        ours = ours.at(scan * 300_000_000, 1e-12).updated(np.zeros(2), thin)
        naive = short_form(step @ naive @ step.T + motion_noise(0.3, 1e-12), thin)
        if scan < 100 or scan % 1000 == 0:
            worst, worst_naive = max(worst, lack(ours.covariance)), max(worst_naive, lack(naive))
    errors(naive=worst_naive, ours=worst)


@pytest.mark.parametrize("elapsed_s", [-1e-6, -0.3, -30.0])
@pytest.mark.hard(
    where="models.perception.tracking.tracker.Estimate.at",
    naive="noise of a negative time",
    bound=0.0,
    unit="m^2 below zero",
    source="a covariance stays positive definite",
)
def test_back_in_time(errors: Errors, elapsed_s: float) -> None:
    """The time asked for lies before the last measurement: with its sign, the noise takes away what is known."""
    known = 1e-8 * np.eye(4)
    back = Estimate(EPOCH_NS, np.zeros(4), known).at(EPOCH_NS + round(elapsed_s * 1e9), 2.0)
    step = np.eye(4) + elapsed_s * np.eye(4, k=2)
    block = np.array([[elapsed_s**3 / 3.0, elapsed_s**2 / 2.0], [elapsed_s**2 / 2.0, elapsed_s]])
    errors(naive=lack(step @ known @ step.T + 2.0 * np.kron(block, np.eye(2))), ours=lack(back.covariance))


@pytest.mark.parametrize("elapsed_ns", [0, 1], ids=["no time", "a nanosecond"])
@pytest.mark.hard(
    where="models.perception.tracking.tracker.Estimate",
    naive="velocity as way over time",
    bound=8.0,
    unit="m/s",
    source="what is known of a velocity before anything is measured",
)
def test_velocity_of_an_object_seen_twice_at_once(errors: Errors, elapsed_ns: int) -> None:
    """Two places of one object, 0.3 m apart by their noise, at the same time: it does not fly."""
    first = Estimate(EPOCH_NS, np.zeros(4), np.diag([0.1, 0.1, 64.0, 64.0]))
    again = first.at(EPOCH_NS + elapsed_ns, 2.0).updated(np.array([0.3, 0.0]), 0.1 * np.eye(2))
    naive = 0.3 / (elapsed_ns * 1e-9) if elapsed_ns else math.inf
    errors(naive=naive, ours=float(np.hypot(*again.mean[2:])))


def last_track(stamps_ns: list[int]) -> tuple[Track, ...]:
    """Tracks after scans at given stamps, an object at 4 m/s in each, by the number of the scan."""
    tracker, told = Tracker(), ()
    for scan, stamp_ns in enumerate(stamps_ns):
        told = tracker.step(frame(stamp_ns, 8.0, 1.2 * scan), stationary_pose())
    return told


@pytest.mark.parametrize("jump_ns", [YEAR_NS, -YEAR_NS, 10_000_000_000, -10_000_000_000], ids=str)
@pytest.mark.hard(
    where="models.perception.tracking.tracker.Tracker",
    naive="tracks go on over the jump",
    bound=1.0,
    unit="m",
    source="places measured without noise, bound of half a car",
)
def test_clock_jumps_between_two_scans(errors: Errors, jump_ns: int) -> None:
    """The clock was set, by seconds or a year, either way: the object is where it is, not where it would have gone."""
    stamps_ns = [EPOCH_NS + scan * 300_000_000 + (jump_ns if scan >= 6 else 0) for scan in range(9)]
    told = last_track(stamps_ns)
    assert [one.id for one in told] == [2]
    naive = abs(4.0 * (jump_ns * 1e-9))
    errors(naive=naive, ours=math.dist((told[0].x_m, told[0].y_m), (8.0, 1.2 * 8)))


def test_a_scan_that_comes_twice_or_late_changes_nothing() -> None:
    in_order = [EPOCH_NS + scan * 300_000_000 for scan in range(9)]
    tracker, told = Tracker(), ()
    for scan, stamp_ns in enumerate(in_order):
        told = tracker.step(frame(stamp_ns, 8.0, 1.2 * scan), stationary_pose())
        assert tracker.step(frame(stamp_ns, 99.0, 0.0), stationary_pose()) == told
        assert tracker.step(frame(stamp_ns - 300_000_000, 99.0, 0.0), stationary_pose()) == told
    assert told == last_track(in_order)


@pytest.mark.slow
@pytest.mark.hard(
    where="models.perception.tracking.odometry.Odometry",
    naive="steps along the heading",
    bound=1e6 * 2.0**-52 * (60.0 + 30.0 * math.pi),
    unit="m",
    source="a million roundings of a place within 60 m and of a heading within pi, at 30 m",
)
def test_a_million_states_round_and_round(errors: Errors) -> None:
    """30 m/s at 1 rad/s, 100 states a second for almost three hours: still a point of a circle of 30 m."""
    odometry, yaw_rate_rps = Odometry(OdometryParams(history_s=0.1)), 1.0
    for step in range(1_000_001):
        odometry.add(VehicleState(stamp_ns=EPOCH_NS + step * 10_000_000, speed_mps=30.0, yaw_rate_rps=yaw_rate_rps))
    place = odometry.at(EPOCH_NS + 10_000_000_000_000)
    assert place is not None
    exact, pose = ego_motion(30.0, yaw_rate_rps, 10_000.0), place.odom_from_vehicle
    heading_rad = 0.01 * np.arange(1_000_000)
    naive = 0.3 * np.cos(heading_rad).sum(), 0.3 * np.sin(heading_rad).sum()
    errors(naive=math.dist(naive, (exact.x_m, exact.y_m)), ours=math.dist((pose.x_m, pose.y_m), (exact.x_m, exact.y_m)))


@pytest.mark.hard(
    where="models.perception.tracking.odometry.Odometry.at",
    naive="place and heading in the middle between two poses",
    bound=1e-12,
    unit="rad",
    source="rounding of 63 headings within pi",
)
def test_heading_between_two_states_across_the_seam(errors: Errors) -> None:
    """Turning on past 180 degrees: the middle of +179 and -179 degrees is no heading at all."""
    odometry = Odometry()
    for step in range(64):
        odometry.add(VehicleState(stamp_ns=EPOCH_NS + step * 100_000_000, speed_mps=5.0, yaw_rate_rps=0.5))
    # pi / 0.5 is 6.283 s: between the states at 6.2 s and 6.3 s
    before, after, middle = (odometry.at(EPOCH_NS + ns) for ns in (6_200_000_000, 6_300_000_000, 6_290_000_000))
    assert before is not None
    assert after is not None
    assert middle is not None
    assert before.odom_from_vehicle.yaw_rad > 3.0
    assert after.odom_from_vehicle.yaw_rad < -3.0
    mean_rad = 0.1 * before.odom_from_vehicle.yaw_rad + 0.9 * after.odom_from_vehicle.yaw_rad
    exact_rad = 0.5 * 6.29
    naive, ours = (
        math.remainder(yaw - exact_rad, 2.0 * math.pi) for yaw in (mean_rad, middle.odom_from_vehicle.yaw_rad)
    )
    errors(naive=abs(naive), ours=abs(ours))


@pytest.mark.parametrize("jump_ns", [YEAR_NS, -YEAR_NS, 5_000_000_000, -5_000_000_000], ids=str)
@pytest.mark.hard(
    where="models.perception.tracking.odometry.Odometry",
    naive="motion goes on over the jump",
    bound=1e-9,
    unit="m",
    source="a new frame begins at its origin; 0.1 s at 30 m/s, rounded",
)
def test_odometry_over_a_clock_jump(errors: Errors, jump_ns: int) -> None:
    """The clock was set while driving at 30 m/s: how far the vehicle came is not known, so a new frame begins."""
    odometry = Odometry()
    for stamp_ns in (EPOCH_NS, EPOCH_NS + 100_000_000, EPOCH_NS + jump_ns, EPOCH_NS + jump_ns + 100_000_000):
        odometry.add(VehicleState(stamp_ns=stamp_ns, speed_mps=30.0))
    place = odometry.at(EPOCH_NS + jump_ns + 100_000_000)
    assert place is not None
    assert place.frame == 1
    errors(naive=abs(30.0 * jump_ns * 1e-9), ours=math.dist((place.odom_from_vehicle.x_m, 0.0), (3.0, 0.0)))


def test_odometry_is_silent_about_times_it_does_not_know() -> None:
    odometry = Odometry()
    assert odometry.at(EPOCH_NS) is None
    odometry.add(VehicleState(stamp_ns=EPOCH_NS, speed_mps=30.0))
    assert odometry.at(EPOCH_NS) is not None
    assert odometry.at(EPOCH_NS).odom_from_vehicle == Pose2()  # type: ignore[union-attr]
    assert odometry.at(EPOCH_NS - 1) is None
    assert odometry.at(EPOCH_NS + YEAR_NS) is None
