"""Recorded codes of a faulty receiver: density of their noise, rounding under dither and without it, saturation."""

from __future__ import annotations

import numpy as np
import pytest

from msgs.values.radar import RadarParams, RadarSetup
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.fmcw import noise_bank
from sim_player.signal.levels import noise_density_mw, noise_profiles, record_beam
from sim_player.signal.receiver import dither_objection, quantisation_power_mw
from sim_player.signal.switches import SignalEffects
from tests.sim_player.signal.references import converted

RADAR = RadarParams(samples_per_chirp=512, chirps_per_beam=32)
SETUP = RadarSetup(radar=RADAR)


def test_kernel_noise_has_the_density_of_the_recorded_codes() -> None:
    """11 bits (32 codes a step, noise of 45), flicker, imbalance: bins of real codes against `noise_density_mw`.

    40 beams, mean power of bins 1..8, 9..40 and 41..120: 320 draws or more, 5.6 % rms; tolerance 17 % (3 sigma). The
    profiles drawn at the kernel level are held to the same.
    """
    faults = FrontEnd(flicker_corner_hz=2e7, adc_bits=11, iq_gain_db=0.4, iq_phase_deg=2.0)
    effects = SignalEffects(flicker=True, iq_imbalance=True)
    bank = noise_bank(RADAR, 1)
    ones = np.ones(RADAR.chirps_per_beam)
    terms = (np.zeros((1, 512), complex), ones, ones[None])
    power = np.zeros(512)
    for beam in range(40):
        codes = record_beam(SETUP, terms, bank, [3, beam], effects, faults).astype(float)
        assert not np.any(codes % 32)
        folded = (codes[..., 0] + 1j * codes[..., 1]).mean(axis=0)
        power += np.abs(np.fft.fft(folded) / 512) ** 2 * SETUP.milliwatt_per_code_squared / 40
    density = noise_density_mw(SETUP, np.arange(121), effects, faults)
    drawn = np.mean(np.abs(noise_profiles(SETUP, 7, effects, faults, 121)) ** 2, axis=0)
    smooth = 1.0 * density[1:-1] + 0.25 * (density[:-2] + density[2:])
    for first, last in ((1, 9), (9, 41), (41, 120)):
        assert np.mean(power[first:last] / density[first:last]) == pytest.approx(1.0, abs=0.17)
        assert np.mean(drawn[first:last] / smooth[first - 1 : last - 1]) == pytest.approx(1.0, abs=0.25)
    # each of the parts is seen: flicker doubles and more below its corner, rounding adds 4 %
    assert density[2] > 2.0 * density[120]
    assert density[120] > 1.02 * noise_density_mw(SETUP, np.array([120]), SignalEffects())[0]


@pytest.mark.parametrize("rms_steps", [1.0, 2.0])
def test_rounding_is_white_noise_under_dither(rms_steps: float) -> None:
    """Real codes of a constant of 0.3 step under Gaussian noise: error power step^2 / 12 per component, no bias.

    2^18 samples: power known to 0.25 %, mean to 0.6 % of a step's error; tolerance 1 %, 1 % of a step.
    """
    rng = np.random.default_rng(3)
    step = 16
    true = 0.3 * step
    noise = rms_steps * step * (rng.standard_normal(2**18) + 1j * rng.standard_normal(2**18))
    codes = converted(true * (1.0 + 1.0j) + noise, step).astype(float)
    error = codes[:, 0] + 1j * codes[:, 1] - true * (1.0 + 1.0j) - noise
    expected = quantisation_power_mw(SETUP, step) / SETUP.milliwatt_per_code_squared
    assert np.mean(np.abs(error) ** 2) == pytest.approx(expected, rel=0.01)
    assert abs(error.mean()) < 0.01 * step
    assert abs(np.mean(error * np.conj(noise))) < 0.01 * expected * rms_steps**2 * 12


def test_without_dither_a_weak_echo_is_lost() -> None:
    """0.3 step under noise of a tenth of a step rounds to nothing: why the kernel level objects."""
    rng = np.random.default_rng(4)
    codes = converted(0.3 * 256 + 25.6 * (rng.standard_normal(10000) + 1j * rng.standard_normal(10000)), 256)
    assert abs(codes[:, 0].astype(float).mean()) < 0.1 * 256
    assert dither_objection(SETUP, FrontEnd(adc_bits=8), True) is not None
    assert dither_objection(SETUP, FrontEnd(adc_bits=12), True) is None
    assert dither_objection(SETUP, FrontEnd(), False) is not None


def test_a_loud_beam_saturates() -> None:
    """A tone 6 dB over full scale through 12 bits: both ends are met, most of the samples stand there."""
    tone = 0.2 * np.exp(2j * np.pi * 0.1003 * np.arange(512))
    ones = np.ones(RADAR.chirps_per_beam)
    codes = record_beam(
        SETUP, (tone[None], ones, ones[None]), noise_bank(RADAR, 0), [0], front_end=FrontEnd(adc_bits=12)
    )
    assert codes.min() == -32768
    assert codes.max() == 32768 - 16
    assert np.mean((codes == -32768) | (codes == 32768 - 16)) > 0.5
