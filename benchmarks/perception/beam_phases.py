"""Whether the phases of beams that were measured on the move say more than their magnitudes.

Beams of point echoes at known azimuths, far away, by the weights as set; the vehicle drives straight ahead, and its
speed is known exactly. Beam k, d_k further on, sees an echo at azimuth a with a phase of 2 k d_k cos(a) more, and it is
turned back by one of these:

- `axis`: for the direction of the beam's axis, as the former does before it tests coherence;
- `direction`: for the direction that is asked for, azimuth by azimuth, so that an echo there adds up in full;
- `magnitudes`: not at all; the magnitudes of the beams are interpolated.

Left over is what no coherent scene explains of the beams turned by their axes: the coherence test allows 0.003. Gain is
that of one echo against an ideal beam steered at it. Of two echoes alike, both count as resolved where each has a
maximum of its own within 1.5 degrees; any other maximum within 15 dB of the largest is spurious.
Usage: python -m benchmarks.perception.beam_phases [--trials 200] [--snr-db 30] [--apart-deg 12] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import NamedTuple

import numpy as np
from scipy.signal import argrelmax

from mirrorwave.studies.report import table
from models.perception.forming.coarray import AzimuthInterpolator, beam_matrix, coefficient_phases, peak_field
from msgs.values.radar import RadarSetup

SPEEDS_MPS = (0.0, 0.5, 2.0, 8.0, 20.0)
WAYS = ("axis", "direction", "magnitudes")
#: Echoes within this of straight ahead; a maximum belongs to an echo within this; spurious ones down to this.
SECTOR_RAD, NEAR_RAD, SPURIOUS_DB = 0.7, math.radians(1.5), 15.0
COLUMNS = ("speed [m/s]", "beams apart [wavelengths]", "left over", "way", "gain", "azimuth error p50, p95 [deg]",
           "both of two resolved", "spurious maxima")  # fmt: skip


class Row(NamedTuple):
    """One way at one speed."""

    speed_mps: float
    apart_wavelengths: float
    left_over: float
    way: str
    gain: float
    error_deg: tuple[float, float]
    resolved: float
    spurious: float


class MovingScan:
    """Beams of one scan at a speed, and the ways to azimuths of the map."""

    def __init__(self, setup: RadarSetup, speed_mps: float) -> None:
        self.setup, self.interpolator = setup, AzimuthInterpolator(setup)
        self._beams, self._beam_rad = beam_matrix(setup), setup.beams.azimuth_rad
        step_m = 1e-9 * setup.beam_interval_ns * speed_mps
        self.apart_wavelengths = step_m / setup.radar.wavelength_m
        # path to the echo and back
        self._turns = 2.0 * self.apart_wavelengths * np.arange(len(self._beam_rad))
        along = np.cos(self.interpolator.grid.azimuth_rad) - np.cos(self._beam_rad)[:, None]
        self._towards = self.interpolator.coherent_matrix * self._turned(-along)
        coefficients = self._beams @ np.linalg.pinv(self._beams)
        self._residual = np.eye(len(coefficients)) - coefficients

    def _turned(self, along: np.ndarray) -> np.ndarray:
        """Return the phase factors of directions by the cosine of their azimuth [beams, N]."""
        return np.asarray(np.exp(2j * np.pi * self._turns[:, None] * along))

    def beams_of(self, azimuth_rad: np.ndarray, phase_rad: np.ndarray) -> np.ndarray:
        """Return the beams, complex [beams], of unit echoes, turned by their axes."""
        echo = np.exp(-1j * np.multiply.outer(coefficient_phases(self.setup), np.sin(azimuth_rad)))
        seen = (self._beams @ echo) * self._turned(np.cos(azimuth_rad)[None]) * np.exp(1j * phase_rad)
        return np.asarray(seen.sum(axis=1) * self._turned(-np.cos(self._beam_rad)[:, None])[:, 0])

    def left_over(self, beams: np.ndarray) -> float:
        """Return the share of beams' energy that no coherent scene explains."""
        return float(np.linalg.norm(self._residual @ beams) ** 2 / np.linalg.norm(beams) ** 2)

    def levels(self, beams: np.ndarray) -> dict[str, np.ndarray]:
        """Return the magnitudes over the map's azimuths by each way."""
        magnitudes = self.interpolator.interpolate_magnitude(np.abs(beams)[:, None].astype(np.float32))[0]
        coherent = np.abs(beams @ self.interpolator.coherent_matrix), np.abs(beams @ self._towards)
        return dict(zip(WAYS, (*coherent, magnitudes), strict=True))


class Trials:
    """What all trials at one speed show, by way."""

    def __init__(self, setup: RadarSetup, speed_mps: float, snr_db: float, seed: int) -> None:
        self.scan, self.speed_mps = MovingScan(setup, speed_mps), speed_mps
        self._rng = np.random.default_rng(seed)
        self._noise = peak_field(setup) * 10.0 ** (-snr_db / 20.0) / math.sqrt(2.0)
        self._ideal = peak_field(setup)
        self.left_over: list[float] = []
        self.gain: dict[str, list[float]] = {way: [] for way in WAYS}
        self.error_rad: dict[str, list[float]] = {way: [] for way in WAYS}
        self.resolved: dict[str, list[bool]] = {way: [] for way in WAYS}
        self.spurious: dict[str, list[int]] = {way: [] for way in WAYS}

    def add(self, apart_rad: float) -> None:
        """Draw one echo, then two so far apart."""
        azimuth_rad = self._rng.uniform(-SECTOR_RAD, SECTOR_RAD, 1)
        beams = self._beams(azimuth_rad)
        self.left_over.append(self.scan.left_over(beams))
        grid_rad = self.scan.interpolator.grid.azimuth_rad
        for way, level in self.scan.levels(beams).items():
            self.gain[way].append(float(level.max()) / self._ideal)
            self.error_rad[way].append(float(abs(grid_rad[level.argmax()] - azimuth_rad[0])))
        pair_rad = self._rng.uniform(-SECTOR_RAD, SECTOR_RAD - apart_rad) + np.array([0.0, apart_rad])
        for way, level in self.scan.levels(self._beams(pair_rad)).items():
            least = level.max() * 10.0 ** (-SPURIOUS_DB / 20.0)
            at_rad = np.array([grid_rad[index] for index in argrelmax(level)[0] if level[index] >= least])
            off_rad = np.abs(np.subtract.outer(at_rad, pair_rad))
            self.resolved[way].append(bool((off_rad <= NEAR_RAD).any(axis=0).all()))
            self.spurious[way].append(int((off_rad > NEAR_RAD).all(axis=1).sum()))

    def _beams(self, azimuth_rad: np.ndarray) -> np.ndarray:
        clean = self.scan.beams_of(azimuth_rad, self._rng.uniform(0.0, 2.0 * np.pi, len(azimuth_rad)))
        noise = self._rng.standard_normal((2, len(clean))) * self._noise
        return np.asarray(clean + noise[0] + 1j * noise[1])

    def rows(self) -> list[Row]:
        """Return a row for each way."""
        return [
            Row(
                self.speed_mps,
                self.scan.apart_wavelengths,
                float(np.median(self.left_over)),
                way,
                float(np.median(self.gain[way])),
                tuple(np.degrees(np.percentile(self.error_rad[way], (50, 95))).tolist()),
                float(np.mean(self.resolved[way])),
                float(np.mean(self.spurious[way])),
            )
            for way in WAYS
        ]


def main() -> None:
    """Print the table, or its rows as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perception.beam_phases", description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--snr-db", type=float, default=30.0)
    parser.add_argument("--apart-deg", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    measured: list[Row] = []
    for speed_mps in SPEEDS_MPS:
        trials = Trials(RadarSetup(), speed_mps, options.snr_db, options.seed)
        for _ in range(options.trials):
            trials.add(math.radians(options.apart_deg))
        measured += trials.rows()
    if options.json:
        json.dump([row._asdict() for row in measured], sys.stdout, indent=1)
        return
    cells = [
        (f"{row.speed_mps:g}", f"{row.apart_wavelengths:.1f}", f"{row.left_over:.3f}", row.way, f"{row.gain:.2f}",
         f"{row.error_deg[0]:.2f}, {row.error_deg[1]:.2f}", f"{row.resolved:.0%}", f"{row.spurious:.1f}")
        for row in measured
    ]  # fmt: skip
    sys.stdout.write("\n".join(table(COLUMNS, cells)) + "\n")


if __name__ == "__main__":
    main()
