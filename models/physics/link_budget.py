"""Radar equation of a target in a beam, and the threshold of an excess of photons; all values linear.

Behind a mirror it is one at the mirrored position whose power passed the wall twice.
"""

from __future__ import annotations

import numpy as np

from models.physics.antenna import element_field, row_field
from models.physics.waveform import window_noise_gain
from msgs.values.radar import RadarSetup


def beam_snr(
    setup: RadarSetup,
    range_m: float | np.ndarray,
    rcs_m2: float | np.ndarray,
    wall_power_per_bounce: float | np.ndarray = 1.0,
    azimuth_rad: float | np.ndarray = 0.0,
) -> np.ndarray:
    """Return the SNR of a point target in one cell of an ideal beam steered at it (broadcast), float64.

    P lambda^2 sigma G / ((4 pi)^3 R^4) times the wall's power squared (1: direct) over a bin's noise, Eqs. (1), (4),
    (5). `ValueError` for a range that is not positive, a negative RCS, or a wall with gain.
    """
    range_m = require_positive_values("range_m", range_m)
    wall = np.asarray(wall_power_per_bounce, np.float64)
    if not ((wall >= 0.0) & (wall <= 1.0)).all():
        raise ValueError(f"wall_power_per_bounce must lie in 0..1, got {wall.tolist()!r}")
    rcs_m2 = require_not_negative("rcs_m2", rcs_m2)
    radar = setup.radar
    # divided twice: the square of a huge range would overflow
    field = two_way_field(setup, azimuth_rad) * wall * radar.wavelength_m / range_m / range_m
    echo_mw = 1e3 * radar.transmit_power_w * rcs_m2 * np.square(field) / (4.0 * np.pi) ** 3
    noise_mw = radar.noise_power_mw * window_noise_gain("hann")
    return np.asarray(echo_mw * radar.samples_per_chirp * radar.chirps_per_beam / noise_mw)


def two_way_field(setup: RadarSetup, azimuth_rad: float | np.ndarray) -> np.ndarray:
    """Return the two-way field gain of an ideal beam steered at a level target (broadcast), float64."""
    azimuth_rad, elevation_rad = np.broadcast_arrays(azimuth_rad, 0.0)
    directions, array = setup.array.steered_ways, setup.array
    gain = np.sqrt(array.columns) * row_field(array, setup.radar.wavelength_m, elevation_rad)
    return np.asarray(element_field(setup.element, azimuth_rad, elevation_rad) ** 2 * gain**directions)


def spad_threshold(false_alarm: float | np.ndarray) -> np.ndarray:
    """Return the threshold of an excess in standard deviations, one-sided: squared normal quantile, 0 from 1/2 on."""
    # imported here: radars do not need it
    from scipy.special import ndtri

    return np.square(np.minimum(ndtri(require_probability(false_alarm)), 0.0))


def require_positive_values(name: str, value: float | np.ndarray) -> np.ndarray:
    """Return the values, float64; `ValueError` unless all are finite and positive."""
    value = np.asarray(value, np.float64)
    if not (np.isfinite(value) & (value > 0.0)).all():
        raise ValueError(f"{name} must be finite and positive, got {value.tolist()!r}")
    return value


def require_not_negative(name: str, value: float | np.ndarray) -> np.ndarray:
    """Return the values, float64; `ValueError` unless all are finite and not negative."""
    value = np.asarray(value, np.float64)
    if not (np.isfinite(value) & (value >= 0.0)).all():
        raise ValueError(f"{name} must be finite and not negative, got {value.tolist()!r}")
    return value


def require_probability(false_alarm: float | np.ndarray) -> np.ndarray:
    """Return the probabilities, float64; `ValueError` unless all lie in (0, 1)."""
    false_alarm = np.asarray(false_alarm, np.float64)
    if not ((false_alarm > 0.0) & (false_alarm < 1.0)).all():
        raise ValueError(f"false_alarm must lie in (0, 1), got {false_alarm.tolist()!r}")
    return false_alarm
