"""Hard cases of calibration: what moves through an open field, tones in the noise, headings beyond half a turn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from contrib.calibrate.background import background_of
from contrib.calibrate.front_end_faults import FaultMeter, FaultParams, sidebands_of
from contrib.calibrate.mounting import Motion
from contrib.calibrate.noise_floor import _median_mean
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from tests.stability.catalogue import Errors

EPOCH_NS = 1_763_750_000_123_456_789


@pytest.mark.hard("contrib.calibrate.background.background_of", "plain mean over scans", 3.0,
                  "rms of the background's noise", "noise of a mean of 32 scans, one bin")  # fmt: skip
def test_lorry_in_the_open_field(errors: Errors) -> None:
    """A lorry crosses the field 60 dB over a scan's noise, in one cell in three of 32 scans."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((2, 32, 1, 128)) / math.sqrt(2.0)
    chirps = noise[0] + 1j * noise[1]
    tone = np.exp(2j * np.pi * 20 * np.arange(128) / 128)
    chirps[[4, 5, 6]] += 1000.0 / math.sqrt(128.0) * np.exp(1j * np.array([0.1, 0.4, 0.9]))[:, None, None] * tone
    background, _ = background_of(chirps.astype(np.complex64))

    def left(values: np.ndarray) -> float:
        return float(abs(np.fft.fft(values[0])[20]) / math.sqrt(128.0 / 32.0))

    errors(naive=left(chirps.mean(axis=0)), ours=left(background))


@pytest.mark.hard("contrib.calibrate.noise_floor._median_mean", "mean power of the bins", 0.1, "dB",
                  "median of 4,096 exponential powers")  # fmt: skip
def test_tone_in_the_noise(errors: Errors) -> None:
    """Eight of 4,096 bins hold tones of 50 dB over the noise whose level is asked for."""
    power = np.random.default_rng(6).exponential(size=4096)
    power[::512] += 1e5
    errors(
        naive=abs(10.0 * math.log10(float(power.mean()))),
        ours=abs(10.0 * math.log10(_median_mean(power))),
    )


@pytest.mark.hard("contrib.calibrate.mounting.Motion.poses", "headings wrapped to half a turn, then interpolated", 1e-3,
                  "rad", "a state every 20 ms at 0.5 rad/s; straight lines between headings are exact")  # fmt: skip
def test_roundabout(errors: Errors) -> None:
    """Three turns of a roundabout at stamps of this century: between two states the heading passes half a turn."""
    states = [
        VehicleState(stamp_ns=EPOCH_NS + ns_from_s(0.02 * k), speed_mps=5.0, yaw_rate_rps=0.5) for k in range(2000)
    ]
    motion = Motion(states)
    asked_s = np.linspace(0.0, 39.0, 5001)
    true_rad = 0.5 * asked_s
    wrapped = np.interp(asked_s, motion.time_s, (0.5 * motion.time_s + np.pi) % (2.0 * np.pi) - np.pi)

    def off(heading_rad: np.ndarray) -> float:
        return float(np.abs((heading_rad - true_rad + np.pi) % (2.0 * np.pi) - np.pi).max())

    errors(naive=off(wrapped), ours=off(motion.poses(asked_s)[:, 2]))


@pytest.mark.hard("contrib.calibrate.front_end_faults.FaultMeter.imbalance",
                  "ratio of image to echo, however small the echo", 0.0, "of the echo's field",
                  "noise has no image")  # fmt: skip
def test_a_capture_of_noise_alone(errors: Errors) -> None:
    """No echo in the beam: both sides of the spectrum hold noise, and their ratio is no imbalance."""
    rng = np.random.default_rng(4)
    chirp = rng.standard_normal(1024) + 1j * rng.standard_normal(1024)
    meter = FaultMeter(RadarSetup(radar=RadarParams(samples_per_chirp=1024)), FaultParams(image_about_hz=0.0))
    meter.add(chirp)
    spectrum = np.fft.fft(chirp * np.hanning(1025)[:-1])
    wanted, image = spectrum[6:506], spectrum[-6:-506:-1]
    naive = abs(np.sum(wanted * image)) / np.sum(np.abs(wanted) ** 2)
    found = meter.imbalance()
    errors(naive=float(naive), ours=0.0 if found is None else 10.0 ** (found.image_db / 20.0))


@pytest.mark.hard("contrib.calibrate.front_end_faults.sidebands_of", "strongest line beside the echoes", 0.5, "dB",
                  "10 ranges of a line of -40 dB, in noise of 65,536 bins")  # fmt: skip
def test_a_mover_beside_the_sidebands(errors: Errors) -> None:
    """Lines of -40 dB at both sides of ten echoes, and a target that moves, 20 dB over all of them, on one line."""
    radar = RadarParams(chirps_per_beam=64, samples_per_chirp=1024)
    power = np.random.default_rng(8).exponential(size=(1024, 64))
    power[100:200:10, 0] += 1e8
    power[100:200:10, [10, -10]] += 1e4
    power[300, 10] += 1e7
    by_offset = power.sum(axis=0)
    (line,) = sidebands_of(radar, power.reshape(-1))
    naive_db = 10.0 * math.log10(by_offset[3:-3].max() / by_offset[0])
    errors(naive=abs(naive_db + 40.0), ours=abs(line.level_db + 40.0))
