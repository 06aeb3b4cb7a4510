"""Plane poses and polar coordinates (REP-103: x forward, y left, azimuth counter-clockwise from x)."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from msgs.values.arrays import require_finite, require_within

#: Limit in both directions: its square, and the divisors of it, are finite doubles.
MAX_COORDINATE_M = 1e12
#: As beyond it a turn is no longer known to a millionth.
MAX_YAW_RAD = 1e6


class Pose2(msgspec.Struct, frozen=True):
    """Rigid transform of the plane, named `outer_from_inner`: maps inner coordinates [m] to outer ones [m]."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        require_finite("pose", self.x_m, self.y_m, self.yaw_rad)
        require_within("pose", -MAX_COORDINATE_M, MAX_COORDINATE_M, self.x_m, self.y_m)
        require_within("pose.yaw_rad", -MAX_YAW_RAD, MAX_YAW_RAD, self.yaw_rad)

    def __matmul__(self, inner: Pose2) -> Pose2:
        """Return the product: `a_from_b @ b_from_c` is `a_from_c`, inner names must meet."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(
            self.x_m + c * inner.x_m - s * inner.y_m,
            self.y_m + s * inner.x_m + c * inner.y_m,
            wrap_angle(self.yaw_rad + inner.yaw_rad),
        )

    def inverse(self) -> Pose2:
        """Return the inverse: `b_from_a` of an `a_from_b`."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, wrap_angle(-self.yaw_rad))

    def apply(self, points_m: np.ndarray) -> np.ndarray:
        """Transform points [..., 2] in metres."""
        return self.rotate(points_m) + np.array([self.x_m, self.y_m])

    def rotate(self, vectors: np.ndarray) -> np.ndarray:
        """Rotate vectors [..., 2] without translating them."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack([c * x - s * y, s * x + c * y], axis=-1)


class Mounting(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Place of a radar on its vehicle (forward, left) and its heading there (turned left), as files say it."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0

    @property
    def vehicle_from_radar(self) -> Pose2:
        """The mounting as a transform."""
        return Pose2(self.x_m, self.y_m, math.radians(self.yaw_deg))


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2.0 * math.pi)


def xy_from_polar(range_m: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return Cartesian points [..., 2] in metres of polar ones (broadcast)."""
    return np.stack(np.broadcast_arrays(range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)), axis=-1)


def polar_from_xy(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return range [m] and azimuth [rad] of points [..., 2] in metres."""
    return np.hypot(points_m[..., 0], points_m[..., 1]), np.arctan2(points_m[..., 1], points_m[..., 0])
