"""Straight walls as fitted lines: their likelihood against scattered points, and weighted total least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from msgs.perception import Wall

#: An inlier's residual stays within this many standard deviations.
INLIER_SIGMAS = 3.0
#: Density of scattered points about a line: one in this many metres across it.
SCATTER_WIDTH_M = 8.0


@dataclass(frozen=True)
class LineFit:
    """A fitted line n.x + offset = 0 with n towards the radar, the points it stands on and its uncertainty."""

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
        """The value that travels."""
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


def line_gain(
    points_m: np.ndarray, covariance_m2: np.ndarray, normals: np.ndarray, offsets_m: np.ndarray
) -> np.ndarray:
    """What each point [N] adds to each line's [H] score, zero for outliers; float64 [H, N].

    log(scatter width / (sqrt(2 pi) sigma)) - d^2 / (2 sigma^2) with sigma^2 = n' C n, the error across the line.
    """
    residual = normals @ points_m.T + offsets_m[:, None]
    # n' C n written out: the three products of the normal against the three entries of each covariance
    squares = np.stack([normals[:, 0] ** 2, 2.0 * normals[:, 0] * normals[:, 1], normals[:, 1] ** 2], axis=1)
    entries = np.stack([covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]])
    variance = squares @ entries
    return residual_gain(residual, variance)


def residual_gain(residual_m: np.ndarray, variance_m2: np.ndarray) -> np.ndarray:
    """The same of residuals across a wall and their variances, of one shape."""
    normed = residual_m**2 / variance_m2
    gain = np.log(SCATTER_WIDTH_M / math.sqrt(2.0 * math.pi)) - 0.5 * np.log(variance_m2) - 0.5 * normed
    return np.where(normed <= INLIER_SIGMAS**2, np.maximum(gain, 0.0), 0.0)


def fit_line(
    points_m: np.ndarray, covariance_m2: np.ndarray, rounds: int = 3
) -> tuple[np.ndarray, float, float, float]:
    """Weighted total least squares: normal [2], offset [m], angle and offset standard deviation at the middle.

    Weights are the inverse variances across the line, so they follow the line: iterated. The uncertainty is that of
    the weights, inflated where the residuals are larger than they promise. Needs two distinct points.
    """
    xx, xy, yy = covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]
    weights = 1.0 / (xx + yy)
    for _ in range(rounds):
        centre = weights @ points_m / weights.sum()
        dx, dy = (points_m - centre).T
        # principal axis of the weighted scatter, in closed form
        angle_rad = 0.5 * math.atan2(2.0 * weights @ (dx * dy), weights @ (dx * dx - dy * dy))
        normal = np.array([-math.sin(angle_rad), math.cos(angle_rad)])
        weights = 1.0 / (normal[0] ** 2 * xx + 2.0 * normal[0] * normal[1] * xy + normal[1] ** 2 * yy)
    offset_m = -float(normal @ centre)
    if offset_m < 0.0:  # the radar, at the origin, stands on the side the normal points to
        normal, offset_m = -normal, -offset_m
    along = (points_m - centre) @ np.array([-normal[1], normal[0]])
    chi_square = float(weights @ (points_m @ normal + offset_m) ** 2)
    inflate = max(1.0, chi_square / max(len(points_m) - 2, 1))
    angle_variance = inflate / max(float(weights @ along**2), 1e-12)
    middle = 0.5 * (along.min() + along.max())
    offset_variance = inflate / float(weights.sum()) + middle**2 * angle_variance
    return normal, offset_m, math.sqrt(angle_variance), math.sqrt(offset_variance)
