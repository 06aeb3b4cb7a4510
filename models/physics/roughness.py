"""Effect of roughness on the mirror: the coherent share, the diffuse rest; Kirchhoff regime, no shadowing.

g = 4 pi s cos(theta) / lambda is the rms phase that heights of rms s put on a reflected wave.
"""

from __future__ import annotations

import numpy as np

from models.physics.fresnel import coherent_power


def phase_deviation_rad(roughness_m: np.ndarray, cos_theta: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Return the rms phase g = 4 pi s cos / lambda (broadcast); ValueError: negative roughness, no cosine."""
    roughness_m, cos_theta = np.asarray(roughness_m, np.float64), np.asarray(cos_theta, np.float64)
    if not np.all((roughness_m >= 0.0) & np.isfinite(roughness_m)):
        raise ValueError(f"roughness_m must be finite and not negative, got {roughness_m!r}")
    if not np.all((cos_theta >= 0.0) & (cos_theta <= 1.0 + 1e-12)):
        raise ValueError(f"cos_theta must lie in 0..1, got {cos_theta!r}")
    return 4.0 * np.pi * roughness_m * cos_theta / wavelength_m


def diffuse_share(roughness_m: np.ndarray, cos_theta: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Return the share 1 - exp(-g^2) of the reflected power that leaves the mirror direction (broadcast)."""
    return -np.expm1(-np.square(phase_deviation_rad(roughness_m, cos_theta, wavelength_m)))


def specular_gain(
    reflection: np.ndarray, roughness_m: np.ndarray, cos_theta: np.ndarray, wavelength_m: float
) -> np.ndarray:
    """Return alpha of Eq. (2): the power ratio |r|^2 exp(-g^2) of one bounce in the mirror direction (broadcast)."""
    return np.square(np.abs(reflection)) * coherent_power(roughness_m, cos_theta, wavelength_m)
