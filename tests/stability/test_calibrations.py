"""Hard cases of calibration: what moves through an open field, tones in the noise, headings beyond half a turn."""

from __future__ import annotations

import numpy as np
import pytest

from contrib.calibrate.front_end_faults import FaultMeter, FaultParams
from contrib.calibrate.mounting import Motion
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from tests.stability.catalogue import Errors

EPOCH_NS = 1_763_750_000_123_456_789


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
