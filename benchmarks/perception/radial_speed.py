"""Radial speed of a cell against its Cramer-Rao bound, over the SNR of the cell.

One echo at a random azimuth within +-50 degrees, closing in or going away at up to 20 m/s, on the default radar's
beams: the slow-time sums of one range bin in white noise, estimated beam by beam and weighed over beams as the former
does. The bound is that of all chirps of all beams together, the echo's amplitude, phase in each beam and speed unknown.
SNR is that of `Peaks`: an ideal beam steered at the echo, over the noise of a coherent cell. `stated` is the standard
deviation that `Peaks` gives; `missed` is the share off by more than half a Doppler bin, left out of the RMSE.

    python -m benchmarks.perception.radial_speed [--trials 2000] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json

import numpy as np
from rich.console import Console

from mirrorwave.studies.report import table
from models.perception.forming.coarray import SEEN_SPACINGS, AzimuthInterpolator
from models.perception.forming.ra_forming import BeamFolder, FormingParams
from models.perception.forming.radial_speed import HEARD, beam_speeds, cell_speeds, unit_std_mps
from models.physics.antenna import element_field, setup_weights, two_way_pattern
from msgs.values.radar import NO_RADIAL_SPEED, RadarSetup, RangeAzimuthGrid
from msgs.values.units import ratio_from_db

SETUP = RadarSetup()
SNR_DB = tuple(range(10, 41, 5))
MAX_SPEED_MPS, MAX_AZIMUTH_RAD = 20.0, np.radians(50.0)


def trial_errors(snr_db: float, trials: int, seed: int) -> dict[str, float]:
    """Return RMSE, bound, stated standard deviation [m/s] and the share missed at one SNR."""
    rng = np.random.default_rng([seed, round(snr_db)])
    radar = SETUP.radar
    wavelength_m = radar.wavelength_m
    folder = BeamFolder(SETUP, FormingParams(), RangeAzimuthGrid())
    azimuth_rad = rng.uniform(-MAX_AZIMUTH_RAD, MAX_AZIMUTH_RAD, trials)
    speed_mps = rng.uniform(-MAX_SPEED_MPS, MAX_SPEED_MPS, trials)
    gain = _beam_gains(azimuth_rad)
    # noise of a beam is 1; that of a cell is less
    amplitude = np.sqrt(ratio_from_db(snr_db) * AzimuthInterpolator(SETUP).noise_gain())
    phase = np.exp(2j * np.pi * rng.random((len(gain), trials)))
    chirp_s = (np.arange(radar.chirps_per_beam) + 0.5) * radar.repetition_interval_s - 0.5 * folder.duration_s
    turn = 4.0 * np.pi / wavelength_m * speed_mps
    tones = np.exp(1j * np.multiply.outer(chirp_s, turn))
    sums = np.add.reduceat(tones, folder.group_edges[:-1], axis=0) / radar.chirps_per_beam
    power, speeds = np.empty(gain.shape), np.empty(gain.shape, np.float32)
    for beam in range(len(gain)):
        series = (amplitude * gain[beam] * phase[beam] * sums + _noise(rng, folder.groups, trials)).astype(np.complex64)
        doppler = folder._doppler(series, None)
        row = np.argmax(np.abs(doppler), axis=0)
        power[beam] = np.abs(np.take_along_axis(doppler, row[None], axis=0)[0]) ** 2
        coarse = 2.0 * np.pi * folder._doppler_hz[row]
        speeds[beam] = beam_speeds(series, coarse, folder.group_time_s, wavelength_m)
    speeds[power <= HEARD] = np.nan
    beams = SETUP.beams.azimuth_rad
    near = np.abs(np.subtract.outer(azimuth_rad, beams)) <= SEEN_SPACINGS * float(np.median(np.diff(beams)))
    # a cell of its own for each echo: the diagonal
    cells = np.diagonal(cell_speeds(speeds, power, 1.0, near))
    error = np.where(cells == NO_RADIAL_SPEED, np.nan, 0.01 * cells) - speed_mps
    kept = np.abs(error) <= 0.25 * wavelength_m / folder.duration_s
    unit = unit_std_mps(wavelength_m, folder.duration_s)
    return {
        "snr_db": snr_db,
        "rmse_mps": float(np.sqrt(np.mean(error[kept] ** 2))),
        "bound_mps": float(np.sqrt(np.mean(unit**2 / (amplitude**2 * (gain**2).sum(axis=0))))),
        "stated_mps": unit / np.sqrt(ratio_from_db(snr_db)),
        "missed": float(1.0 - kept.mean()),
    }


def _beam_gains(azimuth_rad: np.ndarray) -> np.ndarray:
    """Return the magnitude of each beam's pattern, one where it is steered at the echo, [beams, trials]."""
    level = np.zeros(len(azimuth_rad))
    gain = np.abs(two_way_pattern(SETUP, setup_weights(SETUP), azimuth_rad, level))
    element = element_field(SETUP.element, azimuth_rad, level) / element_field(SETUP.element, np.zeros(1), np.zeros(1))
    ahead = np.abs(two_way_pattern(SETUP, setup_weights(SETUP)[12:13], np.zeros(1), np.zeros(1)))[0, 0]
    return np.asarray(gain / (ahead * element**2))


def _noise(rng: np.random.Generator, groups: int, trials: int) -> np.ndarray:
    """Return noise of slow-time sums whose total has power 1."""
    return np.sqrt(0.5 / groups) * (rng.standard_normal((groups, trials)) + 1j * rng.standard_normal((groups, trials)))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = [trial_errors(snr_db, arguments.trials, arguments.seed) for snr_db in SNR_DB]
    if arguments.json:
        Console().print_json(json.dumps(rows))
        return
    columns = ("SNR [dB]", "RMSE [m/s]", "bound [m/s]", "RMSE / bound", "stated [m/s]", "missed")
    cells = (
        (
            f"{row['snr_db']:g}",
            f"{row['rmse_mps']:.2f}",
            f"{row['bound_mps']:.2f}",
            f"{row['rmse_mps'] / row['bound_mps']:.2f}",
            f"{row['stated_mps']:.2f}",
            f"{row['missed']:.1%}",
        )
        for row in rows
    )
    print("\n".join(table(columns, cells)))


if __name__ == "__main__":
    main()
