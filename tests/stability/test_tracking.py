"""Hard cases of tracking: a covariance that must stay one, time that stands, jumps or runs backwards, headings."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.perception.track.bernoulli import Bernoulli, updated
from models.perception.track.estimate import MEASURED, Estimate, motion_noise
from models.perception.track.joint_association import (
    MAX_LOG_ODDS,
    exact,
    log_likelihoods,
    marginal_probabilities,
    propagated,
)
from models.perception.track.measurements import Sighting
from models.perception.track.odometry import Odometry, stationary_pose
from models.perception.track.tracker import MAX_TRACKS, Tracker
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Track
from msgs.values.vehicle import VehicleState, ego_motion
from tests.builders import example_object, example_view
from tests.stability.catalogue import Errors

EPOCH_NS = 1_763_750_000_123_456_789
YEAR_NS = 31_557_600_000_000_000


def frame(stamp_ns: int, x_m: float, y_m: float) -> BevFrame:
    one = example_object(x_m=x_m, y_m=y_m, cov_m2=((0.1, 0.0), (0.0, 0.1)))
    return example_view(rows=1, columns=1, stamp_ns=stamp_ns, objects=(one,))


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


@pytest.mark.hard("models.perception.track.estimate.Estimate.updated", "(I - K H) P", 0.0, "of 2,000 updates",
                  "a covariance stays positive definite")  # fmt: skip
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
@pytest.mark.hard("models.perception.track.estimate.Estimate", "(I - K H) P", 0.0, "smallest eigenvalue below zero",
                  "a covariance stays positive definite")  # fmt: skip
def test_two_thousand_scans_of_a_standing_object(errors: Errors) -> None:
    """Ten minutes, seen to 1e-4 m along and 100 m across, never moving: nothing but rounding is added."""
    turn = np.array([[math.cos(0.6), -math.sin(0.6)], [math.sin(0.6), math.cos(0.6)]])
    thin = turn @ np.diag([1e-8, 1e4]) @ turn.T
    start = np.diag([1e8, 1e8, 64.0, 64.0])
    ours, naive, worst_naive = Estimate(0, np.zeros(4), start), start, 0.0
    worst = 0.0
    step = np.eye(4) + 0.3 * np.eye(4, k=2)
    for scan in range(1, 2_001):
        ours = ours.at(scan * 300_000_000, 1e-12).updated(np.zeros(2), thin)
        naive = short_form(step @ naive @ step.T + motion_noise(0.3, 1e-12), thin)
        if scan < 100 or scan % 100 == 0:
            worst, worst_naive = max(worst, lack(ours.covariance)), max(worst_naive, lack(naive))
    errors(naive=worst_naive, ours=worst)


@pytest.mark.parametrize("elapsed_s", [-1e-6, -0.3, -30.0])
@pytest.mark.hard("models.perception.track.estimate.Estimate.at", "noise of a negative time", 0.0, "m^2 below zero",
                  "a covariance stays positive definite")  # fmt: skip
def test_back_in_time(errors: Errors, elapsed_s: float) -> None:
    """The time asked for lies before the last measurement: with its sign, the noise takes away what is known."""
    known = 1e-8 * np.eye(4)
    back = Estimate(EPOCH_NS, np.zeros(4), known).at(EPOCH_NS + round(elapsed_s * 1e9), 2.0)
    step = np.eye(4) + elapsed_s * np.eye(4, k=2)
    block = np.array([[elapsed_s**3 / 3.0, elapsed_s**2 / 2.0], [elapsed_s**2 / 2.0, elapsed_s]])
    errors(naive=lack(step @ known @ step.T + 2.0 * np.kron(block, np.eye(2))), ours=lack(back.covariance))


@pytest.mark.parametrize("elapsed_ns", [0, 1], ids=["no time", "a nanosecond"])
@pytest.mark.hard("models.perception.track.estimate.Estimate", "velocity as way over time", 8.0, "m/s",
                  "what is known of a velocity before anything is measured")  # fmt: skip
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
@pytest.mark.hard("models.perception.track.tracker.Tracker", "tracks go on over the jump", 1.0, "m",
                  "places measured without noise, bound of half a car")  # fmt: skip
def test_clock_jumps_between_two_scans(errors: Errors, jump_ns: int) -> None:
    """The clock was set, by seconds or a year, either way: the object is where it is, not where it would have gone."""
    stamps_ns = [EPOCH_NS + scan * 300_000_000 + (jump_ns if scan >= 6 else 0) for scan in range(9)]
    told = last_track(stamps_ns)
    assert [one.id for one in told] == [2]
    naive = abs(4.0 * (jump_ns * 1e-9))
    errors(naive=naive, ours=math.dist((told[0].x_m, told[0].y_m), (8.0, 1.2 * 8)))


def crowd(stamp_ns: int, positions_m: np.ndarray) -> BevFrame:
    """A scan of objects at positions [N, 2]."""
    (item,) = frame(stamp_ns, 0.0, 0.0).objects
    objects = [msgspec.structs.replace(item, x_m=float(x_m), y_m=float(y_m)) for x_m, y_m in positions_m]
    return msgspec.structs.replace(frame(stamp_ns, 0.0, 0.0), objects=tuple(objects))


@pytest.mark.parametrize("side_m", [0.0, 5.0, 200.0], ids=["one place", "a room", "a field"])
def test_a_thousand_objects_in_every_scan(side_m: float) -> None:
    """Far more than any street hides, all at one place, in one cluster or in many: hypotheses stay as few as stated,
    the existence a probability, the covariances positive definite."""
    rng, tracker = np.random.default_rng(9), Tracker()
    for scan in range(4):
        positions_m = np.array([30.0, 0.0]) + side_m * rng.random((1000, 2))
        told = tracker.step(crowd(EPOCH_NS + scan * 300_000_000, positions_m), stationary_pose())
        assert len(tracker._tracks) <= MAX_TRACKS
        assert all(0.0 <= track.bernoulli.existence < 1.0 for track in tracker._tracks)
        assert all(lack(track.estimate.covariance) == 0.0 for track in tracker._tracks)
    assert len({one.id for one in told}) == len(told)
    if side_m == 0.0:
        # a thousand reports of one place are one object
        assert len(told) == 1
        assert math.dist((told[0].x_m, told[0].y_m), (30.0, 0.0)) < 0.01


def test_two_tracks_on_one_object_become_one() -> None:
    """Two objects run into each other at 4 m/s and stop: from then on one report, and in the end one track."""
    tracker = Tracker()
    for scan in range(20):
        apart_m = max(9.0 - 1.2 * scan, 0.0)
        places = np.array([[30.0, apart_m], [30.0, -apart_m]])[: 2 if apart_m > 0.0 else 1]
        told = tracker.step(crowd(EPOCH_NS + scan * 300_000_000, places), stationary_pose())
        assert all(math.isfinite(one.existence or math.nan) for one in told)
        if scan == 4:
            assert len(told) == 2
    assert len(told) == 1


@pytest.mark.hard("models.perception.track.joint_association.log_likelihoods", "xx yy - xy^2 and its inverse", 1e-6,
                  "of the squared distance",
                  "a variance of 0.16 m2 beside 1e10 m2, of which float64 keeps 1e-6 m2")  # fmt: skip
def test_distance_across_a_needle(errors: Errors) -> None:
    """An object known to 0.4 m across and 100 km along its ray, 30 deg off the axes, measured 0.4 m across from where
    it is expected: the squared distance is 1."""
    turn = np.array([[math.cos(math.pi / 6), -math.sin(math.pi / 6)], [math.sin(math.pi / 6), math.cos(math.pi / 6)]])
    needle = turn @ np.diag([1e10, 0.16]) @ turn.T
    offset = turn @ np.array([0.0, 0.4])
    track = Estimate(0, np.zeros(4), np.zeros((4, 4)))
    middle, aside = (
        float(log_likelihoods([track], [Sighting(0, at, needle)], 2.0)[0, 0]) for at in (np.zeros(2), offset)
    )
    (xx, xy), (_, yy) = needle.tolist()
    adjoint = np.array([[yy, -xy], [-xy, xx]], np.float32)
    determinant = np.float32(xx) * np.float32(yy) - np.float32(xy) * np.float32(xy)
    naive = float(offset @ adjoint @ offset / determinant) if determinant else math.inf
    errors(naive=abs(naive - 1.0), ours=abs(2.0 * (middle - aside) - 1.0))


def test_overwhelming_odds_leave_the_rest_as_it_is() -> None:
    """Two tracks either of which surely has the first measurement, at odds of a = 1e34, and another at odds of 3.

    Joint events weigh 1, a, a, 3, 3, 3 a and 3 a: each has the first with 4 a / 8 a, the other with 3 a / 8 a.
    Propagation is approximate, 0.1; the sum of a and 3 less a would be nothing, and what is divided by it no number.
    """
    odds = np.array([[1e34, 3.0], [1e34, 3.0]])
    np.testing.assert_allclose(exact(odds), [[0.5, 0.375]] * 2, rtol=1e-12)
    np.testing.assert_allclose(propagated(odds), [[0.5, 0.375]] * 2, atol=0.1)


def test_odds_without_bound_are_still_probabilities() -> None:
    log_odds = np.array([[1e6, MAX_LOG_ODDS, -1e6], [1e6, 1e6, -np.inf], [-np.inf, 700.0, 0.0]])
    for probability in (marginal_probabilities(log_odds), propagated(np.exp(np.minimum(log_odds, MAX_LOG_ODDS)))):
        assert np.isfinite(probability).all()
        assert probability.min() >= 0.0
        assert probability.sum(axis=1).max() <= 1.0 + 1e-9


@pytest.mark.hard("models.perception.track.bernoulli.updated", "E[x x'] - m m'", 0.0, "m^2 below zero",
                  "a covariance stays positive definite")  # fmt: skip
def test_moments_of_measurements_far_from_the_origin(errors: Errors) -> None:
    """1,000 km from where odometry began, two reports a millimetre apart, known to a millimetre: the spread is not the
    difference of squares of 1e6. A hundred places."""
    rng, ours, naive = np.random.default_rng(8), 0.0, 0.0
    for _ in range(100):
        far = np.append(rng.uniform(-1e6, 1e6, 2), np.zeros(2))
        track = Bernoulli(0.9, Estimate(0, far, 1e-6 * np.eye(4)))
        pair = [Sighting(0, far[:2] + side, 1e-6 * np.eye(2)) for side in (-5e-4, 5e-4)]
        after = updated(track, 0.6, np.array([0.5, 0.5]), pair, 0, 2.0).estimate
        parts = [track.estimate.updated(item.position_m, item.covariance_m2) for item in pair]
        second = np.mean([part.covariance + np.outer(part.mean, part.mean) for part in parts], axis=0)
        mean = np.mean([part.mean for part in parts], axis=0)
        ours, naive = max(ours, lack(after.covariance)), max(naive, lack(second - np.outer(mean, mean)))
    errors(naive=naive, ours=ours)


def test_a_track_that_is_known_exactly_stays_a_track() -> None:
    """Singular covariance of track and measurement: what both say is kept, and nothing becomes infinite."""
    exactly = Estimate(0, np.array([3.0, 4.0, 0.0, 0.0]), np.zeros((4, 4)))
    report = Sighting(0, np.array([3.0, 4.0]), 0.16 * np.eye(2))
    probability = marginal_probabilities(log_likelihoods([exactly, exactly], [report, report], 2.0))
    assert np.isfinite(probability).all()
    after = updated(Bernoulli(0.9, exactly), 0.6, probability[0], [report, report], 0, 2.0)
    np.testing.assert_array_equal(after.estimate.mean, exactly.mean)
    assert lack(after.estimate.covariance) == 0.0


def test_a_scan_that_comes_twice_or_late_changes_nothing() -> None:
    in_order = [EPOCH_NS + scan * 300_000_000 for scan in range(9)]
    tracker, told = Tracker(), ()
    for scan, stamp_ns in enumerate(in_order):
        told = tracker.step(frame(stamp_ns, 8.0, 1.2 * scan), stationary_pose())
        assert tracker.step(frame(stamp_ns, 99.0, 0.0), stationary_pose()) == told
        assert tracker.step(frame(stamp_ns - 300_000_000, 99.0, 0.0), stationary_pose()) == told
    assert told == last_track(in_order)


#: States of a long drive.
STATES = 20_000


@pytest.mark.slow
@pytest.mark.hard("models.perception.track.odometry.Odometry", "steps along the heading",
                  STATES * 2.0**-52 * (60.0 + 30.0 * math.pi), "m",
                  "that many roundings of a place within 60 m and of a heading within pi, at 30 m")  # fmt: skip
def test_twenty_thousand_states_round_and_round(errors: Errors) -> None:
    """30 m/s at 1 rad/s, 100 states a second for three minutes: still a point of a circle of 30 m."""
    odometry, yaw_rate_rps = Odometry(), 1.0
    for step in range(STATES + 1):
        odometry.add(VehicleState(stamp_ns=EPOCH_NS + step * 10_000_000, speed_mps=30.0, yaw_rate_rps=yaw_rate_rps))
    place = odometry.at(EPOCH_NS + STATES * 10_000_000)
    assert place is not None
    exact, pose = ego_motion(30.0, yaw_rate_rps, 0.01 * STATES), place.odom_from_vehicle
    heading_rad = 0.01 * np.arange(STATES)
    naive = 0.3 * np.cos(heading_rad).sum(), 0.3 * np.sin(heading_rad).sum()
    errors(naive=math.dist(naive, (exact.x_m, exact.y_m)), ours=math.dist((pose.x_m, pose.y_m), (exact.x_m, exact.y_m)))


@pytest.mark.hard("models.perception.track.odometry.Odometry.at", "place and heading in the middle between two poses",
                  1e-12, "rad", "rounding of 63 headings within pi")  # fmt: skip
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
@pytest.mark.hard("models.perception.track.odometry.Odometry", "motion goes on over the jump", 1e-9, "m",
                  "a new frame begins at its origin; 0.1 s at 30 m/s, rounded")  # fmt: skip
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
