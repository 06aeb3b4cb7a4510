"""The cells in which a plan's law holds: range bins of every steering angle, and of every azimuth of the map.

Both are one linear step apart: the map is the co-array inversion of the beams (`models.perception.form.coarray`).
What is bounded in the beams is bounded on the map by the inversion's magnitudes.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from models.compiled import compiled
from models.perception.form.coarray import AzimuthInterpolator
from msgs.values.radar import ArrayParams, BeamGrid, ElementPattern, RadarParams, RadarSetup
from sim_player.planner.purposes import LEAST, Purpose


class Cells:
    """Rows of cells of one radar: its beams, then the azimuths of its map."""

    def __init__(self, setup: RadarSetup) -> None:
        inversion = AzimuthInterpolator(setup)
        self._matrix = inversion.coherent_matrix  # [beams, azimuths]
        self._magnitude = np.abs(self._matrix).T
        self._noise_gain = np.linalg.norm(self._matrix, axis=0)
        aperture_m = setup.array.columns * setup.array.column_spacing(setup.radar.wavelength_m)
        half_beam_rad = 0.443 * setup.radar.wavelength_m / aperture_m
        step_rad = float(np.median(np.abs(np.diff(setup.beams.azimuth_rad)))) if len(setup.beams) > 1 else np.inf
        # beams may look twice in one direction
        self._near_beams = int(min(half_beam_rad / max(step_rad, 1e-9), len(setup.beams)))
        self._near_azimuths = int(half_beam_rad / inversion.grid.azimuth_step_rad)

    def values(self, profiles: np.ndarray) -> np.ndarray:
        """Beams [beams, bins] and the map they make, complex [beams + azimuths, bins]."""
        return np.concatenate([profiles, self._matrix.T @ profiles])

    def bounds(self, bound: np.ndarray) -> np.ndarray:
        """Bounds in the beams, and on the map that their signals make, [beams + azimuths, bins]."""
        return np.concatenate([bound, self._magnitude @ bound])

    @cached_property
    def map_share(self) -> float:
        """Return the share of its reference by whose magnitude all beams may change so that no azimuth changes more."""
        return float(min(1.0, (self._noise_gain / self._magnitude.sum(axis=1)).min()))

    def floor(
        self,
        profiles: np.ndarray,
        noise_rms: np.ndarray,
        unknown: np.ndarray | float = 0.0,
        sigmas: float = 0.0,
        purpose: Purpose = Purpose.SAMPLES,
    ) -> np.ndarray:
        """Lower bound of the law's reference, [beams + azimuths, bins].

        What surely stands in a cell is |values| - bound of the `unknown` - `sigmas` noise rms.
        """
        beams = len(profiles)
        rms = np.concatenate([np.broadcast_to(noise_rms, profiles.shape), np.outer(self._noise_gain, noise_rms)])
        left = self.bounds(np.broadcast_to(np.asarray(unknown, np.float32), profiles.shape)) + sigmas * rms
        sure = np.abs(self.values(profiles)) - left
        if purpose is not Purpose.SAMPLES:
            return np.asarray(np.maximum(sure, LEAST[purpose] * rms))
        near = np.concatenate(
            [_strongest_near(sure[:beams], self._near_beams), _strongest_near(sure[beams:], self._near_azimuths)]
        )
        return np.asarray(np.maximum(near, rms))

    def off(
        self,
        everything: np.ndarray,
        planned: np.ndarray,
        noise_rms: np.ndarray,
        purpose: Purpose = Purpose.SAMPLES,
    ) -> np.ndarray:
        """The law's ratio of two maps with the same noise, [beams + azimuths, bins]."""
        difference = np.abs(self.values(everything) - self.values(planned))
        return np.asarray(difference / self.floor(everything, noise_rms, purpose=purpose))


def cells_of(setup: RadarSetup) -> Cells:
    """The cells of a set-up; computed once for all set-ups that differ in nothing else."""
    if setup.steering_weights is not None:
        return Cells(setup)
    return _cells(setup.radar, setup.array, setup.element, setup.beams)


@lru_cache(maxsize=8)
def _cells(radar: RadarParams, array: ArrayParams, element: ElementPattern, beams: BeamGrid) -> Cells:
    return Cells(RadarSetup(radar=radar, array=array, element=element, beams=beams))


@compiled
def _strongest_near(values, rows_near):  # type: ignore[no-untyped-def]
    """Largest value within some rows and one bin, [rows, bins]."""
    rows, bins = values.shape
    wide, out = np.empty_like(values), np.empty_like(values)
    for row in range(rows):
        for cell in range(bins):
            low, high = max(cell - 1, 0), min(cell + 1, bins - 1)
            wide[row, cell] = max(values[row, low], values[row, cell], values[row, high])
    for row in range(rows):
        out[row] = wide[row]
        for near in range(max(row - rows_near, 0), min(row + rows_near + 1, rows)):
            for cell in range(bins):
                out[row, cell] = max(out[row, cell], wide[near, cell])
    return out
