"""Leakage, I/Q imbalance and sidebands of a receiver, from what stands still in raw beams.

Leakage is the return near zero range that all beams share. Unbalanced I and Q mirror every echo: with y = mu m + nu
conj(m) and echoes on one side alone, Y(f) Y(-f) = mu nu |M|^2, so r = sum Y(f) Y(-f) / sum |Y(f)|^2 = nu / conj(mu) =
(1 - z) / (1 + z) with z = g exp(-j phi), gain g and phase phi of Q against I. An oscillator that is modulated puts the
same line on both sides of every echo; what moves puts it on one.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy import fft

from msgs.values.arrays import require_finite, require_positive
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import db_from_ratio

#: Leakage stands this far above the noise of a bin of a beam.
LEAKAGE_DB = 15.0
#: An image is resolved if it exceeds its standard deviation so many times.
RESOLVED_SIGMAS = 3.0
#: Bins about the axis of the image that hold both sides of one echo.
AXIS_BINS = 6
#: Sidebands stand this far above the noise of all ranges, and are looked for where echoes stand this far above it.
SIDEBAND_RATIO, ECHO_RATIO = 2.0, 10.0
#: A line within this many bins of the echoes is theirs.
ECHO_BINS = 3
_PADDING = 8


class FaultParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Faults to look for; None: left out."""

    #: The strongest return up to this range is the leakage.
    leakage_to_m: float | None = None
    #: Frequency about which the receiver mirrors, in the sign of the recorded samples: 0 unless beats were shifted.
    image_about_hz: float | None = None

    def __post_init__(self) -> None:
        if self.leakage_to_m is not None:
            require_positive("leakage_to_m", self.leakage_to_m)
        if self.image_about_hz is not None:
            require_finite("image_about_hz", self.image_about_hz)


class Leakage(msgspec.Struct, frozen=True, kw_only=True):
    """Power at the receiver's input, and the range at which it beats."""

    power_dbm: float
    range_m: float


class Imbalance(msgspec.Struct, frozen=True, kw_only=True):
    """Gain and phase of Q against I, the image's power over the echo's, and its standard deviation over the image."""

    gain_db: float
    phase_deg: float
    image_db: float
    std_share: float


class Sideband(msgspec.Struct, frozen=True, kw_only=True):
    """A line on both sides of every echo: its distance, and the weaker side's power over the echoes'."""

    frequency_hz: float
    level_db: float


class FaultMeter:
    """Gathers mean chirps of beams."""

    def __init__(self, setup: RadarSetup, params: FaultParams) -> None:
        radar = setup.radar
        if params.leakage_to_m is not None and not params.leakage_to_m < 0.5 * radar.samples_per_chirp * (
            radar.range_bin_m
        ):
            limit_m = 0.5 * radar.samples_per_chirp * radar.range_bin_m
            raise ValueError(f"leakage_to_m must be under {limit_m:.1f} m, got {params.leakage_to_m!r}")
        if params.image_about_hz is not None and not abs(params.image_about_hz) < 0.25 * radar.sample_rate_hz:
            limit_hz = 0.25 * radar.sample_rate_hz
            raise ValueError(f"image_about_hz must be within +-{limit_hz:g}, got {params.image_about_hz!r}")
        self._setup, self._params = setup, params
        count = radar.samples_per_chirp
        self._window = np.hanning(count + 1)[:-1]
        turns = (params.image_about_hz or 0.0) / radar.sample_rate_hz * np.arange(count)
        self._to_axis = np.exp(-2j * np.pi * (turns % 1.0))
        self._shared = np.zeros(count, np.complex128)
        self._beams = 0
        #: Y(f) and Y(-f) of each beam.
        self._sides: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, chirp: np.ndarray) -> None:
        """Take in the mean chirp of a beam in codes, complex [samples]."""
        self._shared += chirp
        self._beams += 1
        if self._params.image_about_hz is not None:
            spectrum = fft.fft(chirp * self._to_axis * self._window)
            bins = self._setup.beat_sign * np.arange(AXIS_BINS, len(chirp) // 2 - AXIS_BINS)
            self._sides.append((spectrum[bins], spectrum[-bins]))

    def leakage(self, noise_mw: float) -> Leakage | None:
        """Return the strongest return near zero range that all beams share; None under `LEAKAGE_DB` of a bin's noise.

        Raises ValueError if it is strongest where the search ends: it is the flank of another.
        """
        if self._params.leakage_to_m is None:
            return None
        radar = self._setup.radar
        chirp = self._shared / self._beams
        chirp = chirp if self._setup.beat_sign > 0 else np.conj(chirp)
        profile = np.abs(fft.fft(chirp * self._window, _PADDING * len(chirp))) / self._window.sum()
        last = round(_PADDING * self._params.leakage_to_m / radar.range_bin_m)
        at = int(np.argmax(profile[: last + 1]))
        power_mw = float(profile[at] ** 2) * self._setup.milliwatt_per_code_squared
        if power_mw < noise_mw * 10.0 ** (LEAKAGE_DB / 10.0):
            return None
        if profile[at + 1] > profile[at]:
            raise ValueError(
                f"leakage must be a maximum up to {self._params.leakage_to_m:g} m (leakage_to_m), the profile still "
                "rises there"
            )
        return Leakage(power_dbm=db_from_ratio(power_mw), range_m=at / _PADDING * radar.range_bin_m)

    def imbalance(self) -> Imbalance | None:
        """Return the imbalance of I and Q; None if its image is not resolved."""
        if not self._sides:
            return None
        wanted, image = (np.concatenate(side) for side in zip(*self._sides, strict=True))
        power = float(np.sum(np.abs(wanted) ** 2))
        if not power > 0.0:
            return None
        ratio = complex(np.sum(wanted * image)) / power
        rest = image - ratio * np.conj(wanted)
        std = math.sqrt(float(np.sum(np.abs(wanted * rest) ** 2))) / power
        if not abs(ratio) > RESOLVED_SIGMAS * std:
            return None
        turned = (1.0 - ratio) / (1.0 + ratio)
        return Imbalance(
            gain_db=2.0 * db_from_ratio(abs(turned)),
            phase_deg=-math.degrees(math.atan2(turned.imag, turned.real)),
            image_db=2.0 * db_from_ratio(abs(ratio)),
            std_share=std / abs(ratio),
        )


def sidebands_of(radar: RadarParams, power: np.ndarray) -> tuple[Sideband, ...]:
    """Return the lines on both sides of the echoes in a spectrum of whole beams [intervals * chirps], nearest first.

    All ranges are summed by their distance from an echo's line.
    """
    by_offset = power.reshape(-1, radar.chirps_per_beam).sum(axis=0)
    noise = float(np.median(by_offset))
    weaker = np.minimum(by_offset, np.roll(by_offset[::-1], 1)) - noise
    echoes = float(by_offset[0]) - noise
    if not echoes > ECHO_RATIO * noise > 0.0:
        return ()
    return tuple(
        Sideband(
            frequency_hz=offset / radar.beam_duration_s,
            level_db=db_from_ratio(float(weaker[offset]) / echoes),
        )
        for offset in range(ECHO_BINS, radar.chirps_per_beam // 2)
        if weaker[offset] > (SIDEBAND_RATIO - 1.0) * noise
        and weaker[offset] >= max(weaker[offset - 1], weaker[offset + 1])
    )
