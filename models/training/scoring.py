"""Detection scores of confidence maps over a sweep of thresholds (science of 1.2: Hungarian matching, 2 m gate)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.optimize import linear_sum_assignment

from models.training.datasets import PointLabels
from msgs.radar import RangeAzimuthGrid

#: Threshold of the published evaluation on simulated maps.
DEFAULT_THRESHOLD = 0.3
THRESHOLDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7)
GATE_M = 2.0
_MIN_DISTANCE_PX = 3


def local_peaks(confidence: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells [points, 2] and scores [points] of local maxima at least 3 cells apart, of one class's confidence."""
    highest = maximum_filter(confidence, size=2 * _MIN_DISTANCE_PX + 1, mode="constant")
    cells = np.argwhere((confidence == highest) & (confidence >= threshold))
    return cells, confidence[tuple(cells.T)]


def positions_m(grid: RangeAzimuthGrid, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Positions in the plane, [points, 2] in metres, of fractional cells."""
    range_m, azimuth_rad = grid.range_at(row), grid.azimuth_at(column)
    return np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)], axis=-1)


def matched_pairs(found_m: np.ndarray, truth_m: np.ndarray, gate_m: float = GATE_M) -> int:
    """Largest-benefit one-to-one pairs no further apart than the gate."""
    distance_m = np.linalg.norm(found_m[:, None] - truth_m[None], axis=-1)
    # a distance beyond the gate costs the same wherever it is: pairs inside the gate come first
    rows, columns = linear_sum_assignment(np.where(distance_m <= gate_m, distance_m, 1e3 * gate_m))
    return int((distance_m[rows, columns] <= gate_m).sum())


@dataclass
class DetectionTally:
    """Hits, false alarms and misses of each class over all frames, for each threshold; no frame is skipped."""

    grid: RangeAzimuthGrid
    thresholds: tuple[float, ...] = THRESHOLDS
    classes: int = 2
    #: [thresholds, classes, (hits, found, truth)]
    counts: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.counts = np.zeros((len(self.thresholds), self.classes, 3), np.int64)

    def add(self, confidence: np.ndarray, labels: PointLabels) -> None:
        """Count one frame: confidence [classes, range, azimuth] against its truth."""
        for k in range(self.classes):
            cells, scores = local_peaks(confidence[k], min(self.thresholds))
            found_m = positions_m(self.grid, cells[:, 0], cells[:, 1])
            mine = labels.path_class == k
            truth_m = positions_m(self.grid, labels.row[mine], labels.column[mine])
            for i, threshold in enumerate(self.thresholds):
                kept_m = found_m[scores >= threshold]
                self.counts[i, k] += (matched_pairs(kept_m, truth_m), len(kept_m), len(truth_m))

    def scores(self) -> np.ndarray:
        """Precision, recall and F1, float64 [thresholds, classes, 3]; 0 where nothing was found or there is no truth."""
        hits, found, truth = np.moveaxis(self.counts.astype(np.float64), -1, 0)
        return np.stack(
            [hits / np.maximum(found, 1), hits / np.maximum(truth, 1), 2 * hits / np.maximum(found + truth, 1)], axis=-1
        )

    def at(self, threshold: float) -> np.ndarray:
        """Precision, recall and F1 at one of the thresholds, float64 [classes, 3]."""
        return self.scores()[self.thresholds.index(threshold)]
