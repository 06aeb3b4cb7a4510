"""Trails: places of a track over ground, seen from a radar that has moved on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Track
from msgs.values.vehicle import VehicleState
from nodes.viewer.trails import MAX_PAST, TRAIL_NS, Trails, trail_m
from tests.builders import example_view

S = 1_000_000_000
NO_MOUNT = Pose2()


def view(stamp_s: float, *places: tuple[float, float]) -> BevFrame:
    tracks = tuple(
        Track(
            id=index, x_m=x, y_m=y, velocity_x_mps=0.0, velocity_y_mps=0.0, age_s=1.0, cov_m2=((1.0, 0.0), (0.0, 1.0))
        )
        for index, (x, y) in enumerate(places)
    )
    return example_view(stamp_ns=round(stamp_s * S), tracks=tracks)


def driven(trails: Trails, until_s: float, yaw_rate_rps: float = 0.0, start_s: float = 0.0) -> None:
    for time_s in np.arange(start_s, until_s + 1e-9, 0.05).tolist():
        trails.add_state(VehicleState(stamp_ns=round(time_s * S), speed_mps=5.0, yaw_rate_rps=yaw_rate_rps))


@pytest.mark.parametrize("mount", [NO_MOUNT, Pose2(3.0, 0.5, 0.3)])
def test_a_parked_car_leaves_no_trail_however_one_drives(mount: Pose2) -> None:
    """A circle of 10 m radius for 3 s; the car's places as the mounted radar sees them. Exact arcs: bound 1 mm."""
    trails, car = Trails(), np.array([20.0, 15.0])
    driven(trails, 3.0, yaw_rate_rps=0.5)
    for time_s in np.arange(0.0, 3.01, 0.3).tolist():
        turned = 0.5 * time_s
        vehicle = Pose2(10.0 * math.sin(turned), 10.0 * (1.0 - math.cos(turned)), turned)
        x_m, y_m = (vehicle @ mount).inverse().apply(car).tolist()
        trails.add_view(view(time_s, (x_m, y_m)), mount)
    trail = trail_m(0, trails.past)
    assert len(trail) == 11
    assert np.abs(trail - trail[-1]).max() < 1e-3


def test_without_any_state_the_radar_is_taken_as_standing() -> None:
    trails = Trails()
    for index in range(3):
        trails.add_view(view(0.3 * index, (10.0 - index, 5.0)), NO_MOUNT)
    assert trail_m(0, trails.past).tolist() == [[10.0, 5.0], [9.0, 5.0], [8.0, 5.0]]


def test_where_the_motion_is_lost_a_trail_begins_anew() -> None:
    """No state for 4 s: nobody knows where earlier places are now."""
    trails = Trails()
    driven(trails, 1.0)
    for time_s in (0.0, 0.5, 1.0, 5.0):
        trails.add_view(view(time_s, (10.0, 5.0)), NO_MOUNT)
    assert len(trail_m(0, trails.past)) == 1
    driven(trails, 6.0, start_s=5.5)
    for time_s in (5.7, 6.0):
        trails.add_view(view(time_s, (10.0, 5.0)), NO_MOUNT)
    assert len(trail_m(0, trails.past)) == 2


def test_a_trail_is_no_longer_than_it_should_and_no_scan_is_kept_for_ever() -> None:
    trails = Trails()
    for index in range(400):
        trails.add_view(view(0.3 * index, (1.0, 2.0)), NO_MOUNT)
    assert len(trails.past) == TRAIL_NS // 300_000_000 + 1
    for index in range(400):
        trails.add_view(view(200.0 + 0.001 * index, (1.0, 2.0)), NO_MOUNT)
    assert len(trails.past) == MAX_PAST


def test_a_clock_set_back_and_a_track_unknown_leave_nothing() -> None:
    trails = Trails()
    for stamp_s in (10.0, 10.3, 2.0):
        trails.add_view(view(stamp_s, (1.0, 2.0)), NO_MOUNT)
    assert len(trails.past) == 1
    assert trail_m(99, trails.past).shape == trail_m(0, ()).shape == (0, 2)
