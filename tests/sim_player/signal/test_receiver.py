"""Receiver: each addition and distortion against its closed form."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from msgs.values.radar import RadarParams, RadarSetup
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.signal.levels import noise_density_mw
from sim_player.signal.receiver import (
    converter_step,
    dither_objection,
    flicker_noise,
    flicker_ratio,
    iq_factors,
    iq_imbalance,
    iq_mixing,
    leakage_beat,
    leakage_profile,
    overload_objection,
    quantisation_power_mw,
    spur_beat,
    spur_profile,
    spur_turns,
)
from sim_player.signal.switches import SignalEffects
from tests.sim_player.signal.references import converted

RADAR = RadarParams(samples_per_chirp=256, chirps_per_beam=8)
SETUP = RadarSetup(radar=RADAR)


def test_spurs_begin_every_beam_at_a_phase_of_its_seed() -> None:
    """Free of the beams: the same again for a beam, others for the next one, uniform over 1,000 of them."""
    spurs = [Spur(frequency_hz=1e6, power_dbm=-60.0)] * 3
    turns = np.array([spur_turns(spurs, [5, beam]) for beam in range(1000)])
    np.testing.assert_array_equal(turns[7], spur_turns(spurs, [5, 7]))
    assert len(np.unique(turns)) == 3000
    # the mean phasor of n uniform phases is of the order of 1 / sqrt(n)
    assert abs(np.exp(2j * np.pi * turns).mean()) < 4.0 / np.sqrt(3000)


def test_leakage_has_its_power_and_beats_at_its_range() -> None:
    """-40 dBm at the range of bin 10: 1e-4 mW in every sample, a tone of ten turns a chirp, and its root in the bin."""
    beat = leakage_beat(RADAR, -40.0, 10.0 * RADAR.range_bin_m)
    np.testing.assert_allclose(np.abs(beat) ** 2, 1e-4)
    assert np.abs(np.fft.fft(beat)).argmax() == 10
    profile = leakage_profile(RADAR, -40.0, 10.0 * RADAR.range_bin_m, range(5, 16))
    assert np.abs(profile).argmax() == 5
    assert np.abs(profile[5]) == pytest.approx(1e-2)


@pytest.mark.parametrize("start_turns", [0.0, 0.3])
def test_a_spur_runs_on_from_chirp_to_chirp(start_turns: float) -> None:
    """20.25 turns a chirp at -60 dBm: a quarter more at each next one. The mean over four of them is nothing."""
    spur = Spur(frequency_hz=20.25 / RADAR.repetition_interval_s, power_dbm=-60.0)
    tone, phasors = spur_beat(RADAR, spur, start_turns)
    np.testing.assert_allclose(np.abs(tone), 1e-3)
    np.testing.assert_allclose(phasors, np.exp(2j * np.pi * (start_turns + 0.25 * np.arange(8))), atol=1e-9)
    samples_s = np.arange(256) / RADAR.sample_rate_hz
    np.testing.assert_allclose(tone, 1e-3 * np.exp(2j * np.pi * spur.frequency_hz * samples_s), atol=1e-12)
    assert np.abs(spur_profile(RADAR, spur, start_turns, range(64))).max() < 1e-12
    # of whole turns all add up, in the bin of its frequency
    whole = msgspec.structs.replace(spur, frequency_hz=20.0 / RADAR.repetition_interval_s)
    profile = spur_profile(RADAR, whole, start_turns, range(64))
    assert np.abs(profile).argmax() == round(whole.frequency_hz * RADAR.chirp_period_s)
    assert np.abs(profile).max() == pytest.approx(1e-3, rel=1e-6)
    assert np.angle(profile[20]) == pytest.approx(2.0 * np.pi * start_turns)


def test_flicker_falls_as_one_over_f_from_what_a_beam_resolves() -> None:
    """A corner of 1 MHz: as strong as white noise there, ten times so at 0.1 MHz on either side, flat below 1 / T."""
    least_hz = 1.0 / RADAR.beam_duration_s
    ratio = flicker_ratio(RADAR, np.array([1e6, -1e5 - least_hz, 0.5 * least_hz, 0.0]), 1e6)
    np.testing.assert_allclose(ratio, [1.0, 1e6 / (1e5 + least_hz), 1e6 / least_hz, 1e6 / least_hz])


def test_flicker_has_its_density_and_is_a_draw_of_its_seed() -> None:
    """Over 200 beams the periodogram is half the density per component and sample: white noise of as much is RADAR's.

    In each frequency of the beam the mean of 200 exponentials: within 5 / sqrt(200), of 1,500 of them within 1 %.
    """
    draws = np.array([flicker_noise(RADAR, 1e6, [3, beam]).ravel() for beam in range(200)])
    assert not np.array_equal(draws[0], draws[1])
    np.testing.assert_array_equal(draws[1], flicker_noise(RADAR, 1e6, [3, 1]).ravel())
    count = draws.shape[1]
    power = (np.abs(np.fft.fft(draws, axis=1)) ** 2).mean(axis=0) / count
    wanted = RADAR.noise_power_mw * flicker_ratio(RADAR, np.fft.fftfreq(count, 1.0 / RADAR.sample_rate_hz), 1e6)
    assert (power / wanted).mean() == pytest.approx(1.0, abs=0.01)
    assert np.abs(power / wanted - 1.0).max() < 5.0 / math.sqrt(200)


@pytest.mark.parametrize(("gain_db", "phase_deg"), [(1.0, 0.0), (0.0, 5.0), (-0.5, -3.0)])
def test_unbalanced_i_and_q_are_the_two_factors(gain_db: float, phase_deg: float) -> None:
    """I = Re m, Q = g (cos(phi) Im m + sin(phi) Re m), of samples; of profiles the bins at -f come in."""
    front_end = FrontEnd(iq_gain_db=gain_db, iq_phase_deg=phase_deg)
    gain, phase = 10.0 ** (gain_db / 20.0), math.radians(phase_deg)
    m = np.random.default_rng(0).normal(size=(2, 64)) @ np.eye(64)
    m = m[0] + 1j * m[1]
    wanted = m.real + 1j * gain * (math.cos(phase) * m.imag + math.sin(phase) * m.real)
    np.testing.assert_allclose(iq_imbalance(m, m, front_end), wanted)
    profile, mirrored = np.fft.fft(m), np.fft.fft(m)[-np.arange(64)]
    np.testing.assert_allclose(iq_imbalance(profile, mirrored, front_end), np.fft.fft(wanted), atol=1e-9)
    mixed = iq_mixing(front_end) @ np.stack([m.real, m.imag])
    np.testing.assert_allclose(mixed[0] + 1j * mixed[1], wanted)
    # of a receiver that conjugates, both are those of the conjugate
    np.testing.assert_allclose(iq_imbalance(m.conj(), m.conj(), front_end, -1), wanted.conj())
    assert iq_factors(FrontEnd()) == (1.0, 0.0)


@pytest.mark.parametrize(("bits", "step", "top"), [(16, 1, 32767), (12, 16, 32752), (2, 16384, 16384)])
def test_a_converter_rounds_to_its_step_and_saturates(bits: int, step: int, top: int) -> None:
    assert converter_step(FrontEnd(adc_bits=bits)) == step
    codes = converted(np.array([1e6 - 1e6j, 0.4 * step - 0.6j * step, 1.4 * step + 0j]), step)
    assert codes.tolist() == [[top, -32768], [0, -step], [min(step, top), 0]]
    assert codes.dtype == np.int16
    # two components, a step's square over twelve each
    assert quantisation_power_mw(SETUP, step) == pytest.approx(2.0 * step**2 / 12.0 * SETUP.milliwatt_per_code_squared)


def test_a_converter_of_no_bits_is_refused() -> None:
    for bits in (1, 17):
        with pytest.raises(ValueError, match=r"front_end\.adc_bits must be 2\.\.16"):
            converter_step(FrontEnd(adc_bits=bits))


def test_rounding_is_noise_from_one_step_of_noise_on_and_codes_end_at_full_scale() -> None:
    """Noise of c codes a component is enough for a step of the power of two below c, and not for the next one."""
    setup = RadarSetup(full_scale_dbm=-20.0)
    codes = math.sqrt(0.5 * setup.radar.noise_power_mw / setup.milliwatt_per_code_squared)
    enough = int(math.log2(codes))
    assert dither_objection(setup, FrontEnd(adc_bits=16 - enough), thermal=True) is None
    assert dither_objection(setup, FrontEnd(adc_bits=15 - enough), thermal=True) is not None
    assert dither_objection(setup, FrontEnd(), thermal=False) is not None
    full = 10.0 ** (-20.0 / 20.0)
    assert overload_objection(setup, full * 32766.0 / 32768.0) is None
    assert overload_objection(setup, full * 32767.5 / 32768.0) is not None


def test_noise_is_raised_by_what_the_imbalance_lets_through() -> None:
    """A gain g of Q: |mu|^2 + |nu|^2 = (1 + g^2) / 2 of the thermal noise, the same over all bins, N N_c times less."""
    effects = SignalEffects(iq_imbalance=True, adc=False)
    plain = noise_density_mw(SETUP, np.arange(4), SignalEffects(adc=False))
    np.testing.assert_allclose(plain, RADAR.noise_power_mw / (256 * 8))
    unbalanced = noise_density_mw(SETUP, np.arange(4), effects, FrontEnd(iq_gain_db=6.0))
    np.testing.assert_allclose(unbalanced / plain, 0.5 * (1.0 + 10.0**0.6))
