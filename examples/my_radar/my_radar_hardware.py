"""Stand-in for the library of a radar's vendor: it measures a wall of four points, and noise."""

from __future__ import annotations

import numpy as np

from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import beat_samples
from msgs.values.radar import RadarSetup


class Hardware:
    """Measures one beam: int16 I and Q codes [chirps, samples, 2]."""

    def __init__(self, setup: RadarSetup, noise_codes: float, seed: int) -> None:
        self._setup, self._noise_codes = setup, noise_codes
        self._random = np.random.default_rng(seed)
        across_m = np.linspace(-3.0, 3.0, 4)
        azimuth_rad = np.arctan2(across_m, 20.0)
        # the array's own field in every steered direction, [beams, points]: what makes the map coherent
        self._field = two_way_pattern(setup, setup_weights(setup), azimuth_rad, np.zeros_like(azimuth_rad))
        self._beats = beat_samples(setup.radar, 2.0 * np.hypot(20.0, across_m))

    def measure(self, beam_index: int) -> np.ndarray:
        """Return the beam of this index in the scan."""
        shape = (self._setup.radar.chirps_per_beam, self._setup.radar.samples_per_chirp)
        noise = self._noise_codes * (self._random.normal(size=shape) + 1j * self._random.normal(size=shape))
        codes = self._field[beam_index] @ self._beats + noise
        return np.rint(np.stack([codes.real, codes.imag], axis=-1)).astype(np.int16)
