"""The Phaser kit's numbers: chirp, registers, samples; and a recorded burst of a real board, where it is at hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.simulator.real_burst import driven_beam, recorded_burst, setup
from contrib.boards.phaser_model import (
    INTERVAL_SAMPLES,
    OFFSET_HZ,
    PHASE_STEP_DEG,
    RAMP_TIME_S,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_CHIRP,
    PhaserCalibration,
    PhaserParams,
    beam_samples,
    beam_table,
    limits,
    radar_params,
    radar_setup,
    synthesiser_words,
)
from models.perception.form.coarray import AzimuthInterpolator, ideal_beams
from models.perception.form.map_quality import wiring_faults
from models.perception.form.ra_forming import BeamFolder, FormingParams
from models.physics.waveform import beat_frequency_hz
from msgs.values.radar import BeamGrid, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from tests.captures import DATA, needs

BURST = DATA / "xband_cn0566_fmcw" / "hex"
PARAMS = PhaserParams()
#: Gains measured on two boards, 1 at the weakest element.
BOARD_GAINS = (
    (0.638, 0.813, 0.790, 0.974, 0.770, 0.800, 0.614, 1.0),
    (0.861, 0.993, 0.877, 0.844, 0.926, 1.0, 0.868, 0.939),
)


def test_known_numbers_of_the_chirp() -> None:
    """500 MHz in 300 us, 4 MS/s, 1024 samples: by hand."""
    radar, words, found = radar_params(PARAMS), synthesiser_words(), limits(PARAMS)
    assert radar.chirp_slope_hz_per_s == pytest.approx(500e6 / 300e-6)
    assert radar.range_bin_m == pytest.approx(0.3513, abs=1e-4)
    assert beat_frequency_hz(radar, np.array([20.0]))[0] == pytest.approx(111.2e3, rel=1e-3)
    # the oscillator above the band, a fourth of it at the synthesiser
    assert (words.frequency_hz, words.deviation_range_hz, words.deviation_time_us) == (3_000_025_000, 125_000_000, 300)
    assert words.deviation_step_hz * words.deviation_time_us == pytest.approx(125e6, rel=1e-5)
    assert found.range_limit_m == pytest.approx(170.9, abs=0.1)
    assert found.speed_limit_mps == pytest.approx(14.7, abs=0.1)
    assert found.speed_bin_mps == pytest.approx(1.84, abs=0.01)
    assert (found.beam_time_s, found.beam_bytes) == (pytest.approx(8e-3), 256_000)


@pytest.mark.parametrize("first_element_left", [False, True])
def test_registers_steer_the_array_they_are_written_to(first_element_left: bool) -> None:
    """Elements with gains and phases of their own, calibrated: columns add up at the angle asked for.

    Tolerance: half a register step of phase and one gain code, 0.02 of the peak.
    """
    rng = np.random.default_rng(3)
    own = rng.uniform(-180.0, 180.0, 8)
    calibration = PhaserCalibration(gains=BOARD_GAINS[0], phases_deg=tuple(-own))
    params = PhaserParams(first_element_left=first_element_left)
    table = beam_table(params, calibration, BeamGrid())
    assert (table.phases_deg % PHASE_STEP_DEG == 0.0).all()
    assert ((table.phases_deg >= 0.0) & (table.phases_deg < 360.0)).all()
    # what the board makes of the registers, element by element, seen from the right
    board = np.exp(1j * np.radians(own)) / np.array(BOARD_GAINS[0])
    set_weights = board * table.gain_codes / 127.0 * np.exp(1j * np.radians(table.phases_deg))
    seen = set_weights[:, ::-1] if first_element_left else set_weights
    np.testing.assert_allclose(seen, table.weights, atol=1e-6)
    place_m = PARAMS.column_spacing_m * (np.arange(8) - 3.5)
    wave = 2.0 * np.pi / radar_params(params).wavelength_m * np.multiply.outer(np.sin(BeamGrid().azimuth_rad), place_m)
    gain = np.abs((seen * np.exp(1j * wave)).sum(axis=1)) / 8.0
    np.testing.assert_allclose(gain, 1.0, atol=0.02)


@pytest.mark.parametrize("gains", BOARD_GAINS)
def test_known_weights_make_a_point_exact_and_unknown_ones_do_not(gains: tuple[float, ...]) -> None:
    """Beams of a point at 23 deg on the two boards of which gains are known, with and without their calibration.

    The set-up's weights hold the rounding, so what is left is float32; a board taken for perfect errs by percents.
    """
    errors = []
    for calibration in (PhaserCalibration(gains=gains), PhaserCalibration()):
        table = beam_table(PARAMS, calibration, BeamGrid())
        setup = radar_setup(PARAMS, BeamGrid(), table.weights)
        phase = 2.0 * np.pi / setup.radar.wavelength_m * PARAMS.column_spacing_m * (np.arange(8) - 3.5)
        echo = np.exp(-1j * phase * np.sin(np.radians(23.0)))
        real = table.gain_codes / 127.0 / np.array(gains) * np.exp(1j * np.radians(table.phases_deg))
        beams = (real.conj() @ echo / np.sqrt(8.0)).astype(np.complex64)[:, None]
        interpolator = AzimuthInterpolator(setup)
        values, _ = interpolator.interpolate(beams, np.inf)
        exact = ideal_beams(setup, interpolator.grid.azimuth_rad) @ echo
        scale = np.vdot(exact, values[0]) / np.vdot(exact, exact)
        errors.append(np.abs(values[0] / scale - exact).max() / np.sqrt(8.0))
    calibrated, not_calibrated = errors
    assert calibrated < 1e-4
    assert not_calibrated > 0.02


def burst_of(beat_hz: float, codes: float, params: PhaserParams = PARAMS) -> list[np.ndarray]:
    """Both channels of a burst: the same tone from the start of every ramp, zeros between the ramps."""
    time_s = np.arange(INTERVAL_SAMPLES) / SAMPLE_RATE_HZ
    chirp = codes * np.exp(2j * np.pi * beat_hz * time_s) * (time_s < RAMP_TIME_S)
    return [np.tile(chirp, params.chirps_per_beam)] * 2


def test_a_beat_comes_out_at_its_range_and_level() -> None:
    """Bin 40 over the offset, 100 codes in both channels: 1600 codes in bin 40, nothing else (codes are rounded)."""
    beat_hz = OFFSET_HZ + 40 * SAMPLE_RATE_HZ / SAMPLES_PER_CHIRP
    samples = beam_samples(burst_of(beat_hz, 100.0), PARAMS)
    assert samples.shape == (16, 1024, 2)
    spectrum = np.abs(np.fft.fft(samples[..., 0] + 1j * samples[..., 1], axis=1)) / 1024
    assert (spectrum.argmax(axis=1) == 40).all()
    np.testing.assert_allclose(spectrum[:, 40], 1600.0, rtol=1e-4)
    assert np.delete(spectrum, 40, axis=1).max() < 1.0


def test_channel_gains_are_taken_into_account() -> None:
    silent = [burst_of(150e3, 100.0)[0], np.zeros(PARAMS.burst_samples)]
    louder = beam_samples(silent, PARAMS, channel_gains_db=(6.0206, 0.0)).astype(float)
    np.testing.assert_allclose(louder, 2.0 * beam_samples(silent, PARAMS), atol=1.5)


def test_a_sample_at_the_converters_limit_comes_out_at_full_scale() -> None:
    channels = [channel.copy() for channel in burst_of(150e3, 100.0)]
    channels[1][[200, 5000]] = 2047.0, -2048.0j
    samples = beam_samples(channels, PARAMS)
    full = (np.abs(samples.astype(int)) >= 32767).any(axis=-1)
    # 200 - 120 settling samples in the first chirp; 5000 = 2 intervals of 2000 + 120 + 880
    assert np.argwhere(full).tolist() == [[0, 80], [2, 880]]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c[:1], "burst must be of 2 channels, got 1"),
        (lambda c: [c[0][:100], c[1]], "burst must be of 32000 samples, got 100"),
        (lambda c: [c[0] * np.where(np.arange(32000) == 207, np.nan, 1.0), c[1]], "burst must be finite, 1 samples"),
        (lambda c: [c[0].reshape(16, -1), c[1]], "burst must be of 2 channels"),
        (lambda c: [], "burst must be of 2 channels, got 0"),
    ],
    ids=["one channel", "short", "not a number", "wrong shape", "empty"],
)
def test_a_burst_that_is_none_is_refused(spoil: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        beam_samples(spoil(burst_of(150e3, 100.0)), PARAMS)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"chirps_per_beam": 100_000}, "chirps_per_beam must make at most"),
        ({"chirps_per_beam": 0}, "chirps_per_beam must be finite and positive"),
        ({"settle_s": 60e-6}, "must fit the ramp"),
        ({"settle_s": -1e-6}, "must fit the ramp"),
        ({"scan_period_s": 0.0}, "scan_period_s must be finite and positive"),
        ({"full_scale_dbm": float("nan")}, "full_scale_dbm must be finite"),
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhaserParams(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gains": (1.0,) * 7}, "gains must be 8 numbers"),
        ({"gains": (0.0,) * 8}, "gains must be 8 numbers"),
        ({"phases_deg": (float("nan"),) * 8}, "phases_deg must be 8 finite"),
        ({"channel_gains_db": (0.0, 99.0)}, "channel_gains_db must be 2 numbers"),
    ],
)
def test_wrong_calibrations_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhaserCalibration(**changes)  # type: ignore[arg-type]


@needs(BURST)
def test_the_recorded_burst_shows_what_its_note_says() -> None:
    """4 MS/s, 500 MHz in 300 us, beat offset 100 kHz. Its note: strongest at 171.9 kHz, 6.5 m; leakage at 113 kHz,
    1.2 m, 3.3 dB below; the median 33.7 dB below. No ground truth exists. Tolerance: one range bin; 2 to 3 dB, for
    the offset of 25.6 bins moves both between the bins, where a Hann window loses up to 1.4 dB.
    """
    board = setup()
    grid = RangeAzimuthGrid(range_bin_m=board.radar.range_bin_m, range_bins=480)
    beam = driven_beam(recorded_burst(DATA))
    folded = BeamFolder(board, FormingParams(mode="welch"), grid).fold(beam)
    level_db = 20.0 * np.log10(np.abs(folded.profile))
    assert folded.saturated == 0
    # wired as it should be
    assert wiring_faults(*folded.channels) == ()
    strongest_m = grid.range_bin_m * int(level_db[8:].argmax() + 8)
    assert strongest_m == pytest.approx((171.9e3 - 100e3) * SPEED_OF_LIGHT_MPS / (2 * 500e6 / 300e-6), abs=0.36)
    leak = int(level_db[:8].argmax())
    assert grid.range_bin_m * leak == pytest.approx(1.2, abs=0.36)
    assert level_db.max() - level_db[leak] == pytest.approx(3.3, abs=2.0)
    assert level_db.max() - np.median(level_db) == pytest.approx(33.7, abs=3.0)
