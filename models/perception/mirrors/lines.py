"""Straight walls as fitted lines: their likelihood against scattered points, and weighted total least squares."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from models.compiled import compiled
from msgs.values.perception import Wall

#: An inlier's residual stays within this many standard deviations.
INLIER_SIGMAS = 3.0
#: Density of scattered points about a line: one in this many metres across it.
SCATTER_WIDTH_M = 8.0
#: Gain of a point in a line's score at zero residual and a standard deviation of 1 m.
_GAIN_AT_1_M = math.log(SCATTER_WIDTH_M / math.sqrt(2.0 * math.pi))


@dataclass(frozen=True)
class LineFit:
    """A fitted line n.x + offset = 0 with n towards the radar, its points and its uncertainty."""

    normal: np.ndarray
    offset_m: float
    members: np.ndarray
    score: float
    ends_m: np.ndarray
    angle_std_rad: float
    offset_std_m: float
    #: Of an arc through the ends, positive where it is hollow towards the radar; the line is then its chord.
    curvature_per_m: float = 0.0

    @property
    def length_m(self) -> float:
        """Extent of the supporting points along the line."""
        return float(np.hypot(*(self.ends_m[1] - self.ends_m[0])))

    @property
    def tangent(self) -> np.ndarray:
        """Unit vector along the line, the normal turned to the left."""
        return np.array([-self.normal[1], self.normal[0]])

    def as_wall(self) -> Wall:
        """Return the message value."""
        (ax, ay), (bx, by) = self.ends_m.tolist()
        return Wall(
            normal=(float(self.normal[0]), float(self.normal[1])),
            offset_m=self.offset_m,
            ends_m=((ax, ay), (bx, by)),
            inliers=len(self.members),
            angle_std_rad=self.angle_std_rad,
            offset_std_m=self.offset_std_m,
            curvature_per_m=self.curvature_per_m,
        )


def claimed(count: int, fits: Iterable[LineFit]) -> np.ndarray:
    """Return which points, of so many, are on any of the walls; bool [count]."""
    taken = np.zeros(count, bool)
    for fit in fits:
        taken[fit.members] = True
    return taken


class Line(NamedTuple):
    """A line n.x + offset = 0 with n towards the radar, with the uncertainty of its direction and position."""

    nx: float
    ny: float
    offset_m: float
    angle_std_rad: float
    offset_std_m: float


@compiled(error_model="numpy")
def residual_gain(residual_m: float, variance_m2: float) -> float:
    """Return log(scatter width / (sqrt(2 pi) sigma)) - d^2 / (2 sigma^2) of a point, zero for outliers."""
    normed = residual_m * residual_m / variance_m2
    # most points are outliers of most lines: the logarithm is taken for the others only
    if not normed <= INLIER_SIGMAS * INLIER_SIGMAS:
        return 0.0
    return float(max(_GAIN_AT_1_M - 0.5 * math.log(variance_m2) - 0.5 * normed, 0.0))


@compiled(error_model="numpy")
def variance_across(covariance_m2: np.ndarray, nx: float, ny: float) -> float:
    """Return n' C n of one covariance [2, 2]."""
    return float(nx * nx * covariance_m2[0, 0] + 2.0 * nx * ny * covariance_m2[0, 1] + ny * ny * covariance_m2[1, 1])


@compiled(error_model="numpy")
def gains(points_m: np.ndarray, covariance_m2: np.ndarray, nx: float, ny: float, offset_m: float) -> np.ndarray:
    """Return what each point [N, 2] with covariance [N, 2, 2] adds to one line's score; float64 [N]."""
    out = np.empty(len(points_m))
    for i in range(len(points_m)):
        residual_m = nx * points_m[i, 0] + ny * points_m[i, 1] + offset_m
        out[i] = residual_gain(residual_m, variance_across(covariance_m2[i], nx, ny))
    return out


@compiled(error_model="numpy")
def fitted(points_m: np.ndarray, covariance_m2: np.ndarray, rounds: int) -> Line:
    """Return `fit_line` for callers that are compiled themselves."""
    count = len(points_m)
    weights = np.empty(count)
    for i in range(count):
        weights[i] = 1.0 / (covariance_m2[i, 0, 0] + covariance_m2[i, 1, 1])
    cx, cy, nx, ny = 0.0, 0.0, 0.0, 1.0
    for _ in range(rounds):
        cx, cy, angle_rad = _principal_axis(points_m, weights)
        nx, ny = -math.sin(angle_rad), math.cos(angle_rad)
        for i in range(count):
            weights[i] = 1.0 / variance_across(covariance_m2[i], nx, ny)
    offset_m = -(nx * cx + ny * cy)
    if offset_m < 0.0:  # the radar, at the origin, stands on the side the normal points to
        nx, ny, offset_m = -nx, -ny, -offset_m
    total, chi_square, moment, low, high = 0.0, 0.0, 0.0, math.inf, -math.inf
    for i in range(count):
        x, y = points_m[i]
        along = (y - cy) * nx - (x - cx) * ny
        total += weights[i]
        chi_square += weights[i] * (nx * x + ny * y + offset_m) ** 2
        moment += weights[i] * along * along
        low, high = min(low, along), max(high, along)
    inflate = max(1.0, chi_square / max(count - 2, 1))
    angle_variance = inflate / max(moment, 1e-12)
    middle = 0.5 * (low + high)
    return Line(nx, ny, offset_m, math.sqrt(angle_variance), math.sqrt(inflate / total + middle**2 * angle_variance))


@compiled(error_model="numpy")
def _principal_axis(points_m: np.ndarray, weights: np.ndarray) -> tuple[float, float, float]:
    """Return the centre of weighted points [N, 2] and the direction of their largest scatter [rad], in closed form."""
    total, cx, cy = 0.0, 0.0, 0.0
    for i in range(len(points_m)):
        total += weights[i]
        cx += weights[i] * points_m[i, 0]
        cy += weights[i] * points_m[i, 1]
    cx, cy = cx / total, cy / total
    product, difference = 0.0, 0.0
    for i in range(len(points_m)):
        dx, dy = points_m[i, 0] - cx, points_m[i, 1] - cy
        product += weights[i] * dx * dy
        difference += weights[i] * (dx * dx - dy * dy)
    return cx, cy, 0.5 * math.atan2(2.0 * product, difference)


def fit_line(points_m: np.ndarray, covariance_m2: np.ndarray) -> tuple[np.ndarray, float, float, float]:
    """Return the weighted total least squares: normal [2], offset [m], angle and offset std at the middle.

    Weights are inverse variances across the line, iterated; errors grow with residuals. Two distinct points.
    """
    # copied to the one layout for which the kernel is compiled
    line = fitted(np.array(points_m, np.float64), np.array(covariance_m2, np.float64), 3)
    return np.array([line.nx, line.ny]), line.offset_m, line.angle_std_rad, line.offset_std_m
