"""Convolutional perfectly matched layer (CPML): graded profiles and the recursion's coefficients.

Stretching s = kappa + sigma / (alpha + jw eps0) along one axis; sigma and kappa rise outwards, alpha falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SPEED_OF_LIGHT_MPS = 299_792_458.0
VACUUM_PERMITTIVITY_F_PER_M = 8.854_187_812_8e-12
VACUUM_IMPEDANCE_OHM = 1.0 / (SPEED_OF_LIGHT_MPS * VACUUM_PERMITTIVITY_F_PER_M)
#: Power of the grading of sigma and kappa.
ORDER = 3.0
#: alpha at the inner end as a share of w eps0 at the frequency of interest, 0 at the outer one.
ALPHA_SHARE = 0.02


@dataclass(frozen=True)
class CpmlParams:
    """Shape of a layer."""

    #: Thickness in cells.
    cells: int = 40
    #: Round-trip amplitude that the continuous layer would let back at the design angle.
    leak: float = 1e-9
    #: kappa at the outer end, 1 at the inner one.
    kappa_max: float = 4.0

    def __post_init__(self) -> None:
        if self.cells < 1:
            raise ValueError(f"cells must be at least 1, got {self.cells!r}")
        if not (0.0 < self.leak < 1.0 and self.kappa_max >= 1.0):
            raise ValueError(f"CPML needs 0 < leak < 1, kappa_max >= 1, got {self!r}")


@dataclass(frozen=True)
class Cpml:
    """Coefficients at given depths: psi <- decay psi + drive dF, derivative dF inverse_kappa + psi (float64)."""

    decay: np.ndarray
    drive: np.ndarray
    inverse_kappa: np.ndarray


def recursion(
    sigma_s_per_m: np.ndarray, kappa: np.ndarray, alpha_s_per_m: np.ndarray, step_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the decay b = exp(-x) and drive c = sigma (b - 1) / (kappa (sigma + kappa alpha)), x = (sigma/kappa +
    alpha) dt/eps0.

    b - 1 by expm1 in float64: formed as exp(-x) - 1 in float32 it loses every digit once x < 1e-7.
    """
    exponent = (sigma_s_per_m / kappa + alpha_s_per_m) * step_s / VACUUM_PERMITTIVITY_F_PER_M
    scale = kappa * (sigma_s_per_m + kappa * alpha_s_per_m)
    share = np.divide(sigma_s_per_m, scale, out=np.zeros_like(exponent), where=scale > 0.0)
    return np.exp(-exponent), share * np.expm1(-exponent)


def layer(
    params: CpmlParams, depth: np.ndarray, cell_m: float, normal_index: float, step_s: float, frequency_hz: float
) -> Cpml:
    """Return the coefficients at `depth` (cells into the layer; 0 and less: outside of it), float64, shape of depth.

    `normal_index` is k_normal / k0 of the wave to be absorbed: sigma_max = -(m + 1) ln(leak) / (2 eta0 d normal_index).
    """
    share = np.clip(np.asarray(depth, np.float64) / params.cells, 0.0, 1.0)
    thickness_m = params.cells * cell_m
    peak = -(ORDER + 1.0) * np.log(params.leak) / (2.0 * VACUUM_IMPEDANCE_OHM * thickness_m * normal_index)
    grading = share**ORDER
    sigma, kappa = peak * grading, 1.0 + (params.kappa_max - 1.0) * grading
    angular_hz = 2.0 * np.pi * frequency_hz
    alpha = np.where(share > 0.0, ALPHA_SHARE * angular_hz * VACUUM_PERMITTIVITY_F_PER_M * (1.0 - share), 0.0)
    decay, drive = recursion(sigma, kappa, alpha, step_s)
    return Cpml(np.where(share > 0.0, decay, 0.0), drive, 1.0 / kappa)
