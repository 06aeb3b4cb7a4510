"""Leakage, imbalance and sidebands put into beams of noise, and what is measured of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from contrib.calibrate.front_end_faults import FaultMeter, FaultParams, sidebands_of
from contrib.calibrate.noise_floor import NoiseFloor, NoiseMeter
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup
from msgs.values.units import ratio_from_db
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.receiver import iq_imbalance
from tests.builders import example_beam

RADAR = RadarParams(chirps_per_beam=32, samples_per_chirp=1024, noise_figure_db=11.0)
COUNT = RADAR.samples_per_chirp
ECHO_DBM, LEAKAGE_DBM, LEAKAGE_M = -45.0, -50.0, 0.35


def beam(
    setup: RadarSetup, index: int, *, front_end: FrontEnd | None = None, about_hz: float = 0.0,
    wobble: float = 0.0, wobble_bins: int = 6, leak: bool = False, mover_dbm: float | None = None,
) -> RadarBeam:  # fmt: skip
    """An echo at bin 137.3 (another phase in each beam) on noise, with what is asked for."""
    rng = np.random.default_rng([11, index])
    chirp, sample = np.arange(RADAR.chirps_per_beam)[:, None], np.arange(COUNT)
    slow = 1.0 + 2.0 * wobble * np.cos(2.0 * np.pi * wobble_bins * chirp / RADAR.chirps_per_beam)
    values = math.sqrt(ratio_from_db(ECHO_DBM)) * np.exp(2j * np.pi * (137.3 * sample / COUNT + rng.random()))
    if leak:
        own = np.exp(2j * np.pi * LEAKAGE_M / RADAR.range_bin_m * sample / COUNT)
        values = values + math.sqrt(ratio_from_db(LEAKAGE_DBM)) * own
    values = values * slow
    if mover_dbm is not None:
        turns = 200.0 * sample / COUNT + 9.0 * chirp / RADAR.chirps_per_beam
        values = values + math.sqrt(ratio_from_db(mover_dbm)) * np.exp(2j * np.pi * turns)
    noise = rng.standard_normal((2, RADAR.chirps_per_beam, COUNT)) * math.sqrt(0.5 * RADAR.noise_power_mw)
    values = values + noise[0] + 1j * noise[1]
    values = values if setup.beat_sign > 0 else np.conj(values)
    if front_end is not None:
        axis = np.exp(2j * np.pi * about_hz / RADAR.sample_rate_hz * sample)
        values = iq_imbalance(values / axis, values / axis, front_end) * axis
    codes = values / math.sqrt(setup.milliwatt_per_code_squared)
    return example_beam(
        stamp_ns=index,
        beam_index=index,
        azimuth_rad=float(setup.beams.azimuth_rad[index]),
        samples=np.rint(np.stack([codes.real, codes.imag], axis=-1)).astype(np.int16),
        full_scale_dbm=setup.full_scale_dbm,
    )


def measured(params: FaultParams, beat_sign: int = 1, **asked: object) -> NoiseFloor:
    setup = RadarSetup(radar=RADAR, beat_sign=beat_sign)
    meter = NoiseMeter(setup, params)
    for index in range(8):
        meter.add(beam(setup, index, **asked))  # type: ignore[arg-type]
    return meter.result()


@pytest.mark.parametrize("beat_sign", [1, -1])
@pytest.mark.parametrize("about_hz", [0.0, -7.3e6])
def test_imbalance_comes_back(beat_sign: int, about_hz: float) -> None:
    """Q louder by 0.4 dB and late by 2 deg, about zero beat and about another frequency: an image of -30.8 dB.
    Tolerance 0.02 dB and 0.1 deg: the image's bins hold noise 40 dB under it."""
    floor = measured(
        FaultParams(image_about_hz=about_hz), beat_sign, front_end=FrontEnd(iq_gain_db=0.4, iq_phase_deg=2.0),
        about_hz=about_hz,
    )  # fmt: skip
    assert floor.imbalance is not None
    assert floor.imbalance.gain_db == pytest.approx(0.4, abs=0.02)
    assert floor.imbalance.phase_deg == pytest.approx(2.0, abs=0.1)
    assert floor.imbalance.image_db == pytest.approx(-30.8, abs=0.2)


def test_balanced_receivers_have_no_image() -> None:
    floor = measured(FaultParams(image_about_hz=0.0))
    assert floor.imbalance is None or floor.imbalance.image_db < -65.0


def test_leakage_comes_back_with_its_range() -> None:
    """-50 dBm at 0.35 m beside an echo of -45 dBm; tolerance 0.2 dB and an eighth of a bin (0.027 m)."""
    floor = measured(FaultParams(leakage_to_m=1.5), leak=True)
    assert floor.leakage is not None
    assert floor.leakage.power_dbm == pytest.approx(LEAKAGE_DBM, abs=0.2)
    assert floor.leakage.range_m == pytest.approx(LEAKAGE_M, abs=0.027)
    assert measured(FaultParams(leakage_to_m=1.5)).leakage is None


def test_leakage_on_the_flank_of_an_echo_is_refused() -> None:
    with pytest.raises(ValueError, match="the profile still rises there"):
        measured(FaultParams(leakage_to_m=0.2), leak=True)


def test_sidebands_are_told_from_what_moves() -> None:
    """Amplitude wobbles by 2 x -25 dB at 6 lines of the beam: a line of -25 dB on both sides. A mover, on one side,
    10 dB louder than the sidebands, is none. Tolerance 0.5 dB."""
    floor = measured(FaultParams(), wobble=10.0 ** (-25.0 / 20.0), mover_dbm=ECHO_DBM - 15.0)
    (sideband,) = floor.sidebands
    assert sideband.frequency_hz == pytest.approx(6.0 / RADAR.beam_duration_s)
    assert sideband.level_db == pytest.approx(-25.0, abs=0.5)
    # they are no tones, and the floor does not rise
    assert floor.noise_figure_db == pytest.approx(11.0, abs=0.1)


def test_noise_alone_has_no_sidebands() -> None:
    power = np.random.default_rng(0).exponential(size=RADAR.chirps_per_beam * COUNT)
    assert sidebands_of(RADAR, power) == ()
    assert sidebands_of(RADAR, np.zeros(RADAR.chirps_per_beam * COUNT)) == ()


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"leakage_to_m": 1e6}, "leakage_to_m must be under"),
        ({"leakage_to_m": -1.0}, "leakage_to_m must be finite and positive"),
        ({"image_about_hz": math.nan}, "image_about_hz must be finite"),
        ({"image_about_hz": 1e12}, "image_about_hz must be within"),
    ],
)
def test_faults_out_of_range_are_refused(params: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        FaultMeter(RadarSetup(radar=RADAR), FaultParams(**params))
