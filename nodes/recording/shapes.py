"""Shared parts of the formats of `bag convert`: the account of a conversion, walls as lines, odometry from states."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from models.perception.track.yaw_rate_bias import YawRateBias
from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.frames import Pose2
from msgs.values.perception import Wall
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion

#: Two states further apart say nothing of what lay between them.
MAX_STATE_GAP_S = 1.0
#: Display only: the plane has no heights.
OBJECT_HEIGHT_M = 1.5
POINT_SIZE_M = 0.3
WALL_WIDTH_M = 0.15

_ARC_POINTS = 17
_STRAIGHT_PER_M = 1e-6

#: Red, green, blue, opacity, 0 to 1.
Colour = tuple[float, float, float, float]
WALL_COLOUR: Colour = (0.16, 0.40, 0.80, 1.0)
OBJECT_COLOUR: Colour = (0.90, 0.30, 0.10, 0.7)
POINT_COLOUR: Colour = (0.95, 0.55, 0.10, 1.0)
DIRECT_COLOUR: Colour = (0.50, 0.50, 0.50, 1.0)
TRACK_COLOUR: Colour = (0.70, 0.10, 0.60, 1.0)
TRUTH_COLOUR: Colour = (0.10, 0.65, 0.25, 0.5)


class Account:
    """Account of the messages of a recording: written, left out on purpose, or lost; by topic or by reason."""

    def __init__(self) -> None:
        self.written: Counter[str] = Counter()
        self.left_out: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()

    def leave_out(self, topic: str, reason: str) -> None:
        """Take a message that was counted as written back: it was passed over on purpose."""
        self.written[topic] -= 1
        self.left_out[f"{topic}: {reason}"] += 1

    def lose(self, topic: str, reason: str) -> None:
        """Take a message that was counted as written back: it has no place and is lost."""
        self.written[topic] -= 1
        self.lost[f"{topic}: {reason}"] += 1


def counted(
    reader: RecordingReader, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> Iterator[Recorded]:
    """Messages of some topics in order of their sending, each written down as converted when the next is asked for."""
    for recorded in reader.messages(topics):
        account.written[recorded.topic] += 1
        yield recorded
        advance()


class Odometry:
    """The vehicle's pose since its first valid state, integrated from speed and yaw rate alone: it drifts.

    The bias of the yaw rate is taken off once it is known, as the perception does.
    """

    #: Why a state brings no pose.
    REFUSED = "not valid, or not newer than the one before"

    def __init__(self) -> None:
        self.odom_from_vehicle = Pose2()
        self._last: VehicleState | None = None
        self._bias = YawRateBias()
        self._yaw_rate_rps = 0.0

    def advance(self, state: VehicleState) -> Pose2 | None:
        """Pose at a state, by the exact arc of the mean of two states; None where the state is not valid or not newer.

        Over a gap of more than `MAX_STATE_GAP_S` the pose stays where it was.
        """
        if not state.valid or (self._last is not None and state.stamp_ns <= self._last.stamp_ns):
            return None
        last, self._last = self._last, state
        elapsed_s = 0.0 if last is None else s_from_ns(state.stamp_ns - last.stamp_ns)
        is_gap = elapsed_s > MAX_STATE_GAP_S
        if is_gap:
            self._bias.interrupt()
        self._bias.add(state, 0.0 if is_gap else elapsed_s)
        before_rps, self._yaw_rate_rps = self._yaw_rate_rps, self._bias.corrected(state)
        if last is not None and not is_gap:
            speed_mps, yaw_rate_rps = 0.5 * (last.speed_mps + state.speed_mps), 0.5 * (before_rps + self._yaw_rate_rps)
            self.odom_from_vehicle = self.odom_from_vehicle @ ego_motion(speed_mps, yaw_rate_rps, elapsed_s)
        return self.odom_from_vehicle


def wall_line_m(wall: Wall) -> list[tuple[float, float]]:
    """A wall as a polyline in metres: its two ends, or 17 points of its arc, hollow towards the normal."""
    (ax, ay), (bx, by) = wall.ends_m
    half_m, bend_per_m = 0.5 * math.hypot(bx - ax, by - ay), abs(wall.curvature_per_m)
    if bend_per_m < _STRAIGHT_PER_M or half_m == 0.0 or bend_per_m * half_m >= 1.0:
        return [(ax, ay), (bx, by)]
    # it brings compiled kernels along, which a bridge without curved walls does without
    from models.physics.curved_mirror import arc_points

    # an arc bends to the left of the way from end to end, a wall towards its normal
    left = wall.normal[1] * (bx - ax) - wall.normal[0] * (by - ay)
    curvature_per_m = math.copysign(1.0, left) * wall.curvature_per_m
    points_m = arc_points(np.array((ax, ay)), np.array((bx, by)), curvature_per_m, np.linspace(0.0, 1.0, _ARC_POINTS))
    return [(float(x_m), float(y_m)) for x_m, y_m in points_m]


def quaternion_zw(yaw_rad: float) -> tuple[float, float]:
    """z and w of the quaternion of a turn about z; x and y are 0."""
    return math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)


def stamp_parts(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds; a negative stamp becomes 0, which these formats cannot go below."""
    seconds, nanoseconds = divmod(max(stamp_ns, 0), NANOSECONDS_PER_SECOND)
    return seconds, nanoseconds
