"""Calibration of a receive array, element by element, against one strong reflector.

Each beam hears one element. The reflector's beat has the same frequency in all, so its complex amplitudes a differ by
the elements' own gains and phases and by the way to each element, which is known. Beats carry the conjugate of the
field: the phase that a register must add is arg(a) + k (r - distance), up to one phase for all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft

from contrib.boards.phaser_model import CHANNEL_OF_ELEMENT, COLUMNS, PhaserCalibration
from msgs.values.radar import RadarSetup
from msgs.values.units import db_from_ratio

#: The reflector stands this far above the noise of each element.
MIN_SNR_DB = 20.0
#: Largest standard deviation of an element's phase from scan to scan.
MAX_PHASE_STD_DEG = 5.0
#: Least number of scans that shows whether phases repeat.
MIN_SCANS = 4
_PADDING = 8


@dataclass(frozen=True)
class ElementResponses:
    """A reflector as each element hears it."""

    range_m: float
    #: Complex amplitudes in codes, mean over scans after each scan's common phase; complex [8].
    amplitudes: np.ndarray
    #: Reflector over the noise of a bin, and standard deviation of the phase over scans, of each element; [8].
    snr_db: np.ndarray
    phase_std_deg: np.ndarray


def element_responses(setup: RadarSetup, chirps: np.ndarray, range_m: tuple[float, float]) -> ElementResponses:
    """Return the responses to the strongest reflector in a gate [low, high] m of mean chirps [scans, 8, samples].

    Elements are in the order of beams. Raises ValueError if the set-up is not of single elements, the gate lies outside
    the profile, its maximum at its end, an element hears too little, or phases do not repeat.
    """
    columns_of_elements(setup)
    scans, _, count = chirps.shape
    if scans < MIN_SCANS:
        raise ValueError(f"an array calibration needs at least {MIN_SCANS} complete scans, got {scans}")
    window = np.hanning(count + 1)[:-1]
    values = (chirps if setup.beat_sign > 0 else np.conj(chirps)) * window
    profiles = fft.fft(values, _PADDING * count, axis=-1) / window.sum()
    at = _peak(setup, np.mean(np.abs(profiles) ** 2, axis=(0, 1)), range_m)
    responses = profiles[:, :, at]
    noise = np.median(np.abs(profiles) ** 2, axis=(0, 2)) / math.log(2.0)
    power = np.mean(np.abs(responses) ** 2, axis=0)
    snr_db = 10.0 * np.log10(np.maximum(power, 1e-30) / np.maximum(noise, 1e-30))
    weakest = int(np.argmin(snr_db))
    if snr_db[weakest] < MIN_SNR_DB:
        raise ValueError(
            f"the reflector must stand {MIN_SNR_DB:g} dB over the noise of every element, element {weakest + 1} has "
            f"{snr_db[weakest]:.1f} dB: it is dead, or the reflector too weak"
        )
    mean, std_deg = _steady(responses)
    worst = int(np.argmax(std_deg))
    if std_deg[worst] > MAX_PHASE_STD_DEG:
        raise ValueError(
            f"phases must repeat from scan to scan within {MAX_PHASE_STD_DEG:g} deg, those of element {worst + 1} "
            f"spread by {std_deg[worst]:.1f} deg: something moves, or bursts do not begin at the same phase"
        )
    return ElementResponses(at / _PADDING * setup.radar.range_bin_m, mean, snr_db, std_deg)


def _peak(setup: RadarSetup, power: np.ndarray, range_m: tuple[float, float]) -> int:
    """Return the padded bin of the largest power in a gate, which is a maximum."""
    low_m, high_m = range_m
    limit_m = 0.5 * setup.radar.samples_per_chirp * setup.radar.range_bin_m
    if not 0.0 < low_m < high_m < limit_m:
        raise ValueError(f"range_m must be 0 < LOW < HIGH < {limit_m:.1f}, got {low_m!r} {high_m!r}")
    first, last = (round(_PADDING * value / setup.radar.range_bin_m) for value in range_m)
    at = first + int(np.argmax(power[first : last + 1]))
    if power[at] < max(power[at - 1], power[at + 1]):
        raise ValueError(
            f"range_m must hold a reflector, the profile only falls or rises from {low_m:g} to {high_m:g} m"
        )
    return at


def _steady(responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over scans of responses [scans, 8] without each scan's common phase, and phase spreads [8]."""
    reference = responses[0]
    common = np.exp(-1j * np.angle(responses @ np.conj(reference)))
    turned = responses * common[:, None]
    mean = turned.mean(axis=0)
    off_rad = np.angle(turned * np.conj(mean))
    return mean, np.degrees(np.sqrt(np.mean(off_rad**2, axis=0)))


def columns_of_elements(setup: RadarSetup) -> np.ndarray:
    """Return the column, from right to left, that each beam's element is; int [8].

    Raises ValueError if a beam hears another number of columns than one.
    """
    weights = setup.steering_weights
    excited = None if weights is None else np.abs(weights) > 0.0
    if excited is None or excited.shape != (COLUMNS, COLUMNS) or sorted(excited.argmax(axis=1)) != [*range(COLUMNS)]:
        raise ValueError("beams must hear one element each: record with radar_driver.cn0566.single_elements=true")
    if (excited.sum(axis=1) != 1).any():
        beam = int(np.argmax(excited.sum(axis=1) != 1))
        raise ValueError(f"beams must hear one element each, beam {beam} hears {excited[beam].sum()}")
    return np.asarray(excited.argmax(axis=1))


def board_calibration(setup: RadarSetup, responses: ElementResponses, azimuth_rad: float) -> PhaserCalibration:
    """Return the calibration of a board from the responses to a reflector at an azimuth."""
    wavelength_m = setup.radar.wavelength_m
    place_m = setup.array.column_spacing(wavelength_m) * (columns_of_elements(setup) - 0.5 * (COLUMNS - 1))
    range_m = responses.range_m
    way_m = np.sqrt(range_m**2 - 2.0 * range_m * place_m * math.sin(azimuth_rad) + place_m**2)
    own = responses.amplitudes * np.exp(2j * np.pi * (range_m - way_m) / wavelength_m)
    phases_deg = np.degrees(np.angle(own * np.conj(own[0])))
    channels_db = [db_from_ratio(float(np.mean(np.abs(own[np.array(CHANNEL_OF_ELEMENT) == k]) ** 2))) for k in (0, 1)]
    channel_gains_db = np.max(channels_db) - np.array(channels_db)
    level = np.abs(own) * 10.0 ** (channel_gains_db[np.array(CHANNEL_OF_ELEMENT)] / 20.0)
    return PhaserCalibration(
        gains=tuple(np.round(level.min() / level, 4).tolist()),
        phases_deg=tuple(np.round(phases_deg, 2).tolist()),
        channel_gains_db=(round(float(channel_gains_db[0]), 3), round(float(channel_gains_db[1]), 3)),
    )
