"""A confocal scan of a wall: photon histograms of a grid of points, laser and detector always at one and the same."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from msgs.values.units import SPEED_OF_LIGHT_MPS

#: Counts of a scan: padded and complex, they take 1.1 GiB.
MAX_COUNTS = 1 << 24
MIN_POINTS, MIN_BINS = 2, 16
MAX_HALF_WIDTH_M = 1e3
BIN_LIMITS_S = (1e-15, 1e-6)


@dataclass(frozen=True, eq=False)
class ConfocalTransients:
    """Photon counts of a square grid of wall points; time counts from the wall's own return, there and back."""

    #: uint32 [points, points, bins]: rows along x, columns along y of the wall.
    counts: np.ndarray
    #: Half the side of the square that the grid's cells cover.
    half_width_m: float
    bin_s: float

    def __post_init__(self) -> None:
        require_layout("counts", self.counts.shape)
        if self.counts.dtype != np.uint32:
            raise ValueError(f"counts must be uint32, got {self.counts.dtype}")
        if not (math.isfinite(self.half_width_m) and 0.0 < self.half_width_m <= MAX_HALF_WIDTH_M):
            raise ValueError(f"half_width_m must lie in 0..{MAX_HALF_WIDTH_M:g}, 0 excluded, got {self.half_width_m!r}")
        if not BIN_LIMITS_S[0] <= self.bin_s <= BIN_LIMITS_S[1]:
            raise ValueError(f"bin_s must lie in {BIN_LIMITS_S[0]:g}..{BIN_LIMITS_S[1]:g}, got {self.bin_s!r}")

    @property
    def bins(self) -> int:
        """Histogram bins of a wall point."""
        return int(self.counts.shape[2])

    @property
    def wall_m(self) -> np.ndarray:
        """Middles of the grid's cells along either side, [points], metres from the middle of the square."""
        points = len(self.counts)
        return np.asarray(self.half_width_m * ((np.arange(points) + 0.5) * 2.0 / points - 1.0))

    @property
    def range_bin_m(self) -> float:
        """Distance from the wall that a bin stands for."""
        return 0.5 * SPEED_OF_LIGHT_MPS * self.bin_s

    @property
    def range_m(self) -> np.ndarray:
        """Distance of the middle of each bin, [bins]."""
        return np.asarray((np.arange(self.bins) + 0.5) * self.range_bin_m)

    def bin_at(self, range_m: float) -> int:
        """Return the bin of a distance; ValueError unless it lies within the bins."""
        if not 0.0 <= range_m < self.bins * self.range_bin_m:
            raise ValueError(f"range must lie in 0..{self.bins * self.range_bin_m:g} m of the bins, got {range_m!r}")
        return int(range_m / self.range_bin_m)


def require_layout(name: str, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless a shape is [points, points, bins] of a size that can be worked on."""
    if len(shape) != 3 or shape[0] != shape[1]:
        raise ValueError(f"{name} must have shape (points, points, bins), got {tuple(shape)}")
    if shape[0] < MIN_POINTS or shape[2] < MIN_BINS:
        raise ValueError(
            f"{name} must have at least {MIN_POINTS} points a side and {MIN_BINS} bins, got {tuple(shape)}"
        )
    if math.prod(shape) > MAX_COUNTS:
        raise ValueError(f"{name} must hold at most {MAX_COUNTS} counts, got {math.prod(shape)} of {tuple(shape)}")
