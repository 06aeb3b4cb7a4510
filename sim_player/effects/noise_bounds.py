"""How far noise reaches, and how much wider the same draws get when noise is added."""

from __future__ import annotations

import math

import numpy as np

from models.physics.waveform import window_noise_gain
from msgs.values.radar import RadarParams

#: Noise draws reach this many rms once in 10^13 cells.
FAR_SIGMAS = 5.5


def wider(radar: RadarParams, added_mw: np.ndarray) -> np.ndarray:
    """Change of the rms of a Hann-windowed profile's bins when a power per sample is added to thermal noise; [bins]."""
    gain = math.sqrt(window_noise_gain("hann") / (radar.samples_per_chirp * radar.chirps_per_beam))
    change = np.sqrt(radar.noise_power_mw + added_mw) - math.sqrt(radar.noise_power_mw)
    # neighbouring bins come in through the window's taps: take the largest
    padded = np.pad(change, 1, mode="edge")
    return np.asarray(gain * np.maximum.reduce([padded[:-2], padded[1:-1], padded[2:]]))
