from __future__ import annotations

import numpy as np
import pytest

from lab.measures.point_scores import Counts
from lab.training.data.samples import PointLabels
from lab.training.scoring import DetectionTally, positions_m
from models.perception.find.peaks import Points, heatmap_points
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid

GRID = RangeAzimuthGrid(range_bins=64, azimuth_bins=64)


def labels(*points: tuple[float, float, int]) -> PointLabels:
    row, column, path_class = np.array(points, np.float64).reshape(-1, 3).T
    return PointLabels(row=row, column=column, path_class=path_class.astype(np.uint8))


def found(*points: tuple[int, int, int, float]) -> Points:
    values = np.zeros((2, *GRID.shape), np.float32)
    for k, row, column, score in points:
        values[k, row, column] = score
    return heatmap_points(values, 0.05, 3)


def test_positions_follow_the_vehicle_axes() -> None:
    """The largest azimuth is to the left: y positive, counter-clockwise from x."""
    x, y = positions_m(GRID, np.array([10.0]), np.array([63.0]))[0]
    assert (x, y) == pytest.approx((10 * GRID.range_bin_m * 0.5, 10 * GRID.range_bin_m * np.sqrt(0.75)))


def test_empty_prediction_counts_its_misses_and_empty_truth_its_false_alarms() -> None:
    tally = DetectionTally(GRID)
    tally.add(found(), labels((10, 10, 0), (20, 20, 1)))
    tally.add(found((0, 10, 10, 0.9), (1, 30, 30, 0.9)), labels((10, 10, 0)))
    assert tally.counts[0.3] == {PathClass.LOS: Counts(1, 0, 1), PathClass.MIRRORED: Counts(0, 1, 1)}
    assert tally.macro_f1() == pytest.approx((2 / 3 + 0) / 2)


def test_class_and_threshold_matter() -> None:
    tally = DetectionTally(GRID)
    tally.add(found((0, 10, 10, 0.35), (1, 30, 30, 0.9)), labels((10, 10, 1), (30, 30, 1)))
    assert tally.counts[0.3] == {PathClass.LOS: Counts(0, 1, 0), PathClass.MIRRORED: Counts(1, 0, 1)}
    assert tally.counts[0.4] == {PathClass.LOS: Counts(0, 0, 0), PathClass.MIRRORED: Counts(1, 0, 1)}


def test_a_score_at_the_threshold_counts_as_in_the_detector() -> None:
    """At every threshold as many points as the detector reports there: at 0.3 also one of a score of 0.3."""
    heatmap = np.zeros((2, *GRID.shape))
    for column, score in ((10, 0.3), (30, 0.29), (50, 0.31)):
        heatmap[0, 20, column] = score
    tally = DetectionTally(GRID)
    tally.add(heatmap_points(heatmap, 0.05, 3), labels())
    counted = {threshold: counts[PathClass.LOS].false_positives for threshold, counts in tally.counts.items()}
    assert counted == {threshold: len(heatmap_points(heatmap, threshold, 3).score) for threshold in tally.counts}
    assert counted[0.3] == 2
