"""Detection scores of confidence maps over a sweep of thresholds."""

from __future__ import annotations

import numpy as np

from models.perception.metrics import Counts, dense_counts
from models.perception.peaks import PeakParams, local_maxima
from models.training.datasets import PointLabels
from msgs.perception import PathClass
from msgs.radar import RangeAzimuthGrid

#: Threshold of the published evaluation on simulated maps.
DEFAULT_THRESHOLD = 0.3
THRESHOLDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7)


class DetectionTally:
    """Counts of each class over all frames, for each threshold; no frame is skipped."""

    def __init__(self, grid: RangeAzimuthGrid, thresholds: tuple[float, ...] = THRESHOLDS) -> None:
        self.grid = grid
        self.counts = {threshold: dict.fromkeys(PathClass, Counts()) for threshold in thresholds}

    def add(self, confidence: np.ndarray, labels: PointLabels) -> None:
        """Count one frame: confidence [classes, range, azimuth] against its truth (one to one, 2 m gate)."""
        reach = PeakParams().min_distance
        cells = [local_maxima(channel, min(self.counts), reach) for channel in confidence]
        score = np.concatenate([channel[tuple(at.T)] for channel, at in zip(confidence, cells, strict=True)])
        path_class = np.repeat(np.arange(len(confidence)), [len(at) for at in cells])
        found_m = positions_m(self.grid, *np.concatenate(cells).T)
        truth_m = positions_m(self.grid, labels.row, labels.column)
        for threshold, total in self.counts.items():
            kept = score >= threshold
            frame = dense_counts(found_m[kept], path_class[kept], truth_m, labels.path_class)
            for k in PathClass:
                total[k] += frame[k]

    def macro_f1(self, threshold: float = DEFAULT_THRESHOLD) -> float:
        """Mean F1 of the classes at one of the thresholds."""
        return sum(counts.f1 for counts in self.counts[threshold].values()) / len(PathClass)


def positions_m(grid: RangeAzimuthGrid, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Positions in the plane, [points, 2] in metres, of fractional cells."""
    range_m, azimuth_rad = grid.range_at(row), grid.azimuth_at(column)
    return np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)], axis=-1)
