"""From a complex range-azimuth map to the network's input: one function for training and for the vehicle.

The azimuth axis of a map carries only the 2N-1 = 15 coefficients of the co-array, so its power is sampled without loss
by 29 columns; 32 of the 256 are kept. Column j stands for the output columns 8j..8j+7 that the network's pixel shuffle
makes of it, and is read at their centre.
"""

from __future__ import annotations

import msgspec
import numpy as np

from msgs.arrays import require_positive
from msgs.radar import RangeAzimuthGrid, RangeAzimuthMap

#: What each channel of the input says, in order; all are about 0..1 or -1..1.
CHANNELS = ("level", "shadow", "contrast", "range", "azimuth")


class Encoding(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the network's input; travels in the model card."""

    #: Range bins that the network sees (320 bins of the 10 GHz radar: 68.5 m).
    range_bins: int = 320
    #: Columns that the network sees.
    columns: int = 32
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

    @property
    def shape(self) -> tuple[int, int, int]:
        """(channels, range, columns) of one input."""
        return len(CHANNELS), self.range_bins, self.columns

    def check_grid(self, grid: RangeAzimuthGrid) -> None:
        """Raise `ValueError` unless maps on `grid` can be encoded."""
        if grid.range_bins < self.range_bins:
            raise ValueError(f"grid.range_bins must be at least {self.range_bins}, got {grid.range_bins}")
        if grid.azimuth_bins % (2 * self.columns):
            raise ValueError(f"grid.azimuth_bins must be a multiple of {2 * self.columns}, got {grid.azimuth_bins}")


def encode_map(encoding: Encoding, ra_map: RangeAzimuthMap) -> np.ndarray:
    """Network input of one map, float32 [channels, range, columns]."""
    encoding.check_grid(ra_map.grid)
    return encode_columns(encoding, sample_columns(encoding, ra_map.values), np.array(ra_map.noise_power_mw))


def sample_columns(encoding: Encoding, values: np.ndarray) -> np.ndarray:
    """Map values at the centres of the columns, complex64 [..., range, columns], of maps [..., range, azimuth].

    The centre of an even number of azimuths lies between the middle two: their mean.
    """
    width = values.shape[-1] // encoding.columns
    cropped = values[..., : encoding.range_bins, :]
    return 0.5 * (cropped[..., width // 2 - 1 :: width] + cropped[..., width // 2 :: width])


def encode_columns(encoding: Encoding, columns: np.ndarray, noise_power_mw: np.ndarray) -> np.ndarray:
    """Network input, float32 [..., channels, range, columns], of sampled maps [..., range, columns] and noise [...].

    Finite for every input: cells that are not finite count as empty. Levels are over the noise, so a gain common to
    signal and noise changes nothing.
    """
    # [..., range, columns]
    level = _level(encoding, _power_mw(columns), noise_power_mw)
    channels = np.empty((*level.shape[:-2], *encoding.shape), np.float32)
    channels[..., 0, :, :] = level
    channels[..., 1, :, :] = _strongest_nearer(level)
    channels[..., 2, :, :] = level - level.max(axis=-1, keepdims=True)
    channels[..., 3, :, :] = np.linspace(0.0, 1.0, encoding.range_bins)[:, None]
    channels[..., 4, :, :] = np.linspace(-1.0, 1.0, encoding.columns)
    return channels


def _power_mw(columns: np.ndarray) -> np.ndarray:
    """Power of each cell, float64: the square of a float32 magnitude may leave float32."""
    power_mw = columns.real.astype(np.float64) ** 2 + columns.imag.astype(np.float64) ** 2
    power_mw[~np.isfinite(power_mw)] = 0.0
    return power_mw


def _level(encoding: Encoding, power_mw: np.ndarray, noise_power_mw: np.ndarray) -> np.ndarray:
    """Level over the noise in 0..1; an empty map is 0 everywhere."""
    peak_mw = power_mw.max(axis=(-2, -1), keepdims=True)
    noise_mw = np.maximum(np.nan_to_num(noise_power_mw), 0.0)[..., None, None]
    floor_mw = np.maximum(noise_mw, peak_mw * 10.0 ** (-encoding.dynamic_range_db / 10.0))
    smallest = np.finfo(np.float64).tiny
    level_db = 10.0 * (np.log10(np.maximum(power_mw, smallest)) - np.log10(np.maximum(floor_mw, smallest)))
    level = (level_db - encoding.level_min_db) / (encoding.level_max_db - encoding.level_min_db)
    return np.where(peak_mw > 0.0, np.clip(level, 0.0, 1.0), 0.0)


def _strongest_nearer(level: np.ndarray) -> np.ndarray:
    """Strongest level nearer in range in the same direction: what an image in a mirror stands behind."""
    shadow = np.zeros_like(level)
    np.maximum.accumulate(level[..., :-1, :], axis=-2, out=shadow[..., 1:, :])
    return shadow
