"""Views of several radars as one: what two see is one object, walls are one wall, whoever is missing is flagged."""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.perception.track.view_fusion import (
    RADAR_LOST,
    FusionStage,
    RadarView,
    covariance_intersection,
    joined_objects,
)
from msgs.values.frames import Pose2
from msgs.values.perception import BevGrid, HiddenObject, HiddenPoint, RadialSpeed, Visibility
from msgs.values.vehicle import VehicleState
from tests.builders import example_view, wall_between

LEFT, RIGHT = Pose2(3.6, 0.8, math.radians(40.0)), Pose2(3.6, -0.8, math.radians(-40.0))
PERIOD_NS = 300_000_000


def hidden(x_m: float, y_m: float, **fields: Any) -> HiddenObject:
    """An object of 0.3 m standard deviation each way."""
    plain: dict[str, Any] = {"id": 0, "length_m": 4.5, "width_m": 1.8, "yaw_rad": 0.0, "score": 0.6}
    return HiddenObject(**plain | {"x_m": x_m, "y_m": y_m, "cov_m2": ((0.09, 0.0), (0.0, 0.09))} | fields)


def seen_by(radar: Pose2, *places_m: tuple[float, float], **fields: Any) -> RadarView:
    """The view of a radar of objects at places of the vehicle's frame."""
    at_m = radar.inverse().apply(np.array(places_m, np.float64).reshape(-1, 2))
    return RadarView(example_view(objects=tuple(hidden(*place) for place in at_m.tolist()), **fields), radar)


def test_what_two_radars_see_is_counted_once() -> None:
    """Two of three objects are seen by both: three are left, at the places that both say, in the vehicle's frame."""
    both = seen_by(LEFT, (20.0, 10.0), (15.0, -8.0)), seen_by(RIGHT, (20.4, 9.8), (14.0, 6.0))
    frame = FusionStage().view(both)
    assert sorted((round(item.x_m, 6), round(item.y_m, 6)) for item in frame.objects) == [
        (14.0, 6.0), (15.0, -8.0), (20.2, 9.9)
    ]  # fmt: skip
    assert [item.id for item in frame.objects] == [0, 1, 2]
    assert RADAR_LOST not in frame.flags


def test_two_objects_of_one_radar_stay_two() -> None:
    """Objects side by side that both radars tell apart are two, paired so that all distances are least."""
    frame = FusionStage().view([seen_by(LEFT, (20.0, 10.0), (20.0, 12.0)), seen_by(RIGHT, (20.0, 11.4), (20.0, 9.7))])
    assert [round(item.y_m, 2) for item in frame.objects] == [9.85, 11.7]


def test_three_radars_see_one_object() -> None:
    """The third joins what the first two have joined."""
    views = [seen_by(pose, (18.0, 3.0 + 0.1 * number)) for number, pose in enumerate((LEFT, RIGHT, Pose2()))]
    (item,) = FusionStage().view(views).objects
    assert item.y_m == pytest.approx(3.1, abs=0.1)


def test_a_lost_radar_leaves_the_view_of_the_other() -> None:
    """The other's objects, walls and tracks go on, and the view says what it lacks."""
    stage = FusionStage()
    for scan in range(4):
        views = [seen_by(pose, (20.0, 10.0), stamp_ns=scan * PERIOD_NS) for pose in (LEFT, RIGHT)]
        frame = stage.view(views[: 2 if scan < 2 else 1], is_whole=scan < 2)
        assert len(frame.objects) == 1
        assert (RADAR_LOST in frame.flags) == (scan >= 2)
    (track,) = frame.tracks
    assert (track.x_m, track.y_m) == pytest.approx((20.0, 10.0), abs=0.2)


def test_views_of_two_times_meet_at_the_later_one() -> None:
    """The car drives on between two scans: an object at rest is at one place of its frame then."""
    stage = FusionStage()
    for at_ns in range(0, 400_000_000, 20_000_000):
        stage.add_state(VehicleState(stamp_ns=at_ns, speed_mps=10.0, yaw_rate_rps=0.0))
    early = seen_by(LEFT, (20.0, 10.0), stamp_ns=100_000_000)
    late = seen_by(RIGHT, (18.0, 10.0), stamp_ns=300_000_000)
    frame = stage.view([early, late])
    (item,) = frame.objects
    assert frame.stamp_ns == 300_000_000
    assert (item.x_m, item.y_m) == pytest.approx((18.0, 10.0), abs=1e-6)


def test_what_was_not_compensated_is_moved_from_its_own_time() -> None:
    """Such an object lies where the radar was when its beam looked."""
    stage = FusionStage()
    for at_ns in range(0, 400_000_000, 20_000_000):
        stage.add_state(VehicleState(stamp_ns=at_ns, speed_mps=10.0, yaw_rate_rps=0.0))
    view = seen_by(LEFT, (20.0, 10.0), stamp_ns=100_000_000)
    later = tuple(msgspec.structs.replace(item, stamp_ns=200_000_000) for item in view.frame.objects)
    view = view._replace(frame=msgspec.structs.replace(view.frame, objects=later), ego_compensated=False)
    (item,) = stage.view([view]).objects
    assert (item.x_m, item.y_m) == pytest.approx((21.0, 10.0), abs=1e-6)


def test_the_parts_of_a_wall_are_one_wall() -> None:
    """One facade before the car, a part of it in each view, is one wall as long as both; points name it."""
    ends_m = np.array([[25.0, -14.0], [25.0, 2.0]]), np.array([[25.02, -1.0], [25.02, 15.0]])
    views = []
    for pose, part_m in zip((RIGHT, LEFT), ends_m, strict=True):
        (a, b), own = pose.inverse().apply(part_m).tolist(), pose.inverse()
        x_m, y_m = own.apply(np.array([20.0, 5.0])).tolist()
        point = HiddenPoint(x_m=x_m, y_m=y_m, score=0.5, image_x_m=x_m, image_y_m=y_m, wall=0)
        views.append(RadarView(example_view(walls=(wall_between(a, b),), points=(point,)), pose))
    frame = FusionStage().view(views)
    (wall,) = frame.walls
    assert wall.offset_m == pytest.approx(25.01, abs=0.05)
    assert wall.inliers == 18
    assert sorted(round(y_m) for _, y_m in wall.ends_m) == [-14, 15]
    assert [point.wall for point in frame.points] == [0, 0]
    assert [(round(point.x_m, 6), round(point.y_m, 6)) for point in frame.points] == [(20.0, 5.0)] * 2


def test_walls_apart_stay_apart() -> None:
    """Two facades of one view stay two, however near, and others of the other are others, one half a metre away."""
    first = example_view(walls=(wall_between((5.0, 6.0), (25.0, 6.0)), wall_between((5.0, 6.02), (25.0, 6.02))))
    second = example_view(walls=(wall_between((5.0, -6.0), (25.0, -6.0)), wall_between((5.0, 5.5), (25.0, 5.5))))
    assert len(FusionStage().view([RadarView(first, Pose2()), RadarView(second, Pose2())]).walls) == 4


def test_a_cell_is_seen_by_whoever_sees_it() -> None:
    """Direct sight of one radar counts before the mirror of the other, a mirror before nothing."""
    grid = BevGrid(rows=4, columns=2, y_min_m=-1.0)
    masks = np.array([[0, 0], [1, 2], [2, 0], [2, 1]], np.uint8), np.array([[0, 1], [2, 2], [0, 0], [1, 0]], np.uint8)
    views = [RadarView(example_view(visibility=mask, grid=grid), Pose2()) for mask in masks]
    frame = FusionStage(grid=grid).view(views)
    expected = [[0, Visibility.DIRECT], [1, 2], [2, 0], [1, 1]]
    assert frame.visibility.tolist() == expected


def test_directions_are_turned_into_the_vehicle() -> None:
    """Heading, radial speed, centre and covariance of an object of a radar that looks to the left."""
    pose = Pose2(0.0, 0.0, 0.5 * math.pi)
    item = hidden(
        10.0, 0.0, centre_m=(11.0, 0.0), cov_m2=((0.04, 0.0), (0.0, 0.25)),
        radial_speed=RadialSpeed(azimuth_rad=0.1, speed_mps=3.0, std_mps=0.2),
    )  # fmt: skip
    (moved,) = FusionStage().view([RadarView(example_view(objects=(item,)), pose)]).objects
    assert (moved.x_m, moved.y_m) == pytest.approx((0.0, 10.0))
    assert moved.centre_m == pytest.approx((0.0, 11.0))
    assert moved.yaw_rad == pytest.approx(0.5 * math.pi)
    assert moved.radial_speed is not None
    assert moved.radial_speed.azimuth_rad == pytest.approx(0.5 * math.pi + 0.1)
    assert np.array(moved.cov_m2) == pytest.approx(np.diag([0.25, 0.04]))


@pytest.mark.parametrize(("radar_x_m", "offset_m", "sign"), [(0.0, 2.0, 1.0), (5.0, 3.0, -1.0)])
def test_an_arc_turns_its_hollow_side_with_its_normal(radar_x_m: float, offset_m: float, sign: float) -> None:
    """Two metres before a radar that looks back: behind the vehicle it stays hollow, before it it bulges."""
    arc = msgspec.structs.replace(wall_between((2.0, -1.0), (2.0, 1.0)), curvature_per_m=0.05)
    pose = Pose2(radar_x_m, 0.0, math.pi)
    (wall,) = FusionStage().view([RadarView(example_view(walls=(arc,)), pose)]).walls
    assert wall.normal == pytest.approx((sign, 0.0))
    assert (wall.offset_m, wall.curvature_per_m) == pytest.approx((offset_m, sign * 0.05))


@pytest.mark.parametrize("apart_s", [0.0, 0.2])
def test_objects_are_paired_within_their_errors(apart_s: float) -> None:
    """Sure objects 3 m apart are two, with an unsure one they are one, and so are those of other times: it may have
    moved.
    """
    sure, unsure = ((0.01, 0.0), (0.0, 0.01)), ((4.0, 0.0), (0.0, 4.0))
    late_ns = round(1e9 * apart_s) + 1
    for first, second in itertools.product((sure, unsure), repeat=2):
        count = 2 if first == second == sure and apart_s == 0.0 else 1
        pair = [
            hidden(20.0, 5.0, cov_m2=first, stamp_ns=1), hidden(20.0, 8.0, cov_m2=second, stamp_ns=late_ns)
        ]  # fmt: skip
        assert len(joined_objects(pair[:1], pair[1:])) == count


def test_nothing_joins_to_nothing() -> None:
    """Views without an object, and one beside such a view."""
    assert joined_objects([], []) == []
    assert joined_objects([], [hidden(1.0, 2.0)]) == [hidden(1.0, 2.0)]
    assert FusionStage().view([seen_by(LEFT), seen_by(RIGHT)]).objects == ()


stds = st.floats(0.05, 5.0)


@settings(max_examples=60, deadline=None)
@given(stds, stds, stds, stds, st.floats(-3.0, 3.0), st.floats(-0.99, 0.99))
def test_the_intersection_is_never_too_sure(
    first: float, second: float, third: float, fourth: float, turn_rad: float, correlation: float
) -> None:
    """However the errors of two estimates depend on each other, the joint covariance is no less than those of its
    estimate (consistency), and its trace is no more than that of either.
    """
    turn = np.array([[math.cos(turn_rad), -math.sin(turn_rad)], [math.sin(turn_rad), math.cos(turn_rad)]])
    one, other = np.diag([first**2, second**2]), turn @ np.diag([third**2, fourth**2]) @ turn.T
    place_m, joint = covariance_intersection(np.array([1.0, 2.0]), one, np.array([1.5, 1.0]), other)
    assert np.isfinite(place_m).all()
    assert np.trace(joint) <= min(np.trace(one), np.trace(other)) * (1.0 + 1e-6)
    # the weights that gave the place, from two estimates that differ along each axis
    gain = np.stack([covariance_intersection(np.zeros(2), one, axis, other)[0] for axis in np.eye(2)], axis=1)
    root_one, root_other = np.linalg.cholesky(one), np.linalg.cholesky(other)
    cross = correlation * root_one @ root_other.T
    rest = np.eye(2) - gain
    true = rest @ one @ rest.T + gain @ other @ gain.T + rest @ cross @ gain.T + gain @ cross.T @ rest.T
    assert np.linalg.eigvalsh(joint - true).min() >= -1e-6 * np.trace(joint)
