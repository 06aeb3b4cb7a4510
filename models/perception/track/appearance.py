"""Time until a hidden object comes into direct sight, where walls hide it from a radar that drives on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from models.perception.track.odometry import OdometryPose
from models.physics.mirror import blocked
from msgs.values.frames import Pose2
from msgs.values.perception import Wall
from msgs.values.units import ns_from_s
from msgs.values.vehicle import ego_motion

#: The prediction of direct sight: horizon and steps.
HORIZON_S, STEP_S = 6.0, 0.1
#: Times from now to the horizon [steps].
STEPS_S = STEP_S * np.arange(round(HORIZON_S / STEP_S) + 1)
#: An object comes into sight with its nose, so far ahead of the centre of its visible part.
NOSE_M = 2.0
#: Walls of scans this recent still block: a scan does not find every wall.
WALL_MEMORY_S = 1.5
#: Slower objects count as stationary: the time to appear then follows from the ego motion alone.
SLOW_MPS = 0.5


@dataclass(frozen=True)
class Outlook:
    """Radar positions from here on [steps, 2] and the ends of walls that hide, [W, 2] each; odometry frame."""

    radar_m: np.ndarray
    a: np.ndarray
    b: np.ndarray

    def hidden(self, state: np.ndarray) -> np.ndarray:
        """Return whether walls hide the nose of an object (x, y, vx, vy) now and in each step ahead, bool [steps]."""
        speed_mps = math.hypot(state[2], state[3])
        velocity = state[2:] if speed_mps > SLOW_MPS else np.zeros(2)
        nose_m = NOSE_M * velocity / max(speed_mps, SLOW_MPS)
        targets = state[:2] + nose_m + STEPS_S[:, None] * velocity
        return blocked(self.radar_m, targets, self.a, self.b)

    def time_to_appear_s(self, hidden: np.ndarray) -> float | None:
        """Return the time of the first step in sight, None where there is none within the horizon."""
        return None if hidden.all() else float(hidden.argmin()) * STEP_S


def radar_ahead(pose: OdometryPose, vehicle_from_radar: Pose2) -> np.ndarray:
    """Return the radar's positions [steps, 2] in the odometry frame at constant speed and yaw rate."""
    times_s = STEPS_S
    if pose.speed_mps == pose.yaw_rate_rps == 0.0:
        # at rest it stays where it is
        times_s = times_s[:1]
    motions = (ego_motion(pose.speed_mps, pose.yaw_rate_rps, float(time_s)) for time_s in times_s)
    poses = [pose.odom_from_vehicle @ motion @ vehicle_from_radar for motion in motions]
    positions_m = np.array([[radar_pose.x_m, radar_pose.y_m] for radar_pose in poses])
    return np.broadcast_to(positions_m, (len(STEPS_S), 2)).copy()


@dataclass(frozen=True)
class _ScanWalls:
    """Walls of one scan, ends a and b [W, 2] in the odometry frame."""

    stamp_ns: int
    a: np.ndarray
    b: np.ndarray


@dataclass
class RecentWalls:
    """Walls of the last scans."""

    _scans: list[_ScanWalls] = field(default_factory=list, init=False)

    def clear(self) -> None:
        """Drop all."""
        self._scans = []

    def add(self, stamp_ns: int, walls: Sequence[Wall], odom_from_radar: Pose2) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends [W, 2] in the odometry frame of the walls of this scan and of those shortly before."""
        oldest_ns = stamp_ns - ns_from_s(WALL_MEMORY_S)
        self._scans = [scan for scan in self._scans if scan.stamp_ns >= oldest_ns]
        ends = np.array([wall.ends_m for wall in walls], np.float64).reshape(-1, 2, 2)
        self._scans.append(_ScanWalls(stamp_ns, odom_from_radar.apply(ends[:, 0]), odom_from_radar.apply(ends[:, 1])))
        return np.concatenate([scan.a for scan in self._scans]), np.concatenate([scan.b for scan in self._scans])
