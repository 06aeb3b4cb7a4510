from __future__ import annotations

import numpy as np
import pytest

from models.training.datasets import PointLabels
from models.training.scoring import DetectionTally, local_peaks, matched_pairs, positions_m
from msgs.radar import RangeAzimuthGrid

GRID = RangeAzimuthGrid(range_bins=64, azimuth_bins=64)


def labels(*points: tuple[float, float, int]) -> PointLabels:
    row, column, path_class = np.array(points, np.float64).reshape(-1, 3).T
    return PointLabels(row=row, column=column, path_class=path_class.astype(np.uint8))


def confidence(*points: tuple[int, int, int, float]) -> np.ndarray:
    values = np.zeros((2, *GRID.shape), np.float32)
    for k, row, column, score in points:
        values[k, row, column] = score
    return values


def test_peaks_stand_apart_and_above_the_threshold() -> None:
    values = confidence((0, 10, 10, 0.9), (0, 12, 12, 0.8), (0, 16, 10, 0.5), (0, 40, 63, 0.29), (0, 0, 0, 0.4))[0]
    cells, scores = local_peaks(values, 0.3)
    assert cells.tolist() == [[0, 0], [10, 10], [16, 10]]
    np.testing.assert_allclose(scores, [0.4, 0.9, 0.5], rtol=1e-6)


def test_positions_follow_the_vehicle_axes() -> None:
    """The largest azimuth is to the left: y positive, counter-clockwise from x."""
    x, y = positions_m(GRID, np.array([10.0]), np.array([63.0]))[0]
    assert (x, y) == pytest.approx((10 * GRID.range_bin_m * 0.5, 10 * GRID.range_bin_m * np.sqrt(0.75)))


def test_pairs_are_one_to_one_and_as_many_as_possible() -> None:
    """Nearest-first would pair 0.0 with 0.9 and leave the truth at -1.9 alone: both can be matched."""
    found, truth = np.array([[0.0, 0.0], [2.5, 0.0]]), np.array([[0.9, 0.0], [-1.9, 0.0]])
    assert matched_pairs(found, truth) == 2
    assert matched_pairs(found[:1], truth) == 1
    assert matched_pairs(found, truth[:0]) == 0


def test_empty_prediction_counts_its_misses() -> None:
    tally = DetectionTally(GRID)
    tally.add(confidence(), labels((10, 10, 0), (20, 20, 1)))
    tally.add(confidence((0, 10, 10, 0.9)), labels((10, 10, 0)))
    np.testing.assert_allclose(tally.at(0.3), [[1.0, 0.5, 2 / 3], [0.0, 0.0, 0.0]])


def test_class_and_threshold_matter() -> None:
    tally = DetectionTally(GRID)
    tally.add(confidence((0, 10, 10, 0.35), (1, 30, 30, 0.9)), labels((10, 10, 1), (30, 30, 1)))
    np.testing.assert_allclose(tally.at(0.3), [[0.0, 0.0, 0.0], [1.0, 0.5, 2 / 3]])
    assert tally.counts[tally.thresholds.index(0.3), 0, 1] == 1
    assert tally.counts[tally.thresholds.index(0.4), 0, 1] == 0
