"""Speed and exactness of range-azimuth forming at full size: 25 beams of 128 chirps x 8192 samples, 100 MiB.

Run from the root of the checkout, on one core so that ratios compare like with like:
OMP_NUM_THREADS=1 python -m benchmarks.perception.ra_forming [--json] [--rounds 7] [--seed 0]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial

import numba
import numpy as np
import scipy

from models.perception.form.coarray import AzimuthInterpolator, beam_matrix, ideal_beams
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import BeamFolder, FormingParams
from models.perception.form.slow_time_sums import fold_chirps
from models.physics.antenna import element_field, row_field, setup_weights, steering_weights, two_way_pattern
from models.physics.waveform import beat_samples
from msgs.values.radar import ArrayParams, RadarBeam, RadarSetup, RangeAzimuthGrid

SETUP = RadarSetup()
GRID = RangeAzimuthGrid()
#: Static points of the scene: range [m], azimuth [deg], power at boresight [dBm].
POINTS = ((6.5, -38.0, -45.0), (14.2, 11.0, -60.0), (30.0, 35.0, -75.0), (61.7, -4.0, -90.0), (103.0, 48.0, -100.0))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=7, help="interleaved repetitions of every timing")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    beams = make_scan(options.seed)
    report = {
        "seed": options.seed,
        "rounds": options.rounds,
        "machine": machine(),
        "folding": time_folding(beams, options.rounds),
        "forming": time_forming(beams, options.rounds),
        "map_relative_l2": literal_error(beams),
        "pattern_error_inside_50_deg": pattern_error(),
        "doppler_loss_db": doppler_loss(),
    }
    if options.json:
        print(json.dumps(report))
    else:
        for name, value in report.items():
            print(f"{name:28} {json.dumps(value)}")


def machine() -> dict[str, str | int | None]:
    """What the figures were measured on."""
    return {
        "system": platform.system(),
        "architecture": platform.machine(),
        "cores": os.cpu_count(),
        "threads": os.environ.get("OMP_NUM_THREADS"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
    }


def make_scan(seed: int) -> list[RadarBeam]:
    """A static scene with thermal noise as 25 beams of int16 codes."""
    rng = np.random.default_rng(seed)
    radar, points = SETUP.radar, np.array(POINTS)
    code = np.sqrt(SETUP.milliwatt_per_code_squared)
    beats = beat_samples(radar, 2.0 * points[:, 0]) * (10.0 ** (points[:, 2] / 20.0) / code)[:, None]
    gain = recorded_pattern(np.radians(points[:, 1]), with_elements=True)
    gain /= np.abs(recorded_pattern(np.zeros(1), with_elements=True)).max()
    noise = np.sqrt(radar.noise_power_mw / 2.0) / code
    beams = []
    for index, azimuth_rad in enumerate(SETUP.beams.azimuth_rad):
        chirp = gain[index] @ beats
        codes = rng.standard_normal((radar.chirps_per_beam, radar.samples_per_chirp, 2), np.float32) * np.float32(noise)
        codes += np.stack([chirp.real, chirp.imag], axis=-1).astype(np.float32)
        beams.append(
            RadarBeam(
                stamp_ns=index * SETUP.beam_interval_ns,
                scan_id=0,
                beam_index=index,
                beam_count=len(SETUP.beams),
                azimuth_rad=float(azimuth_rad),
                samples=np.rint(codes).clip(-32768, 32767).astype(np.int16),
                full_scale_dbm=SETUP.full_scale_dbm,
            )
        )
    return beams


def recorded_pattern(
    azimuth_rad: np.ndarray, with_elements: bool, setup: RadarSetup = SETUP, weights: np.ndarray | None = None
) -> np.ndarray:
    """Recorded two-way pattern, complex128 [beams, directions]."""
    level = np.zeros_like(azimuth_rad)
    pattern = two_way_pattern(setup, setup_weights(setup) if weights is None else weights, azimuth_rad, level).conj()
    if with_elements:
        return pattern
    elements = element_field(setup.element, azimuth_rad, level)
    return pattern / (elements * row_field(setup.array, setup.radar.wavelength_m, level)) ** 2


def time_folding(beams: list[RadarBeam], rounds: int) -> dict[str, float]:
    """Folding a scan to 8 sums a beam against copying it into memory already there; medians, interleaved."""
    scan = np.stack([beam.samples for beam in beams])
    copied = np.empty_like(scan)
    fold_chirps(scan[0], 8)
    folds, copies = [], []
    for _ in range(rounds):
        folds.append(seconds(lambda: [fold_chirps(samples, 8) for samples in scan]))
        copies.append(seconds(partial(np.copyto, copied, scan)))
    ratios = [fold / copy for fold, copy in zip(folds, copies, strict=True)]
    return {
        "scan_mib": scan.nbytes / 2**20,
        "fold_ms": 1e3 * statistics.median(folds),
        "copy_ms": 1e3 * statistics.median(copies),
        "ratio": statistics.median(ratios),
    }


def time_forming(beams: list[RadarBeam], rounds: int) -> dict[str, float]:
    """Time in `add` of a beam, and of the last one, which brings the map."""
    each, last = [], []
    for _ in range(rounds):
        former = RaFormer(SETUP)
        durations = [seconds(partial(former.add, beam)) for beam in beams]
        each += durations[1:-1]
        last.append(durations[-1])
    return {"beam_ms": 1e3 * statistics.median(each), "last_beam_ms": 1e3 * statistics.median(last)}


def seconds(call: Callable[[], object]) -> float:
    """Duration of a call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def literal_error(beams: list[RadarBeam]) -> float:
    """Relative L2 of a map against float64: windowed FFT of every chirp, mean, least squares on the co-array."""
    former = RaFormer(SETUP)
    values = next(formed for beam in beams for formed in former.add(beam)).values
    samples = SETUP.radar.samples_per_chirp
    window = 1.0 - np.cos(2.0 * np.pi * np.arange(samples) / samples)
    profiles = []
    for beam in beams:
        spectra = np.fft.fft((beam.samples[..., 0] + 1j * beam.samples[..., 1]) * window, axis=1) / samples
        profiles.append(np.sqrt(SETUP.milliwatt_per_code_squared) * spectra[:, : GRID.range_bins].mean(axis=0))
    coefficients = np.linalg.lstsq(beam_matrix(SETUP), np.array(profiles), rcond=None)[0]
    exact = (ideal_beams(SETUP, GRID.azimuth_rad) @ coefficients).T
    return float(np.linalg.norm(values - exact) / np.linalg.norm(exact))


def pattern_error() -> float:
    """Largest error of interpolated beams against ideal ones, relative to the peak, targets and cells inside 50 deg."""
    azimuth_rad = np.radians(np.linspace(-50.0, 50.0, 201))
    beams = recorded_pattern(azimuth_rad, with_elements=False).astype(np.complex64)
    values, _ = AzimuthInterpolator(SETUP, GRID).interpolate(beams, 0.0)
    ideal = RadarSetup(array=ArrayParams(phase_bits=0))
    weights = steering_weights(ideal.array, ideal.radar.wavelength_m, GRID.azimuth_rad)
    exact = recorded_pattern(azimuth_rad, with_elements=False, setup=ideal, weights=weights).T
    inside = np.abs(np.degrees(GRID.azimuth_rad)) <= 50.0
    return float(np.abs(values - exact)[:, inside].max() / SETUP.array.columns)


def doppler_loss() -> dict[str, object]:
    """Worst loss of a closing target, noise-free, over 0..40 m/s by 0.5, beside that of a plain mean over chirps."""
    radar = SETUP.radar
    folder = BeamFolder(SETUP, FormingParams(), GRID)
    middle_s = radar.chirp_period_s * (np.arange(radar.chirps_per_beam) - (radar.chirps_per_beam - 1) / 2.0)
    speeds_mps = np.append(np.arange(0.0, 40.1, 0.5), 21.4)
    losses_db = [-20.0 * np.log10(_closing_level(folder, middle_s * speed)) for speed in speeds_mps]
    plain = np.abs(np.sinc(2.0 * np.array([15.0, 21.4]) * radar.beam_duration_s / radar.wavelength_m))
    return {
        "worst_db": round(max(losses_db), 2),
        "at_15_and_21.4_db": [round(losses_db[30], 2), round(losses_db[-1], 2)],
        "plain_mean_at_15_and_21.4_db": np.round(-20.0 * np.log10(plain), 1).tolist(),
    }


def _closing_level(folder: BeamFolder, approach_m: np.ndarray) -> float:
    """Level of a target on a bin that comes closer by so much at each chirp, relative to one that stands."""
    beat = 1000.0 * beat_samples(SETUP.radar, 2.0 * (100 * SETUP.radar.range_bin_m - approach_m))
    beam = RadarBeam(
        stamp_ns=0,
        scan_id=0,
        beam_index=12,
        beam_count=len(SETUP.beams),
        azimuth_rad=0.0,
        samples=np.rint(np.stack([beat.real, beat.imag], axis=-1)).astype(np.int16),
        full_scale_dbm=SETUP.full_scale_dbm,
    )
    profile = folder.fold(beam).profile
    return float(np.abs(profile).max() / (1000.0 * np.sqrt(SETUP.milliwatt_per_code_squared)))


if __name__ == "__main__":
    main()
