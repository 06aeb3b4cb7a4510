"""Beats: literal, closed form and gridded agree; codes are rounded, saturated, noisy as stated, and repeatable."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.waveform import beat_samples
from msgs.values.radar import RadarParams, RadarSetup
from sim_player.signal.fmcw import Noise, beam_codes, noise_bank, noise_reads, slow_time_table
from tests.sim_player.signal.references import literal_beats, quiet

RADAR = RadarParams()


def weights(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=count) + 1j * rng.normal(size=count)


@pytest.mark.parametrize("carrier_hz", [10e9, 77e9])
def test_literal_mixing_equals_the_closed_form(carrier_hz: float) -> None:
    """Layout: 30 paths to 219 m round trip, one chirp. Reference: g(t) g*(t - tau) of Eq. (6) in float64.

    Bias: f_c t reaches 4e5 turns, rounded to 6e-11 turns; tolerance 1e-8 relative. The residual video phase, 34
    turns at 110 m, is in both.
    """
    radar = RadarParams(carrier_hz=carrier_hz, samples_per_chirp=512, sample_rate_hz=93.75e6)
    length = np.linspace(0.0, 219.0, 30)
    w = weights(30)
    literal = literal_beats(radar, length, w, chirps=2)
    np.testing.assert_array_equal(literal[0], literal[1])
    closed = w @ beat_samples(radar, length)
    assert np.linalg.norm(literal[0] - closed) < 1e-8 * np.linalg.norm(closed)


@pytest.mark.parametrize(("slowest", "fastest"), [(0.0, 0.0), (5.0, 5.0), (-0.6, 0.0), (-15.0, 15.0), (-8.0, 40.0)])
@pytest.mark.parametrize("chirps", [1, 5, 16, 128])
def test_slow_time_of_moving_paths(slowest: float, fastest: float, chirps: int) -> None:
    """Reference: exp(j 4 pi v c T / lambda) of each path; rms over the beam 1e-5 (twice, for rounding)."""
    radar = RadarParams(chirps_per_beam=chirps)
    speed = np.linspace(slowest, fastest, 50)
    turn = 4.0 * np.pi * speed * radar.chirp_period_s / radar.wavelength_m
    table = slow_time_table(radar, turn)
    exact = np.exp(1j * np.multiply.outer(np.arange(chirps) - 0.5 * (chirps - 1), turn))
    got = table.carrier[:, None] * (table.basis.T @ table.shares(turn))
    assert np.sqrt(np.mean(np.abs(got - exact) ** 2, axis=0)).max() < 2e-5
    assert len(table.basis) <= min(chirps, 16)


@pytest.mark.parametrize("turns_rad", [(0.43,), (-0.43,), (-0.43, -0.28), (-0.07, 0.21), (-0.25, 0.0)])
def test_the_table_holds_turns_as_much_larger_as_was_asked(turns_rad: tuple[float, ...]) -> None:
    """Turns 7 % larger than those of the paths, all to one side or to both: exp(j w c), rms 1e-5 (twice, as above).

    Of the last ones half the span, 1/8, is no wider after rounding up.
    """
    radar, turn = RadarParams(chirps_per_beam=128), np.array(turns_rad)
    table = slow_time_table(radar, turn, margin=1.07)
    chirp = np.arange(128) - 63.5
    for asked in (turn, 1.07 * turn):
        got = table.carrier[:, None] * (table.basis.T @ table.shares(asked))
        exact = np.exp(1j * np.multiply.outer(chirp, asked))
        assert np.sqrt(np.mean(np.abs(got - exact) ** 2, axis=0)).max() < 2e-5


def test_a_scene_at_one_speed_needs_one_term() -> None:
    assert len(slow_time_table(RADAR, np.full(30, 0.3)).basis) == 1


def codes_of(tone: np.ndarray, setup: RadarSetup, noise: Noise) -> np.ndarray:
    ones = np.ones(setup.radar.chirps_per_beam)
    return beam_codes(setup, tone[None], ones, ones[None], noise)


def test_codes_are_rounded_to_nearest_and_saturated() -> None:
    """Beats worth given codes, no noise: ties go to even, ends of int16 hold."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=8, chirps_per_beam=2))
    wanted = np.array([0.4, 0.6, -0.6, 1.5, 2.5, 4e4, -4e4, 32767.4])
    per_code = math.sqrt(setup.milliwatt_per_code_squared)
    codes = codes_of((wanted - 1j * wanted) * per_code, setup, quiet(setup.radar))
    expected = [0, 1, -1, 2, 2, 32767, -32768, 32767]
    # 1.5 and 2.5 are ties only up to float32 rounding: either neighbour is nearest
    free = [3, 4]
    np.testing.assert_array_equal(np.delete(codes[0, :, 0], free), np.delete(expected, free))
    np.testing.assert_array_equal(codes[0, :, 1][:3], [0, -1, 1])
    assert np.abs(codes[0, free, 0] - wanted[free]).max() <= 0.5
    np.testing.assert_array_equal(codes[0], codes[1])


def test_codes_follow_the_terms() -> None:
    """carrier[c] sum_r basis[r, c] beats[r] to half a code and float32 rounding, odd block ends included."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=3001, chirps_per_beam=7))
    rng = np.random.default_rng(8)
    beats = 0.01 * (rng.normal(size=(3, 3001)) + 1j * rng.normal(size=(3, 3001)))
    carrier, basis = np.exp(1j * rng.uniform(0, 6, 7)), rng.normal(size=(3, 7))
    exact = carrier[:, None] * (basis.T @ beats) / math.sqrt(setup.milliwatt_per_code_squared)
    codes = beam_codes(setup, beats, carrier, basis, quiet(setup.radar))
    np.testing.assert_allclose(codes[..., 0], np.clip(exact.real, -32768, 32767), atol=0.51)
    np.testing.assert_allclose(codes[..., 1], np.clip(exact.imag, -32768, 32767), atol=0.51)


def test_beat_sign_of_the_hardware_conjugates_the_echoes() -> None:
    radar = RadarParams(samples_per_chirp=256, chirps_per_beam=1)
    tone = 1e-2 * np.exp(2j * np.pi * 0.1 * np.arange(256))
    plus, minus = (
        codes_of(tone, setup, quiet(setup.radar))
        for setup in (RadarSetup(radar=radar), RadarSetup(radar=radar, beat_sign=-1))
    )
    np.testing.assert_array_equal(plus[..., 0], minus[..., 0])
    np.testing.assert_array_equal(plus[..., 1], -minus[..., 1])


def test_noise_power_is_k_t0_fs_f() -> None:
    """No echoes: mean |codes|^2 is kT0 f_s F = -74.2 dBm within 0.1 dB.

    2^20 samples: 0.1 % rms (0.004 dB); rounding to codes of 64 rms adds 2 / 12 code^2, 2e-4 dB.
    """
    setup = RadarSetup()
    codes = codes_of(np.zeros(8192, complex), setup, noise_reads(RADAR, noise_bank(RADAR, 3), [3, 0, 0])).astype(float)
    power_mw = np.mean(np.sum(codes**2, axis=-1)) * setup.milliwatt_per_code_squared
    assert 10.0 * math.log10(power_mw) == pytest.approx(-74.2, abs=0.1)
    assert 10.0 * math.log10(power_mw / RADAR.noise_power_mw) == pytest.approx(0.0, abs=0.02)
    assert abs(codes.mean()) < 5.0 * 64 / math.sqrt(2**21)


def test_noise_is_white_over_samples_chirps_and_beams() -> None:
    """Folded and transformed: power per bin 1 / 2^20 of the total, and beams uncorrelated.

    512 bins of one beam: mean power known to 1/sqrt(512) = 4.4 %, 4 sigma. Two beams: |correlation| of the folded
    chirps is below 5 / sqrt(8192) + 1 / sqrt(128) (their stretches of the bank overlap, with random phases).
    """
    setup = RadarSetup()
    bank = noise_bank(RADAR, 1)
    folded = []
    for beam in range(2):
        codes = codes_of(np.zeros(8192, complex), setup, noise_reads(RADAR, bank, [1, 0, beam])).astype(float)
        folded.append((codes[..., 0] + 1j * codes[..., 1]).mean(axis=0))
    spectrum = np.fft.fft(folded[0])[:512] / 8192
    expected = RADAR.noise_power_mw / setup.milliwatt_per_code_squared / 2**20
    assert np.mean(np.abs(spectrum) ** 2) == pytest.approx(expected, rel=0.18)
    correlation = abs(np.vdot(*folded)) / (np.linalg.norm(folded[0]) * np.linalg.norm(folded[1]))
    assert correlation < 5.0 / math.sqrt(8192) + 1.0 / math.sqrt(128)


def test_noise_has_no_memory_over_chirps() -> None:
    """Slow-time spectrum of pure noise is flat: the strongest of 128 Doppler bins stays below 1.5 x the mean.

    Each bin averages 8192 samples: 1.1 % rms; a bank read twice in step would show up as lines. I and Q of a chirp are
    of one power and independent.
    """
    setup = RadarSetup()
    noise = noise_reads(RADAR, noise_bank(RADAR, 2), [2, 0, 0])
    codes = codes_of(np.zeros(8192, complex), setup, noise).astype(np.float32)
    samples = codes[..., 0] + 1j * codes[..., 1]
    doppler = np.mean(np.abs(np.fft.fft(samples, axis=0)) ** 2, axis=1)
    assert doppler.max() < 1.1 * doppler.mean()
    assert np.abs(np.mean(samples**2, axis=1)).max() < 0.1 * np.mean(np.abs(samples) ** 2)
