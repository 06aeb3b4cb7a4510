"""Reflection of plane waves by flat walls: half-space, slab, stack of layers, and the coherent share of a rough one.

Time convention e^{+jwt}: passive media have Im(eps) <= 0, waves inside decay as e^{-jqz} with Im(q) <= 0.
TE: electric field along the wall's vertical when the ray is horizontal, so vertical polarisation at an upright wall;
it is the default everywhere. The sign of TM is that of Eq. (13): opposite to TE at normal incidence.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from models.compiled import compiled

Polarisation = Literal["te", "tm"]


def _inner_cosine(permittivity: np.ndarray, cos_theta: np.ndarray) -> np.ndarray:
    """Return q = sqrt((eps - 1) + cos^2) of the inner wave, decaying (Im q <= 0); exact at grazing."""
    q = np.sqrt(np.asarray(permittivity, np.complex128) - 1.0 + np.square(cos_theta))
    # the principal root of a number with Im <= 0 has Im <= 0; -0.0 and +0.0 parts of lossless media need the rule said
    return np.where(q.imag > 0.0, -q, q)


def half_space_reflection(
    permittivity: np.ndarray, cos_theta: np.ndarray, polarisation: Polarisation = "te"
) -> np.ndarray:
    """Return the complex field reflection of a half-space, Eq. (13) (broadcast); ValueError if active, or no cosine."""
    return _half_space(*_checked(permittivity, cos_theta), polarisation)[0]


def slab_reflection(
    permittivity: np.ndarray,
    cos_theta: np.ndarray,
    thickness_m: np.ndarray,
    wavelength_m: float,
    polarisation: Polarisation = "te",
) -> np.ndarray:
    """Return the complex field reflection of one slab in air (broadcast); an infinite thickness is a half-space.

    r (1 - p) / (1 - r^2 p) with p = exp(-2j k q d), by 1 - p and 1 - r^2, which keep their digits for the thinnest film
    and at grazing. ValueError for a negative thickness.
    """
    permittivity, cos_theta = _checked(permittivity, cos_theta)
    r, kept = _half_space(permittivity, cos_theta, polarisation)
    lost = _round_trip_loss(permittivity, cos_theta, thickness_m, wavelength_m)
    denominator = kept + r**2 * lost
    # 0/0 as r -> -1 and p -> 1 together (grazing): there the half-space value is the limit
    return np.where(denominator == 0.0, r, r * lost / np.where(denominator == 0.0, 1.0, denominator))


def slab_transmission(
    permittivity: np.ndarray,
    cos_theta: np.ndarray,
    thickness_m: np.ndarray,
    wavelength_m: float,
    polarisation: Polarisation = "te",
) -> np.ndarray:
    """Return the complex field transmission through one slab in air (broadcast): (1 - r^2) e^{-jkqd} / (1 - r^2 p)."""
    permittivity, cos_theta = _checked(permittivity, cos_theta)
    r, kept = _half_space(permittivity, cos_theta, polarisation)
    once = _passage(permittivity, cos_theta, thickness_m, wavelength_m)
    denominator = kept + r**2 * _round_trip_loss(permittivity, cos_theta, thickness_m, wavelength_m)
    return np.where(denominator == 0.0, 0.0, kept * once / np.where(denominator == 0.0, 1.0, denominator))


def stack_reflection(
    permittivities: Sequence[complex] | np.ndarray,
    thicknesses_m: Sequence[float] | np.ndarray,
    cos_theta: np.ndarray,
    wavelength_m: float,
    polarisation: Polarisation = "te",
) -> np.ndarray:
    """Return the complex field reflection of layers in air, the first one facing the wave (shape of `cos_theta`).

    `permittivities`, `thicknesses_m` [layers], the last may be infinite. From the back, r = (rho + r' p) / (1 + rho r'
    p). ValueError for an empty stack, lengths that differ, an active medium, a negative or inner infinite thickness.
    """
    layers, cos_theta = _checked_stack(permittivities, thicknesses_m, cos_theta)
    return _walk(layers, cos_theta, wavelength_m, polarisation)[0]


def stack_transmission(
    permittivities: Sequence[complex] | np.ndarray,
    thicknesses_m: Sequence[float] | np.ndarray,
    cos_theta: np.ndarray,
    wavelength_m: float,
    polarisation: Polarisation = "te",
) -> np.ndarray:
    """Return the complex field transmission through layers into air, as `stack_reflection`; 0 into a half-space."""
    layers, cos_theta = _checked_stack(permittivities, thicknesses_m, cos_theta)
    return _walk(layers, cos_theta, wavelength_m, polarisation)[1]


def coherent_power(roughness_m: np.ndarray, cos_theta: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Return the power share exp(-(4 pi s cos / lambda)^2) left by a bounce at a rough wall (Gaussian, Kirchhoff)."""
    return np.exp(-np.square(4.0 * np.pi * np.asarray(roughness_m) * cos_theta / wavelength_m))


def diffuse_share(roughness_m: np.ndarray, cos_theta: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Return the share that `coherent_power` leaves (broadcast); ValueError: negative roughness, no cosine."""
    roughness_m, cos_theta = np.asarray(roughness_m, np.float64), np.asarray(cos_theta, np.float64)
    if not np.all((roughness_m >= 0.0) & np.isfinite(roughness_m)):
        raise ValueError(f"roughness_m must be finite and not negative, got {roughness_m!r}")
    if not np.all((cos_theta >= 0.0) & (cos_theta <= 1.0 + 1e-12)):
        raise ValueError(f"cos_theta must lie in 0..1, got {cos_theta!r}")
    return -np.expm1(-np.square(4.0 * np.pi * roughness_m * cos_theta / wavelength_m))


def _walk(
    layers: list[tuple[np.ndarray, float]], cos_theta: np.ndarray, wavelength_m: float, polarisation: Polarisation
) -> tuple[np.ndarray, np.ndarray]:
    """Return reflection and transmission of a stack, interface by interface from the back to the front."""
    air = np.asarray(1.0 + 0.0j)
    reflected, transmitted = np.zeros(cos_theta.shape, np.complex128), np.ones(cos_theta.shape, np.complex128)
    behind = air
    for medium, thickness_m in reversed(layers):
        rho, tau = _interface(medium, behind, cos_theta, polarisation)
        reflected, transmitted = _add_interface(rho, tau, reflected, transmitted)
        once = _passage(medium, cos_theta, np.asarray(thickness_m), wavelength_m)
        reflected, transmitted = reflected * once**2, transmitted * once
        behind = medium
    rho, tau = _interface(air, behind, cos_theta, polarisation)
    return _add_interface(rho, tau, reflected, transmitted)


def _add_interface(
    rho: np.ndarray, tau: np.ndarray, reflected: np.ndarray, transmitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a stack with one more interface in front of it; `reflected` is seen from that interface."""
    denominator = 1.0 + rho * reflected
    # 0/0 as rho -> -1 meets a wave that comes back whole (grazing): there the interface alone is the limit
    empty = denominator == 0.0
    safe = np.where(empty, 1.0, denominator)
    return np.where(empty, rho, (rho + reflected) / safe), np.where(empty, 0.0, tau * transmitted / safe)


def _interface(
    front: np.ndarray, behind: np.ndarray, cos_theta: np.ndarray, polarisation: Polarisation
) -> tuple[np.ndarray, np.ndarray]:
    """Return reflection and transmission (TE: of E; TM: of H, the sign of Eq. (13)) where two media meet."""
    outer, inner = _inner_cosine(front, cos_theta), _inner_cosine(behind, cos_theta)
    if polarisation == "tm":
        outer, inner = behind * outer, front * inner
    total = outer + inner
    # two equal media at grazing: there is no reflection
    empty = total == 0.0
    safe = np.where(empty, 1.0, total)
    return np.where(empty, 0.0, (outer - inner) / safe), np.where(empty, 1.0, 2.0 * outer / safe)


def _checked_stack(
    permittivities: Sequence[complex] | np.ndarray, thicknesses_m: Sequence[float] | np.ndarray, cos_theta: np.ndarray
) -> tuple[list[tuple[np.ndarray, float]], np.ndarray]:
    """Return layers as (permittivity, thickness_m) and the cosines; ValueError as `stack_reflection` says."""
    media, cos_theta = _checked(np.asarray(permittivities), cos_theta)
    thicknesses = np.asarray(thicknesses_m, np.float64)
    if media.ndim != 1 or media.size == 0 or media.shape != thicknesses.shape:
        raise ValueError(
            f"a stack needs one thickness for each of at least one layer, got {media.shape} and {thicknesses.shape}"
        )
    if np.isinf(thicknesses[:-1]).any():
        raise ValueError(f"only the last layer of a stack may be endless, got thicknesses_m {thicknesses.tolist()}")
    return [(medium, float(thickness)) for medium, thickness in zip(media, thicknesses, strict=True)], cos_theta


def _half_space(
    permittivity: np.ndarray, cos_theta: np.ndarray, polarisation: Polarisation
) -> tuple[np.ndarray, np.ndarray]:
    """Return Eq. (13) of a half-space: r, and 1 - r^2 = 4 outer q / (outer + q)^2, which does not cancel at grazing."""
    q = _inner_cosine(permittivity, cos_theta)
    outer = cos_theta if polarisation == "te" else permittivity * cos_theta
    total = outer + q
    # eps = 1 at grazing: there is no reflection, 0/0 means 0
    empty = total == 0.0
    safe = np.where(empty, 1.0, total)
    return np.where(empty, 0.0, (outer - q) / safe), np.where(empty, 1.0, 4.0 * (outer / safe) * (q / safe))


def _passage(
    permittivity: np.ndarray, cos_theta: np.ndarray, thickness_m: np.ndarray, wavelength_m: float
) -> np.ndarray:
    """Return exp(-j k q d), zero where the thickness is infinite."""
    exponent, endless = _exponent(permittivity, cos_theta, thickness_m, wavelength_m)
    return np.where(endless, 0.0, np.exp(exponent))


def _round_trip_loss(
    permittivity: np.ndarray, cos_theta: np.ndarray, thickness_m: np.ndarray, wavelength_m: float
) -> np.ndarray:
    """Return 1 - exp(-2j k q d) to all digits, one where the thickness is infinite."""
    exponent, endless = _exponent(permittivity, cos_theta, thickness_m, wavelength_m)
    return np.where(endless, 1.0, -np.expm1(2.0 * exponent))


def _exponent(
    permittivity: np.ndarray, cos_theta: np.ndarray, thickness_m: np.ndarray, wavelength_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return -j k q d, zero for infinite thicknesses, and a mask of those; ValueError for a negative one."""
    thickness_m = np.asarray(thickness_m, np.float64)
    if np.any(thickness_m < 0.0) or np.isnan(thickness_m).any():
        raise ValueError(f"thickness_m must not be negative, got {thickness_m.min()!r}")
    endless = np.isinf(thickness_m)
    depth = 2.0 * np.pi / wavelength_m * np.where(endless, 0.0, thickness_m)
    return -1j * depth * _inner_cosine(permittivity, cos_theta), endless


def _checked(permittivity: np.ndarray, cos_theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs as arrays; ValueError unless passive and 0 <= cos <= 1."""
    permittivity = np.asarray(permittivity, np.complex128)
    cos_theta = np.asarray(cos_theta, np.float64)
    if np.any(permittivity.imag > 0.0):
        raise ValueError(f"permittivity must have Im <= 0 (e^{{+jwt}}), got {permittivity!r}")
    if not np.all((cos_theta >= 0.0) & (cos_theta <= 1.0 + 1e-12)):
        raise ValueError(f"cos_theta must lie in 0..1, got {cos_theta!r}")
    return permittivity, np.minimum(cos_theta, 1.0)


# --- one wave at one wall, for callers that are compiled themselves: the same laws without their checks


@compiled(error_model="numpy")
def half_space_at(permittivity, cos_theta, is_tm):  # type: ignore[no-untyped-def]
    """Return `half_space_reflection` of one wave, and 1 - r^2."""
    q = _inner_cosine_at(permittivity, cos_theta)
    outer = permittivity * cos_theta if is_tm else complex(cos_theta)
    total = outer + q
    if total == 0.0:
        return 0.0j, 1.0 + 0.0j
    return (outer - q) / total, 4.0 * (outer / total) * (q / total)


@compiled(error_model="numpy")
def slab_at(permittivity, cos_theta, thickness_m, wavelength_m):  # type: ignore[no-untyped-def]
    """Return `slab_reflection` of one wave (TE), and that of the slab's front face alone."""
    r, kept = half_space_at(permittivity, cos_theta, False)
    if math.isinf(thickness_m):
        return r, r
    exponent = -2j * (2.0 * np.pi / wavelength_m * thickness_m) * _inner_cosine_at(permittivity, cos_theta)
    # 1 - e^x to all digits
    grown, half = math.exp(exponent.real), math.sin(0.5 * exponent.imag)
    lost = -complex(
        math.expm1(exponent.real) * math.cos(exponent.imag) - 2.0 * half * half, grown * math.sin(exponent.imag)
    )
    denominator = kept + r * r * lost
    return (r if denominator == 0.0 else r * lost / denominator), r


@compiled(error_model="numpy")
def stack_at(permittivities, thicknesses_m, cos_theta, wavelength_m):  # type: ignore[no-untyped-def]
    """Return `stack_reflection` of one wave (TE), and that of the front face alone."""
    reflected, behind = 0.0j, 1.0 + 0.0j
    for layer in range(len(permittivities) - 1, -2, -1):
        front = permittivities[layer] if layer >= 0 else 1.0 + 0.0j
        outer, inner = _inner_cosine_at(front, cos_theta), _inner_cosine_at(behind, cos_theta)
        rho = (outer - inner) / (outer + inner) if outer + inner != 0.0 else 0.0j
        denominator = 1.0 + rho * reflected
        reflected = (rho + reflected) / denominator if denominator != 0.0 else rho
        if layer >= 0:
            once = 0.0j
            if not math.isinf(thicknesses_m[layer]):
                once = cmath.exp(-1j * (2.0 * np.pi / wavelength_m * thicknesses_m[layer]) * outer)
            reflected *= once * once
        behind = front
    return reflected, half_space_at(permittivities[0], cos_theta, False)[0]


@compiled(error_model="numpy")
def _inner_cosine_at(permittivity, cos_theta):  # type: ignore[no-untyped-def]
    q = cmath.sqrt(permittivity - 1.0 + cos_theta * cos_theta)
    return -q if q.imag > 0.0 else q
