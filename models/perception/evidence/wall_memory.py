"""Walls over scans: what earlier scans showed of walls, carried by odometry into the frame of the present one."""

from __future__ import annotations

from collections import deque

import numpy as np

from models.perception.evidence.wall_elements import WallElements
from models.perception.objects.judging import RadarPose
from msgs.values.frames import Pose2

#: Scans that are remembered beside the present one: over a second, in which odometry errs by centimetres.
EARLIER_SCANS = 4


class WallMemory:
    """Wall elements of the last scans of a radar that moves; they are forgotten where the odometry frame ends."""

    def __init__(self) -> None:
        self._scans: deque[tuple[RadarPose, WallElements]] = deque(maxlen=EARLIER_SCANS)

    def earlier(self, pose: RadarPose | None) -> list[WallElements]:
        """Return the elements of earlier scans in the frame of the radar at a pose; none without a pose."""
        if pose is None or (self._scans and self._scans[-1][0].frame != pose.frame):
            self._scans.clear()
        if pose is None:
            return []
        radar_from_odom = pose.odom_from_radar.inverse()
        return [carried(elements, radar_from_odom @ before.odom_from_radar) for before, elements in self._scans]

    def add(self, pose: RadarPose | None, elements: WallElements) -> None:
        """Remember the elements of the scan at a pose, in its own frame."""
        if pose is not None:
            self._scans.append((pose, elements))


def carried(elements: WallElements, radar_from_earlier: Pose2) -> WallElements:
    """Return elements in another frame; the foot of a line may lie on its other side there."""
    place_m = radar_from_earlier.apply(elements.place_m)
    turn_rad = radar_from_earlier.yaw_rad
    rotation = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    toward = elements.toward @ rotation.T
    side = np.where(np.sum(place_m * toward, axis=1) < 0.0, -1.0, 1.0)
    return WallElements(place_m, side[:, None] * toward, elements.probability)
