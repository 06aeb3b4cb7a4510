"""Noise floor: white noise, 1/f noise, tones and echoes of known power, as codes."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contrib.calibrate.noise_floor import NoiseFloor, NoiseMeter
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup
from msgs.values.units import db_from_ratio, ratio_from_db
from tests.builders import beam_of

RADAR = RadarParams(chirps_per_beam=32, samples_per_chirp=1024, noise_figure_db=11.0)
SETUP = RadarSetup(radar=RADAR)
COUNT = RADAR.chirps_per_beam * RADAR.samples_per_chirp
CORNER_HZ, SPUR_HZ, SPUR_DBM = 5e6, 123.4e6, -80.0


def beam(index: int, corner_hz: float = 0.0, echo_dbm: float | None = None, spur: bool = False) -> RadarBeam:
    """A beam of noise in codes, with what is asked for."""
    rng = np.random.default_rng([7, index])
    frequency_hz = np.fft.fftfreq(COUNT, 1.0 / RADAR.sample_rate_hz)
    shape = 1.0 + corner_hz / np.maximum(np.abs(frequency_hz), 1.0 / RADAR.beam_duration_s)
    draws = rng.standard_normal((2, COUNT))
    spectrum = (draws[0] + 1j * draws[1]) * np.sqrt(0.5 * RADAR.noise_power_mw * COUNT * shape)
    samples = np.fft.ifft(spectrum)
    time_s = np.arange(COUNT) / RADAR.sample_rate_hz
    if echo_dbm is not None:
        chirp = np.exp(2j * np.pi * 37.3 * np.arange(RADAR.samples_per_chirp) / RADAR.samples_per_chirp)
        samples += np.sqrt(ratio_from_db(echo_dbm)) * np.tile(chirp, RADAR.chirps_per_beam)
    if spur:
        samples += np.sqrt(ratio_from_db(SPUR_DBM)) * np.exp(2j * np.pi * (SPUR_HZ * time_s + rng.random()))
    codes = samples / np.sqrt(SETUP.milliwatt_per_code_squared)
    pairs = np.stack([codes.real, codes.imag], axis=-1).reshape(RADAR.chirps_per_beam, -1, 2)
    return beam_of(SETUP, index, np.rint(pairs).astype(np.int16), stamp_ns=index)


def measured(corner_hz: float = 0.0, echo_dbm: float | None = None, spur: bool = False) -> NoiseFloor:
    meter = NoiseMeter(SETUP)
    for index in range(len(SETUP.beams)):
        meter.add(beam(index, corner_hz, echo_dbm, spur))
    return meter.result()


def test_white_noise_gives_its_figure() -> None:
    """k T0 f_s F at 11 dB is -71.2 dBm; tolerance 0.05 dB: 0.01 of 0.8 M samples, the rest of the fit's corner."""
    floor = measured()
    assert floor.noise_figure_db == pytest.approx(11.0, abs=0.05)
    assert floor.power_dbm == pytest.approx(db_from_ratio(RADAR.noise_power_mw), abs=0.05)
    assert floor.bin_dbm == pytest.approx(db_from_ratio(RADAR.noise_power_mw) + 10.0 * np.log10(1.5 / COUNT), abs=0.05)
    assert floor.flicker_corner_hz == 0.0
    assert floor.spurs == ()
    assert floor.beam_spread_db < 0.3


def test_corner_and_tone_are_found_under_an_echo() -> None:
    """1/f noise of 5 MHz, a tone of -80 dBm and an echo of -45 dBm; corner within 8 %, tone within 0.5 dB, 2 kHz."""
    floor = measured(CORNER_HZ, echo_dbm=-45.0, spur=True)
    assert floor.noise_figure_db == pytest.approx(11.0, abs=0.05)
    assert floor.flicker_corner_hz == pytest.approx(CORNER_HZ, rel=0.08)
    assert floor.model_rms_db < 0.4
    (spur,) = floor.spurs
    assert spur.frequency_hz == pytest.approx(SPUR_HZ, abs=2e3)
    assert spur.power_dbm == pytest.approx(SPUR_DBM, abs=0.5)


@pytest.mark.parametrize("beat_sign", [1, -1])
def test_a_tone_is_named_by_the_sign_of_the_receivers_beats(beat_sign: int) -> None:
    """Codes hold a tone at +123.4 MHz. Where positive ranges make negative beats it lies on the other side of zero,
    where no echo is: -123.4 MHz. Tolerance 2 kHz: a twentieth of a bin, 1 / 21.8 us."""
    setup = RadarSetup(radar=RADAR, beat_sign=beat_sign)
    meter = NoiseMeter(setup)
    for index in range(4):
        meter.add(beam(index, spur=True))
    (spur,) = meter.result().spurs
    assert spur.frequency_hz == pytest.approx(beat_sign * SPUR_HZ, abs=2e3)
    assert spur.power_dbm == pytest.approx(SPUR_DBM, abs=0.5)


def test_captures_that_tell_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="chirps_per_beam must be at least 8, got 4"):
        NoiseMeter(RadarSetup(radar=RadarParams(chirps_per_beam=4)))
    with pytest.raises(ValueError, match="at least one beam"):
        NoiseMeter(SETUP).result()
    meter = NoiseMeter(SETUP)
    silent = np.zeros((RADAR.chirps_per_beam, RADAR.samples_per_chirp, 2), np.int16)
    one = beam(0)
    meter.add(
        RadarBeam(**{name: getattr(one, name) for name in one.__struct_fields__ if name != "samples"}, samples=silent)
    )
    with pytest.raises(ValueError, match="without any noise"):
        meter.result()


def test_beams_too_short_for_a_band_are_refused() -> None:
    meter = NoiseMeter(RadarSetup(radar=RadarParams(chirps_per_beam=8, samples_per_chirp=16)))
    one, codes = beam(0), np.random.default_rng(0).integers(-50, 50, (8, 16, 2), dtype=np.int16)
    meter.add(msgspec.structs.replace(one, samples=codes))
    with pytest.raises(ValueError, match="beams of 8 chirps of 16 samples are too short"):
        meter.result()


def test_beams_with_rests_between_chirps_give_level_and_tone() -> None:
    """Chirps of 0.68 us every 1.2 us: white noise within 0.1 dB and a tone within 0.5 dB and 3 kHz, as without rests;
    the tone's lines 1 / T beside it are not tones of their own."""
    # 148.56 turns from chirp to chirp: away from the echoes' lines
    interval, spur_hz = 1800, 123.8e6
    radar = msgspec.structs.replace(RADAR, chirp_interval_s=interval / RADAR.sample_rate_hz)
    setup = RadarSetup(radar=radar)
    rng = np.random.default_rng(3)
    time_s = np.arange(RADAR.chirps_per_beam * interval) / RADAR.sample_rate_hz
    tone = np.sqrt(ratio_from_db(SPUR_DBM)) * np.exp(2j * np.pi * spur_hz * time_s)
    meter = NoiseMeter(setup)
    for index in range(4):
        noise = rng.standard_normal((2, len(time_s))) * np.sqrt(0.5 * RADAR.noise_power_mw)
        values = (tone + noise[0] + 1j * noise[1]) / np.sqrt(setup.milliwatt_per_code_squared)
        taken = values.reshape(-1, interval)[:, : RADAR.samples_per_chirp]
        codes = np.rint(np.stack([taken.real, taken.imag], axis=-1)).astype(np.int16)
        meter.add(msgspec.structs.replace(beam(index), samples=codes))
    floor = meter.result()
    assert floor.noise_figure_db == pytest.approx(11.0, abs=0.1)
    (spur,) = floor.spurs
    assert spur.frequency_hz == pytest.approx(spur_hz, abs=3e3)
    assert spur.power_dbm == pytest.approx(SPUR_DBM, abs=0.5)


def test_a_clipped_burst_is_refused() -> None:
    """A tone of three times full scale: most codes stand at a limit, and its harmonics would pass for spurs."""
    sample = np.arange(COUNT).reshape(RADAR.chirps_per_beam, -1)
    tone = 1e5 * np.exp(2j * np.pi * 0.1234 * sample)
    codes = np.clip(np.stack([tone.real, tone.imag], axis=-1), -32768, 32767).astype(np.int16)
    with pytest.raises(ValueError, match=r"at most 0.1 % of codes may stand at full scale, 7\d\.\d % of beam 0 do"):
        NoiseMeter(SETUP).add(msgspec.structs.replace(beam(0), samples=codes))
