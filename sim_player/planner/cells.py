"""The cells in which a plan's law holds: range bins of every steering angle, and of every azimuth of the map.

Both are one linear step apart: the map is the co-array inversion of the beams (`models.perception.forming.coarray`).
What is bounded in the beams is bounded on the map by the inversion's magnitudes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from models.compiled import compiled
from models.perception.forming.coarray import AzimuthInterpolator
from msgs.values.radar import ArrayParams, BeamGrid, ElementPattern, RadarParams, RadarSetup
from sim_player.planner.purposes import DETECTION, Purpose, object_paths
from sim_player.trace.paths import Paths


class Cells:
    """Rows of cells of one radar: its beams, then the azimuths of its map."""

    def __init__(self, setup: RadarSetup) -> None:
        inversion = AzimuthInterpolator(setup)
        self._matrix = inversion.coherent_matrix  # [beams, azimuths]
        self._magnitude = np.abs(self._matrix).T
        self._noise_gain = np.linalg.norm(self._matrix, axis=0)
        self._azimuth_rad = np.concatenate([setup.beams.azimuth_rad, inversion.grid.azimuth_rad])
        apart_rad = np.abs(inversion.grid.azimuth_rad[:, None] - setup.beams.azimuth_rad)
        self._owner = apart_rad.argmin(axis=1)
        self._range_bin_m = setup.radar.range_bin_m
        aperture_m = setup.array.columns * setup.array.column_spacing(setup.radar.wavelength_m)
        self._half_beam_rad = 0.443 * setup.radar.wavelength_m / aperture_m
        step_rad = float(np.median(np.diff(setup.beams.azimuth_rad))) if len(setup.beams) > 1 else np.inf
        self._near_beams = int(self._half_beam_rad / abs(step_rad))
        self._near_azimuths = int(self._half_beam_rad / inversion.grid.azimuth_step_rad)

    def values(self, profiles: np.ndarray) -> np.ndarray:
        """Beams [beams, bins] and the map they make, complex [beams + azimuths, bins]."""
        return np.concatenate([profiles, self._matrix.T @ profiles])

    def bounds(self, bound: np.ndarray) -> np.ndarray:
        """Bounds in the beams, and on the map that their signals make, [beams + azimuths, bins]."""
        return np.concatenate([bound, self._magnitude @ bound])

    def nearest(self, limit: np.ndarray) -> np.ndarray:
        """Return the least limit of each beam and of the azimuths of the map nearest to it, [beams, bins]."""
        beams = len(limit) - self._matrix.shape[1]
        return _least_of(limit, self._owner, beams)

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
            return np.asarray(np.maximum(sure, DETECTION * rms))
        near = np.concatenate(
            [_strongest_near(sure[:beams], self._near_beams), _strongest_near(sure[beams:], self._near_azimuths)]
        )
        return np.asarray(np.maximum(near, rms))

    def asked(self, setup: RadarSetup, purpose: Purpose, paths: Paths, noise_rms: np.ndarray) -> np.ndarray | None:
        """Return the cells in which a purpose's law holds, bool [beams + azimuths, bins]; None: in all of them.

        `paths` are those of all effects. Cells of a path lie within one range bin and half a beam.
        """
        if purpose is not Purpose.OBJECTS:
            return None
        mine = paths.take(object_paths(setup, paths, noise_rms))
        bins = len(noise_rms)
        mask = np.zeros((len(self._azimuth_rad), bins), bool)
        centre = np.rint(0.5 * mine.length_m / self._range_bin_m).astype(int)
        for azimuth_rad, cell in zip(mine.azimuth_rad, centre, strict=True):
            rows = np.abs(self._azimuth_rad - azimuth_rad) <= self._half_beam_rad
            mask[rows, max(cell - 1, 0) : min(cell + 2, bins)] = True
        return mask

    def off(
        self,
        everything: np.ndarray,
        planned: np.ndarray,
        noise_rms: np.ndarray,
        purpose: Purpose = Purpose.SAMPLES,
        asked: np.ndarray | None = None,
    ) -> np.ndarray:
        """The law's ratio of two maps with the same noise, [beams + azimuths, bins]; 0 where it does not hold."""
        difference = np.abs(self.values(everything) - self.values(planned))
        ratio = difference / self.floor(everything, noise_rms, purpose=purpose)
        return np.asarray(ratio if asked is None else np.where(asked, ratio, 0.0))


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


@compiled
def _least_of(limit, owner, beams):  # type: ignore[no-untyped-def]
    """Least of the rows that each of the first `beams` rows owns among the rest, and of its own."""
    out = limit[:beams].copy()
    for row in range(len(owner)):
        for cell in range(limit.shape[1]):
            out[owner[row], cell] = min(out[owner[row], cell], limit[beams + row, cell])
    return out
