"""Network input from a complex range-azimuth map: one function for training and for the vehicle.

The azimuth axis carries only the 2N-1 = 15 coefficients of the co-array, so 29 columns sample its power without loss;
the default network sees 32 of the 256, each read at the centre of the output columns 8j..8j+7. The published networks
see all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from msgs.values.arrays import require_positive
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap

#: Channels of the compact networks; all are about 0..1 or -1..1.
CHANNELS = ("level", "shadow", "contrast", "range", "azimuth")


class Encoding(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the network's input; travels in the model card."""

    #: Range bins that the network sees (320 bins of the 10 GHz radar: 68.5 m).
    range_bins: int = 320
    #: Columns of the map that the network sees.
    columns: int = 32
    #: Content of each input channel, in order: names of `ENCODERS`.
    channels: tuple[str, ...] = CHANNELS
    #: Columns of zeros to either side (section 3.1.1 pads 256 to 512).
    pad_columns: int = 0
    #: Levels over the noise, in dB, that map to 0 and to 1.
    level_min_db: float = -5.0
    level_max_db: float = 85.0
    #: Without a usable noise power, levels count from this far below the strongest cell.
    dynamic_range_db: float = 90.0

    def __post_init__(self) -> None:
        require_positive("encoding.range_bins", self.range_bins)
        require_positive("encoding.columns", self.columns)
        require_positive("encoding.dynamic_range_db", self.dynamic_range_db)
        if not self.level_min_db < self.level_max_db:
            raise ValueError(
                f"encoding.level_min_db must be below level_max_db, got {self.level_min_db} and {self.level_max_db}"
            )
        if self.pad_columns < 0:
            raise ValueError(f"encoding.pad_columns must not be negative, got {self.pad_columns}")
        unknown = [name for name in self.channels if name not in ENCODERS]
        if unknown or not self.channels:
            raise ValueError(f"encoding.channels must be some of {', '.join(ENCODERS)}, got {self.channels}")

    @property
    def shape(self) -> tuple[int, int, int]:
        """(channels, range, columns) of one input."""
        return len(self.channels), self.range_bins, self.columns + 2 * self.pad_columns

    def check_grid(self, grid: RangeAzimuthGrid) -> None:
        """Raise `ValueError` unless maps on `grid` can be encoded."""
        if grid.range_bins < self.range_bins:
            raise ValueError(f"grid.range_bins must be at least {self.range_bins}, got {grid.range_bins}")
        step = self.columns if self.columns == grid.azimuth_bins else 2 * self.columns
        if grid.azimuth_bins % step:
            raise ValueError(f"grid.azimuth_bins must be a multiple of {step}, got {grid.azimuth_bins}")

    def check_array(self, setup: RadarSetup, grid: RangeAzimuthGrid) -> None:
        """Raise `ValueError` where the array's beams fall between the columns that sample maps on `grid`.

        The power of an N-column array one way has the frequencies of N points d apart over the sine of the azimuth:
        its samples are at most lambda / (2 d (N - 1)) apart where the sine changes fastest, at boresight.
        """
        wavelength_m, array = setup.radar.wavelength_m, setup.array
        aperture = 2.0 * (array.columns - 1) * array.column_spacing(wavelength_m) / wavelength_m
        least = math.ceil(2.0 * math.radians(grid.azimuth_limit_deg) * aperture)
        if self.columns < least:
            raise ValueError(
                f"encoding.columns must be at least {least} for an array of {array.columns} columns, whose beams "
                f"would fall between them, got {self.columns}: compact_unet:fine has enough, method cfar needs none"
            )

    def is_turned(self, channels: np.ndarray) -> bool:
        """Return whether a map is louder at its higher azimuths, by its encoded channels [channels, ..., columns].

        Networks then look at its mirror image. Without levels among the channels no map is turned.
        """
        if "level" not in self.channels:
            return False
        level = channels[self.channels.index("level")].reshape(-1, channels.shape[-1]).astype(np.float64)
        power = np.exp(level * (self.level_max_db - self.level_min_db) * math.log(10.0) / 10.0).sum(axis=0)
        half = len(power) // 2
        return bool(power[-half:].sum() > power[:half].sum())


def encode_map(encoding: Encoding, ra_map: RangeAzimuthMap) -> np.ndarray:
    """Return the network input of one map, float32 [channels, range, columns]."""
    encoding.check_grid(ra_map.grid)
    return encode_columns(encoding, sample_columns(encoding, ra_map.values), np.array(ra_map.noise_power_mw))


def sample_columns(encoding: Encoding, values: np.ndarray) -> np.ndarray:
    """Return the map values [..., range, azimuth] at the centres of the columns, complex64 [..., range, columns]."""
    width = values.shape[-1] // encoding.columns
    cropped = values[..., : encoding.range_bins, :]
    if width == 1:
        return cropped
    return 0.5 * (cropped[..., width // 2 - 1 :: width] + cropped[..., width // 2 :: width])


def encode_columns(encoding: Encoding, columns: np.ndarray, noise_power_mw: np.ndarray) -> np.ndarray:
    """Return the network input, float32 [..., channels, range, columns], of sampled maps and noise [...].

    Finite for every input, cells that are not count as empty. Levels are over the noise: a common gain has no effect.
    """
    sampled = _Sampled(encoding, columns, noise_power_mw)
    pad = encoding.pad_columns
    inside = slice(pad, pad + encoding.columns)
    channels = np.zeros(
        (*columns.shape[:-2], len(encoding.channels), encoding.range_bins, encoding.shape[-1]), np.float32
    )
    for index, name in enumerate(encoding.channels):
        channels[..., index, :, inside] = ENCODERS[name](sampled)
    return channels


@dataclass(frozen=True)
class _Sampled:
    """Sampled maps complex [..., range, columns], their noise [...], and what several channels are made from."""

    encoding: Encoding
    columns: np.ndarray
    noise_power_mw: np.ndarray

    @cached_property
    def power_mw(self) -> np.ndarray:
        # in float64: the square of a float32 magnitude may leave float32
        power_mw = self.columns.real.astype(np.float64) ** 2 + self.columns.imag.astype(np.float64) ** 2
        power_mw[~np.isfinite(power_mw)] = 0.0
        return power_mw

    @cached_property
    def level(self) -> np.ndarray:
        return _level(self.encoding, self.power_mw, self.noise_power_mw)

    @cached_property
    def direction(self) -> np.ndarray:
        """Values of unit magnitude, complex64; zero where a cell is empty or not finite."""
        magnitude = np.sqrt(self.power_mw)
        filled = (magnitude > 0.0) & np.isfinite(self.columns)
        return np.where(filled, self.columns / np.where(filled, magnitude, 1.0), 0.0).astype(np.complex64)

    @cached_property
    def normalised(self) -> np.ndarray:
        """Values over the map's root mean square; an empty map is 0."""
        rms = np.sqrt(self.power_mw.mean(axis=(-2, -1), keepdims=True))
        return self.direction * np.sqrt(self.power_mw) / np.where(rms > 0.0, rms, 1.0)


def _log_magnitude(sampled: _Sampled) -> np.ndarray:
    """Return the log magnitude from the weakest to the strongest cell in 0..1, as the released code has it."""
    log = np.log10(np.maximum(sampled.power_mw, np.finfo(np.float64).tiny))
    log = np.maximum(log, log.max(axis=(-2, -1), keepdims=True) - 0.1 * sampled.encoding.dynamic_range_db)
    low, high = log.min(axis=(-2, -1), keepdims=True), log.max(axis=(-2, -1), keepdims=True)
    return (log - low) / np.where(high > low, high - low, 1.0)


#: Channels by name, each [..., range, columns]. Level: power over noise in dB. Shadow: the strongest level nearer in
#: the same direction. Contrast: level under the strongest of the range. Real, imaginary: the value over the map's rms.
#: Level_real, level_imaginary: the value with its level in place of its magnitude.
ENCODERS: dict[str, Callable[[_Sampled], np.ndarray]] = {
    "level": lambda sampled: sampled.level,
    "shadow": lambda sampled: _strongest_nearer(sampled.level),
    "contrast": lambda sampled: sampled.level - sampled.level.max(axis=-1, keepdims=True),
    "range": lambda sampled: np.linspace(0.0, 1.0, sampled.encoding.range_bins)[:, None],
    "azimuth": lambda sampled: np.linspace(-1.0, 1.0, sampled.encoding.columns),
    "real": lambda sampled: sampled.normalised.real,
    "imaginary": lambda sampled: sampled.normalised.imag,
    "level_real": lambda sampled: sampled.level * sampled.direction.real,
    "level_imaginary": lambda sampled: sampled.level * sampled.direction.imag,
    "log_magnitude": _log_magnitude,
    "zero": lambda sampled: np.zeros(1),
}

#: Input channels of the specification (complex, padded to three), of the released code, and of both.
COMPLEX = ("real", "imaginary", "zero")
LOG_MAGNITUDE = ("log_magnitude", "log_magnitude", "log_magnitude")
BOTH = ("real", "imaginary", "log_magnitude")


def _level(encoding: Encoding, power_mw: np.ndarray, noise_power_mw: np.ndarray) -> np.ndarray:
    """Return the level over the noise in 0..1; an empty map is 0 everywhere."""
    peak_mw = power_mw.max(axis=(-2, -1), keepdims=True)
    noise_mw = np.maximum(np.nan_to_num(noise_power_mw), 0.0)[..., None, None]
    floor_mw = np.maximum(noise_mw, peak_mw * 10.0 ** (-encoding.dynamic_range_db / 10.0))
    smallest = np.finfo(np.float64).tiny
    level_db = 10.0 * (np.log10(np.maximum(power_mw, smallest)) - np.log10(np.maximum(floor_mw, smallest)))
    level = (level_db - encoding.level_min_db) / (encoding.level_max_db - encoding.level_min_db)
    return np.where(peak_mw > 0.0, np.clip(level, 0.0, 1.0), 0.0)


def _strongest_nearer(level: np.ndarray) -> np.ndarray:
    """Return the strongest level nearer in range in the same direction: an image in a mirror lies behind it."""
    shadow = np.zeros_like(level)
    np.maximum.accumulate(level[..., :-1, :], axis=-2, out=shadow[..., 1:, :])
    return shadow
