"""Walls over scans: one line, seen in parts from a vehicle that moves, is one wall."""

from __future__ import annotations

import math

import numpy as np

from models.perception.see.wall_elements import WallElements, grown_walls, weighed_together
from models.perception.see.wall_memory import EARLIER_SCANS, RadarPose, WallMemory
from msgs.values.frames import Pose2

#: A wall along x, 8 m to the left of the start, as the odometry frame has it.
WALL_Y_M = 8.0


def pose(number: int) -> RadarPose:
    """2 m further along a bend of 3 deg a scan."""
    return RadarPose(0, Pose2(2.0 * number, 0.1 * number, math.radians(3.0 * number)))


def seen(number: int, first_m: float, last_m: float) -> WallElements:
    """Elements of a part of the wall, every 0.5 m, in the frame of the radar."""
    radar_from_odom = pose(number).odom_from_radar.inverse()
    x_m = np.arange(first_m, last_m, 0.5)
    place_m = radar_from_odom.apply(np.column_stack([x_m, np.full(len(x_m), WALL_Y_M)]))
    turn_rad = radar_from_odom.yaw_rad
    toward = np.tile([-math.sin(turn_rad), math.cos(turn_rad)], (len(x_m), 1))
    return WallElements(place_m, toward, np.full(len(x_m), 0.9))


def test_parts_of_a_wall_of_several_scans_are_one_wall() -> None:
    memory, scans = WallMemory(), [seen(number, 4.0 * number, 4.0 * number + 5.0) for number in range(4)]
    for number, elements in enumerate(scans):
        memory.move(pose(number))
        earlier = memory.earlier()
        memory.add(elements)
    walls, _ = grown_walls(weighed_together([scans[-1], *earlier]))
    (wall,) = walls
    radar_from_odom = pose(3).odom_from_radar.inverse()
    ends_m = radar_from_odom.apply(np.array([[0.0, WALL_Y_M], [16.5, WALL_Y_M]]))
    np.testing.assert_allclose(sorted(map(tuple, wall.ends_m)), sorted(map(tuple, ends_m)), atol=1e-6)
    # alone, the last scan shows its own five metres
    (alone,), _ = grown_walls(scans[-1])
    np.testing.assert_allclose(math.dist(*alone.ends_m), 4.5, atol=1e-6)


def test_scans_are_forgotten_with_their_odometry_frame_and_after_a_while() -> None:
    memory = WallMemory()
    for number in range(2 * EARLIER_SCANS):
        memory.move(pose(number))
        memory.add(seen(number, 0.0, 2.0))
    assert len(memory.earlier()) == EARLIER_SCANS
    memory.move(RadarPose(1, Pose2()))
    assert memory.earlier() == []
    memory.add(seen(0, 0.0, 2.0))
    assert len(memory.earlier()) == 1
    memory.move(None)
    assert memory.earlier() == []
    memory.move(RadarPose(1, Pose2()))
    assert memory.earlier() == []


def test_a_line_passed_by_the_radar_is_seen_from_its_other_side() -> None:
    """A wall across the road, 5 m ahead, of which the radar has passed the line: its foot lies behind."""
    memory = WallMemory()
    ahead = WallElements(np.array([[5.0, 3.0]]), np.array([[1.0, 0.0]]), np.array([0.5]))
    memory.move(RadarPose(0, Pose2()))
    memory.add(ahead)
    memory.move(RadarPose(0, Pose2(6.0, 0.0, 0.0)))
    (carried,) = memory.earlier()
    np.testing.assert_allclose(carried.place_m, [[-1.0, 3.0]])
    np.testing.assert_allclose(carried.toward, [[-1.0, 0.0]])
