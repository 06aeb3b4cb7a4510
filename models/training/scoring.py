"""Detection scores of confidence maps over a sweep of thresholds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.perception.metrics import Counts, dense_counts
from models.perception.peaks import PeakParams, local_maxima
from models.training.datasets import PointLabels
from msgs.perception import PathClass
from msgs.radar import RangeAzimuthGrid

#: Threshold of the published evaluation on simulated maps.
DEFAULT_THRESHOLD = 0.3
THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


@dataclass(frozen=True)
class Detections:
    """Points read from an answer: fractional cells [N, 2], scores and classes [N]."""

    cells: np.ndarray
    score: np.ndarray
    path_class: np.ndarray


def confidence_points(confidence: np.ndarray, floor: float) -> Detections:
    """Local maxima of a confidence map [classes, range, azimuth] with at least this score, section 3.1.1."""
    cells = [local_maxima(channel, floor, PeakParams().min_distance) for channel in confidence]
    at = np.concatenate(cells)
    path_class = np.repeat(np.arange(len(confidence)), [len(of_class) for of_class in cells])
    return Detections(at.astype(np.float64), confidence[path_class, at[:, 0], at[:, 1]], path_class)


class DetectionTally:
    """Counts of each class over all frames, for each threshold; no frame is skipped."""

    def __init__(self, grid: RangeAzimuthGrid, thresholds: tuple[float, ...] = THRESHOLDS) -> None:
        self.grid = grid
        self.counts = {threshold: dict.fromkeys(PathClass, Counts()) for threshold in thresholds}

    def add(self, confidence: np.ndarray, labels: PointLabels) -> None:
        """Count one frame: confidence [classes, range, azimuth] against its truth (one to one, 2 m gate)."""
        self.add_points(confidence_points(confidence, min(self.counts)), labels)

    def add_points(self, found: Detections, labels: PointLabels) -> None:
        """Count one frame: points against its truth."""
        found_m = positions_m(self.grid, *found.cells.T)
        truth_m = positions_m(self.grid, labels.row, labels.column)
        for threshold, total in self.counts.items():
            kept = found.score >= threshold
            frame = dense_counts(found_m[kept], found.path_class[kept], truth_m, labels.path_class)
            for k in PathClass:
                total[k] += frame[k]

    def macro_f1(self, threshold: float = DEFAULT_THRESHOLD) -> float:
        """Mean F1 of the classes at one of the thresholds."""
        return sum(counts.f1 for counts in self.counts[threshold].values()) / len(PathClass)


def positions_m(grid: RangeAzimuthGrid, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Positions in the plane, [points, 2] in metres, of fractional cells."""
    range_m, azimuth_rad = grid.range_at(row), grid.azimuth_at(column)
    return np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)], axis=-1)
