"""Straight walls in the radar frame of a scan, with the covariance of position and direction, and their combination."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from models.perception.track.estimate import linear_update
from models.physics.mirror import wall_from_ends
from msgs.values.perception import Wall

RADAR = np.zeros(2)
#: Points along a wall that stand for the whole of it.
_SAMPLES = np.linspace(-1.0, 1.0, 17)[:, None]
#: Least standard deviations: a perfect fit is still no exact wall.
_LEAST_OFFSET_M, _LEAST_ANGLE_RAD = 1e-3, 1e-4


@dataclass(frozen=True)
class WallLine:
    """A stretch of wall: its middle [2], unit normal towards the radar [2] and half length [m].

    `covariance` [2, 2] of (offset at the middle, direction); an offset grows away from the normal.
    """

    middle_m: np.ndarray
    normal: np.ndarray
    half_m: float
    covariance: np.ndarray
    end_std_m: float = 0.0

    @classmethod
    def between(cls, ends_m: np.ndarray, offset_std_m: float, angle_std_rad: float, end_std_m: float = 0.0) -> WallLine:
        """Return the wall between two ends [2, 2]; `ValueError` where they coincide."""
        normal, _ = wall_from_ends(ends_m[0], ends_m[1], RADAR)
        half_m = 0.5 * float(np.hypot(*(ends_m[1] - ends_m[0])))
        stds = max(offset_std_m, _LEAST_OFFSET_M), max(angle_std_rad, _LEAST_ANGLE_RAD)
        return cls(ends_m.mean(axis=0), normal, half_m, np.diag(np.square(stds)), end_std_m)

    @classmethod
    def of(cls, wall: Wall) -> WallLine:
        """Return a measured wall."""
        return cls.between(np.array(wall.ends_m), wall.offset_std_m, wall.angle_std_rad)

    @property
    def tangent(self) -> np.ndarray:
        """Unit vector along the wall, the normal turned to the left."""
        return np.array([-self.normal[1], self.normal[0]])

    @property
    def offset_m(self) -> float:
        """Distance of the line from the radar; negative where a correction moved it to the other side."""
        return -float(self.normal @ self.middle_m)

    @property
    def ends_m(self) -> np.ndarray:
        """Ends [2, 2], the lower along the tangent first."""
        return self.middle_m + np.array([[-self.half_m], [self.half_m]]) * self.tangent

    @property
    def samples_m(self) -> np.ndarray:
        """Points along the stretch [17, 2], its ends among them."""
        return self.middle_m + self.half_m * _SAMPLES * self.tangent

    @property
    def range_m(self) -> float:
        """Distance of the stretch from the radar."""
        along_m = float(np.clip(self.along_m(RADAR), -self.half_m, self.half_m))
        return float(np.hypot(*(self.middle_m + along_m * self.tangent)))

    def along_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return the coordinates of points [N, 2] along the wall, from its middle [N]."""
        return np.asarray((points_m - self.middle_m) @ self.tangent)

    def height_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return the heights of points [N, 2] over the line, positive on the radar's side [N]."""
        return np.asarray((points_m - self.middle_m) @ self.normal)

    def gap_m(self, other: WallLine) -> float:
        """Return the gap between two stretches along this one, negative where they overlap."""
        low_m, high_m = np.sort(self.along_m(other.ends_m))
        return float(max(low_m - self.half_m, -self.half_m - high_m))

    def common_m(self, other: WallLine) -> float:
        """Return the middle of the stretch that both have in common, or of their gap, along this one."""
        low_m, high_m = np.clip(np.sort(self.along_m(other.ends_m)), -self.half_m, self.half_m)
        return 0.5 * float(low_m + high_m)

    def trimmed_m(self, trim_m: float) -> np.ndarray:
        """Return the ends [2, 2] drawn in by a length, by a quarter of the wall at most."""
        return self.middle_m + (self.ends_m - self.middle_m) * max(1.0 - trim_m / max(self.half_m, 1e-9), 0.5)

    def variance_at(self, along_m: np.ndarray) -> np.ndarray:
        """Return the variance of the offset at places along the wall [N], m^2 [N]."""
        (offset, both), (_, angle) = self.covariance
        return np.asarray(offset + 2.0 * along_m * both + along_m**2 * angle)

    def corrected(self, factors: np.ndarray, off: np.ndarray, noise: np.ndarray) -> WallLine:
        """Return the line after measurements [M] of (offset, direction) by `factors` [M, 2], covariance [M, M]."""
        gain, covariance = linear_update(self.covariance, factors, noise)
        shift_m, turn_rad = gain @ off
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        normal = np.array([[cos, -sin], [sin, cos]]) @ self.normal
        return replace(self, middle_m=self.middle_m - shift_m * self.normal, normal=normal, covariance=covariance)

    def seen_at(self, other: WallLine) -> tuple[np.ndarray, np.ndarray]:
        """Return this line as a measurement of another: (offset, direction) at its middle, covariance; or inf."""
        own = self.facing(other)
        across = float(own.normal @ other.normal)
        turn_rad = math.atan2(other.normal[0] * own.normal[1] - other.normal[1] * own.normal[0], across)
        height_m = float(own.normal @ (own.middle_m - other.middle_m)) / across if across > 1e-6 else -math.inf
        to_middle = np.array([[1.0, float(own.along_m(other.middle_m))], [0.0, 1.0]])
        return np.array([-height_m, turn_rad]), to_middle @ own.covariance @ to_middle.T

    def facing(self, other: WallLine) -> WallLine:
        """Return the line with its normal turned to the side of another's."""
        if float(self.normal @ other.normal) >= 0.0:
            return self
        # the offset and the coordinate along the line change their signs, the direction does not
        return replace(self, normal=-self.normal, covariance=self.covariance * np.array([[1.0, -1.0], [-1.0, 1.0]]))

    def reaching(self, points_m: np.ndarray) -> WallLine:
        """Return the stretch of the line between the feet of the outermost of points [N, 2]."""
        along_m = self.along_m(points_m)
        low_m, high_m = float(along_m.min()), float(along_m.max())
        shift_m = 0.5 * (low_m + high_m)
        move = np.array([[1.0, shift_m], [0.0, 1.0]])
        covariance = move @ self.covariance @ move.T
        middle_m = self.middle_m + shift_m * self.tangent
        return replace(self, middle_m=middle_m, half_m=0.5 * (high_m - low_m), covariance=covariance)

    def as_wall(self, inliers: int) -> Wall:
        """Return the message value, its normal towards the radar."""
        sign = -1.0 if self.offset_m < 0.0 else 1.0
        (ax, ay), (bx, by) = self.ends_m.tolist()
        return Wall(
            normal=(float(sign * self.normal[0]), float(sign * self.normal[1])),
            offset_m=sign * self.offset_m,
            ends_m=((ax, ay), (bx, by)),
            inliers=inliers,
            angle_std_rad=math.sqrt(self.covariance[1, 1]),
            offset_std_m=math.sqrt(self.covariance[0, 0]),
        )
