"""Detection SNR of a hidden target without a simulation: radar equation and photon budget.

The value is the one in the maps: power of the target's cell over the mean noise power of cells, linear. A target
behind a wall's mirror is one at the mirrored position whose power passed the wall twice. For radars the echo lies on
its range bin and azimuth; half a bin beside it the default window costs 1.4 dB. Of the LiDAR the echo lies in the
middle of its cell; one on the border between two cells loses 6 dB.
"""

from __future__ import annotations

import numpy as np

from models.physics.antenna import coarray_weights, column_response, setup_weights
from models.physics.link_budget import beam_snr, require_not_negative, require_positive_values, require_probability
from models.physics.photons.flux import share_within
from msgs.values.arrays import require_positive
from msgs.values.lidar import SpadParams
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS


def radar_snr(
    setup: RadarSetup,
    range_m: float | np.ndarray,
    rcs_m2: float | np.ndarray,
    wall_power_per_bounce: float | np.ndarray = 1.0,
    azimuth_rad: float | np.ndarray = 0.0,
) -> np.ndarray:
    """Return the SNR of a point target in the coherent map of a scan (broadcast): `beam_snr` over its cells' noise."""
    return beam_snr(setup, range_m, rcs_m2, wall_power_per_bounce, azimuth_rad) / map_noise_gain(setup)


def map_noise_gain(setup: RadarSetup) -> float:
    """Return the mean noise power of a coherent map's cells over a beam's: 0.58 of the default radar, 1 of 57 columns.

    Least squares from all beams to ideal beams at the azimuths of the default grid. Holds if the beams are
    at least as many as the co-array's coefficients.
    """
    azimuth_rad = RangeAzimuthGrid().azimuth_rad
    ideal = np.conj(column_response(setup.array, setup.radar.wavelength_m, azimuth_rad, np.zeros(1)))
    forward = _two_way_weights(setup, ideal) @ np.linalg.pinv(_two_way_weights(setup, setup_weights(setup)))
    return float(np.sum(np.abs(forward) ** 2) / len(azimuth_rad))


def photon_snr(
    spad: SpadParams,
    range_m: float | np.ndarray,
    photons: float | np.ndarray,
    earlier_photons: float | np.ndarray = 0.0,
    earlier_range_m: float | np.ndarray | None = None,
    cell_m: float | None = None,
) -> np.ndarray:
    """Return the SNR of an echo of mean `photons` a pulse (broadcast): squared excess over ambient light, by variance.

    Only first photons count. W pulses still wait for one when the cell opens, e^-h of them past the half of it, in
    which h ambient photons a pulse fall; there the echo takes 1 - e^-s, and e^-s are left for the ambient light after
    it. So excess W e^-h (1 - e^-s), variance W (1 - e^-h) (1 + e^-(h+s)), or of one count where that is less.
    `earlier_photons` (the wall's own return) leave e^-earlier of W if they arrive before the target in its gate,
    from `earlier_range_m` (None: they do). 0 beyond the period. `cell_m` None: that of the default map.

    Left out: a gate's border inside the cell, and the width of the pulse, in which first photons of a strong echo come
    early and leave less variance (0.4 dB at 3 photons). Raises `ValueError` for a negative number, and for a range or
    cell that is not positive. Source: Eqs. (11), (12).
    """
    range_m = require_positive_values("range_m", range_m)
    photons = require_not_negative("photons", photons)
    earlier = require_not_negative("earlier_photons", earlier_photons)
    if earlier_range_m is not None:
        earlier_range_m = require_positive_values("earlier_range_m", earlier_range_m)
        blinds = (_gate(spad, range_m) == _gate(spad, earlier_range_m)) & (earlier_range_m < range_m)
        earlier = np.where(blinds, earlier, 0.0)
    cell_s = _cell_s(cell_m)
    inside = photons * share_within(spad, 0.5 * cell_s)
    waiting = _waiting_pulses(spad, range_m, cell_s) * np.exp(-earlier)
    half = 0.5 * cell_s * spad.ambient_rate_hz
    # expm1 keeps the digits of an echo of one photon in a million pulses
    excess = waiting * np.exp(-half) * np.expm1(-inside)
    variance = waiting * -np.expm1(-half) * (1.0 + np.exp(-half - inside))
    return np.asarray(np.square(excess) / np.maximum(variance, 1.0))


def radar_threshold(false_alarm: float | np.ndarray) -> np.ndarray:
    """Return the SNR that noise alone exceeds in a cell with this probability: -ln P_fa (exponential power).

    Raises `ValueError` outside (0, 1).
    """
    return -np.log(require_probability(false_alarm))


def half_range(range_m: np.ndarray, value: np.ndarray) -> float:
    """Return the range at which a curve [N] over ranges [N] last falls below half of its best, interpolated linearly.

    Infinite where the curve ends at or above half; 0 where its best is 0. Raises `ValueError` unless ranges rise,
    shapes agree, and values are finite and not negative.
    """
    range_m, value = np.asarray(range_m, np.float64), require_not_negative("value", value)
    if range_m.ndim != 1 or range_m.shape != value.shape or not len(value):
        raise ValueError(f"range_m and value must be of one shape [N], N > 0, got {range_m.shape} and {value.shape}")
    if not (np.isfinite(range_m).all() and (np.diff(range_m) > 0.0).all()):
        raise ValueError(f"range_m must be finite and rise, got {range_m.tolist()}")
    half = 0.5 * value.max()
    if half == 0.0:
        return 0.0
    last = int(np.flatnonzero(value >= half)[-1])
    if last == len(value) - 1:
        return np.inf
    return float(np.interp(-half, -value[last : last + 2], range_m[last : last + 2]))


def _two_way_weights(setup: RadarSetup, weights: np.ndarray) -> np.ndarray:
    """Return two-way weights on the co-array's coefficients, power normalised, of column weights [beams, columns]."""
    combined = coarray_weights(weights) if setup.array.steered_ways == 2 else weights
    return combined / np.sqrt(setup.array.columns) ** setup.array.steered_ways


def _cell_s(cell_m: float | None) -> float:
    """Return the round-trip duration of a cell of the map."""
    if cell_m is None:
        cell_m = RangeAzimuthGrid().range_bin_m
    require_positive("cell_m", cell_m)
    return 2.0 * cell_m / SPEED_OF_LIGHT_MPS


def _gate(spad: SpadParams, range_m: float | np.ndarray) -> np.ndarray:
    """Return the number of the gate in which an echo from a range arrives, from 0; `spad.gates` or more: none."""
    return np.floor(2.0 * range_m / SPEED_OF_LIGHT_MPS / spad.period_s * spad.gates)


def _waiting_pulses(spad: SpadParams, range_m: float | np.ndarray, cell_s: float) -> np.ndarray:
    """Return the mean pulses of a measurement whose first photon is still to come when the cell around a range opens.

    Gated: those of the gate, times exp(-rate t) since it opened. Free: the detector may still be dead from the period
    before; ambient light alone is a stationary renewal process, of which exp(-rate (t - dead)) / (1 + rate dead) wait.
    """
    gate, rate_hz = _gate(spad, range_m), spad.ambient_rate_hz
    pulses = spad.pulses // spad.gates + (gate < spad.pulses % spad.gates)
    opened_s = gate * spad.period_s / spad.gates
    since_s = np.maximum(2.0 * range_m / SPEED_OF_LIGHT_MPS - opened_s - 0.5 * cell_s, 0.0)
    dead_s = spad.dead_time_s if spad.arming == "free" else 0.0
    waiting = np.exp(-rate_hz * np.maximum(since_s - dead_s, 0.0)) / (1.0 + rate_hz * dead_s)
    return np.where(gate < spad.gates, pulses * waiting, 0.0)
