from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from models.perception.track.appearance import NOSE_M
from models.perception.track.estimate import motion_noise
from models.perception.track.measurements import UNOBSERVABLE_SHARE
from models.perception.track.odometry import Odometry, OdometryPose, stationary_pose
from models.perception.track.tracker import MAX_POSITION_STD_M, Tracker, TrackerParams
from msgs.values.arrays import Covariance
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, Track, Visibility, Wall
from msgs.values.vehicle import VehicleState, ego_motion
from tests.builders import example_object, example_view

PERIOD_NS = 300_000_000
EYE: Covariance = ((0.09, 0.0), (0.0, 0.09))
#: Its end at (10, 4) is the corner that things come out from behind.
HOUSE = Wall(normal=(0.0, -1.0), offset_m=4.0, ends_m=((0.0, 4.0), (10.0, 4.0)), inliers=9)


def seen(x_m: float, y_m: float, stamp_ns: int = 0, cov_m2: Covariance = EYE) -> HiddenObject:
    return example_object(x_m=x_m, y_m=y_m, cov_m2=cov_m2, stamp_ns=stamp_ns)


def frame(scan: int, *objects: HiddenObject, walls: Sequence[Wall] = (HOUSE,)) -> BevFrame:
    return example_view(
        rows=1, columns=1, stamp_ns=1_000_000_000 + scan * PERIOD_NS, scan_id=scan, objects=objects, walls=tuple(walls)
    )


def drive(tracker: Tracker, places: Sequence[Sequence[tuple[float, float]]], start: int = 0) -> list[tuple[Track, ...]]:
    """A standing radar's scans with objects at the given places."""
    scans = enumerate(places, start)
    return [tracker.step(frame(scan, *(seen(*place) for place in there)), stationary_pose()) for scan, there in scans]


def state(time_s: float, speed_mps: float = 0.0, yaw_rate_rps: float = 0.0, valid: bool = True) -> VehicleState:
    return VehicleState(
        stamp_ns=round(time_s * 1e9), speed_mps=speed_mps, yaw_rate_rps=yaw_rate_rps, valid=valid
    )  # fmt: skip


def test_existence_of_an_object_seen_twice_is_that_of_bayes():
    """Without other objects, reported twice at the same place with score 0.6, 0.3 s apart, by a scan without a mask.

    It begins with r = 0.6 and a variance of R = 0.09 + 0.16 along each axis. Then r = 0.6 * 0.8^0.3, the density f of
    the report has variance 2 R + 64 * 0.09 + 2 * 0.027 / 3, the background is k = 3e-4 / 0.6 and p_D = 0.7:
    r' = (r p f + k r (1 - p)) / (r p f + k (1 - r p)).
    """
    tracker = Tracker()
    item = msgspec.structs.replace(seen(8.0, 9.0), score=0.6)
    assert tracker.step(frame(0, item), stationary_pose()) == ()
    (track,) = tracker.step(frame(1, item), stationary_pose())
    prior, background = 0.6 * 0.8**0.3, 3e-4 / 0.6
    report = prior * 0.7 / (2.0 * math.pi * (0.5 + 5.76 + 0.018))
    expected = (report + background * prior * 0.3) / (report + background * (1.0 - prior * 0.7))
    assert track.existence == pytest.approx(expected, rel=1e-12)


def test_a_sure_report_is_published_at_once_and_misses_end_it():
    """Missed where it could be seen: r (1 - p_D) / (1 - r p_D) a scan, and the track is gone below its least."""
    told = drive(Tracker(), [[(8.0, 9.0)]] * 4 + [[]] * 8)
    # a report of score 0.9; that of 0.6 above waits for the next scan
    assert [one.existence for one in told[0]] == [0.9]
    assert [len(tracks) for tracks in told[:5]] == [1] * 5
    assert told[-1] == ()
    existence = [one.existence for tracks in told for one in tracks]
    assert existence[:4] == sorted(existence[:4])
    after = existence[4:]
    assert after == sorted(after, reverse=True)
    assert [one.misses for tracks in told[4:] for one in tracks] == list(range(1, len(after) + 1))
    assert after[0] == pytest.approx(existence[3] * 0.8**0.3 * 0.3 / (1.0 - existence[3] * 0.8**0.3 * 0.7))


def masked(scan: int, *objects: HiddenObject, observable: bool) -> BevFrame:
    """A view with a mask: everything observable, or nothing but a cell far away."""
    mask = np.full((80, 80), Visibility.MIRRORED if observable else Visibility.UNKNOWN, np.uint8)
    mask[0, 0] = Visibility.MIRRORED
    grid = BevGrid(y_min_m=-20.0, rows=80, columns=80)
    return msgspec.structs.replace(frame(scan, *objects), grid=grid, visibility=mask)


@pytest.mark.parametrize("observable", [True, False])
def test_a_scan_that_cannot_see_a_track_takes_little_from_it(observable: bool):
    """p_D is 0.7 where the mask shows the place, a fifth of that where it does not."""
    tracker = Tracker()
    before = [tracker.step(masked(scan, seen(8.0, 9.0), observable=True), stationary_pose()) for scan in range(4)][-1]
    (now,) = tracker.step(masked(4, observable=observable), stationary_pose())
    assert before[0].existence is not None
    prior = before[0].existence * 0.8**0.3
    detection = 0.7 if observable else 0.7 * UNOBSERVABLE_SHARE
    assert now.existence == pytest.approx(prior * (1.0 - detection) / (1.0 - prior * detection), rel=1e-9)


def test_a_track_whose_position_is_lost_is_not_published():
    """Unseen and unobservable it may still exist, but after 1.5 s nobody knows where to 2 m; its id comes back."""
    tracker = Tracker()
    for scan in range(3):
        (known,) = tracker.step(masked(scan, seen(8.0, 9.0), observable=True), stationary_pose()) or (None,)
    blind = [tracker.step(masked(scan, observable=False), stationary_pose()) for scan in range(3, 8)]
    assert len(blind[0]) == 1
    assert blind[-1] == ()
    assert all(np.linalg.eigvalsh(np.array(one.cov_m2))[-1] <= MAX_POSITION_STD_M**2 for now in blind for one in now)
    again = tracker.step(masked(8, seen(8.0, 9.0), observable=True), stationary_pose())
    assert known is not None
    assert [one.id for one in again] == [known.id]


def test_a_doubtful_object_takes_more_scans():
    """At a score of 0.05 two reports are hardly an object; at 0.9 they are."""
    tracker = Tracker(TrackerParams(confirm_existence=0.9))
    doubtful = [
        tracker.step(frame(scan, msgspec.structs.replace(seen(8.0, 9.0), score=0.05)), stationary_pose())
        for scan in range(5)
    ]
    sure = drive(Tracker(TrackerParams(confirm_existence=0.9)), [[(8.0, 9.0)]] * 2)
    assert len(sure[-1]) == 1
    assert not doubtful[1]
    assert len(doubtful[-1]) == 1


def test_two_reports_of_one_object_are_one_track():
    """Half a metre apart in each scan."""
    told = drive(Tracker(), [[(8.0, 9.0), (8.5, 9.0)]] * 6)
    assert [len(tracks) for tracks in told] == [1] * 6


def test_of_too_many_tracks_the_likeliest_are_kept(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("models.perception.track.tracker.MAX_TRACKS", 2)
    old = [(8.0, 9.0), (8.0, -9.0)]
    assert [track.id for track in drive(Tracker(), [old, old, [*old, (20.0, 0.0)]])[-1]] == [1, 2]


def test_the_class_of_a_track_is_that_of_its_objects():
    tracker, told = Tracker(), ()
    for scan, name in enumerate(("car", "van", "van")):
        told = tracker.step(frame(scan, msgspec.structs.replace(seen(8.0, 9.0), object_class=name)), stationary_pose())
    assert [one.object_class for one in told] == ["van"]


def test_covariances_of_tracks_hold_among_false_reports():
    """60 drives of 15 scans: an object at up to 8 m/s an axis with white acceleration of the filter's density, reported
    with 0.7, an error of 0.5 m (0.3 m of its own covariance and 0.4 m of wandering), and in each scan a Poisson number,
    mean 1, of false reports over 60 x 60 m; score 0.5, so that the model's background is 6e-4 per m2 (here 2.8e-4).
    Mean squared Mahalanobis distance of the position, 2 degrees of freedom, over the tracks within 5 m of it: 1.4 to
    2.6. Drives are independent, scans of one are not: of 60 drives, the standard error of the mean is about 0.2.
    """
    rng, root = np.random.default_rng(17), np.linalg.cholesky(motion_noise(0.3, 2.0))
    squares = []
    for _ in range(60):
        tracker, state = Tracker(), np.concatenate([rng.uniform(20.0, 40.0, 2), rng.uniform(-8.0, 8.0, 2)])
        for scan in range(15):
            false = [seen(*rng.uniform(0.0, 60.0, 2)) for _ in range(rng.poisson(1.0))]
            mine = [seen(*(state[:2] + 0.5 * rng.standard_normal(2)))] if rng.random() < 0.7 else []
            objects = [msgspec.structs.replace(item, score=0.5) for item in mine + false]
            for track in tracker.step(frame(scan, *objects), stationary_pose()):
                error = np.array([track.x_m, track.y_m]) - state[:2]
                if math.hypot(*error) < 5.0:
                    squares.append(error @ np.linalg.solve(np.array(track.cov_m2), error))
            state = (np.eye(4) + 0.3 * np.eye(4, k=2)) @ state + root @ rng.standard_normal(4)
    assert len(squares) > 300
    assert 1.4 < np.mean(squares) < 2.6


def test_place_velocity_and_age_of_a_moving_object():
    told = drive(Tracker(), [[(8.0, 20.0 - 1.2 * scan)] for scan in range(20)])
    (last,) = told[-1]
    assert (last.x_m, last.y_m) == pytest.approx((8.0, 20.0 - 1.2 * 19), abs=0.05)
    assert (last.velocity_x_mps, last.velocity_y_mps) == pytest.approx((0.0, -4.0), abs=0.1)
    assert last.age_s == pytest.approx(19 * 0.3)
    assert last.velocity_cov_m2ps2 is not None
    assert np.linalg.eigvalsh(np.array(last.cov_m2))[0] > 0.0
    assert math.sqrt(last.velocity_cov_m2ps2[1][1]) < 1.5


def test_an_object_is_where_it_was_when_its_beams_were_measured():
    """Measured 0.2 s after the stamp, at 5 m/s a metre on; the track says where it was at the stamp."""
    tracker, told = Tracker(), ()
    for scan in range(30):
        stamp_ns = frame(scan).stamp_ns + 200_000_000
        told = tracker.step(frame(scan, seen(1.5 * scan + 1.0, 9.0, stamp_ns)), stationary_pose())
    assert told[0].x_m == pytest.approx(1.5 * 29, abs=0.05)


@pytest.mark.parametrize(("ego_compensated", "later_s"), [(True, 0.0), (True, 0.2), (False, 0.2)])
def test_a_parked_object_stands_while_the_radar_drives_a_bend(ego_compensated: bool, later_s: float):
    """Seen from a radar mounted ahead of the axle and turned, at 8 m/s and 0.3 rad/s; measured 0.2 s after the scan's
    start, 1.6 m further on, where it lies as seen from there unless ego motion is compensated.
    """
    mounted = Pose2(2.0, 0.5, 0.4)
    tracker, odometry, parked = Tracker(), Odometry(), np.array([25.0, 12.0])
    told: tuple[Track, ...] = ()
    for scan in range(10):
        for step in range(15):
            odometry.add(state(1.0 + 0.3 * scan + 0.02 * step, 8.0, 0.3))
        one = frame(scan)
        place = odometry.at(one.stamp_ns)
        assert place is not None
        x_m, y_m = (ego_motion(8.0, 0.3, 0.3 * scan) @ mounted).inverse().apply(parked)
        looking = ego_motion(8.0, 0.3, 0.3 * scan + (0.0 if ego_compensated else later_s)) @ mounted
        there_m = looking.inverse().apply(parked).tolist()
        report = seen(*there_m, stamp_ns=one.stamp_ns + round(1e9 * later_s))
        told = tracker.step(msgspec.structs.replace(one, objects=(report,)), place, mounted, ego_compensated)
        if told:
            assert math.dist((told[0].x_m, told[0].y_m), (x_m, y_m)) < 1e-6
    assert math.hypot(told[0].velocity_x_mps, told[0].velocity_y_mps) < 1e-6


def test_two_that_pass_each_other_keep_their_ids():
    """Against each other, three metres apart, and told in changing order."""
    ways = [[(4.0 + 1.2 * scan, 9.0), (16.0 - 1.2 * scan, 12.0)] for scan in range(11)]
    told = drive(Tracker(), [way if scan % 2 else way[::-1] for scan, way in enumerate(ways)])
    ids = [{one.id: one.y_m for one in tracks} for tracks in told if tracks]
    assert all(math.dist(list(now.values()), list(ids[0].values())) < 0.2 for now in ids)
    assert all(list(now) == list(ids[0]) for now in ids)


def test_nothing_outside_the_gate_is_assigned():
    told = drive(Tracker(), [[(8.0, 9.0)]] * 8 + [[(8.0, 13.0)]])
    # missed, and the other report begins one of its own
    assert [one.misses for one in told[-1]] == [1, 0]


def test_ids_are_never_used_twice():
    tracker = Tracker()
    first = drive(tracker, [[(8.0, 9.0)]] * 3)[-1]
    assert tracker.step(frame(3), None) == ()
    second = drive(tracker, [[(8.0, 9.0)]] * 3, start=4)[-1]
    third = drive(tracker, [[(8.0, 9.0)]] * 3, start=400)[-1]
    assert [one.id for one in (*first, *second, *third)] == [1, 2, 3]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5, -2.0])
def test_covariances_of_a_track_are_in_the_axes_of_the_radar(yaw_rad: float):
    """Seen twice, 0.3 s apart, by a standing radar turned by some yaw: 1 m uncertain along its x, 0.1 m along its y.

    Each of its axes is a filter of its own: r = s^2 + 0.4^2 is 1.16 and 0.17. The second scan predicts from diag(r, 64)
    with density 2: xx = r + 64 * 0.09 + 2 * 0.027 / 3, xv = 64 * 0.3 + 2 * 0.09 / 2 = 19.29, vv = 64 + 2 * 0.3 = 64.6;
    xx is 6.938 and 5.948. Updated: vv - xv^2 / (xx + r) = 64.6 - 372.1041 / 8.098 = 18.6499 and
    64.6 - 372.1041 / 6.118 = 3.7788; xx r / (xx + r) = 0.99384 and 0.16528. The yaw changes nothing of it, since speeds
    and accelerations are as uncertain in all directions. Tolerance: the digits given.
    """
    # so little background that the second object is surely the first one's
    tracker = Tracker(TrackerParams(birth_density_per_m2=1e-12))
    here = OdometryPose(0, Pose2(3.0, -2.0, yaw_rad), 0.0, 0.0)
    there = seen(8.0, 9.0, cov_m2=((1.0, 0.0), (0.0, 0.01)))
    told = [tracker.step(frame(scan, there), here) for scan in range(2)][-1]
    assert told[0].velocity_cov_m2ps2 is not None
    np.testing.assert_allclose(told[0].velocity_cov_m2ps2, [[18.6499, 0.0], [0.0, 3.7788]], atol=1e-4)
    np.testing.assert_allclose(told[0].cov_m2, [[0.99384, 0.0], [0.0, 0.16528]], atol=1e-5)


def test_time_to_appear_is_when_the_nose_passes_the_corner():
    """Along y = 8 at 4 m/s: the ray from the radar past (10, 4) reaches that line at x = 20."""
    told = drive(Tracker(), [[(4.0 + 1.2 * scan, 8.0)] for scan in range(8)])
    (last,) = told[-1]
    assert last.time_to_appear_s == pytest.approx((20.0 - NOSE_M - last.x_m) / 4.0, abs=0.15)


def test_time_to_appear_counts_the_radars_own_way():
    """A parked object at (12, 8), hidden by the house up to x = 10; the radar at 4 m/s sees it from x = 8 on."""
    tracker, told = Tracker(), ()
    for scan in range(4):
        ahead = Pose2(1.2 * scan)
        x_m, y_m = ahead.inverse().apply(np.array([12.0, 8.0]))
        ends = ahead.inverse().apply(np.array(HOUSE.ends_m))
        wall = msgspec.structs.replace(HOUSE, ends_m=tuple(map(tuple, ends.tolist())))
        told = tracker.step(frame(scan, seen(float(x_m), float(y_m)), walls=(wall,)), OdometryPose(0, ahead, 4.0, 0.0))
    assert told[0].time_to_appear_s == pytest.approx((8.0 - 3.6) / 4.0, abs=0.11)


def test_time_to_appear_is_none_where_it_does_not_or_nothing_hides_it():
    away = drive(Tracker(), [[(6.0, 8.0 + 0.9 * scan)] for scan in range(4)])[-1]
    assert away[0].time_to_appear_s is None
    tracker, told = Tracker(), ()
    for scan in range(4):
        told = tracker.step(frame(scan, seen(4.0, 8.0), walls=()), stationary_pose())
    assert told[0].time_to_appear_s is None


def test_a_wall_that_one_scan_missed_still_stands():
    tracker, told = Tracker(), ()
    for scan in range(6):
        told = tracker.step(
            frame(scan, seen(8.0 + 0.9 * scan, 8.0), walls=() if scan == 5 else (HOUSE,)), stationary_pose()
        )
    assert told[0].time_to_appear_s is not None
    assert told[0].time_to_appear_s > 0.5


def test_odometry_between_states_and_after_the_last():
    odometry = Odometry()
    odometry.add(state(1.0, 4.0))
    odometry.add(state(1.5, 8.0))
    places = [odometry.at(round(time_s * 1e9)) for time_s in (1.25, 1.5, 2.0, 2.6)]
    # evenly faster: 4 t + 4 t^2; then straight on; then unknown
    assert [one and one.odom_from_vehicle.x_m for one in places] == [pytest.approx(1.25), 3.0, 7.0, None]
    assert odometry.at(999_999_999) is None


def test_bias_is_learnt_at_rest_and_taken_off():
    rng = np.random.default_rng(3)
    odometry = Odometry()
    for step in range(150):
        odometry.add(state(0.02 * step, 0.0, 0.02 + 0.004 * rng.standard_normal()))
    at_rest = odometry.at(2_980_000_000)
    assert at_rest is not None
    # it turned until it counted as standing, half a second
    assert at_rest.odom_from_vehicle.yaw_rad == pytest.approx(0.02 * 0.5, rel=0.1)
    assert odometry.yaw_rate_bias_rps == pytest.approx(0.02, abs=3 * 0.004 / math.sqrt(125))
    odometry.add(state(3.0, 5.0, 0.12))
    now = odometry.at(3_000_000_000)
    assert now is not None
    assert now.yaw_rate_rps == pytest.approx(0.10, abs=1.1e-3)


def test_bias_is_not_learnt_on_a_turntable_nor_while_creeping():
    odometry = Odometry()
    for step in range(100):
        odometry.add(state(0.02 * step, 0.0, 0.2))
    turned = odometry.at(1_980_000_000)
    assert turned is not None
    assert turned.odom_from_vehicle.yaw_rad == pytest.approx(0.2 * 1.98)
    for step in range(100, 200):
        odometry.add(state(0.02 * step, 0.3, 0.02))
    assert odometry.yaw_rate_bias_rps == 0.0


def test_states_that_are_late_repeated_or_not_valid_change_nothing():
    odometry = Odometry()
    for one in (state(1.0, 4.0), state(1.1, 4.0), state(1.05, 99.0), state(1.1, 99.0), state(1.2, 99.0, valid=False)):
        odometry.add(one)
    place = odometry.at(1_200_000_000)
    assert place is not None
    assert (place.frame, place.speed_mps) == (0, 4.0)
    assert place.odom_from_vehicle.x_m == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: TrackerParams(place_std_m=0.0), "tracker.place_std_m"),
        (lambda: TrackerParams(detection_probability=1.0), "tracker.detection_probability"),
        (lambda: TrackerParams(birth_density_per_m2=1e-30), "tracker.birth_density_per_m2"),
        (lambda: TrackerParams(confirm_existence=0.01), "tracker.confirm_existence"),
    ],
)
def test_parameters_are_checked_at_the_door(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()


def test_recordings_without_the_newer_fields_of_a_track_decode():
    old = {"id": 1, "x_m": 1.0, "y_m": 2.0, "velocity_x_mps": 0.0, "velocity_y_mps": 1.0, "age_s": 1.0, "cov_m2": EYE}
    track = msgspec.msgpack.decode(msgspec.msgpack.encode(old), type=Track)
    assert (track.velocity_cov_m2ps2, track.misses, track.existence, track.object_class) == (None, 0, None, "")


def rolling(step: int, *objects: HiddenObject) -> BevFrame:
    """View `step` of rolling scans: 60 ms after the last, of the newest 300 ms, settled 24 ms before its end."""
    stamp_ns = 1_000_000_000 + step * 60_000_000
    view = frame(0, *objects)
    return msgspec.structs.replace(
        view, stamp_ns=stamp_ns, scan_id=step // 5 + 1, settled_stamp_ns=stamp_ns + 264_000_000
    )


def test_views_that_share_beams_measure_an_object_once_a_sweep():
    """At the same place in all views, measured anew every 300 ms: existence and covariance of whole scans 0.3 s apart.

    Survival is the same power of time; the motion noise of 0.3 s is added in five parts, which is the same sum.
    """
    whole, rolled = Tracker(), Tracker()
    for scan in range(3):
        expected = whole.step(frame(scan, seen(8.0, 9.0, 1_100_000_000 + scan * PERIOD_NS)), stationary_pose())
    # measured at 1.1 s and every 0.3 s after; the beams of each view hold the newest of them
    for step in range(-2, 9):
        newest_ns = 1_000_000_000 + step * 60_000_000 + 264_000_000
        measured_ns = 1_100_000_000 + (newest_ns - 1_100_000_000) // PERIOD_NS * PERIOD_NS
        tracks = rolled.step(rolling(step, seen(8.0, 9.0, measured_ns)), stationary_pose())
    (track,), (other,) = tracks, expected
    assert (track.id, track.misses) == (other.id, 0)
    assert track.existence == pytest.approx(other.existence, rel=0.05)
    assert track.velocity_x_mps == pytest.approx(other.velocity_x_mps, abs=1e-9)


def test_views_that_share_beams_miss_an_object_once_a_sweep():
    """Measured twice and then gone: the second sweep without it lowers existence by (1 - p_D) / (1 - r p_D) once."""
    tracker = Tracker()
    for step in range(-2, 5):
        newest_ns = 1_000_000_000 + step * 60_000_000 + 264_000_000
        measured_ns = 1_100_000_000 + (newest_ns - 1_100_000_000) // PERIOD_NS * PERIOD_NS
        before = tracker.step(rolling(step, seen(8.0, 9.0, measured_ns)), stationary_pose())
    assert before[0].misses == 0
    misses = []
    for step in range(5, 17):
        tracker.step(rolling(step), stationary_pose())
        misses += [track.misses for track in tracker._tracks]
    # a sweep and its margin are six views
    assert misses == [0] * 4 + [1] * 6 + [2] * 2


def test_an_object_of_beams_that_lack_their_neighbours_waits_for_them():
    """Measured 12 ms before the newest beam: not yet whole. The next view takes it."""
    tracker = Tracker()
    item = seen(8.0, 9.0, 1_000_000_000 + 264_000_000 + 12_000_000)
    tracker.step(rolling(0, item), stationary_pose())
    assert tracker._tracks == []
    tracker.step(rolling(1, item), stationary_pose())
    assert len(tracker._tracks) == 1
    tracker.step(rolling(2, item), stationary_pose())
    assert [track.measurements for track in tracker._tracks] == [1]


@pytest.mark.parametrize(("later_ms", "measurements"), [(100, 1), (200, 2)])
def test_an_object_is_new_half_a_sweep_after_it_was_measured(later_ms: int, measurements: int):
    """Views share beams for a sweep of 264 ms: what is measured 100 ms later is of the same beams, 200 ms is not."""
    tracker = Tracker()
    for step, stamp_ns in ((0, 1_100_000_000), (4, 1_100_000_000 + later_ms * 1_000_000)):
        tracker.step(rolling(step, seen(8.0, 9.0, stamp_ns)), stationary_pose())
    assert [track.measurements for track in tracker._tracks] == [measurements]
