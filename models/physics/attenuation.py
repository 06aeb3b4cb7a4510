"""Attenuation of a wave by air, rain, snow, fog and foliage, one way.

Power loss only: the phase shift of air, rain and leaves (refractivity) is not modelled. Over 100 m, round trip, air
costs 0.003 dB at 10 GHz and 0.07 dB at 77 GHz; a rain of 25 mm/h costs 0.1 dB and 2.2 dB.
"""

from __future__ import annotations

import math

import numpy as np

from msgs.values.units import SPEED_OF_LIGHT_MPS

#: Oxygen, ITU-R P.676-13, Table 1: frequency [GHz], a1..a6.
OXYGEN_LINES = np.array(
    [
        [50.474214, 0.975, 9.651, 6.69, 0.0, 2.566, 6.85],
        [50.987745, 2.529, 8.653, 7.17, 0.0, 2.246, 6.8],
        [51.50336, 6.193, 7.709, 7.64, 0.0, 1.947, 6.729],
        [52.021429, 14.32, 6.819, 8.11, 0.0, 1.667, 6.64],
        [52.542418, 31.24, 5.983, 8.58, 0.0, 1.388, 6.526],
        [53.066934, 64.29, 5.201, 9.06, 0.0, 1.349, 6.206],
        [53.595775, 124.6, 4.474, 9.55, 0.0, 2.227, 5.085],
        [54.130025, 227.3, 3.8, 9.96, 0.0, 3.17, 3.75],
        [54.67118, 389.7, 3.182, 10.37, 0.0, 3.558, 2.654],
        [55.221384, 627.1, 2.618, 10.89, 0.0, 2.56, 2.952],
        [55.783815, 945.3, 2.109, 11.34, 0.0, -1.172, 6.135],
        [56.264774, 543.4, 0.014, 17.03, 0.0, 3.525, -0.978],
        [56.363399, 1331.8, 1.654, 11.89, 0.0, -2.378, 6.547],
        [56.968211, 1746.6, 1.255, 12.23, 0.0, -3.545, 6.451],
        [57.612486, 2120.1, 0.91, 12.62, 0.0, -5.416, 6.056],
        [58.323877, 2363.7, 0.621, 12.95, 0.0, -1.932, 0.436],
        [58.446588, 1442.1, 0.083, 14.91, 0.0, 6.768, -1.273],
        [59.164204, 2379.9, 0.387, 13.53, 0.0, -6.561, 2.309],
        [59.590983, 2090.7, 0.207, 14.08, 0.0, 6.957, -0.776],
        [60.306056, 2103.4, 0.207, 14.15, 0.0, -6.395, 0.699],
        [60.434778, 2438.0, 0.386, 13.39, 0.0, 6.342, -2.825],
        [61.150562, 2479.5, 0.621, 12.92, 0.0, 1.014, -0.584],
        [61.800158, 2275.9, 0.91, 12.63, 0.0, 5.014, -6.619],
        [62.41122, 1915.4, 1.255, 12.17, 0.0, 3.029, -6.759],
        [62.486253, 1503.0, 0.083, 15.13, 0.0, -4.499, 0.844],
        [62.997984, 1490.2, 1.654, 11.74, 0.0, 1.856, -6.675],
        [63.568526, 1078.0, 2.108, 11.34, 0.0, 0.658, -6.139],
        [64.127775, 728.7, 2.617, 10.88, 0.0, -3.036, -2.895],
        [64.67891, 461.3, 3.181, 10.38, 0.0, -3.968, -2.59],
        [65.224078, 274.0, 3.8, 9.96, 0.0, -3.528, -3.68],
        [65.764779, 153.0, 4.473, 9.55, 0.0, -2.548, -5.002],
        [66.302096, 80.4, 5.2, 9.06, 0.0, -1.66, -6.091],
        [66.836834, 39.8, 5.982, 8.58, 0.0, -1.68, -6.393],
        [67.369601, 18.56, 6.818, 8.11, 0.0, -1.956, -6.475],
        [67.900868, 8.172, 7.708, 7.64, 0.0, -2.216, -6.545],
        [68.431006, 3.397, 8.652, 7.17, 0.0, -2.492, -6.6],
        [68.960312, 1.334, 9.65, 6.69, 0.0, -2.773, -6.65],
        [118.750334, 940.3, 0.01, 16.64, 0.0, -0.439, 0.079],
        [368.498246, 67.4, 0.048, 16.4, 0.0, 0.0, 0.0],
        [424.76302, 637.7, 0.044, 16.4, 0.0, 0.0, 0.0],
        [487.249273, 237.4, 0.049, 16.0, 0.0, 0.0, 0.0],
        [715.392902, 98.1, 0.145, 16.0, 0.0, 0.0, 0.0],
        [773.83949, 572.3, 0.141, 16.2, 0.0, 0.0, 0.0],
        [834.145546, 183.1, 0.145, 14.7, 0.0, 0.0, 0.0],
    ]
)

#: Water vapour, ITU-R P.676-13, Table 2: frequency [GHz], b1..b6.
WATER_LINES = np.array(
    [
        [22.23508, 0.1079, 2.144, 26.38, 0.76, 5.087, 1.0],
        [67.80396, 0.0011, 8.732, 28.58, 0.69, 4.93, 0.82],
        [119.99594, 0.0007, 8.353, 29.48, 0.7, 4.78, 0.79],
        [183.310087, 2.273, 0.668, 29.06, 0.77, 5.022, 0.85],
        [321.22563, 0.047, 6.179, 24.04, 0.67, 4.398, 0.54],
        [325.152888, 1.514, 1.541, 28.23, 0.64, 4.893, 0.74],
        [336.227764, 0.001, 9.825, 26.93, 0.69, 4.74, 0.61],
        [380.197353, 11.67, 1.048, 28.11, 0.54, 5.063, 0.89],
        [390.134508, 0.0045, 7.347, 21.52, 0.63, 4.81, 0.55],
        [437.346667, 0.0632, 5.048, 18.45, 0.6, 4.23, 0.48],
        [439.150807, 0.9098, 3.595, 20.07, 0.63, 4.483, 0.52],
        [443.018343, 0.192, 5.048, 15.55, 0.6, 5.083, 0.5],
        [448.001085, 10.41, 1.405, 25.64, 0.66, 5.028, 0.67],
        [470.888999, 0.3254, 3.597, 21.34, 0.66, 4.506, 0.65],
        [474.689092, 1.26, 2.379, 23.2, 0.65, 4.804, 0.64],
        [488.490108, 0.2529, 2.852, 25.86, 0.69, 5.201, 0.72],
        [503.568532, 0.0372, 6.731, 16.12, 0.61, 3.98, 0.43],
        [504.482692, 0.0124, 6.731, 16.12, 0.61, 4.01, 0.45],
        [547.67644, 0.9785, 0.158, 26.0, 0.7, 4.5, 1.0],
        [552.02096, 0.184, 0.158, 26.0, 0.7, 4.5, 1.0],
        [556.935985, 497.0, 0.159, 30.86, 0.69, 4.552, 1.0],
        [620.700807, 5.015, 2.391, 24.38, 0.71, 4.856, 0.68],
        [645.766085, 0.0067, 8.633, 18.0, 0.6, 4.0, 0.5],
        [658.00528, 0.2732, 7.816, 32.1, 0.69, 4.14, 1.0],
        [752.033113, 243.4, 0.396, 30.86, 0.68, 4.352, 0.84],
        [841.051732, 0.0134, 8.177, 15.9, 0.33, 5.76, 0.45],
        [859.965698, 0.1325, 8.055, 30.6, 0.68, 4.09, 0.84],
        [899.303175, 0.0547, 7.914, 29.85, 0.68, 4.53, 0.9],
        [902.611085, 0.0386, 8.429, 28.65, 0.7, 5.1, 0.95],
        [906.205957, 0.1836, 5.11, 24.08, 0.7, 4.7, 0.53],
        [916.171582, 8.4, 1.441, 26.73, 0.7, 5.15, 0.78],
        [923.112692, 0.0079, 10.293, 29.0, 0.7, 5.0, 0.8],
        [970.315022, 9.009, 1.919, 25.5, 0.64, 4.94, 0.67],
        [987.926764, 134.6, 0.257, 29.85, 0.68, 4.55, 0.9],
        [1780.0, 17506.0, 0.952, 196.3, 2.0, 24.15, 5.0],
    ]
)

#: Rain, ITU-R P.838-3, vertical: peaks (height a, position b, width c over log10 of GHz), slope m, offset c.
_RainFit = tuple[tuple[tuple[float, float, float], ...], float, float]
RAIN_LOG_K: _RainFit = (
    (
        (-3.80595, 0.56934, 0.81061),
        (-3.44965, -0.22911, 0.51059),
        (-0.39902, 0.73042, 0.11899),
        (0.50167, 1.07319, 0.27195),
    ),
    -0.16398,
    0.63297,
)
RAIN_ALPHA: _RainFit = (
    (
        (-0.07771, 2.33840, -0.76284),
        (0.56727, 0.95545, 0.54039),
        (-0.20238, 1.14520, 0.26809),
        (-48.2991, 0.791669, 0.116226),
        (48.5833, 0.791459, 0.116479),
    ),
    -0.053739,
    0.83433,
)

#: Foliage, both times f^0.284 with f in GHz: loss of a short path [dB/m] (Weissberger's law below 14 m, in leaf, as
#: quoted in textbooks) and the maximum loss of a long one [dB] (fitted here, see `vegetation_db`).
FOLIAGE_DB_PER_M = 0.45
FOLIAGE_MAX_DB = 20.0
FOLIAGE_EXPONENT = 0.284


def gas_db_per_m(
    frequency_hz: float,
    temperature_c: float = 15.0,
    pressure_hpa: float = 1013.25,
    water_vapour_g_per_m3: float = 7.5,
) -> float:
    """Return the loss in air [dB/m]: oxygen and water vapour line by line, ITU-R P.676-13 Annex 1.

    Raises ValueError outside 1..1000 GHz, -60..60 deg C, 300..1100 hPa (air and vapour) and 0..100 g/m3.
    """
    frequency_ghz = within("frequency_hz", frequency_hz, 1e9, 1000e9) / 1e9
    kelvin = within("temperature_c", temperature_c, -60.0, 60.0) + 273.15
    vapour_hpa = within("water_vapour_g_per_m3", water_vapour_g_per_m3, 0.0, 100.0) * kelvin / 216.7
    dry_hpa = within("pressure_hpa", pressure_hpa, 300.0, 1100.0) - vapour_hpa
    theta = 300.0 / kelvin
    refractivity = (
        _oxygen(frequency_ghz, dry_hpa, vapour_hpa, theta)
        + _continuum(frequency_ghz, dry_hpa, vapour_hpa, theta)
        + _water(frequency_ghz, dry_hpa, vapour_hpa, theta)
    )
    return 0.1820e-3 * frequency_ghz * refractivity


def rain_db_per_m(frequency_hz: float, rain_mm_per_h: float) -> float:
    """Return the loss of a vertical wave in rain on a level path [dB/m]: k R^alpha, ITU-R P.838-3.

    Raises ValueError outside 1..1000 GHz and 0..300 mm/h.
    """
    frequency_ghz = within("frequency_hz", frequency_hz, 1e9, 1000e9) / 1e9
    rain = within("rain_mm_per_h", rain_mm_per_h, 0.0, 300.0)
    k = 10.0 ** _rain_fit(RAIN_LOG_K, frequency_ghz)
    return 1e-3 * k * rain ** _rain_fit(RAIN_ALPHA, frequency_ghz)


def snow_db_per_m(frequency_hz: float, snow_mm_per_h: float) -> float:
    """Return the loss in dry snow of a melted rate at 0 deg C [dB/m]; ValueError outside 1..1000 GHz, 0..300 mm/h.

    3.49e-6 R^1.6 / lambda^4 + 2.24e-6 R / lambda, lambda in cm (Skolnik, Introduction to Radar Systems, 13.7).
    """
    wavelength_cm = 100.0 * SPEED_OF_LIGHT_MPS / within("frequency_hz", frequency_hz, 1e9, 1000e9)
    snow = within("snow_mm_per_h", snow_mm_per_h, 0.0, 300.0)
    return 3.49e-6 * snow**1.6 / wavelength_cm**4 + 2.24e-6 * snow / wavelength_cm


def fog_db_per_m(frequency_hz: float, fog_g_per_m3: float, temperature_c: float = 15.0) -> float:
    """Return the loss in fog [dB/m]: K_l M by Rayleigh's law, ITU-R P.840-8 Eqs. (2) to (11).

    Raises ValueError outside 1..200 GHz, 0..10 g/m3 and -60..60 deg C.
    """
    frequency_ghz = within("frequency_hz", frequency_hz, 1e9, 200e9) / 1e9
    fog = within("fog_g_per_m3", fog_g_per_m3, 0.0, 10.0)
    permittivity = water_permittivity(frequency_hz, within("temperature_c", temperature_c, -60.0, 60.0))
    loss = -permittivity.imag
    ratio = (2.0 + permittivity.real) / loss
    return 1e-3 * fog * 0.819 * frequency_ghz / (loss * (1.0 + ratio**2))


def water_permittivity(frequency_hz: float, temperature_c: float) -> complex:
    """Return the relative permittivity of liquid water: double Debye of ITU-R P.840-8, Im <= 0."""
    frequency_ghz, excess = frequency_hz / 1e9, 300.0 / (temperature_c + 273.15) - 1.0
    static = 77.66 + 103.3 * excess
    middle, high = 0.0671 * static, 3.52
    principal_ghz = 20.20 - 146.0 * excess + 316.0 * excess**2
    secondary_ghz = 39.8 * principal_ghz
    slow = (static - middle) / (1.0 + 1j * frequency_ghz / principal_ghz)
    fast = (middle - high) / (1.0 + 1j * frequency_ghz / secondary_ghz)
    return complex(slow + fast + high)


def vegetation_db(frequency_hz: float, depth_m: np.ndarray) -> np.ndarray:
    """Return the one-way loss in foliage in leaf [dB], shaped as `depth_m`: Am (1 - exp(-d gamma / Am)), ITU-R P.833.

    gamma is Weissberger's law for short paths (0.87 dB/m at 10 GHz, 1.5 at 77), Am (38 dB, 69 dB) follows his long ones
    within 15 %: an engineering value. ValueError outside 0.23..95 GHz and for a depth that is negative or none.
    """
    frequency_ghz = within("frequency_hz", frequency_hz, 0.23e9, 95e9) / 1e9
    depth_m = np.asarray(depth_m, np.float64)
    if not np.all(depth_m >= 0.0):
        raise ValueError(f"depth_m must not be negative, got {np.min(depth_m)!r}")
    scale = frequency_ghz**FOLIAGE_EXPONENT
    return -FOLIAGE_MAX_DB * scale * np.expm1(-depth_m * FOLIAGE_DB_PER_M / FOLIAGE_MAX_DB)


def within(name: str, value: float, minimum: float, maximum: float) -> float:
    """Return the value; ValueError unless it lies in minimum..maximum."""
    if not minimum <= value <= maximum:
        raise ValueError(f"{name} must lie in {minimum:g}..{maximum:g}, got {value!r}")
    return float(value)


def _oxygen(frequency_ghz: float, dry_hpa: float, vapour_hpa: float, theta: float) -> float:
    """Return the imaginary refractivity of oxygen, P.676-13 Eqs. (2) to (7); Zeeman splitting and line mixing in."""
    line, a1, a2, a3, a4, a5, a6 = OXYGEN_LINES.T
    strength = 1e-7 * a1 * dry_hpa * theta**3 * np.exp(a2 * (1.0 - theta))
    width = 1e-4 * a3 * (dry_hpa * theta ** (0.8 - a4) + 1.1 * vapour_hpa * theta)
    width = np.sqrt(width**2 + 2.25e-6)
    mixing = 1e-4 * (a5 + a6 * theta) * (dry_hpa + vapour_hpa) * theta**0.8
    return float(np.sum(strength * _line_shape(frequency_ghz, line, width, mixing)))


def _water(frequency_ghz: float, dry_hpa: float, vapour_hpa: float, theta: float) -> float:
    """Return the imaginary refractivity of water vapour, P.676-13 Eqs. (2) to (7); Doppler broadening in."""
    line, b1, b2, b3, b4, b5, b6 = WATER_LINES.T
    strength = 1e-1 * b1 * vapour_hpa * theta**3.5 * np.exp(b2 * (1.0 - theta))
    width = 1e-4 * b3 * (dry_hpa * theta**b4 + b5 * vapour_hpa * theta**b6)
    width = 0.535 * width + np.sqrt(0.217 * width**2 + 2.1316e-12 * line**2 / theta)
    return float(np.sum(strength * _line_shape(frequency_ghz, line, width, np.zeros_like(line))))


def _line_shape(frequency_ghz: float, line: np.ndarray, width: np.ndarray, mixing: np.ndarray) -> np.ndarray:
    """Return the shape of a line at its own and at its mirrored frequency, P.676-13 Eq. (5)."""
    below, above = line - frequency_ghz, line + frequency_ghz
    near = (width - mixing * below) / (below**2 + width**2)
    far = (width - mixing * above) / (above**2 + width**2)
    return frequency_ghz / line * (near + far)


def _continuum(frequency_ghz: float, dry_hpa: float, vapour_hpa: float, theta: float) -> float:
    """Return the Debye spectrum of oxygen and pressure-induced nitrogen, P.676-13 Eqs. (8) and (9)."""
    debye = 5.6e-4 * (dry_hpa + vapour_hpa) * theta**0.8
    oxygen = 6.14e-5 / (debye * (1.0 + (frequency_ghz / debye) ** 2))
    nitrogen = 1.4e-12 * dry_hpa * theta**1.5 / (1.0 + 1.9e-5 * frequency_ghz**1.5)
    return frequency_ghz * dry_hpa * theta**2 * (oxygen + nitrogen)


def _rain_fit(fit: _RainFit, frequency_ghz: float) -> float:
    """Return the fit's Gaussian peaks plus its straight line over log10 of the frequency, P.838-3 Eqs. (2) and (3)."""
    peaks, slope, offset = fit
    x = math.log10(frequency_ghz)
    return sum(a * math.exp(-(((x - b) / c) ** 2)) for a, b, c in peaks) + slope * x + offset
