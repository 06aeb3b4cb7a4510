"""Model of the 8-element 10 GHz Phaser kit: its chirp, its register words, its beams, its samples.

A synthesiser sweeps the local oscillator above the band; a tone at the intermediate frequency, moved by a small
offset, is mixed down to the band and sent by one fixed antenna. Eight columns receive, each with its own gain and phase
(ADAR1000), four to a converter channel. The oscillator lies above the band, so beats rise with range and carry the
conjugate of the columns' phases: the recorded convention of this project, `beat_sign` +1.

Pure functions: `contrib.boards.phaser_device` controls the kit. Not confirmed on hardware:
docs/guides/connect-my-radar.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from msgs.values.arrays import require_finite, require_positive
from msgs.values.radar import ArrayParams, BeamGrid, RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS

COLUMNS = 8
#: Converter channel of each element, 1..8: four share a chip, and a chip a channel.
CHANNEL_OF_ELEMENT = (0, 0, 0, 0, 1, 1, 1, 1)
#: Beams that hear one element each; all look ahead.
ELEMENT_BEAMS = BeamGrid(azimuth_deg=(0.0,) * COLUMNS)
#: Steps of the phase registers, and the largest gain code.
PHASE_STEP_DEG = 360.0 / 128.0
PHASE_BITS = 7
GAIN_CODES = 127
#: The synthesiser's input is behind a divider: all its frequencies are a fourth of the oscillator's.
DIVIDER = 4
#: Largest code of the 12-bit converters, and its scale factor: two full channels in phase fill an int16.
CONVERTER_LIMIT = 2047
CODES_PER_CONVERTER_CODE = 8
#: Maximum samples of one buffer of the kit.
MAX_BURST_SAMPLES = 1 << 22
#: The chirp of the maker's published recording. Frequency on air at the start of the ramp, and the ramp.
RAMP_START_HZ, RAMP_BANDWIDTH_HZ = 9.9e9, 500e6
RAMP_TIME_S = 300e-6
SLOPE_HZ_PER_S = RAMP_BANDWIDTH_HZ / RAMP_TIME_S
#: Time from ramp to ramp, and its samples.
CHIRP_INTERVAL_S = 500e-6
SAMPLE_RATE_HZ = 4e6
INTERVAL_SAMPLES = round(CHIRP_INTERVAL_S * SAMPLE_RATE_HZ)
SAMPLES_PER_CHIRP = 1024
#: The tone, and the beat frequency of zero range: a whole number of turns a ramp.
INTERMEDIATE_HZ = 2.1e9
OFFSET_HZ = 100e3
#: Gain of the transmit converter, as in the maker's examples.
TRANSMIT_GAIN_DB = 0


class PhaserParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Beams and levels of a kit."""

    chirps_per_beam: int = 16
    #: Nominal time from scan to scan, most of it registers written one by one over the network.
    scan_period_s: float = 1.0
    #: The ramp is not straight at its start: samples count from here.
    settle_s: float = 30e-6
    column_spacing_m: float = 0.015
    #: Element 1 is at the left end, seen from behind the array.
    first_element_left: bool = False
    receive_gain_db: int = 60
    #: Power at the antenna of a tone that fills an int16; to be replaced by the value of one's own board.
    full_scale_dbm: float = -20.0

    def __post_init__(self) -> None:
        for name in ("chirps_per_beam", "scan_period_s", "column_spacing_m"):
            require_positive(name, getattr(self, name))
        require_finite("full_scale_dbm", self.full_scale_dbm)
        sampled_s = SAMPLES_PER_CHIRP / SAMPLE_RATE_HZ
        if not 0.0 <= self.settle_s <= RAMP_TIME_S * (1.0 + 1e-9) - sampled_s:
            raise ValueError(
                f"settle_s + {sampled_s!r} s of samples must fit the ramp of {RAMP_TIME_S!r} s, got {self.settle_s!r}"
            )
        if self.burst_samples > MAX_BURST_SAMPLES:
            raise ValueError(
                f"chirps_per_beam must make at most {MAX_BURST_SAMPLES} samples a burst, got {self.chirps_per_beam!r}"
            )

    @property
    def burst_samples(self) -> int:
        """Samples of each channel that one beam takes."""
        return self.chirps_per_beam * INTERVAL_SAMPLES


class PhaserCalibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Measured corrections of one board, in element order 1..8; those of a perfect board unless given.

    Signs and scales are those of the maker's calibration: gains multiply the gain code (1 at the weakest element),
    phases are added to the wanted phase, channel gains in dB are added to the channel.
    """

    gains: tuple[float, ...] = (1.0,) * COLUMNS
    phases_deg: tuple[float, ...] = (0.0,) * COLUMNS
    channel_gains_db: tuple[float, ...] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.gains) != COLUMNS or not all(0.0 < gain <= 1.0 for gain in self.gains):
            raise ValueError(f"gains must be {COLUMNS} numbers in (0, 1], got {self.gains}")
        if len(self.phases_deg) != COLUMNS or not np.isfinite(self.phases_deg).all():
            raise ValueError(f"phases_deg must be {COLUMNS} finite numbers, got {self.phases_deg}")
        if len(self.channel_gains_db) != 2 or not all(abs(gain) <= 20.0 for gain in self.channel_gains_db):
            raise ValueError(f"channel_gains_db must be 2 numbers in -20..20, got {self.channel_gains_db}")


@dataclass(frozen=True)
class SynthesiserWords:
    """Settings of the synthesiser, behind the divider of the oscillator."""

    frequency_hz: int
    deviation_range_hz: int
    deviation_step_hz: int
    deviation_time_us: int


def synthesiser_words() -> SynthesiserWords:
    """Return one step a microsecond, from the oscillator's frequency at the start of the ramp."""
    time_us = round(1e6 * RAMP_TIME_S)
    oscillator_hz = RAMP_START_HZ + INTERMEDIATE_HZ + OFFSET_HZ
    return SynthesiserWords(
        frequency_hz=round(oscillator_hz / DIVIDER),
        deviation_range_hz=round(RAMP_BANDWIDTH_HZ / DIVIDER),
        deviation_step_hz=round(RAMP_BANDWIDTH_HZ / DIVIDER / time_us),
        deviation_time_us=time_us,
    )


def radar_params(params: PhaserParams) -> RadarParams:
    """Return the effective radar of its samples: the sampled bandwidth, with the carrier in the middle of it."""
    sampled_s = SAMPLES_PER_CHIRP / SAMPLE_RATE_HZ
    return RadarParams(
        carrier_hz=RAMP_START_HZ + SLOPE_HZ_PER_S * (params.settle_s + 0.5 * sampled_s),
        bandwidth_hz=SLOPE_HZ_PER_S * sampled_s,
        sample_rate_hz=SAMPLE_RATE_HZ,
        chirps_per_beam=params.chirps_per_beam,
        samples_per_chirp=SAMPLES_PER_CHIRP,
        scan_period_s=params.scan_period_s,
        chirp_interval_s=CHIRP_INTERVAL_S,
    )


@dataclass(frozen=True)
class PhaserLimits:
    """Limits of a chirp."""

    range_bin_m: float
    #: Beyond this, beats alias to the other side of the spectrum.
    range_limit_m: float
    speed_bin_mps: float
    #: Beyond this, closing and opening cannot be distinguished.
    speed_limit_mps: float
    beam_time_s: float
    #: Bytes of a beam over the link, both channels.
    beam_bytes: int


def limits(params: PhaserParams) -> PhaserLimits:
    """Return the limits that follow from the parameters alone; the detection range depends on the board."""
    radar = radar_params(params)
    return PhaserLimits(
        range_bin_m=radar.range_bin_m,
        range_limit_m=0.5 * SPEED_OF_LIGHT_MPS * (0.5 * SAMPLE_RATE_HZ - OFFSET_HZ) / SLOPE_HZ_PER_S,
        speed_bin_mps=0.5 * radar.wavelength_m / radar.beam_duration_s,
        speed_limit_mps=0.25 * radar.wavelength_m / CHIRP_INTERVAL_S,
        beam_time_s=radar.beam_duration_s,
        beam_bytes=2 * 4 * params.burst_samples,
    )


@dataclass(frozen=True)
class BeamTable:
    """Registers of all beams, and the resulting weights of the columns."""

    #: Register phases in element order 1..8, multiples of `PHASE_STEP_DEG` in [0, 360); float64 [beams, 8].
    phases_deg: np.ndarray
    #: Gain codes in element order; int [beams, 8].
    gain_codes: np.ndarray
    #: Weights of the columns from right to left as actually set, complex64 [beams, 8].
    weights: np.ndarray


def beam_table(params: PhaserParams, calibration: PhaserCalibration, beams: BeamGrid) -> BeamTable:
    """Return registers that steer the calibrated array, and its weights after both roundings.

    A beam steered to a turns column n, counted from the right, by -k (n - 3.5) d sin(a). Calibration phases go
    into the register before it is rounded, so the remainder is known and goes into the weights.
    """
    wavelength_m = radar_params(params).wavelength_m
    step_deg = 360.0 * params.column_spacing_m / wavelength_m
    column = np.arange(COLUMNS) - 0.5 * (COLUMNS - 1)
    position = -column if params.first_element_left else column
    wanted_deg = -step_deg * np.multiply.outer(np.sin(beams.azimuth_rad), position)
    own_deg = np.array(calibration.phases_deg)
    phases_deg = (PHASE_STEP_DEG * np.round((wanted_deg + own_deg) / PHASE_STEP_DEG)) % 360.0
    equalised = GAIN_CODES * np.array(calibration.gains)
    gain_codes = np.floor(equalised).astype(np.int64)
    weights = gain_codes / equalised * np.exp(1j * np.radians(phases_deg - own_deg))
    return BeamTable(
        phases_deg=phases_deg, gain_codes=np.tile(gain_codes, (len(beams), 1)), weights=_in_columns(params, weights)
    )


def element_table(params: PhaserParams) -> BeamTable:
    """Return registers of `ELEMENT_BEAMS`: beam k hears element k alone, at full gain and phase zero."""
    only = np.eye(COLUMNS)
    return BeamTable(
        phases_deg=np.zeros((COLUMNS, COLUMNS)),
        gain_codes=(GAIN_CODES * only).astype(np.int64),
        weights=_in_columns(params, only),
    )


def _in_columns(params: PhaserParams, weights: np.ndarray) -> np.ndarray:
    """Return weights [beams, 8] of elements in the order of columns, from right to left; complex64."""
    return np.ascontiguousarray(weights[:, ::-1] if params.first_element_left else weights, np.complex64)


def radar_setup(params: PhaserParams, beams: BeamGrid, weights: np.ndarray, stamp_ns: int = 0) -> RadarSetup:
    """Return the kit's set-up: eight receive columns, one fixed transmitter, weights as set complex64 [beams, 8]."""
    array = ArrayParams(
        columns=COLUMNS, column_spacing_m=params.column_spacing_m, phase_bits=PHASE_BITS, steered_ways=1
    )
    return RadarSetup(
        stamp_ns=stamp_ns,
        radar=radar_params(params),
        array=array,
        beams=beams,
        full_scale_dbm=params.full_scale_dbm,
        steering_weights=weights,
    )


def beam_samples(
    channels: list[np.ndarray], params: PhaserParams, channel_gains_db: tuple[float, ...] = (0.0, 0.0)
) -> np.ndarray:
    """Return I/Q codes int16 [chirps, samples, 2] of a burst of converter codes, complex [burst] for each channel.

    The channels are summed, zero range is moved to zero frequency, and the straight part of every ramp is kept. A
    sample at the converter's limit comes out at full scale. Raises `ValueError` for a burst that is too short, not of
    two channels or not finite.
    """
    kept = _straight(channels, params)
    gains = 10.0 ** (np.array(channel_gains_db) / 20.0)
    turns = OFFSET_HZ / SAMPLE_RATE_HZ * _straight_samples(params)
    beats = np.tensordot(gains, kept, axes=1) * np.exp(-2j * np.pi * (turns % 1.0))
    limited = (np.maximum(np.abs(kept.real), np.abs(kept.imag)) >= CONVERTER_LIMIT).any(axis=0)
    codes = CODES_PER_CONVERTER_CODE * np.stack([beats.real, beats.imag], axis=-1)
    # the rotation hides the limit: restore it where receivers check for it
    codes[limited] *= 32768.0 / np.maximum(np.abs(codes[limited]).max(axis=-1, keepdims=True), 1.0)
    return np.clip(np.rint(codes), -32768, 32767).astype("<i2")


def _straight(channels: list[np.ndarray], params: PhaserParams) -> np.ndarray:
    """Return the samples on the straight part of each ramp, if it is a burst; complex [2, chirps, samples]."""
    if len(channels) != 2 or any(np.ndim(channel) != 1 for channel in channels):
        raise ValueError(f"burst must be of 2 channels, got {len(channels)}")
    short = min(len(channel) for channel in channels)
    if short < params.burst_samples:
        raise ValueError(f"burst must be of {params.burst_samples} samples, got {short}")
    samples = _straight_samples(params)
    ramps = (channel[: params.burst_samples].reshape(-1, INTERVAL_SAMPLES) for channel in channels)
    kept = np.stack([ramp[:, samples[0] : samples[-1] + 1] for ramp in ramps])
    if not np.isfinite(kept).all():
        raise ValueError(f"burst must be finite, {np.count_nonzero(~np.isfinite(kept))} samples are not")
    return kept


def _straight_samples(params: PhaserParams) -> np.ndarray:
    """Return the sample numbers counted from the start of a ramp; [samples]."""
    return round(params.settle_s * SAMPLE_RATE_HZ) + np.arange(SAMPLES_PER_CHIRP)
