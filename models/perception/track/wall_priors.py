"""Wall priors of a vehicle: messages of maps and other sensors, moved by odometry to the time of a scan."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable

import numpy as np

from models.perception.track.odometry import OdometryPose
from models.perception.track.wall_fusion import (
    HEADING_STD_RAD_PER_M,
    MAX_AGE_S,
    PLACE_STD_M_PER_M,
    PlacedPrior,
    ScanReturns,
    fused,
)
from models.perception.track.wall_lines import WallLine
from msgs.values.environment import PriorWall, WallPriors
from msgs.values.frames import Pose2
from msgs.values.perception import Wall
from msgs.values.units import ns_from_s

#: Messages of a source that wait for the scan of their time, and sources; those longest silent are forgotten.
MAX_WAITING_MESSAGES, MAX_SOURCES = 64, 8

#: Stamp -> the vehicle's pose at that time, None where no state is near enough.
PoseAt = Callable[[int], OdometryPose | None]


class WallPriorStore:
    """The newest walls of each source at any scan, whatever order messages arrive in within a source's stamps."""

    def __init__(self) -> None:
        self._messages: OrderedDict[str, deque[WallPriors]] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self._messages)

    def add(self, message: WallPriors) -> None:
        """Take in the walls of a source."""
        self._messages.setdefault(message.source, deque(maxlen=MAX_WAITING_MESSAGES)).append(message)
        self._messages.move_to_end(message.source)
        if len(self._messages) > MAX_SOURCES:
            self._messages.popitem(last=False)

    def at(self, stamp_ns: int, pose_at: PoseAt, vehicle_from_radar: Pose2) -> list[PlacedPrior]:
        """Return the priors of a scan in its radar frame: of each source those stamped last, within `MAX_AGE_S`."""
        priors: list[PlacedPrior] = []
        for messages in self._messages.values():
            message = self._newest(messages, stamp_ns)
            if message is not None:
                priors += self._placed(message, stamp_ns, pose_at, vehicle_from_radar)
        return priors

    def _newest(self, messages: deque[WallPriors], stamp_ns: int) -> WallPriors | None:
        """Return the message with the last stamp in time; of two with the same, the one that came later."""
        oldest_ns = stamp_ns - ns_from_s(MAX_AGE_S)
        timely = [message for message in messages if oldest_ns <= message.stamp_ns <= stamp_ns]
        return max(reversed(timely), key=lambda message: message.stamp_ns, default=None)

    def _placed(
        self, message: WallPriors, stamp_ns: int, pose_at: PoseAt, vehicle_from_radar: Pose2
    ) -> list[PlacedPrior]:
        now_from_then = _motion(message.stamp_ns, stamp_ns, pose_at)
        if now_from_then is None:
            return []
        radar_from_then = vehicle_from_radar.inverse() @ now_from_then
        driven_m = math.hypot(now_from_then.x_m, now_from_then.y_m)
        return [PlacedPrior(message.source, self._line(wall, radar_from_then, driven_m)) for wall in message.walls]

    def _line(self, wall: PriorWall, radar_from_then: Pose2, driven_m: float) -> WallLine:
        """Return a prior in the radar frame, as uncertain as odometry has made it meanwhile."""
        offset_m = math.hypot(wall.offset_std_m, PLACE_STD_M_PER_M * driven_m)
        angle_rad = math.hypot(wall.angle_std_rad, HEADING_STD_RAD_PER_M * driven_m)
        ends_m = radar_from_then.apply(np.array(wall.ends_m))
        return WallLine.between(ends_m, offset_m, angle_rad, wall.end_std_m)

    def fused(
        self,
        priors: list[PlacedPrior],
        points_m: np.ndarray,
        covariance_m2: np.ndarray,
        walls: list[Wall],
        wall_of_point: np.ndarray,
    ) -> tuple[list[Wall], np.ndarray]:
        """Return the walls of a scan fused with priors, as `models.perception.mirrors.peaks_to_view.WallPrior` has
        them."""
        return fused(priors, ScanReturns(points_m, covariance_m2, wall_of_point), walls)


def _motion(then_ns: int, now_ns: int, pose_at: PoseAt) -> Pose2 | None:
    """Return `now_from_then` of the vehicle, None where it is not known."""
    if then_ns == now_ns:
        return Pose2()
    then, now = pose_at(then_ns), pose_at(now_ns)
    if then is None or now is None or then.frame != now.frame:
        return None
    return now.odom_from_vehicle.inverse() @ then.odom_from_vehicle
