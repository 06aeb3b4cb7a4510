"""Noise floor of a receiver from raw beams: white level, 1/f corner and spurs, read between the echoes.

Whatever stands still repeats from chirp to chirp: in the spectrum of the whole beam, with zeros where the radar rests,
it lies on the multiples of 1 / T alone (T from chirp to chirp), what moves lies close beside them, and all other bins
hold noise, free-running tones and sidebands of the oscillator, which lie alike on both sides of every echo. Captures
with echoes therefore serve as well as those of an open field.

The model is that of the simulator: P(f) = P_white (1 + f_corner / max(|f|, 1 / T_f)) per sample band.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy import fft
from scipy.optimize import least_squares
from scipy.special import gammaincinv

from contrib.calibrate.front_end_faults import (
    FaultMeter,
    FaultParams,
    Imbalance,
    Leakage,
    Sideband,
    sidebands_of,
)
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup
from msgs.values.units import BOLTZMANN_J_PER_K, REFERENCE_TEMPERATURE_K, db_from_ratio

#: Least number of chirps that leaves bins between the echoes.
MIN_CHIRPS = 8
#: Share of the bins between two multiples of 1 / T_c left to what moves, to either side of each: 10 bins of 128
#: chirps, up to 215 m/s at 10 GHz.
_GUARD_SHARE = 0.08
#: A tone stands this far above the noise about it, in the mean over all beams.
SPUR_DB = 15.0
#: Bands of frequency in which the floor is read, to either sign; a factor each.
_BANDS = 24
#: Largest share of codes at the converter's limits.
MAX_CLIPPED = 1e-3
#: Largest number of tones that are reported, strongest first.
MAX_SPURS = 16


class FloorBand(msgspec.Struct, frozen=True, kw_only=True):
    """Noise in one band of beat frequency (both signs), as a range: power per Hann-windowed bin of a beam."""

    range_m: float
    frequency_hz: float
    measured_dbm: float
    modelled_dbm: float


class FoundSpur(msgspec.Struct, frozen=True, kw_only=True):
    """A free-running tone: beat frequency and power at the receiver's input."""

    frequency_hz: float
    power_dbm: float


class NoiseFloor(msgspec.Struct, frozen=True, kw_only=True):
    """Noise floor of a receiver."""

    scans: int
    beams: int
    #: White noise: over the sampled band, per Hann-windowed range bin of a beam, and as a noise figure.
    power_dbm: float
    bin_dbm: float
    noise_figure_db: float
    #: Frequency below which 1/f noise exceeds the white one; 0: none seen.
    flicker_corner_hz: float
    spurs: tuple[FoundSpur, ...]
    #: Lines on both sides of every echo; the simulator has none.
    sidebands: tuple[Sideband, ...]
    #: None: not asked for, or not above the noise.
    leakage: Leakage | None
    imbalance: Imbalance | None
    #: White noise over the sampled band of each beam, and the largest difference of one from their mean.
    beam_power_dbm: tuple[float, ...]
    beam_spread_db: float
    #: Floor against range; rms of measured less modelled.
    bands: tuple[FloorBand, ...]
    model_rms_db: float


class NoiseMeter:
    """Gathers the spectra of beams; ValueError for beams too short to tell noise from echoes."""

    def __init__(self, setup: RadarSetup, faults: FaultParams | None = None) -> None:
        radar = setup.radar
        if radar.chirps_per_beam < MIN_CHIRPS:
            raise ValueError(
                f"noise is read between the echoes: chirps_per_beam must be at least {MIN_CHIRPS}, "
                f"got {radar.chirps_per_beam}"
            )
        #: Samples from chirp to chirp; those after a chirp's own are rest.
        self._interval = round(radar.repetition_interval_s * radar.sample_rate_hz)
        self._setup, self._count = setup, radar.chirps_per_beam * self._interval
        self._faults = FaultMeter(setup, faults or FaultParams())
        #: Mean periodogram over all beams, and the white level's sum and number of each.
        self._power = np.zeros(self._count, np.float64)
        self._white = np.zeros((2, len(setup.beams)))
        self._scans: set[int] = set()
        # a sine over the beam (Hann) keeps echoes on their own three bins
        self._window = np.hanning(self._count + 1)[:-1].astype(np.float32)
        #: Sum of squares of the window over what is sampled.
        sampled = self._window.reshape(-1, self._interval)[:, : radar.samples_per_chirp]
        self._window_power = float((sampled.astype(np.float64) ** 2).sum())
        self._between = _between_echoes(radar, self._count)
        self._high = np.abs(np.fft.fftfreq(self._count)) > 0.25

    def add(self, beam: RadarBeam) -> None:
        """Take in a beam; ValueError where its shape is not the set-up's."""
        radar = self._setup.radar
        shape = radar.chirps_per_beam, radar.samples_per_chirp, 2
        if beam.samples.shape != shape:
            raise ValueError(f"beam.samples must have shape {shape}, got {beam.samples.shape}")
        clipped = float(np.mean((beam.samples == 32767) | (beam.samples == -32768)))
        if clipped > MAX_CLIPPED:
            raise ValueError(
                f"at most {100.0 * MAX_CLIPPED:g} % of codes may stand at full scale, {100.0 * clipped:.1f} % of beam "
                f"{beam.beam_index} do: clipping makes noise and tones of its own"
            )
        series = np.zeros((radar.chirps_per_beam, self._interval), np.complex64)
        series[:, : radar.samples_per_chirp] = beam.samples.astype(np.float32).view(np.complex64)[..., 0]
        self._faults.add(series[:, : radar.samples_per_chirp].mean(axis=0))
        spectrum = fft.fft(series.reshape(-1) * self._window, overwrite_x=True)
        # density per sample band: white noise of power P shows P in every bin
        scale = 10.0 ** (beam.full_scale_dbm / 10.0) / 32768**2 / self._window_power
        power = (spectrum.real**2 + spectrum.imag**2) * np.float32(scale)
        self._power += power
        self._white[:, beam.beam_index] += _median_mean(power[self._between & self._high]), 1.0
        self._scans.add(beam.scan_id)

    def result(self) -> NoiseFloor:
        """Return the floor of all beams so far; ValueError before the first or where nothing is heard."""
        total, number = self._white
        if not number.any():
            raise ValueError("noise needs at least one beam, got none")
        beam_mw = total[number > 0] / number[number > 0]
        if not beam_mw.min() > 0.0:
            raise ValueError("the capture holds beams without any noise: the receiver was off, or its codes too coarse")
        radar, beams = self._setup.radar, int(number.sum())
        mean_power = self._power / beams
        sidebands = sidebands_of(radar, mean_power)
        between = _beside(radar, self._between, sidebands)
        frequency_hz, power_mw = _bands(radar, mean_power, between, beams)
        white_mw, corner_hz = _fit(radar, frequency_hz, power_mw)
        beam_dbm = tuple(db_from_ratio(float(power)) for power in beam_mw)
        modelled = white_mw * (1.0 + corner_hz / np.maximum(frequency_hz, 1.0 / radar.beam_duration_s))
        off_db = 10.0 * np.log10(power_mw / modelled)
        per_bin = 1.5 / (radar.chirps_per_beam * radar.samples_per_chirp)
        return NoiseFloor(
            scans=len(self._scans),
            beams=beams,
            power_dbm=db_from_ratio(white_mw),
            bin_dbm=db_from_ratio(white_mw * per_bin),
            noise_figure_db=noise_figure_db(radar, white_mw),
            flicker_corner_hz=corner_hz,
            spurs=_spurs(radar, mean_power, between, self._setup.beat_sign),
            sidebands=sidebands,
            leakage=self._faults.leakage(white_mw * per_bin),
            imbalance=self._faults.imbalance(),
            beam_power_dbm=beam_dbm,
            beam_spread_db=float(np.abs(np.array(beam_dbm) - np.mean(beam_dbm)).max()),
            bands=tuple(
                FloorBand(
                    range_m=float(band_hz * radar.chirp_period_s * radar.range_bin_m),
                    frequency_hz=float(band_hz),
                    measured_dbm=db_from_ratio(float(measured) * per_bin),
                    modelled_dbm=db_from_ratio(float(model) * per_bin),
                )
                for band_hz, measured, model in zip(frequency_hz, power_mw, modelled, strict=True)
            ),
            model_rms_db=float(np.sqrt(np.mean(off_db**2))),
        )


def noise_figure_db(radar: RadarParams, power_mw: float) -> float:
    """Return the F of a noise power over the sampled band: power / (k T0 f_s), in dB."""
    return db_from_ratio(power_mw / (1e3 * BOLTZMANN_J_PER_K * REFERENCE_TEMPERATURE_K * radar.sample_rate_hz))


def _between_echoes(radar: RadarParams, count: int) -> np.ndarray:
    """Return the bins of a whole beam's spectrum away from the multiples of 1 / T, bool [count]."""
    chirps = radar.chirps_per_beam
    off = np.arange(count) % chirps
    off = np.minimum(off, chirps - off)
    return np.asarray(off > max(2, round(_GUARD_SHARE * chirps)))


def _beside(radar: RadarParams, between: np.ndarray, sidebands: tuple[Sideband, ...]) -> np.ndarray:
    """Return the bins between the echoes that are not of their sidebands, a Hann window's lobe wide, bool [count]."""
    chirps = radar.chirps_per_beam
    off = np.arange(len(between)) % chirps
    off = np.minimum(off, chirps - off)
    bins = [sideband.frequency_hz * radar.beam_duration_s for sideband in sidebands]
    return between & ~np.any([np.abs(off - bin_) < 2.5 for bin_ in bins], axis=0) if bins else between


def _median_mean(power: np.ndarray, averages: int = 1) -> float:
    """Return the mean power of noise from the median of `averages`-fold periodograms: tones do not set it."""
    return float(np.median(power)) * averages / float(gammaincinv(averages, 0.5))


def _bands(radar: RadarParams, power: np.ndarray, between: np.ndarray, averages: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies [Hz] and powers per sample band of logarithmic bands of a mean periodogram, both signs;
    [bands].

    Raises ValueError where the beams are too short to fill a band.
    """
    frequency_hz = np.abs(np.fft.fftfreq(len(power), 1.0 / radar.sample_rate_hz))
    lowest = 3.0 / radar.beam_duration_s
    edges = np.geomspace(lowest, 0.5 * radar.sample_rate_hz, _BANDS + 1)
    order = np.digitize(frequency_hz, edges) - 1
    bands = []
    for band in range(_BANDS):
        in_band = between & (order == band)
        if in_band.sum() >= 8:
            # tones and movers are few: the median does not see them
            bands.append((float(np.exp(np.log(frequency_hz[in_band]).mean())), _median_mean(power[in_band], averages)))
    if not bands:
        raise ValueError(
            f"noise is read in bands of at least 8 bins: beams of {radar.chirps_per_beam} chirps of "
            f"{radar.samples_per_chirp} samples are too short"
        )
    band_hz, power_mw = np.array(bands).T
    return band_hz, power_mw


def _fit(radar: RadarParams, frequency_hz: np.ndarray, power_mw: np.ndarray) -> tuple[float, float]:
    """Return the white power over the sampled band and corner frequency that fit the bands best in dB, robustly."""
    low_hz = 1.0 / radar.beam_duration_s
    start = math.log(float(np.median(power_mw))), math.log(low_hz)

    def off_db(values: np.ndarray) -> np.ndarray:
        modelled = values[0] + np.log1p(np.exp(values[1]) / np.maximum(frequency_hz, low_hz))
        return np.asarray((np.log(power_mw) - modelled) * 10.0 / math.log(10.0))

    solution = least_squares(off_db, start, loss="soft_l1", f_scale=0.3).x
    corner_hz = float(np.exp(solution[1]))
    # the lowest bands hold few bins: a corner that lifts them by less than 1.5 dB may be their scatter
    return float(np.exp(solution[0])), corner_hz if corner_hz > 0.4 * frequency_hz[0] else 0.0


def _spurs(radar: RadarParams, power: np.ndarray, between: np.ndarray, beat_sign: int) -> tuple[FoundSpur, ...]:
    """Return the tones between the echoes that stand out of the floor about them, strongest first."""
    blocks = power.reshape(-1, 2 * radar.chirps_per_beam)
    floor = np.repeat(np.median(blocks, axis=1), blocks.shape[1])
    loud = between & (power > floor * 10.0 ** (SPUR_DB / 10.0))
    loud &= (power >= np.roll(power, 1)) & (power >= np.roll(power, -1))
    bins = np.flatnonzero(loud)
    bins = bins[np.argsort(-power[bins], kind="stable")]
    chirps, rests = radar.chirps_per_beam, radar.repetition_interval_s > radar.chirp_period_s
    kept: list[int] = []
    for bin_ in bins.tolist():
        # a Hann window's lobe, and the skirt of a strong tone
        near = any(abs(bin_ - earlier) <= 16 for earlier in kept)
        # a tone that is cut by rests has lines beside it, 1 / T apart
        cut = rests and any((bin_ - earlier + 4) % chirps <= 8 for earlier in kept)
        if not near and not cut and len(kept) < MAX_SPURS:
            kept.append(bin_)
    return tuple(_spur_at(radar, power, bin_, beat_sign) for bin_ in kept)


def _spur_at(radar: RadarParams, power: np.ndarray, at: int, beat_sign: int) -> FoundSpur:
    """Return the frequency below the bin and power of the tone whose lobe peaks at a bin."""
    count = len(power)
    around = np.arange(at - 4, at + 5) % count
    lobe = power[around]
    # over a Hann window's lobe the powers sum to the tone's, the number of taken samples times (2/3 at its top)
    tone_mw = float(lobe.sum()) / (radar.chirps_per_beam * radar.samples_per_chirp)
    offset = float((np.arange(-4, 5) * lobe).sum() / lobe.sum())
    turns = (at + offset) / count
    frequency_hz = (turns - 1.0 if turns > 0.5 else turns) * radar.sample_rate_hz
    return FoundSpur(frequency_hz=beat_sign * frequency_hz, power_dbm=db_from_ratio(tone_mw))
