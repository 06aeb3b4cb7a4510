"""Reflection of plane waves by flat walls: half-space, slab, and what roughness leaves of the mirror.

Time convention e^{+jwt}: passive media have Im(eps) <= 0, waves inside decay as e^{-jqz} with Im(q) <= 0.
TE: electric field along the wall's vertical when the ray is horizontal, so vertical polarisation at an upright wall;
it is the default everywhere. The sign of TM is that of Eq. (13): opposite to TE at normal incidence.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

Polarisation = Literal["te", "tm"]


def _inner_cosine(permittivity: np.ndarray, cos_theta: np.ndarray) -> np.ndarray:
    """q = sqrt(eps - sin^2) of the wave inside, on the branch that decays (Im q <= 0, and Re q >= 0 where lossless).

    eps - sin^2 is formed as (eps - 1) + cos^2: no cancellation at grazing.
    """
    q = np.sqrt(np.asarray(permittivity, np.complex128) - 1.0 + np.square(cos_theta))
    # the principal root of a number with Im <= 0 has Im <= 0; -0.0 and +0.0 parts of lossless media need the rule said
    return np.where(q.imag > 0.0, -q, q)


def half_space_reflection(
    permittivity: np.ndarray, cos_theta: np.ndarray, polarisation: Polarisation = "te"
) -> np.ndarray:
    """Complex field reflection coefficient of a half-space, Eq. (13) (broadcast); -1 at grazing, both ways.

    Raises ValueError for an active medium (Im(eps) > 0) or a cosine outside 0..1.
    """
    permittivity, cos_theta = _checked(permittivity, cos_theta)
    q = _inner_cosine(permittivity, cos_theta)
    outer = cos_theta if polarisation == "te" else permittivity * cos_theta
    total = outer + q
    # eps = 1 at grazing: nothing is there to reflect, 0/0 means 0
    return np.where(total == 0.0, 0.0, (outer - q) / np.where(total == 0.0, 1.0, total))


def slab_reflection(
    permittivity: np.ndarray,
    cos_theta: np.ndarray,
    thickness_m: np.ndarray,
    wavelength_m: float,
    polarisation: Polarisation = "te",
) -> np.ndarray:
    """Complex field reflection of one slab in air (broadcast); an infinite thickness is a half-space.

    r (1 - p) / (1 - r^2 p) with p = exp(-2j k q d): p only ever decays, so opaque slabs need no care (p -> 0).
    Raises ValueError for a negative thickness.
    """
    permittivity, cos_theta = _checked(permittivity, cos_theta)
    r = half_space_reflection(permittivity, cos_theta, polarisation)
    p = _round_trip(permittivity, cos_theta, thickness_m, wavelength_m, 2.0)
    denominator = 1.0 - r**2 * p
    # 0/0 as r -> -1 and p -> 1 together (grazing): there the half-space value is the limit
    return np.where(denominator == 0.0, r, r * (1.0 - p) / np.where(denominator == 0.0, 1.0, denominator))


def slab_transmission(
    permittivity: np.ndarray,
    cos_theta: np.ndarray,
    thickness_m: np.ndarray,
    wavelength_m: float,
    polarisation: Polarisation = "te",
) -> np.ndarray:
    """Complex field transmission through one slab in air (broadcast): (1 - r^2) e^{-jkqd} / (1 - r^2 p)."""
    permittivity, cos_theta = _checked(permittivity, cos_theta)
    r = half_space_reflection(permittivity, cos_theta, polarisation)
    once = _round_trip(permittivity, cos_theta, thickness_m, wavelength_m, 1.0)
    denominator = 1.0 - (r * once) ** 2
    return np.where(denominator == 0.0, 0.0, (1.0 - r**2) * once / np.where(denominator == 0.0, 1.0, denominator))


def coherent_power(roughness_m: np.ndarray, cos_theta: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Power share of the mirror left by one bounce at a rough wall, exp(-(4 pi s cos / lambda)^2).

    The field takes its square root. Gaussian heights, Kirchhoff regime.
    """
    return np.exp(-np.square(4.0 * np.pi * np.asarray(roughness_m) * cos_theta / wavelength_m))


def _round_trip(
    permittivity: np.ndarray, cos_theta: np.ndarray, thickness_m: np.ndarray, wavelength_m: float, passes: float
) -> np.ndarray:
    """exp(-j passes k q d), zero where the thickness is infinite."""
    thickness_m = np.asarray(thickness_m, np.float64)
    if np.any(thickness_m < 0.0) or np.isnan(thickness_m).any():
        raise ValueError(f"thickness_m must not be negative, got {thickness_m.min()!r}")
    endless = np.isinf(thickness_m)
    depth = passes * 2.0 * np.pi / wavelength_m * np.where(endless, 0.0, thickness_m)
    return np.where(endless, 0.0, np.exp(-1j * depth * _inner_cosine(permittivity, cos_theta)))


def _checked(permittivity: np.ndarray, cos_theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inputs as arrays; ValueError unless passive and 0 <= cos <= 1."""
    permittivity = np.asarray(permittivity, np.complex128)
    cos_theta = np.asarray(cos_theta, np.float64)
    if np.any(permittivity.imag > 0.0):
        raise ValueError(f"permittivity must have Im <= 0 (e^{{+jwt}}), got {permittivity!r}")
    if not np.all((cos_theta >= 0.0) & (cos_theta <= 1.0 + 1e-12)):
        raise ValueError(f"cos_theta must lie in 0..1, got {cos_theta!r}")
    return permittivity, np.minimum(cos_theta, 1.0)
