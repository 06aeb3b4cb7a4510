"""Beats, phases and range profiles against independent formulas."""

from __future__ import annotations

from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.physics.waveform import (
    WINDOW_TAPS,
    beat_frequency_hz,
    beat_phase_rad,
    beat_samples,
    doppler_turn_rad,
    range_profile,
    tone_profile,
    window_covariance,
    window_noise_gain,
)
from msgs.values.radar import RadarParams

RADAR = RadarParams()
LENGTHS_M = np.array([0.0, 0.2, 10.0, 31.234, 2 * 50 * RADAR.range_bin_m, 100.0, 218.0])


def test_a_target_on_a_bin_stands_in_that_bin() -> None:
    """Round trip 2 * 50 bins: beat at exactly bin 50 of the chirp-length FFT (R = f_b c / 2S)."""
    frequency_hz = beat_frequency_hz(RADAR, np.array([2 * 50 * RADAR.range_bin_m]))
    assert frequency_hz * RADAR.chirp_period_s == pytest.approx(50.0, rel=1e-12)


def test_beat_at_the_edge_of_the_map() -> None:
    """DESIGN: the beat at 109.4 m is 93.5 MHz."""
    assert beat_frequency_hz(RADAR, np.array(2 * 109.42)) == pytest.approx(93.5e6, rel=2e-3)


@given(st.floats(0.1, 220.0))
def test_phase_keeps_the_residual_video_term(length_m: float) -> None:
    """2 pi f_c tau - pi S tau^2 in 50 decimal digits; tolerance 1e-7 rad: 64-bit rounding of 15,000 turns is 1e-11."""
    getcontext().prec = 50
    delay = Decimal(length_m) / Decimal(299_792_458)
    slope = Decimal(RADAR.bandwidth_hz) * Decimal(RADAR.sample_rate_hz) / Decimal(RADAR.samples_per_chirp)
    turns = Decimal(RADAR.carrier_hz) * delay - slope * delay * delay / 2
    exact_rad = 2 * np.pi * float(turns % 1)
    assert np.angle(np.exp(1j * (beat_phase_rad(RADAR, np.array(length_m)) - exact_rad))) == pytest.approx(0, abs=1e-7)


def test_beats_are_the_mixed_chirps() -> None:
    """Literal Eq. (6): chirp times conjugate of its delayed self, float64, at baseband carrier for few samples.

    Layout: carrier and slope as Table 1, evaluated with exact phase bookkeeping per sample (turns modulo one).
    Tolerance 1e-6: the literal phase f_c t reaches 5e4 turns, 64-bit rounding of it is 1e-11 turns.
    """
    time_s = np.arange(RADAR.samples_per_chirp) / RADAR.sample_rate_hz
    delay_s = LENGTHS_M[:, None] / 299_792_458.0

    def chirp_turns(t: np.ndarray) -> np.ndarray:
        return RADAR.carrier_hz * t + 0.5 * RADAR.chirp_slope_hz_per_s * t**2

    mixed = np.exp(2j * np.pi * ((chirp_turns(time_s) - chirp_turns(time_s - delay_s)) % 1.0))
    np.testing.assert_allclose(beat_samples(RADAR, LENGTHS_M), mixed, atol=1e-6)


@pytest.mark.parametrize("window", WINDOW_TAPS)
def test_closed_form_profile_is_the_fft(window: str) -> None:
    """Against the FFT of the beat itself, any kind of length; tolerance: rounding."""
    time_window = {"none": np.ones(8192), "hann": 1.0 - np.cos(2 * np.pi * np.arange(8192) / 8192)}[window]
    literal = np.fft.fft(beat_samples(RADAR, LENGTHS_M) * time_window, axis=1)[:, :512] / 8192
    np.testing.assert_allclose(range_profile(RADAR, LENGTHS_M, 512, window), literal, atol=1e-12)


def test_a_tone_keeps_its_amplitude_under_the_window() -> None:
    profile = np.abs(range_profile(RADAR, np.array([2 * 50 * RADAR.range_bin_m]), 512))[0]
    assert profile[50] == pytest.approx(1.0, rel=1e-9)
    assert profile[[49, 51]] == pytest.approx(0.5, rel=1e-3)
    # Hann on a bin centre: nothing beyond the neighbours
    assert profile[60:].max() < 1e-9


def test_window_noise_gain() -> None:
    """Hann of unit coherent gain: 1^2 + 2 (1/2)^2 = 1.5, i.e. 1.76 dB."""
    assert window_noise_gain("hann") == 1.5
    assert window_noise_gain("none") == 1.0


@pytest.mark.parametrize("window", WINDOW_TAPS)
def test_tone_profile_at_any_bin(window: str) -> None:
    """Tones and bins of either sign, 200 samples, against the FFT; tolerance: rounding."""
    tone_bin = np.array([-60.3, -1.0, 0.0, 17.25, 99.5])
    time_window = {"none": np.ones(200), "hann": 1.0 - np.cos(2 * np.pi * np.arange(200) / 200)}[window]
    tones = np.exp(2j * np.pi * np.multiply.outer(tone_bin, np.arange(200)) / 200)
    spectrum = np.fft.fft(tones * time_window, axis=1) / 200
    expected = np.concatenate([spectrum[:, -80:], spectrum[:, :90]], axis=1)
    np.testing.assert_allclose(tone_profile(200, tone_bin, 170, window, first_bin=-80), expected, atol=1e-13)


def test_window_covariance_is_that_of_filtered_noise() -> None:
    """(1.5, -1, 0.25) / 1.5 for Hann, the identity without a window."""
    np.testing.assert_allclose(window_covariance("hann", 4)[0], [1.0, -2.0 / 3.0, 1.0 / 6.0, 0.0])
    np.testing.assert_array_equal(window_covariance("none", 3), np.eye(3))


def test_doppler_turns_once_over_a_beam_at_its_speed_bin() -> None:
    """lambda / (2 T_f) = 21.4 m/s at X-band: one whole turn over the 128 chirps of a beam, backwards if it recedes."""
    radar = RadarParams()
    speed_mps = radar.wavelength_m / (2.0 * radar.beam_duration_s)
    assert speed_mps == pytest.approx(21.4, abs=0.05)
    turn = doppler_turn_rad(radar, np.array([speed_mps, -speed_mps])) * radar.chirps_per_beam
    np.testing.assert_allclose(turn, [2.0 * np.pi, -2.0 * np.pi], rtol=1e-12)
