"""The cells in which the planner's law holds: range bins of every steering angle, and of every azimuth of the map.

Both are one linear step apart: the map is the co-array inversion of the beams (`models.perception.forming.coarray`).
What is bounded in the beams is bounded on the map by the inversion's magnitudes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from models.perception.forming.coarray import AzimuthInterpolator
from msgs.values.radar import ArrayParams, BeamGrid, ElementPattern, RadarParams, RadarSetup


class Cells:
    """Rows of cells of one radar: its beams, then the azimuths of its map."""

    def __init__(self, setup: RadarSetup) -> None:
        inversion = AzimuthInterpolator(setup)
        self._matrix = inversion.coherent_matrix  # [beams, azimuths]
        self._magnitude = np.abs(self._matrix).T
        self._noise_gain = np.linalg.norm(self._matrix, axis=0)
        aperture_m = setup.array.columns * setup.array.column_spacing(setup.radar.wavelength_m)
        half_beam_rad = 0.443 * setup.radar.wavelength_m / aperture_m
        step_rad = float(np.median(np.diff(setup.beams.azimuth_rad))) if len(setup.beams) > 1 else np.inf
        self._near_beams = int(half_beam_rad / abs(step_rad))
        self._near_azimuths = int(half_beam_rad / inversion.grid.azimuth_step_rad)

    def values(self, profiles: np.ndarray) -> np.ndarray:
        """Beams [beams, bins] and the map they make, complex [beams + azimuths, bins]."""
        return np.concatenate([profiles, self._matrix.T @ profiles])

    def bounds(self, bound: np.ndarray) -> np.ndarray:
        """Bounds in the beams, and on the map that their signals make, [beams + azimuths, bins]."""
        return np.concatenate([bound, self._magnitude @ bound])

    def floor(
        self, profiles: np.ndarray, noise_rms: np.ndarray, unknown: np.ndarray | float = 0.0, sigmas: float = 0.0
    ) -> np.ndarray:
        """Lower bound of the law's denominator: noise rms, or what surely stands nearby; [beams + azimuths, bins].

        The strongest of |values| - bound of the `unknown` - `sigmas` noise rms within one range bin and half a beam.
        """
        # here: a player of basic effects asks for no bounds
        from scipy.ndimage import maximum_filter

        beams = len(profiles)
        rms = np.concatenate([np.broadcast_to(noise_rms, profiles.shape), np.outer(self._noise_gain, noise_rms)])
        left = self.bounds(np.broadcast_to(np.asarray(unknown, np.float64), profiles.shape)) + sigmas * rms
        sure = np.abs(self.values(profiles)) - left
        near = np.concatenate(
            [
                maximum_filter(sure[:beams], (2 * self._near_beams + 1, 3), mode="nearest"),
                maximum_filter(sure[beams:], (2 * self._near_azimuths + 1, 3), mode="nearest"),
            ]
        )
        return np.asarray(np.maximum(near, rms))

    def off(self, everything: np.ndarray, planned: np.ndarray, noise_rms: np.ndarray) -> np.ndarray:
        """The law's ratio of two maps with the same noise, [beams + azimuths, bins]."""
        difference = np.abs(self.values(everything) - self.values(planned))
        return np.asarray(difference / self.floor(everything, noise_rms))


def cells_of(setup: RadarSetup) -> Cells:
    """The cells of a set-up; computed once for all set-ups that differ in nothing else."""
    if setup.steering_weights is not None:
        return Cells(setup)
    return _cells(setup.radar, setup.array, setup.element, setup.beams)


@lru_cache(maxsize=8)
def _cells(radar: RadarParams, array: ArrayParams, element: ElementPattern, beams: BeamGrid) -> Cells:
    return Cells(RadarSetup(radar=radar, array=array, element=element, beams=beams))
