"""When a hidden object comes into sight: the walls that count, and the steps ahead."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.track.appearance import STEPS_S, Outlook, RecentWalls, radar_ahead
from models.perception.track.odometry import OdometryPose
from msgs.values.frames import Pose2
from msgs.values.perception import Wall

#: From the radar at the origin it hides what lies beyond x = 10, between the rays to its ends.
WALL = Wall(normal=(-1.0, 0.0), offset_m=10.0, ends_m=((10.0, -5.0), (10.0, 5.0)), inliers=9)


def outlook() -> Outlook:
    return Outlook(np.zeros((len(STEPS_S), 2)), *RecentWalls().add(0, [WALL], Pose2()))


def test_an_object_appears_when_its_nose_passes_the_edge():
    """At x = 20 the wall hides |y| < 10. From y = 4 at 2 m/s with the nose 2 m ahead: y + 2 = 10 after 2 s."""
    view = outlook()
    hidden = view.hidden(np.array([20.0, 4.0, 0.0, 2.0]))
    assert view.time_to_appear_s(hidden) == pytest.approx(2.0, abs=0.11)


@pytest.mark.parametrize(("speed_mps", "hidden_all"), [(0.49, True), (3.0, False)])
def test_slow_objects_count_as_standing(speed_mps: float, hidden_all: bool):
    """From y = 7.5 with 6 s ahead: at 0.49 m/s its nose would pass y = 10, but it counts as standing."""
    view = outlook()
    hidden = view.hidden(np.array([20.0, 7.5, 0.0, speed_mps]))
    assert hidden.all() == hidden_all
    assert (view.time_to_appear_s(hidden) is None) == hidden_all


def test_the_radar_drives_on_round_its_circle():
    """4 m/s and 0.5 rad/s, mounted 2 m ahead: after t the vehicle is at 8 (sin t/2, 1 - cos t/2), turned by t/2."""
    ahead_m = radar_ahead(OdometryPose(0, Pose2(), 4.0, 0.5), Pose2(2.0))[::10]
    for number, turn in enumerate((0.0, 0.5, 1.0)):
        expected = 8.0 * np.array([math.sin(turn), 1.0 - math.cos(turn)]) + 2.0 * np.array(
            [math.cos(turn), math.sin(turn)]
        )
        np.testing.assert_allclose(ahead_m[number], expected, atol=1e-9)


def test_walls_are_kept_in_the_odometry_frame_as_long_as_stated():
    """Two scans 1 s apart, the radar 3 m on: both walls count; a second later the first has gone."""
    walls = RecentWalls()
    walls.add(0, [WALL], Pose2())
    a, _ = walls.add(1_000_000_000, [WALL], Pose2(3.0))
    np.testing.assert_allclose(a, [[10.0, -5.0], [13.0, -5.0]])
    a, _ = walls.add(2_000_000_000, [], Pose2(6.0))
    np.testing.assert_allclose(a, [[13.0, -5.0]])
    walls.clear()
    assert len(walls.add(2_000_000_000, [], Pose2())[0]) == 0


def test_a_radar_at_rest_is_where_each_step_ahead_would_put_it() -> None:
    """To the byte: the least motion there is takes the way of all steps, and moves it by less than rounding."""
    mounted = Pose2(3.7, -0.4, 0.2)
    at_rest = OdometryPose(0, Pose2(17.3, -5.1, 0.7), 0.0, 0.0)
    least = at_rest._replace(speed_mps=5e-324)
    np.testing.assert_array_equal(radar_ahead(at_rest, mounted), radar_ahead(least, mounted))
