"""Laws of the sweep that every level of the signal shares, at values known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from msgs.values.radar import RadarParams
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.signal.switches import overlap_samples, previous_length_m, sampled, sweep_ratio

RADAR = RadarParams()


def test_the_sweep_runs_half_a_band_to_either_side_of_the_carrier() -> None:
    """700 MHz about 10 GHz: 0.965 when the chirp begins, 1 in its middle, 1.035 at its end."""
    half_band = 0.5 * RADAR.bandwidth_hz / RADAR.carrier_hz
    at_s = RADAR.chirp_period_s * np.array([0.0, 0.5, 1.0])
    np.testing.assert_allclose(sweep_ratio(RADAR, at_s), [1.0 - half_band, 1.0, 1.0 + half_band])


def test_an_echo_is_the_last_chirps_until_it_comes() -> None:
    """Of samples at n / f_s those with t < tau: at a delay of 3 samples 0, 1 and 2, a little later the third too."""
    sample_m = SPEED_OF_LIGHT_MPS / RADAR.sample_rate_hz
    assert overlap_samples(RADAR, sample_m * np.array([0.0, 0.1, 2.999, 3.001])).tolist() == [0, 1, 3, 4]
    longest_m = sample_m * RADAR.samples_per_chirp
    assert overlap_samples(RADAR, np.array([longest_m - 1.5 * sample_m])).tolist() == [RADAR.samples_per_chirp - 1]
    with pytest.raises(ValueError, match="length_m must be under one chirp"):
        overlap_samples(RADAR, np.array([longest_m]))
    np.testing.assert_allclose(previous_length_m(RADAR, np.array([100.0])), 100.0 - longest_m)


def test_beats_within_half_the_sample_rate_pass() -> None:
    half_hz = 0.5 * RADAR.sample_rate_hz
    beats_hz = np.array([0.0, half_hz, -half_hz, 1.001 * half_hz, -1.001 * half_hz])
    assert sampled(RADAR, beats_hz).tolist() == [True, True, True, False, False]
