"""What a driver is told: each rule on facts with a known answer, and the memory that keeps warnings from flickering."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from msgs.values.arrays import Covariance
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, Track, Visibility, Wall
from msgs.values.radar import MAP_FAULTS
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import ViewFigures
from nodes.viewer import driver_warnings
from nodes.viewer.driver_warnings import (
    FLAG_WORDS,
    DriverWarning,
    Facts,
    Level,
    NodeFact,
    Warner,
    crossing_of,
    is_moving,
    place_words,
    radar_ahead_m,
    side_of,
    warnings_json,
)

S = 1_000_000_000
#: Standard deviations 0.5 m and 0.3 m/s, along any direction.
PLACE_COV: Covariance = ((0.25, 0.0), (0.0, 0.25))
VELOCITY_COV: Covariance = ((0.09, 0.0), (0.0, 0.09))
WALL = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -9.0), (20.0, 9.0)), inliers=9)
STATE = VehicleState(stamp_ns=0, speed_mps=5.0)


def track(x_m: float = 35.0, y_m: float = 15.0, **changes: Any) -> Track:
    """A car that comes from the left at 4 m/s, far enough not to meet anybody."""
    facts: dict[str, Any] = {
        "id": 1, "velocity_x_mps": 0.0, "velocity_y_mps": -4.0, "age_s": 2.0, "cov_m2": PLACE_COV,
        "velocity_cov_m2ps2": VELOCITY_COV,
    }  # fmt: skip
    return Track(x_m=x_m, y_m=y_m, **{**facts, **changes})


def frame(*tracks: Track, mirrored: bool = True, **changes: Any) -> BevFrame:
    visibility = np.full((40, 40), Visibility.MIRRORED if mirrored else Visibility.DIRECT, np.uint8)
    facts = {"stamp_ns": 0, "scan_id": 0, "walls": (WALL,), "visibility": visibility, **changes}
    return BevFrame(
        tracks=tracks, los_points_m=np.zeros((0, 2), np.float32), grid=BevGrid(rows=40, columns=40), **facts
    )


def facts(now_s: float, view: BevFrame | None, **changes: Any) -> Facts:
    """All well at a time: a view of this moment, a vehicle state of this moment."""
    now_ns = round(now_s * S)
    # of another clock, so that a track's times count from now
    view = None if view is None else msgspec.structs.replace(view, stamp_ns=now_ns + 1000 * S)
    return Facts(now_ns, 0, view, now_ns, now_ns, STATE, now_ns)._replace(**changes)


def run(steps: list[Facts]) -> list[list[DriverWarning]]:
    warner = Warner()
    return [list(warner.step(one)) for one in steps]


def at_last(steps: list[Facts]) -> list[DriverWarning]:
    return run(steps)[-1]


def steady(view: BevFrame | None, count: int = 5, **changes: Any) -> list[Facts]:
    """The same again and again, 0.3 s apart."""
    return [facts(0.3 * index, view, **changes) for index in range(count)]


def test_nothing_is_said_while_all_is_well() -> None:
    assert run(steady(frame())) == [[]] * 5


# hidden road users


def test_a_hidden_car_about_to_appear_is_urgent_at_once() -> None:
    (one,) = at_last(steady(frame(track(time_to_appear_s=2.4)), 1))
    assert (one.key, one.level, one.left_s) == ("hidden/left", Level.URGENT, 2.4)
    assert one.title == "Hidden road user from the left: about to appear"
    assert one.detail == "38 m, 23° left, 14 km/h"
    assert one.tracks == (1,)


def test_times_count_from_now_and_not_from_the_scan() -> None:
    """A view that came 0.8 s after its first beam: 0.8 s of the 2.4 s have passed."""
    late = facts(10.0, frame(track(time_to_appear_s=2.4)))
    assert late.frame is not None
    late = late._replace(frame=msgspec.structs.replace(late.frame, stamp_ns=round(9.2 * S)))
    (one,) = at_last([late])
    assert one.left_s == pytest.approx(1.6)


def test_a_standing_object_is_no_road_user_about_to_appear() -> None:
    """It comes into sight by the vehicle's own motion: worth a caution."""
    (one,) = at_last(steady(frame(track(velocity_y_mps=0.3, time_to_appear_s=2.0)), 1))
    assert one.level is Level.CAUTION
    assert one.title == "Slow or standing hidden object from the left: about to appear"


@pytest.mark.parametrize(
    ("speed_mps", "std_mps", "moves"), [(4.0, 1.3, True), (2.0, 1.3, False), (0.9, 0.01, False), (1.5, None, True)]
)
def test_only_what_surely_moves_is_called_moving(speed_mps: float, std_mps: float | None, moves: bool) -> None:
    covariance = None if std_mps is None else ((std_mps**2, 0.0), (0.0, std_mps**2))
    one = track(velocity_x_mps=0.6 * speed_mps, velocity_y_mps=-0.8 * speed_mps, velocity_cov_m2ps2=covariance)
    assert is_moving(one) is moves


def test_one_car_followed_twice_is_one_warning() -> None:
    twins = track(time_to_appear_s=2.4), track(35.5, 15.2, id=7, time_to_appear_s=2.0)
    (one,) = at_last(steady(frame(*twins), 1))
    assert (one.left_s, one.tracks) == (2.0, (7,))
    assert one.detail.endswith("; 1 more on this side")


def test_a_new_id_of_the_same_car_does_not_begin_anew() -> None:
    seen = [facts(0.3 * index, frame(track(id=index, time_to_appear_s=2.5 - 0.3 * index))) for index in range(5)]
    for number, (one,) in enumerate(run(seen)):
        assert (one.since_ns, one.tracks) == (0, (number,))


def test_a_car_that_crosses_ahead_still_comes_from_its_side() -> None:
    """Bearing from 20 to -5 degrees: one warning, from the left, all the way."""
    seen = [facts(0.3 * i, frame(track(20.0, 7.0 - 1.2 * i, time_to_appear_s=2.0))) for i in range(8)]
    assert [[one.key for one in step] for step in run(seen)] == [["hidden/left"]] * 8


def test_both_sides_are_told_the_sooner_first() -> None:
    view = frame(track(time_to_appear_s=2.4), track(35.0, -15.0, id=2, velocity_y_mps=4.0, time_to_appear_s=1.0))
    assert [one.key for one in at_last(steady(view, 1))] == ["hidden/right", "hidden/left"]


def test_a_limit_that_is_passed_to_and_fro_does_not_flicker() -> None:
    """Begins below 3 s, ends above 4 s: 2.9, 3.1, 2.9, 3.8 s is one warning, in one piece."""
    times_s = [3.2, 2.9, 3.1, 2.9, 3.8]
    told = run([facts(0.3 * index, frame(track(time_to_appear_s=value))) for index, value in enumerate(times_s)])
    assert [bool(one) and one[0].level is Level.URGENT for one in told] == [False, True, True, True, True]
    assert {one.ended for step in told[1:] for one in step} == {False}


def test_one_scan_without_a_track_does_not_end_a_warning() -> None:
    """It stays for a second, marked as over, its time running on; then it goes."""
    view = frame(track(time_to_appear_s=2.0))
    told = run([facts(0.0, view), facts(0.3, frame()), facts(0.6, view), facts(1.5, frame()), facts(1.7, frame())])
    (first,), (second,), (third,), (fourth,), fifth = told
    assert [one.ended for one in (first, second, third, fourth)] == [False, True, False, True]
    assert second.left_s == pytest.approx(1.7)
    assert third.since_ns == 0
    assert fifth == []


def test_urgency_does_not_drop_and_rise_from_scan_to_scan() -> None:
    """A track whose way out of hiding is lost for one scan stays urgent; lost for longer it is a notice."""
    soon, known = frame(track(time_to_appear_s=2.0)), frame(track())
    told = run([facts(0.3 * index, view) for index, view in enumerate([soon, known, soon, *[known] * 5])])
    assert [one[0].level for one in told][:4] == [Level.URGENT] * 4
    assert told[-1][0].level is Level.NOTICE


def test_since_counts_from_when_it_became_as_urgent() -> None:
    """Seen at 0 s without a track, a notice from then; moving soon into sight from 0.9 s on; at last a notice again."""
    one = HiddenObject(
        id=0, x_m=35.0, y_m=15.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=0.9, cov_m2=PLACE_COV
    )  # fmt: skip
    views = [frame(objects=(one,))] * 3 + [frame(track(time_to_appear_s=2.0))] * 3 + [frame(track())] * 5
    told = run([facts(0.3 * index, view) for index, view in enumerate(views)])
    since = [(step[0].level, step[0].since_ns / S) for step in told if step]
    assert since[0] == (Level.NOTICE, 0.0)
    assert {level_since for level_since in since if level_since[0] is Level.URGENT} == {(Level.URGENT, 0.9)}
    assert since[-1] == (Level.NOTICE, 0.0)


def test_a_track_not_seen_for_long_begins_no_warning_but_keeps_one() -> None:
    assert at_last(steady(frame(track(time_to_appear_s=2.0, misses=3)))) == []
    seen = facts(0.0, frame(track(time_to_appear_s=2.0)))
    (one,) = at_last([seen, facts(0.3, frame(track(time_to_appear_s=1.7, misses=3)))])
    assert not one.ended


def test_what_came_into_sight_says_so() -> None:
    told = run([facts(0.3 * i, frame(track(time_to_appear_s=max(0.6 - 0.3 * i, 0.0)))) for i in range(9)])
    assert told[0][0].level is Level.URGENT
    assert told[-1][0].detail.startswith("now in direct sight")


def test_objects_without_tracks_are_a_notice() -> None:
    """Recordings from before there were tracks, and scans before a track is confirmed."""
    one = HiddenObject(
        id=0, x_m=10.0, y_m=-10.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=0.9, cov_m2=PLACE_COV
    )  # fmt: skip
    (told,) = at_last(steady(frame(objects=(one,))))
    assert (told.key, told.level) == ("hidden/right", Level.NOTICE)
    assert told.detail == "14 m, 45° right; not followed, motion unknown"


def test_a_thousand_tracks_are_four_warnings() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-60.0, 60.0, (1000, 2)).tolist()
    crowd = [track(x, y, id=number, time_to_appear_s=1.0) for number, (x, y) in enumerate(places)]
    told = at_last(steady(frame(*crowd), 1))
    assert {one.key for one in told} <= {"hidden/left", "hidden/right", "hidden/ahead", "hidden/behind"}


# ways that cross


def straight(speed_mps: float) -> tuple[np.ndarray, np.ndarray]:
    times_s = 0.1 * np.arange(51)
    return radar_ahead_m(VehicleState(stamp_ns=0, speed_mps=speed_mps), Pose2(), times_s), times_s


def test_ways_cross_where_and_when_they_must() -> None:
    """Layout: radar at 5 m/s forward, car 20 m ahead and 16 m left at 4 m/s to the right: both at (20, 0) after 4 s.

    Distance t s before that: 6.403 t, so 3 m are reached at 4 - 0.4685 s, the first step after it at 3.6 s. Standard
    deviation there: sqrt(0.5^2 + (3.6 * 0.3)^2) = 1.19 m.
    """
    met = crossing_of(track(20.0, 16.0), *straight(5.0), near_m=3.0)
    assert met is not None
    assert met.time_s == pytest.approx(3.6)
    assert met.distance_m == pytest.approx(0.0, abs=1e-9)
    assert met.std_m == pytest.approx(math.hypot(0.5, 3.6 * 0.3))


def test_a_turning_vehicle_goes_round_a_circle_and_its_radar_with_it() -> None:
    """Layout: 5 m/s and 0.5 rad/s are a circle of 10 m radius; a radar 2 m ahead is sqrt(104) m from its centre."""
    times_s = np.array([0.0, math.pi, 2.0 * math.pi])
    mounted = Pose2(2.0, 0.0, 0.0)
    ahead = radar_ahead_m(VehicleState(stamp_ns=0, speed_mps=5.0, yaw_rate_rps=0.5), mounted, times_s)
    assert ahead[0] == pytest.approx([0.0, 0.0])
    # after a quarter turn the axle is at (10, 10), the radar 2 m to its left; seen from where the radar was
    assert ahead[1] == pytest.approx([10.0 - 2.0, 12.0])
    assert np.hypot(*(ahead + np.array([2.0, -10.0])).T) == pytest.approx(math.hypot(2.0, 10.0))


@pytest.mark.parametrize(
    "one",
    [
        track(20.0, -16.0),  # moves away
        track(20.0, 40.0),  # too far
        track(20.0, 16.0, velocity_cov_m2ps2=None),  # nobody knows how surely
        track(20.0, 16.0, velocity_cov_m2ps2=((4.0, 0.0), (0.0, 4.0))),  # not surely at all
    ],
)
def test_ways_that_nobody_can_tell_to_meet_do_not(one: Track) -> None:
    assert crossing_of(one, *straight(5.0), near_m=3.0) is None


def test_of_a_side_meeting_ways_are_told_before_what_comes_into_sight() -> None:
    view = frame(track(20.0, 16.0, time_to_appear_s=2.0), track(id=2, time_to_appear_s=1.0))
    (one,) = at_last(steady(view, 1))
    assert (one.level, one.title) == (Level.URGENT, "Hidden road user from the left: ways meet")
    assert one.tracks == (1,)


def test_ways_that_just_miss_keep_a_warning_but_begin_none() -> None:
    """Begins within 3 m, ends beyond 4.5 m. Layout: 5 m further left it passes 5 * 5 / 6.403 = 3.9 m off."""
    near, missed = frame(track(20.0, 16.0)), frame(track(20.0, 21.0))
    assert [one.title for one in at_last(steady(missed))] == ["Hidden road user from the left"]
    told = run([facts(0.0, near), facts(0.3, missed), facts(2.0, missed)])
    assert [one[0].title[-9:] for one in told] == ["ways meet"] * 3


@pytest.mark.parametrize(
    "unknown", [{"vehicle": None}, {"vehicle": VehicleState(stamp_ns=0, speed_mps=5.0, valid=False)}]
)
def test_without_own_motion_no_ways_are_said_to_meet(unknown: dict[str, Any]) -> None:
    told = at_last(steady(frame(track(20.0, 16.0)), 1, **unknown))
    assert not [one for one in told if "meet" in one.title]


# seeing at all


def test_cannot_see_is_not_nothing_hidden() -> None:
    (one,) = at_last(steady(frame(mirrored=False, walls=())))
    assert (one.key, one.level) == ("blind", Level.CAUTION)
    assert one.detail.startswith("no wall found")
    (other,) = at_last(steady(frame(mirrored=False)))
    assert other.detail.startswith("no wall mirrors")


def test_one_scan_without_walls_is_not_said() -> None:
    told = run([facts(0.3 * index, frame(mirrored=index != 2)) for index in range(5)])
    assert told == [[]] * 5


def test_a_little_more_sight_does_not_end_blindness() -> None:
    """Cells of 0.25 m^2: begins under 10 m^2, ends at 20 m^2."""
    mask = np.zeros((40, 40), np.uint8)
    told = []
    for cells in (0, 0, 0, 60, 79, 80):
        visibility = mask.copy()
        visibility.flat[:cells] = Visibility.MIRRORED
        told.append(facts(0.3 * len(told), frame(visibility=visibility)))
    assert [[one.ended for one in step] for step in run(told)] == [[], [], [False], [False], [False], [True]]


@pytest.mark.parametrize(
    ("map_at_ns", "title"),
    [(10 * S, "No view: perception is silent"), (7 * S, "No view: the radar is silent"), (None, "No view")],
)
def test_silence_is_told_of_whom_it_comes(map_at_ns: int | None, title: str) -> None:
    """3 s after the last view; maps come still, do not, or never came. What that view said is not repeated."""
    now = facts(10.0, frame(track(time_to_appear_s=2.0)), frame_at_ns=7 * S, map_at_ns=map_at_ns)
    (one,) = at_last([now])
    assert (one.level, one.title) == (Level.URGENT, title)
    assert "3 s" in one.detail


def test_before_the_first_view_it_waits() -> None:
    nothing = Facts(5 * S, 0)
    (one,) = at_last([nothing])
    assert (one.key, one.level, one.title) == ("silent", Level.CAUTION, "No view yet")


@pytest.mark.parametrize(
    ("changes", "detail"),
    [
        ({"vehicle": None, "vehicle_at_ns": None}, "the radar is taken as standing"),
        ({"vehicle_at_ns": -1 * S}, "no vehicle state for "),
        ({"vehicle": VehicleState(stamp_ns=0, valid=False, reason="counter stuck")}, "counter stuck; hidden objects"),
    ],
)
def test_an_unknown_own_motion_is_told_with_its_reason(changes: dict[str, Any], detail: str) -> None:
    (one,) = at_last(steady(frame(), **changes))
    assert one.key == "vehicle"
    assert one.detail.startswith(detail)


def test_every_condition_of_a_scan_has_plain_words(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(FLAG_WORDS) >= {*MAP_FAULTS, "incoherent", "missing_beams", "saturated"}
    monkeypatch.setattr(driver_warnings, "MAX_WARNINGS", len(FLAG_WORDS) + 1)
    told = run(steady(frame(flags=(*FLAG_WORDS, "something_new"))))[-1]
    assert {one.key for one in told} == {f"flag/{flag}" for flag in (*FLAG_WORDS, "something_new")}
    assert "Something new" in {one.title for one in told}
    assert all("_" not in one.title + one.detail for one in told)


def test_late_views_are_told_when_there_are_two() -> None:
    def views(late: int) -> ViewFigures:
        return ViewFigures(
            watched_s=10.0, window_s=10.0, deadline_s=0.3, age_ms=None, rate_hz=3.3, latency_p50_ms=None,
            latency_p99_ms=None, latency_max_ms=None, views=30, views_total=30, late=late, late_total=late, absent=0,
            absent_total=0, overdue=0,
        )  # fmt: skip

    told = run([facts(0.3 * index, frame(), views=views(late)) for index, late in enumerate([1, 2, 1, 0])])
    assert [[one.key for one in step if not one.ended] for step in told] == [[], ["late"], ["late"], []]


def test_nodes_that_are_not_well_and_losses_are_told() -> None:
    sick = NodeFact("geometry", "degraded", "<why>", 0), NodeFact("ra_former", "ready", "", 7)
    told = {one.key: one for one in at_last(steady(frame(), nodes=sick))}
    assert set(told) == {"node/geometry", "lost/ra_former"}
    assert told["node/geometry"].detail == "<why>"
    assert told["lost/ra_former"].detail.startswith("7 messages")


# the memory, and what pages get


def test_a_clock_that_goes_back_begins_anew() -> None:
    warner = Warner()
    warner.step(facts(100.0, frame(track(time_to_appear_s=2.0))))
    (one,) = warner.step(facts(1.0, frame(track(time_to_appear_s=2.0))))
    assert one.since_ns == S


def test_no_more_than_can_be_read() -> None:
    many = [NodeFact(f"n{index:02d}", "silent", "gone", 0) for index in range(64)]
    assert len(at_last(steady(frame(), 1, nodes=many))) == 12


def test_a_page_gets_how_long_it_lasts() -> None:
    told = run(steady(frame(track(time_to_appear_s=2.46))))[-1]
    (one,) = warnings_json(told, round(1.5 * S))
    assert one == {
        "key": "hidden/left", "level": "urgent", "title": "Hidden road user from the left: about to appear",
        "detail": "38 m, 23° left, 14 km/h", "left_s": 2.5, "age_s": 1.5, "tracks": [1], "ended": False,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("place", "side", "words"),
    [
        ((20.0, 0.0), "ahead", "20 m, straight ahead"),
        ((20.0, 20.0), "left", "28 m, 45° left"),
        ((0.0, -9.6), "right", "10 m, 90° right"),
        ((-5.0, 0.1), "behind", "5 m, 179° left"),
    ],
)
def test_places_in_words(place: tuple[float, float], side: str, words: str) -> None:
    assert side_of(*place) == side
    assert place_words(*place) == words
