"""Odometry from speed and yaw rate without its bias: a frame that drifts slowly and never jumps."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import deque
from typing import NamedTuple

from models.perception.track.yaw_rate_bias import BiasEstimate, YawRateBias
from msgs.values.frames import Pose2
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion

#: Largest number of states that wait for a scan: 10 s at 100 a second.
MAX_WAITING_STATES = 1000


#: A state holds this long; after a longer silence, or a clock that went back, a new frame begins.
MAX_GAP_S = 1.0
#: Poses are kept this long for queries about the past.
HISTORY_S = 5.0


class OdometryPose(NamedTuple):
    """The vehicle at a time: pose `odom_from_vehicle` in frame number `frame`, speed, yaw rate without bias."""

    frame: int
    odom_from_vehicle: Pose2
    speed_mps: float
    yaw_rate_rps: float


class _StampedPose(NamedTuple):
    """A pose with the motion measured there."""

    stamp_ns: int
    pose: Pose2
    speed_mps: float
    yaw_rate_rps: float


class Odometry:
    """Integrator of vehicle states to poses; a change of the frame number invalidates old poses."""

    def __init__(self) -> None:
        self._poses: deque[_StampedPose] = deque()
        self._frame = 0
        self._bias = YawRateBias()

    @property
    def yaw_rate_bias(self) -> BiasEstimate:
        """The bias that is subtracted from the newest yaw rate."""
        return self._bias.estimate(self._poses[-1].stamp_ns if self._poses else 0)

    @property
    def yaw_rate_bias_rps(self) -> float:
        """Its value; zero while none is known."""
        return self.yaw_rate_bias.rps

    @property
    def driving_bias(self) -> BiasEstimate:
        """Bias from driving alone, accurate enough to be subtracted or not."""
        return self._bias.driving

    def add(self, state: VehicleState) -> None:
        """Take in a state; states that are not valid, late or repeated are ignored."""
        if not state.valid or self._is_late(state.stamp_ns):
            return
        pose = self._next_pose(state)
        yaw_rate_rps = self._bias.corrected(state)
        self._poses.append(_StampedPose(state.stamp_ns, pose, state.speed_mps, yaw_rate_rps))
        while self._poses[0].stamp_ns < state.stamp_ns - ns_from_s(HISTORY_S):
            self._poses.popleft()

    def at(self, stamp_ns: int) -> OdometryPose | None:
        """Return the vehicle's pose at a time, None where no state is near enough."""
        index = bisect_right(self._poses, stamp_ns, key=lambda pose: pose.stamp_ns) - 1
        if index < 0:
            return None
        start = self._poses[index]
        elapsed_s = s_from_ns(stamp_ns - start.stamp_ns)
        if elapsed_s > MAX_GAP_S:
            return None
        after = self._poses[index + 1] if index + 1 < len(self._poses) else start
        share = elapsed_s / max(s_from_ns(after.stamp_ns - start.stamp_ns), elapsed_s, 1e-9)
        speed_mps = start.speed_mps + share * (after.speed_mps - start.speed_mps)
        yaw_rate_rps = start.yaw_rate_rps + share * (after.yaw_rate_rps - start.yaw_rate_rps)
        return OdometryPose(self._frame, _moved(start, speed_mps, yaw_rate_rps, elapsed_s), speed_mps, yaw_rate_rps)

    def _is_late(self, stamp_ns: int) -> bool:
        """Return whether a stamp lies behind the newest, but not so far that the clock must have been set back."""
        return bool(self._poses) and 0 <= self._poses[-1].stamp_ns - stamp_ns <= ns_from_s(MAX_GAP_S)

    def _next_pose(self, state: VehicleState) -> Pose2:
        """Return the pose at a new state: the trapezoid of both motions, or the origin of a new frame."""
        if self._poses:
            last = self._poses[-1]
            elapsed_s = s_from_ns(state.stamp_ns - last.stamp_ns)
            if 0.0 < elapsed_s <= MAX_GAP_S:
                self._bias.add(state, elapsed_s)
                return _moved(last, state.speed_mps, self._bias.corrected(state), elapsed_s)
            self._poses.clear()
            self._frame += 1
        self._bias.interrupt()
        self._bias.add(state, 0.0)
        return Pose2()


class ScanOdometry:
    """The vehicle at each scan's stamp, from the states stamped at or before it, whatever order they arrive in.

    States wait, sorted, until a scan queries a time; older ones that arrive later are too late. The result depends on
    the states alone: a graph, a replay and a chain in one process agree.
    """

    def __init__(self) -> None:
        self._odometry = Odometry()
        self._waiting: list[VehicleState] = []
        self._last_query_ns: int | None = None
        self._has_state = False

    def add(self, state: VehicleState) -> None:
        """Take in a state."""
        insort(self._waiting, state, key=_order)
        # bound the queue where no scans arrive
        if len(self._waiting) > MAX_WAITING_STATES:
            self._take(1)

    def at(self, stamp_ns: int) -> OdometryPose | None:
        """Return the vehicle's pose at a scan's stamp: `stationary_pose` before any state, None where none is near."""
        last_query_ns, self._last_query_ns = self._last_query_ns, stamp_ns
        if last_query_ns is not None and last_query_ns - stamp_ns > ns_from_s(MAX_GAP_S):
            # the clock was set back: waiting states from before would be used again later
            self._waiting = [state for state in self._waiting if state.stamp_ns <= last_query_ns]
        self._take(bisect_right(self._waiting, stamp_ns, key=lambda state: state.stamp_ns))
        return self.before(stamp_ns)

    def before(self, stamp_ns: int) -> OdometryPose | None:
        """Return the vehicle's pose at a time no later than the last scan's, as `at` does; it takes in no state."""
        return self._odometry.at(stamp_ns) if self._has_state else stationary_pose()

    @property
    def yaw_rate_bias(self) -> BiasEstimate:
        """The bias that is subtracted from the newest yaw rate in use."""
        return self._odometry.yaw_rate_bias

    def _take(self, count: int) -> None:
        for state in self._waiting[:count]:
            self._odometry.add(state)
        del self._waiting[:count]
        self._has_state |= count > 0


def _order(state: VehicleState) -> tuple[int, float, float, bool]:
    """Return the sort key: the stamp, then the values, so that the order of arrival has no effect."""
    return state.stamp_ns, state.speed_mps, state.yaw_rate_rps, state.valid


def stationary_pose() -> OdometryPose:
    """Return the pose of a radar that never moves, in a frame of its own."""
    return OdometryPose(-1, Pose2(), 0.0, 0.0)


def odom_from_radar_after(pose: OdometryPose, vehicle_from_radar: Pose2, elapsed_s: float) -> Pose2:
    """Return the radar's pose `odom_from_radar` a time after that of `pose`, or before it; its motion is held."""
    return pose.odom_from_vehicle @ ego_motion(pose.speed_mps, pose.yaw_rate_rps, elapsed_s) @ vehicle_from_radar


def _moved(start: _StampedPose, speed_mps: float, yaw_rate_rps: float, elapsed_s: float) -> Pose2:
    """Return the pose after a time over which the motion changes linearly to the given one."""
    mean = 0.5 * (start.speed_mps + speed_mps), 0.5 * (start.yaw_rate_rps + yaw_rate_rps)
    return start.pose @ ego_motion(*mean, elapsed_s)
