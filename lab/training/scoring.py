"""Detection scores over a sweep of thresholds."""

from __future__ import annotations

import numpy as np

from lab.measures.point_scores import Counts, dense_counts
from lab.training.data.samples import PointLabels
from models.perception.find.peaks import Points
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid

#: Threshold of the published evaluation on simulated maps.
DEFAULT_THRESHOLD = 0.3
THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


class DetectionTally:
    """Counts of each class over all frames, for each threshold; no frame is skipped."""

    def __init__(self, grid: RangeAzimuthGrid, thresholds: tuple[float, ...] = THRESHOLDS) -> None:
        self.grid = grid
        self.counts = {threshold: dict.fromkeys(PathClass, Counts()) for threshold in thresholds}

    def add(self, detected: Points, labels: PointLabels) -> None:
        """Count one frame: points against its truth (one to one, 2 m gate)."""
        found_m = positions_m(self.grid, *detected.cells.T)
        truth_m = positions_m(self.grid, labels.row, labels.column)
        for threshold, total in self.counts.items():
            kept = detected.score >= threshold
            frame = dense_counts(found_m[kept], detected.path_class[kept], truth_m, labels.path_class)
            for k in PathClass:
                total[k] += frame[k]

    def macro_f1(self, threshold: float = DEFAULT_THRESHOLD) -> float:
        """Return the mean F1 of the classes at one of the thresholds."""
        return sum(counts.f1 for counts in self.counts[threshold].values()) / len(PathClass)


def positions_m(grid: RangeAzimuthGrid, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return positions in the plane, [points, 2] in metres, of fractional cells."""
    return xy_from_polar(grid.range_at(row), grid.azimuth_at(column))
