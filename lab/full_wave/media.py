"""Media a time-stepped grid can carry: relative permittivity and conductivity that give eps at one frequency.

A constant complex eps is unstable in the time domain; eps_r and sigma with eps = eps_r - j sigma / (w eps0) are not.
"""

from __future__ import annotations

import math

import numpy as np

from lab.full_wave.cpml import VACUUM_PERMITTIVITY_F_PER_M

Layers = tuple[tuple[complex, float], ...]

#: Least eps_r of a good conductor as a share of its loss: its waves would else want a thousandfold shorter steps.
#: It moves r of metal by less than 1e-6: displacement current is nothing beside conduction.
CONDUCTOR_SHARE = 1e-3


def checked_layers(layers: Layers) -> Layers:
    """Return the layers, front first: passive, Re(eps) >= 1, positive thickness, infinite only the last; else
    ValueError.
    """
    if not layers:
        raise ValueError("layers must hold at least one (permittivity, thickness_m)")
    for index, (permittivity, thickness_m) in enumerate(layers):
        eps = complex(permittivity)
        if not (math.isfinite(abs(eps)) and eps.real >= 1.0 and eps.imag <= 0.0):
            raise ValueError(f"layers[{index}]: permittivity must be finite, Re >= 1, Im <= 0, got {permittivity!r}")
        endless = math.isinf(thickness_m) and index == len(layers) - 1
        if not (thickness_m > 0.0 and (math.isfinite(thickness_m) or endless)):
            raise ValueError(
                f"layers[{index}]: thickness_m must be positive, infinite only in the last, got {thickness_m!r}"
            )
    return tuple((complex(permittivity), float(thickness_m)) for permittivity, thickness_m in layers)


def real_medium(permittivity: complex | np.ndarray, frequency_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Return eps_r and sigma [S/m], float64 of the input's shape, of a complex permittivity at a frequency."""
    permittivity = np.asarray(permittivity, np.complex128)
    loss = -permittivity.imag
    sigma = loss * 2.0 * math.pi * frequency_hz * VACUUM_PERMITTIVITY_F_PER_M
    return np.maximum(permittivity.real, CONDUCTOR_SHARE * loss), sigma


def electric_coefficients(eps_r: np.ndarray, sigma: np.ndarray, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return E <- a E + b c dt curl(eta0 H): a = (1 - l) / (1 + l), b = 1 / (eps_r (1 + l)), l = sigma dt / (2 eps).

    The mean of old and new E carries the current: stable for every sigma, second order in dt.
    """
    eps_r = np.asarray(eps_r, np.float64)
    loss = np.asarray(sigma, np.float64) * step_s / (2.0 * VACUUM_PERMITTIVITY_F_PER_M * eps_r)
    return (1.0 - loss) / (1.0 + loss), 1.0 / (eps_r * (1.0 + loss))
