"""Kalman estimate of an object's position and velocity, nearly constant, in the odometry frame, at any time.

Joseph's form and symmetric covariances stay positive definite whatever is rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msgs.values.units import s_from_ns

#: Measurement matrix of a state (x, y, vx, vy).
MEASURED = np.eye(2, 4)


@dataclass(frozen=True)
class Estimate:
    """State (x, y, vx, vy) [m, m/s] of an object in the odometry frame at a time, with its covariance [4, 4]."""

    stamp_ns: int
    mean: np.ndarray
    covariance: np.ndarray

    def at(self, stamp_ns: int, density_m2ps3: float) -> Estimate:
        """Return the state at another time, before or after; uncertainty grows either way."""
        if stamp_ns == self.stamp_ns:
            return self
        elapsed_s = s_from_ns(stamp_ns - self.stamp_ns)
        step = np.eye(4) + elapsed_s * np.eye(4, k=2)
        covariance = step @ self.covariance @ step.T + motion_noise(elapsed_s, density_m2ps3)
        return Estimate(stamp_ns, step @ self.mean, symmetric(covariance))

    def updated(self, position_m: np.ndarray, measurement_covariance_m2: np.ndarray) -> Estimate:
        """Return the state after a position measurement."""
        return self._corrected(MEASURED, position_m - self.mean[:2], measurement_covariance_m2)

    def updated_along(self, direction: np.ndarray, speed_mps: float, std_mps: float) -> Estimate:
        """Return the state after a measurement of the velocity's part along a unit vector [2]."""
        matrix = np.concatenate([np.zeros(2), direction])[None]
        return self._corrected(matrix, np.array([speed_mps - matrix[0] @ self.mean]), np.array([[std_mps**2]]))

    def _corrected(self, matrix: np.ndarray, innovation: np.ndarray, covariance: np.ndarray) -> Estimate:
        """Return the state after a linear measurement."""
        gain, after = linear_update(self.covariance, matrix, covariance)
        return Estimate(self.stamp_ns, self.mean + gain @ innovation, symmetric(after))


def linear_update(covariance: np.ndarray, matrix: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Kalman gain [N, M] and covariance [N, N] after a linear measurement by `matrix` with `noise`; Joseph."""
    spread = matrix @ covariance @ matrix.T + noise
    gain = np.linalg.solve(spread, matrix @ covariance).T
    rest = np.eye(len(covariance)) - gain @ matrix
    return gain, rest @ covariance @ rest.T + gain @ noise @ gain.T


def motion_noise(elapsed_s: float, density_m2ps3: float) -> np.ndarray:
    """Return the covariance [4, 4] that white acceleration adds over a time, which may be negative."""
    # back in time only the covariance of position and velocity changes its sign
    length_s, cross = abs(elapsed_s), 0.5 * elapsed_s * abs(elapsed_s)
    block = np.array([[length_s**3 / 3.0, cross], [cross, length_s]])
    return density_m2ps3 * np.kron(block, np.eye(2))


def mixture(weights: Sequence[float], estimates: Sequence[Estimate]) -> Estimate:
    """Return the Gaussian of a mixture of estimates of one time (else `ValueError`); weights positive, sum 1."""
    stamps_ns = {estimate.stamp_ns for estimate in estimates}
    if len(stamps_ns) != 1:
        raise ValueError(f"estimates of a mixture must be of one time, got {len(stamps_ns)}")
    if len(estimates) == 1:
        return estimates[0]
    share, means = np.asarray(weights, np.float64), np.array([estimate.mean for estimate in estimates])
    mean = share @ means
    offsets = means - mean
    covariance = np.einsum("k,kij->ij", share, np.array([estimate.covariance for estimate in estimates]))
    return Estimate(stamps_ns.pop(), mean, symmetric(covariance + (share * offsets.T) @ offsets))


def symmetric(matrix: np.ndarray) -> np.ndarray:
    """Return the symmetric part of a square matrix."""
    return 0.5 * (matrix + matrix.T)
