"""Vehicle state (topic `vehicle/state`)."""

from __future__ import annotations

import math

import msgspec

from msgs.values.arrays import require_finite, require_stamps, require_within
from msgs.values.frames import Pose2, wrap_angle

#: In both directions; beyond any vehicle, and within it every pose has finite doubles.
MAX_SPEED_MPS, MAX_YAW_RATE_RPS = 1e7, 1e4


class VehicleState(msgspec.Struct, frozen=True, kw_only=True):
    """Speed and yaw rate of the vehicle at a time; counts only while `valid`."""

    stamp_ns: int
    speed_mps: float = 0.0
    yaw_rate_rps: float = 0.0
    #: At the steering wheel, positive to the left; 0.0 also if it is not measured.
    steering_rad: float = 0.0
    valid: bool = True
    #: Why it is not valid, empty if it is.
    reason: str = ""
    #: Age of the oldest signal used.
    age_s: float = 0.0
    #: Speed of the right wheels less that of the left ones, positive in a left turn; None if unknown.
    wheel_speed_difference_mps: float | None = None

    def __post_init__(self) -> None:
        require_stamps("vehicle.stamp_ns", self.stamp_ns)
        require_finite("vehicle", self.speed_mps, self.yaw_rate_rps, self.steering_rad, self.age_s)
        require_within("vehicle.speed_mps", -MAX_SPEED_MPS, MAX_SPEED_MPS, self.speed_mps)
        if self.wheel_speed_difference_mps is not None:
            bound_mps = 2.0 * MAX_SPEED_MPS
            require_within("vehicle.wheel_speed_difference_mps", -bound_mps, bound_mps, self.wheel_speed_difference_mps)
        require_within("vehicle.yaw_rate_rps", -MAX_YAW_RATE_RPS, MAX_YAW_RATE_RPS, self.yaw_rate_rps)


def ego_motion(speed_mps: float, yaw_rate_rps: float, elapsed_s: float) -> Pose2:
    """Return `start_from_now` after constant speed and yaw rate (exact arc, straight line as the yaw rate vanishes)."""
    yaw_rad = yaw_rate_rps * elapsed_s
    half_rad = 0.5 * yaw_rad
    # sin(a)/a: the chord of an arc, finite and smooth through zero
    chord_m = speed_mps * elapsed_s * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    return Pose2(chord_m * math.cos(half_rad), chord_m * math.sin(half_rad), wrap_angle(yaw_rad))
