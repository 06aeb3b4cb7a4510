"""Backscatter of rain, snow and fog: radar cross section per volume of air [1/m], of spheres, co-polar."""

from __future__ import annotations

import math

import numpy as np

from models.physics.attenuation import water_permittivity, within
from msgs.values.units import SPEED_OF_LIGHT_MPS

#: |(eps - 1) / (eps + 2)|^2 of water, 3 to 30 GHz; of dry snow by its melted drops, over that of water (Smith 1984).
WATER_FACTOR, SNOW_OVER_WATER = 0.93, 0.224
#: Up to here drops are small against the wavelength, so that Rayleigh's law holds for rain and snow.
RAYLEIGH_MAX_HZ = 20e9
#: Drop sizes that Mie's series is summed over, mm, and the temperature of the drops.
DIAMETERS_MM = np.linspace(0.05, 8.0, 160)
DROP_TEMPERATURE_C = 10.0
#: Permittivity of ice at the radar's bands, and diameter of an ice sphere over that of its melted drop.
ICE_PERMITTIVITY, ICE_SWELLING = 3.17 - 0.003j, 0.917 ** (-1.0 / 3.0)


def reflectivity_per_m(
    frequency_hz: float, rain_mm_per_h: float = 0.0, snow_mm_per_h: float = 0.0, fog_g_per_m3: float = 0.0
) -> float:
    """Return the cross section per volume of what falls and floats [m2/m3]; snow counts as the water it melts to.

    Rayleigh: pi^5 |K|^2 Z / lambda^4 (Skolnik, Introduction to Radar Systems, Eq. 13.13). Rain: Z = 200 R^1.6 (Marshall
    and Palmer 1948) up to 20 GHz, above that Mie's series over their drop sizes N = 8000 exp(-4.1 R^-0.21 D) per m3
    and mm. Snow: Z = 1780 R^2.21 (Sekhon and Srivastava 1970), above 20 GHz less by what Mie's series takes off over
    their sizes as solid ice. Fog: Z = 0.048 M^2 (Atlas 1954). ValueError outside 1..1000 GHz and for a negative amount.
    """
    within("frequency_hz", frequency_hz, 1e9, 1000e9)
    rain = within("rain_mm_per_h", rain_mm_per_h, 0.0, 300.0)
    snow = within("snow_mm_per_h", snow_mm_per_h, 0.0, 300.0)
    fog = within("fog_g_per_m3", fog_g_per_m3, 0.0, 10.0)
    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    from_fog = _rayleigh_per_m(wavelength_m, 0.048 * fog**2)
    return from_fog + _rain_per_m(wavelength_m, rain) + _snow_per_m(wavelength_m, snow)


def _rain_per_m(wavelength_m: float, rain: float) -> float:
    if rain == 0.0 or SPEED_OF_LIGHT_MPS / wavelength_m <= RAYLEIGH_MAX_HZ:
        return _rayleigh_per_m(wavelength_m, 200.0 * rain**1.6)
    number = 8000.0 * np.exp(-4.1 * rain**-0.21 * DIAMETERS_MM)
    permittivity = water_permittivity(SPEED_OF_LIGHT_MPS / wavelength_m, DROP_TEMPERATURE_C)
    return _sum_of_sizes(number * mie_cross_section_m2(1e-3 * DIAMETERS_MM, wavelength_m, permittivity))


def _snow_per_m(wavelength_m: float, snow: float) -> float:
    rayleigh = _rayleigh_per_m(wavelength_m, SNOW_OVER_WATER * 1780.0 * snow**2.21)
    if snow == 0.0 or SPEED_OF_LIGHT_MPS / wavelength_m <= RAYLEIGH_MAX_HZ:
        return rayleigh
    number = np.exp(-2.29 * snow**-0.45 * DIAMETERS_MM)
    diameter_m = 1e-3 * ICE_SWELLING * DIAMETERS_MM
    contrast = abs((ICE_PERMITTIVITY - 1.0) / (ICE_PERMITTIVITY + 2.0)) ** 2
    small = math.pi**5 * contrast * diameter_m**6 / wavelength_m**4
    exact = mie_cross_section_m2(diameter_m, wavelength_m, ICE_PERMITTIVITY)
    # a trace of snow has no size large enough to sum over
    return rayleigh * _sum_of_sizes(number * exact) / max(_sum_of_sizes(number * small), 1e-300)


def _rayleigh_per_m(wavelength_m: float, z_mm6_per_m3: float) -> float:
    return math.pi**5 * WATER_FACTOR * 1e-18 * z_mm6_per_m3 / wavelength_m**4


def _sum_of_sizes(density: np.ndarray) -> float:
    return float(np.sum(density) * (DIAMETERS_MM[1] - DIAMETERS_MM[0]))


def mie_cross_section_m2(diameter_m: np.ndarray, wavelength_m: float, permittivity: complex) -> np.ndarray:
    """Return the backscatter of spheres [N], m2: lambda^2 / (4 pi) |sum (2n+1) (-1)^n (a_n - b_n)|^2, Mie's series."""
    # imported here: only radars over 20 GHz in rain or snow need it
    from scipy.special import spherical_jn, spherical_yn

    size = np.pi * np.asarray(diameter_m, np.float64) / wavelength_m
    # Bohren and Huffman's sign of time: a passive medium has Im(m) >= 0
    index = np.conj(np.sqrt(complex(permittivity)))
    inner = index * size
    order = np.arange(1, int(size.max() + 4.0 * size.max() ** (1.0 / 3.0) + 4.0))[:, None]
    j, y = spherical_jn(order, size), spherical_yn(order, size)
    psi, xi = size * j, size * (j + 1j * y)
    psi_slope = j + size * spherical_jn(order, size, derivative=True)
    xi_slope = psi_slope + 1j * (y + size * spherical_yn(order, size, derivative=True))
    j_inner = spherical_jn(order, inner)
    psi_inner = inner * j_inner
    slope_inner = j_inner + inner * spherical_jn(order, inner, derivative=True)
    a = (index * psi_inner * psi_slope - psi * slope_inner) / (index * psi_inner * xi_slope - xi * slope_inner)
    b = (psi_inner * psi_slope - index * psi * slope_inner) / (psi_inner * xi_slope - index * xi * slope_inner)
    total = np.sum((2 * order + 1) * (-1.0) ** order * (a - b), axis=0)
    return np.asarray(wavelength_m**2 / (4.0 * np.pi) * np.abs(total) ** 2)
