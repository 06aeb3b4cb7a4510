"""FMCW beats: from a round-trip length to frequency, phase (float64 turns) and range profile, exact at any range."""

from __future__ import annotations

import numpy as np

from msgs.values.radar import RadarParams
from msgs.values.units import SPEED_OF_LIGHT_MPS

#: Range windows as taps on neighbouring FFT bins: a Hann window is a three-tap filter of the spectrum.
#: Taps are normalised to unit coherent gain: a tone on a bin keeps its amplitude.
WINDOW_TAPS: dict[str, tuple[float, ...]] = {"none": (1.0,), "hann": (-0.5, 1.0, -0.5)}


def window_noise_gain(window: str) -> float:
    """Return the noise power per bin after a window of unit coherent gain, relative to none (Hann: 1.5)."""
    return float(np.sum(np.square(WINDOW_TAPS[window])))


def window_covariance(window: str, bins: int) -> np.ndarray:
    """Return the covariance [bins, bins] of neighbouring bins of windowed white noise relative to its power in one."""
    taps = np.array(WINDOW_TAPS[window])
    lags = np.correlate(taps, taps, "full")[len(taps) - 1 :] / np.sum(taps**2)
    separation = np.abs(np.subtract.outer(np.arange(bins), np.arange(bins)))
    return np.append(lags, 0.0)[np.minimum(separation, len(lags))]


def beat_frequency_hz(radar: RadarParams, length_m: np.ndarray) -> np.ndarray:
    """Return the beat frequency S L / c of paths with round-trip lengths in metres."""
    return radar.chirp_slope_hz_per_s * np.asarray(length_m, np.float64) / SPEED_OF_LIGHT_MPS


def beat_phase_rad(radar: RadarParams, length_m: np.ndarray) -> np.ndarray:
    """Return the phase of the recorded beat at the start of the chirp, 2 pi f_c tau - pi S tau^2, in [0, 2 pi)."""
    delay_s = np.asarray(length_m, np.float64) / SPEED_OF_LIGHT_MPS
    # f_c tau as L / lambda: one rounding less than through the delay
    turns = np.asarray(length_m, np.float64) / radar.wavelength_m - 0.5 * radar.chirp_slope_hz_per_s * delay_s**2
    return 2.0 * np.pi * (turns % 1.0)


def doppler_turn_rad(radar: RadarParams, radial_speed_mps: np.ndarray) -> np.ndarray:
    """Return the turn of beats from chirp to chirp without rest, 4 pi v T_c / lambda, of paths with radial speeds."""
    return 4.0 * np.pi * np.asarray(radial_speed_mps, np.float64) * radar.chirp_period_s / radar.wavelength_m


def beat_samples(radar: RadarParams, length_m: np.ndarray) -> np.ndarray:
    """Return recorded beats of unit weight over one chirp, complex128 [paths, samples] (conjugate of Eq. (7))."""
    turns_per_sample = beat_frequency_hz(radar, length_m) / radar.sample_rate_hz
    turns = np.multiply.outer(turns_per_sample, np.arange(radar.samples_per_chirp)) % 1.0
    return np.exp(1j * (2.0 * np.pi * turns + beat_phase_rad(radar, length_m)[..., None]))


def range_profile(
    radar: RadarParams, length_m: np.ndarray, range_bins: int, window: str = "hann", first_bin: int = 0
) -> np.ndarray:
    """Return the FFT of `beat_samples` at bins from `first_bin`, by `tone_profile`; complex128 [paths, bins]."""
    tone_bin = beat_frequency_hz(radar, length_m) * radar.chirp_period_s
    profile = tone_profile(radar.samples_per_chirp, tone_bin, range_bins, window, first_bin)
    return profile * np.exp(1j * beat_phase_rad(radar, length_m))[..., None]


def tone_profile(
    samples: int, tone_bin: np.ndarray, range_bins: int, window: str = "hann", first_bin: int = 0
) -> np.ndarray:
    """Return the windowed FFT of exp(2 pi j q n / N) over N samples over N, in closed form; complex128 [tones, bins].

    exp(j pi (N-1)/N (q-i)) sin(pi (q-i)) / (N sin(pi (q-i)/N)), windowed by taps on neighbouring bins.
    """
    taps = WINDOW_TAPS[window]
    reach = len(taps) // 2
    offset = np.asarray(tone_bin)[..., None] - np.arange(first_bin - reach, first_bin + range_bins + reach)
    dirichlet = _periodic_sinc(offset, samples) * np.exp(1j * np.pi * (samples - 1) / samples * offset)
    return sum(tap * dirichlet[..., i : i + range_bins] for i, tap in enumerate(taps))


def _periodic_sinc(offset_bins: np.ndarray, count: int) -> np.ndarray:
    """Return sin(pi x) / (count sin(pi x / count)), finite and exact at multiples of `count`."""
    wrapped = offset_bins - count * np.round(offset_bins / count)
    # sin(pi x / N) of the wrapped offset only vanishes at x = 0
    sign = np.where(((count - 1) * np.round(offset_bins / count)) % 2 == 0, 1.0, -1.0)
    return sign * np.sinc(wrapped) / np.sinc(wrapped / count)
