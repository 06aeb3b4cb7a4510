"""Walls over scans: what earlier scans showed of walls, carried by odometry into the frame of the present one."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from models.perception.see.wall_elements import WallElements
from msgs.values.frames import Pose2

#: Scans that are remembered beside the present one: over a second, in which odometry errs by centimetres.
EARLIER_SCANS = 4


class RadarPose(NamedTuple):
    """Pose of a radar in an odometry frame of some number; poses of other frames do not compare."""

    frame: int
    odom_from_radar: Pose2


class WallMemory:
    """Wall elements of the last scans of one radar that moves; they are forgotten where the odometry frame ends."""

    def __init__(self) -> None:
        self._pose: RadarPose | None = None
        self._scans: deque[tuple[RadarPose, WallElements]] = deque(maxlen=EARLIER_SCANS)

    def move(self, pose: RadarPose | None) -> None:
        """Take in the radar's pose of the scan to come; None: not known."""
        if pose is None or (self._pose is not None and self._pose.frame != pose.frame):
            self._scans.clear()
        self._pose = pose

    def earlier(self) -> list[WallElements]:
        """Return the elements of earlier scans in the frame of the radar at its pose; none without a pose."""
        if self._pose is None:
            return []
        radar_from_odom = self._pose.odom_from_radar.inverse()
        return [carried(elements, radar_from_odom @ before.odom_from_radar) for before, elements in self._scans]

    def add(self, elements: WallElements) -> None:
        """Remember the elements of the scan at the pose, in its own frame."""
        if self._pose is not None:
            self._scans.append((self._pose, elements))


def carried(elements: WallElements, radar_from_earlier: Pose2) -> WallElements:
    """Return elements in another frame; the foot of a line may lie on its other side there."""
    place_m = radar_from_earlier.apply(elements.place_m)
    turn_rad = radar_from_earlier.yaw_rad
    rotation = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    toward = elements.toward @ rotation.T
    side = np.where(np.sum(place_m * toward, axis=1) < 0.0, -1.0, 1.0)
    return WallElements(place_m, side[:, None] * toward, elements.probability)
