"""Vehicle state (topic `vehicle/state`)."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

from msgspec import Meta

from msgs.values.arrays import AngleRad, Checked, Seconds, SpeedMps, StampNs
from msgs.values.frames import Pose2, wrap_angle

#: In both directions; beyond any vehicle.
MAX_YAW_RATE_RPS = 1e3


class VehicleState(Checked, frozen=True, kw_only=True):
    """Speed and yaw rate of the vehicle at a time; counts only while `valid`."""

    label: ClassVar[str] = "vehicle"

    stamp_ns: StampNs
    speed_mps: SpeedMps = 0.0
    yaw_rate_rps: Annotated[float, Meta(ge=-MAX_YAW_RATE_RPS, le=MAX_YAW_RATE_RPS)] = 0.0
    #: At the steering wheel, positive to the left; 0.0 also if it is not measured.
    steering_rad: AngleRad = 0.0
    valid: bool = True
    #: Why it is not valid, empty if it is.
    reason: str = ""
    #: Age of the oldest signal used.
    age_s: Seconds = 0.0
    #: Speed of the right wheels less that of the left ones, positive in a left turn; None if unknown.
    wheel_speed_difference_mps: SpeedMps | None = None


def ego_motion(speed_mps: float, yaw_rate_rps: float, elapsed_s: float) -> Pose2:
    """Return `start_from_now` after constant speed and yaw rate (exact arc, straight line as the yaw rate vanishes)."""
    yaw_rad = yaw_rate_rps * elapsed_s
    half_rad = 0.5 * yaw_rad
    # sin(a)/a: the chord of an arc, finite and smooth through zero
    chord_m = speed_mps * elapsed_s * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    return Pose2(chord_m * math.cos(half_rad), chord_m * math.sin(half_rad), wrap_angle(yaw_rad))
