"""Range-azimuth forming for digital arrays: every virtual channel is sampled, beams are formed afterwards.

Transmitters may take turns (TDM): a mover's phase then advances from slot to slot. It is turned back, Doppler bin by
Doppler bin, before the channels are added. A cell of the map shows its strongest Doppler bin, and its speed beside.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import scipy.fft

from models.physics.waveform import WINDOW_TAPS
from msgs.values.arrays import require_array, require_finite, require_positive
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.units import SPEED_OF_LIGHT_MPS


class DigitalArrayParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A digital array and its chirps; defaults are a 77 GHz board of two transmitters and four receivers."""

    #: Carrier in the middle of the sampled sweep.
    carrier_hz: float = 78.956e9
    chirp_slope_hz_per_s: float = 60e12
    sample_rate_hz: float = 2.5e6
    #: From one chirp to the next, whichever transmitter sends it.
    chirp_interval_s: float = 92e-6
    #: TDM slot in which each virtual channel's transmitter sends.
    channel_slot: tuple[int, ...] = (0, 0, 0, 0, 1, 1, 1, 1)
    #: Position of each virtual channel along +y (left); two-way phases count each metre once.
    channel_y_m: tuple[float, ...] = tuple(0.5 * SPEED_OF_LIGHT_MPS / 78.956e9 * n for n in range(8))
    #: Beat frequency of zero range (boards that offset their intermediate frequency).
    beat_offset_hz: float = 0.0
    #: +1 where beats have positive frequency for positive range, -1 where the hardware differs.
    beat_sign: int = 1
    #: Take the mean over chirps off every channel: what stands still disappears.
    remove_static: bool = False

    def __post_init__(self) -> None:
        for name in ("carrier_hz", "chirp_slope_hz_per_s", "sample_rate_hz", "chirp_interval_s"):
            require_positive(f"digital_array.{name}", getattr(self, name))
        require_finite("digital_array.beat_offset_hz", self.beat_offset_hz)
        require_finite("digital_array.channel_y_m", *self.channel_y_m)
        if not self.channel_slot or len(self.channel_slot) != len(self.channel_y_m):
            raise ValueError(
                "digital_array.channel_slot and channel_y_m must name the same channels, "
                f"got {len(self.channel_slot)} and {len(self.channel_y_m)}"
            )
        if min(self.channel_slot) < 0:
            raise ValueError(f"digital_array.channel_slot must not be negative, got {self.channel_slot}")
        if self.beat_sign not in (1, -1):
            raise ValueError(f"digital_array.beat_sign must be +1 or -1, got {self.beat_sign!r}")

    @property
    def wavelength_m(self) -> float:
        """Wavelength in the middle of the sweep."""
        return SPEED_OF_LIGHT_MPS / self.carrier_hz

    @property
    def repetition_interval_s(self) -> float:
        """From one chirp of a transmitter to its next."""
        return self.chirp_interval_s * (max(self.channel_slot) + 1)

    def range_bin_m(self, samples: int) -> float:
        """Return the range spacing of the FFT of so many samples."""
        return SPEED_OF_LIGHT_MPS * self.sample_rate_hz / (2.0 * self.chirp_slope_hz_per_s * samples)

    def closing_speed_mps(self, chirps: int) -> np.ndarray:
        """Return the closing speed of each Doppler bin, zero first, then receding, then closing; [chirps].

        A closing target shortens its path, so its recorded beat turns backwards from chirp to chirp.
        """
        # 0 - x: no negative zero for what stands still
        return 0.0 - 0.5 * self.wavelength_m * scipy.fft.fftfreq(chirps, self.repetition_interval_s)


@dataclass(frozen=True)
class DigitalArrayMap:
    """A range-azimuth map and the closing speed that each cell shows."""

    map: RangeAzimuthMap
    #: float32 [range, azimuth]
    closing_speed_mps: np.ndarray


def range_doppler(samples: np.ndarray, params: DigitalArrayParams) -> np.ndarray:
    """Return the spectra complex64 [Doppler, channels, range] in sqrt(mW), TDM phases turned back, of unit coherent
    gain; a tone of amplitude one has one milliwatt.

    `samples` complex64 [chirps, channels, samples], a chirp of every transmitter counted once. Raises `ValueError`
    where there are none or one is not finite.
    """
    require_array("samples", samples, "<c8", (None, len(params.channel_slot), None))
    if 0 in samples.shape:
        raise ValueError(f"samples must hold at least one chirp and one sample, got {samples.shape}")
    # the transforms would spread a single bad value over every cell
    if not np.isfinite(samples).all():
        raise ValueError(f"samples must be finite, got {np.count_nonzero(~np.isfinite(samples))} that are not")
    if params.beat_sign < 0:
        samples = samples.conj()
    if params.remove_static:
        # summed in float64: what stands still may be 100 dB over what moves, and there are thousands of chirps
        samples = samples - samples.mean(axis=0, dtype=np.complex128).astype(np.complex64)
    chirps, _, length = samples.shape
    offset_turns = params.beat_offset_hz / params.sample_rate_hz * np.arange(length)
    ramp = np.exp(-2j * np.pi * (offset_turns % 1.0)) * _window(length)
    series = samples * ramp.astype(np.complex64)
    series *= _window(chirps).astype(np.float32)[:, None, None]
    spectra = scipy.fft.fft2(series, axes=(0, 2), workers=1, overwrite_x=True)
    spectra *= np.float32(1.0 / (chirps * length)) * _slot_turns(chirps, params)
    return spectra


def slots_aligned(samples: np.ndarray, params: DigitalArrayParams) -> np.ndarray:
    """Return samples complex64 [chirps, channels, samples] as if all transmitters sent in slot 0.

    Speeds beyond half a turn a repetition are taken for others, and a single chirp, which shows none, stays as it is.
    """
    spectra = scipy.fft.fft(samples, axis=0, workers=1)
    spectra *= _slot_turns(len(samples), params)
    aligned: np.ndarray = scipy.fft.ifft(spectra, axis=0, workers=1, overwrite_x=True)
    return aligned


def slots_turned(samples: np.ndarray, params: DigitalArrayParams, closing_speed_mps: float) -> np.ndarray:
    """Return samples complex64 [chirps, channels, samples] as if all transmitters sent in slot 0, for one speed.

    For frames whose own Doppler says too little: a single chirp of each transmitter, with the speed of a track.
    """
    turns = 2.0 * closing_speed_mps / params.wavelength_m * params.chirp_interval_s * np.array(params.channel_slot)
    return np.asarray(samples * np.exp(2j * np.pi * turns).astype(np.complex64)[:, None])


def _slot_turns(chirps: int, params: DigitalArrayParams) -> np.ndarray:
    """Return the factors that turn each Doppler bin back to slot 0, complex64 [Doppler, channels, 1]."""
    doppler_hz = scipy.fft.fftfreq(chirps, params.repetition_interval_s)
    turns = np.multiply.outer(doppler_hz, np.array(params.channel_slot) * params.chirp_interval_s)
    return np.exp(-2j * np.pi * turns).astype(np.complex64)[..., None]


def _window(count: int) -> np.ndarray:
    """Return the periodic Hann window of unit mean; a single value stays as it is."""
    taps = WINDOW_TAPS["hann"]
    if count < len(taps):
        return np.ones(count)
    turns = np.multiply.outer(np.arange(len(taps)) - len(taps) // 2, np.arange(count)) / count
    window: np.ndarray = np.array(taps) @ np.cos(2.0 * np.pi * turns)
    return window


def form_digital_map(
    samples: np.ndarray,
    params: DigitalArrayParams,
    grid: RangeAzimuthGrid,
    stamp_ns: int = 0,
    scan_id: int = 0,
) -> DigitalArrayMap:
    """Return the map of one burst, complex64 [chirps, channels, samples]; cells hold the mean over channels steered at
    them.

    Raises `ValueError` unless the grid's range bins are those of the samples and no more than there are.
    """
    length = samples.shape[-1]
    range_bin_m = params.range_bin_m(length)
    if abs(grid.range_bin_m / range_bin_m - 1.0) > 1e-6 or grid.range_bins > length:
        raise ValueError(
            f"grid must have at most {length} range bins of {range_bin_m!r} m, "
            f"got {grid.range_bins} of {grid.range_bin_m!r}"
        )
    spectra = range_doppler(samples, params)[..., : grid.range_bins]
    steering = _steering(params, grid)
    speeds_mps = params.closing_speed_mps(len(samples)).astype(np.float32)
    values = np.empty(grid.shape, np.complex64)
    strongest = np.empty(grid.shape, np.intp)
    for row in range(grid.range_bins):
        # one range bin at a time: the cube of all would be hundreds of megabytes
        beams = spectra[:, :, row] @ steering
        strongest[row] = np.argmax(beams.real**2 + beams.imag**2, axis=0)
        values[row] = np.take_along_axis(beams, strongest[row][None], axis=0)[0]
    formed = RangeAzimuthMap(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        grid=grid,
        values=values,
        azimuth_stamp_ns=np.full(grid.azimuth_bins, stamp_ns, np.int64),
        noise_power_mw=_noise_power_mw(spectra),
        incoherent=np.zeros(grid.range_bins, np.bool_),
    )
    return DigitalArrayMap(map=formed, closing_speed_mps=speeds_mps[strongest])


def _steering(params: DigitalArrayParams, grid: RangeAzimuthGrid) -> np.ndarray:
    """Return the channels to azimuths, complex64 [channels, azimuth]; recorded phases are conjugate, exp(-j k y
    sin(azimuth)).
    """
    turns = np.multiply.outer(np.array(params.channel_y_m) / params.wavelength_m, np.sin(grid.azimuth_rad))
    return (np.exp(2j * np.pi * turns) / len(turns)).astype(np.complex64)


def _noise_power_mw(spectra: np.ndarray) -> float:
    """Return the noise of a steered cell before its Doppler bin is chosen: median over cells, exponential, mean of
    channels.
    """
    channels = spectra.shape[1]
    return float(np.median(spectra.real**2 + spectra.imag**2) / np.log(2.0) / channels)
