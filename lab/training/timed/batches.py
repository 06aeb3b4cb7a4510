"""Batches on the device that trains: augmentation, encoding and targets as `encode_columns` and `class_heatmaps` make
them, from maps of `lab.training.data.map_arrays`, without a loop over samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from lab.training.data.samples import PointLabels
from lab.training.objectives.heatmaps import REACH_SIGMA
from models.perception.find.encoding import Encoding

#: Standard deviation of the misjudged noise in training, dB (`lab.training.data.samples.augment`).
NOISE_STD_DB = 1.0


def flipped_labels(labels: Sequence[PointLabels], flips: np.ndarray, azimuth_bins: int) -> list[PointLabels]:
    """Return the truth of maps of which some are mirrored, left for right."""
    return [points.flipped(azimuth_bins) if flip else points for points, flip in zip(labels, flips, strict=True)]


def point_table(labels: Sequence[PointLabels]) -> np.ndarray:
    """Return the points of a batch, float32 [points, 4]: sample, class, row, column."""
    sample = np.repeat(np.arange(len(labels)), [len(points.row) for points in labels])
    columns = [np.concatenate([getattr(points, name) for points in labels]) for name in ("path_class", "row", "column")]
    return np.stack([sample, *columns], axis=-1).astype(np.float32)


def augmented(values: Tensor, noise: Tensor, flips: Tensor) -> tuple[Tensor, Tensor]:
    """Return maps [batch, rows, columns, 2] and noise [batch] with some maps mirrored, all phases turned, and the noise
    misjudged: `augment`, for a batch.
    """
    values = torch.where(flips[:, None, None, None], values.flip(2), values)
    phase_rad = 2.0 * math.pi * torch.rand(len(values), 1, 1, device=values.device)
    cosine, sine = phase_rad.cos(), phase_rad.sin()
    real, imaginary = values.unbind(-1)
    turned = torch.stack((real * cosine - imaginary * sine, real * sine + imaginary * cosine), dim=-1)
    return turned, noise * 10.0 ** (0.1 * NOISE_STD_DB * torch.randn_like(noise))


def encode(encoding: Encoding, values: Tensor, noise: Tensor) -> Tensor:
    """Return the network input, float32 [batch, channels, range, columns], of float32 maps [batch, rows, columns, 2]
    and their noise [batch]: `encode_columns`.
    """
    maps = _Maps(encoding, values, noise)
    shape = len(values), encoding.range_bins, encoding.columns
    channels = torch.stack([_ENCODERS[name](maps).expand(shape) for name in encoding.channels], dim=1)
    return torch.nn.functional.pad(channels, (encoding.pad_columns, encoding.pad_columns))


@dataclass(frozen=True)
class _Maps:
    """Maps, and what several channels are made from."""

    encoding: Encoding
    values: Tensor
    noise: Tensor

    @cached_property
    def power(self) -> Tensor:
        return self.values.square().sum(dim=-1)

    @cached_property
    def level(self) -> Tensor:
        encoding, tiny = self.encoding, torch.finfo(torch.float32).tiny
        peak = self.power.amax(dim=(-2, -1), keepdim=True)
        floor = torch.maximum(self.noise[:, None, None], peak * 10.0 ** (-encoding.dynamic_range_db / 10.0))
        level_db = 10.0 * (self.power.clamp(min=tiny).log10() - floor.clamp(min=tiny).log10())
        return ((level_db - encoding.level_min_db) / (encoding.level_max_db - encoding.level_min_db)).clamp(0.0, 1.0)

    @cached_property
    def direction(self) -> Tensor:
        magnitude = self.power.sqrt()
        return self.values / torch.where(magnitude > 0.0, magnitude, 1.0)[..., None]

    @cached_property
    def rms(self) -> Tensor:
        rms = self.power.mean(dim=(-2, -1), keepdim=True).sqrt()
        return torch.where(rms > 0.0, rms, 1.0)

    def ramp(self, first: float, count: int) -> Tensor:
        return torch.linspace(first, 1.0, count, device=self.values.device)


def _shadow(level: Tensor) -> Tensor:
    nearer = level.cummax(dim=-2).values[..., :-1, :]
    return torch.nn.functional.pad(nearer, (0, 0, 1, 0))


def _log_magnitude(maps: _Maps) -> Tensor:
    log = maps.power.clamp(min=torch.finfo(torch.float32).tiny).log10()
    log = torch.maximum(log, log.amax(dim=(-2, -1), keepdim=True) - 0.1 * maps.encoding.dynamic_range_db)
    low, high = log.amin(dim=(-2, -1), keepdim=True), log.amax(dim=(-2, -1), keepdim=True)
    return (log - low) / torch.where(high > low, high - low, 1.0)


#: The channels of `models.perception.find.encoding.ENCODERS`, each broadcast to [batch, range, columns].
_ENCODERS: dict[str, Callable[[_Maps], Tensor]] = {
    "level": lambda maps: maps.level,
    "shadow": lambda maps: _shadow(maps.level),
    "contrast": lambda maps: maps.level - maps.level.amax(dim=-1, keepdim=True),
    "range": lambda maps: maps.ramp(0.0, maps.encoding.range_bins)[:, None],
    "azimuth": lambda maps: maps.ramp(-1.0, maps.encoding.columns),
    "real": lambda maps: maps.values[..., 0] / maps.rms,
    "imaginary": lambda maps: maps.values[..., 1] / maps.rms,
    "level_real": lambda maps: maps.level * maps.direction[..., 0],
    "level_imaginary": lambda maps: maps.level * maps.direction[..., 1],
    "log_magnitude": _log_magnitude,
    "zero": lambda maps: maps.noise.new_zeros(1),
}


def heatmaps(points: Tensor, shape: tuple[int, int, int, int], sigma_px: float) -> Tensor:
    """Return Gaussian targets of `shape` (batch, classes, rows, columns) for points of `point_table`, Eq. (22)."""
    reach = math.ceil(REACH_SIGMA * sigma_px)
    offset = torch.arange(-reach, reach + 1, device=points.device)
    kernel = torch.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2.0 * sigma_px**2))
    return _painted(points, shape, offset, kernel)


def masks(points: Tensor, shape: tuple[int, int, int, int]) -> Tensor:
    """Return masks of `shape`, 1 in the cell of each point: `class_masks`."""
    return _painted(points, shape, torch.zeros(1, dtype=torch.int64, device=points.device), points.new_ones(1, 1))


def _painted(points: Tensor, shape: tuple[int, int, int, int], offset: Tensor, kernel: Tensor) -> Tensor:
    _, classes, rows, columns = shape
    sample, path_class = points[:, 0].long(), points[:, 1].long()
    row, column = points[:, 2].round().long(), points[:, 3].round().long()
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    # [points, kernel rows, kernel columns]
    at_row = row[:, None, None] + offset[:, None]
    at_column = column[:, None, None] + offset[None, :]
    drawn = inside[:, None, None] & (at_row >= 0) & (at_row < rows) & (at_column >= 0) & (at_column < columns)
    plane = (sample * classes + path_class)[:, None, None] * rows
    index = (plane + at_row.clamp(0, rows - 1)) * columns + at_column.clamp(0, columns - 1)
    # what is not drawn is zero somewhere on the map, which changes nothing
    heat = points.new_zeros(shape).flatten()
    return heat.scatter_reduce(0, index.flatten(), (kernel * drawn).flatten(), "amax").reshape(shape)
