"""Receiver: signals added to the echoes and distortions of them, sample by sample and, where possible, per bin.

Echoes and leakage, spurs, thermal and flicker noise; then I/Q imbalance; then the converter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy import fft

from models.physics.waveform import beat_samples, range_profile, tone_profile
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import ratio_from_db
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.signal.fmcw import Noise

#: Thermal noise per component, in steps of the converter, that makes rounding errors white (error 3e-9 at 1).
DITHER_STEPS = 1.0


def leakage_beat(radar: RadarParams, power_dbm: float, range_m: float) -> np.ndarray:
    """Return the leakage of the transmitter into the receiver: a range's beat, the same in all beams; [samples]."""
    return math.sqrt(ratio_from_db(power_dbm)) * beat_samples(radar, np.array([2.0 * range_m]))[0]


def leakage_profile(radar: RadarParams, power_dbm: float, range_m: float, bins: range) -> np.ndarray:
    """Return the leakage as a Hann-windowed profile, complex128 [bins]."""
    profile = range_profile(radar, np.array([2.0 * range_m]), len(bins), first_bin=bins.start)[0]
    return math.sqrt(ratio_from_db(power_dbm)) * profile


def spur_turns(spurs: Sequence[Spur], seed: Sequence[int]) -> np.ndarray:
    """Return the phase of each spur at a beam's start in turns: spurs run free of the beams; `seed` names the beam."""
    return np.random.default_rng([*seed, 8]).random(len(spurs))


def spur_beat(radar: RadarParams, spur: Spur, start_turns: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a free-running tone: one chirp of it [samples], and its phasor at each chirp's start [chirps]."""
    tone = np.exp(2j * np.pi * ((spur.frequency_hz / radar.sample_rate_hz * np.arange(radar.samples_per_chirp)) % 1.0))
    turns = spur.frequency_hz * radar.repetition_interval_s * np.arange(radar.chirps_per_beam) + start_turns
    return math.sqrt(ratio_from_db(spur.power_dbm)) * tone, np.exp(2j * np.pi * (turns % 1.0))


def spur_profile(radar: RadarParams, spur: Spur, start_turns: float, bins: range) -> np.ndarray:
    """Return a spur after the mean over chirps, Hann-windowed, complex128 [bins]."""
    tone_bin = np.array([spur.frequency_hz * radar.chirp_period_s])
    chirps = spur_beat(radar, spur, start_turns)[1].mean()
    amplitude = math.sqrt(ratio_from_db(spur.power_dbm))
    return amplitude * chirps * tone_profile(radar.samples_per_chirp, tone_bin, len(bins), first_bin=bins.start)[0]


def flicker_ratio(radar: RadarParams, frequency_hz: np.ndarray, corner_hz: float) -> np.ndarray:
    """Return the density of 1/f noise over the white noise's: f_corner / |f|, flat below 1 / T_f."""
    return corner_hz / np.maximum(np.abs(frequency_hz), 1.0 / radar.beam_duration_s)


def flicker_noise(radar: RadarParams, corner_hz: float, seed: Sequence[int]) -> np.ndarray:
    """Return 1/f noise of one beam in sqrt(mW), coloured over the whole beam; complex64 [chirps, samples]."""
    rms = _flicker_spectrum(radar, corner_hz)
    draws = np.random.default_rng([*seed, 9]).standard_normal((2, len(rms)), np.float32)
    spectrum = (draws[0] + 1j * draws[1]) * rms
    return fft.ifft(spectrum, overwrite_x=True).reshape(radar.chirps_per_beam, -1)


@lru_cache(maxsize=2)
def _flicker_spectrum(radar: RadarParams, corner_hz: float) -> np.ndarray:
    """Return the rms of each line of a beam's 1/f noise, per component; float32 [chirps x samples]."""
    count = radar.chirps_per_beam * radar.samples_per_chirp
    frequency_hz = np.fft.fftfreq(count, 1.0 / radar.sample_rate_hz)
    power = flicker_ratio(radar, frequency_hz, corner_hz) * (0.5 * radar.noise_power_mw * count)
    return np.sqrt(power).astype(np.float32)


def with_flicker(radar: RadarParams, noise: Noise, corner_hz: float, seed: list[int]) -> Noise:
    """Return white noise with 1/f noise added, which every chirp reads in turn."""
    bank, start, turn = noise
    count = radar.samples_per_chirp
    beam = flicker_noise(radar, corner_hz, seed)
    for chirp, (first, phasor) in enumerate(zip(start, turn.astype(np.complex64), strict=True)):
        beam[chirp] += phasor * (bank[0, first : first + count] + 1j * bank[1, first : first + count])
    flat = beam.ravel()
    return np.stack([flat.real, flat.imag]), np.arange(len(start)) * count, np.ones(len(start))


def iq_factors(front_end: FrontEnd) -> tuple[complex, complex]:
    """Return (mu, nu) of y = mu m + nu conj(m), (1 + g e^{j phi}) / 2 and (1 - g e^{-j phi}) / 2."""
    gain = 10.0 ** (front_end.iq_gain_db / 20.0) * np.exp(1j * math.radians(front_end.iq_phase_deg))
    return complex(0.5 * (1.0 + gain)), complex(0.5 * (1.0 - np.conj(gain)))


def iq_mixing(front_end: FrontEnd) -> np.ndarray:
    """Return the same for samples: rows make the receiver's I and Q of those that come in, float64 [2, 2]."""
    wanted, image = iq_factors(front_end)
    both, apart = wanted + image, wanted - image
    return np.array([[both.real, -apart.imag], [both.imag, apart.real]])


def iq_imbalance(values: np.ndarray, mirrored: np.ndarray, front_end: FrontEnd, beat_sign: int = 1) -> np.ndarray:
    """Return the imbalance of samples (`mirrored` = the same) or of profiles (`mirrored` = the bins at -f)."""
    wanted, image = iq_factors(front_end)
    if beat_sign < 0:
        wanted, image = wanted.conjugate(), image.conjugate()
    return (wanted * values + image * np.conj(mirrored)).astype(values.dtype, copy=False)


def converter_step(front_end: FrontEnd) -> int:
    """Return the step of the converter in int16 codes, 2^(16 - bits); ValueError unless bits are 2..16."""
    if not 2 <= front_end.adc_bits <= 16:
        raise ValueError(f"front_end.adc_bits must be 2..16, got {front_end.adc_bits!r}")
    return 2 ** (16 - front_end.adc_bits)


def quantisation_power_mw(setup: RadarSetup, step: int) -> float:
    """Return the rounding noise of one complex sample: step^2 / 12 per component, white while the input dithers; mW."""
    return step**2 / 6.0 * setup.milliwatt_per_code_squared


def dither_objection(setup: RadarSetup, front_end: FrontEnd, thermal: bool) -> str | None:
    """Return why rounding is no white noise, or None: thermal noise under `DITHER_STEPS` steps per component."""
    step = converter_step(front_end)
    rms = math.sqrt(0.5 * setup.radar.noise_power_mw / setup.milliwatt_per_code_squared) if thermal else 0.0
    if rms >= DITHER_STEPS * step:
        return None
    return f"rounding is white only under noise of {DITHER_STEPS * step:g} codes rms, got {rms:.1f}: use the beat level"


def overload_objection(setup: RadarSetup, peak_mw_root: float) -> str | None:
    """Return why a converter would clip, or None: a component's peak `peak_mw_root` [sqrt(mW)] over full scale."""
    codes = peak_mw_root / math.sqrt(setup.milliwatt_per_code_squared)
    if codes < 32767.0:
        return None
    return f"samples must stay under 32767 codes, got {codes:.0f}: the converter clips, use the beat level"
