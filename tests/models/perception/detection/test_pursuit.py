from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from models.perception.detection.pursuit import PursuitParams, pursued_peaks
from models.training.objectives.heatmaps import gaussian_heatmap

SHARP = PursuitParams(blur=(0.0, 0.0))


def test_gaussians_of_points_are_found_where_they_stand() -> None:
    """Layout: Eq. (22) heatmap of three points 4 cells apart at least, two at the border. Found: those cells, at 1."""
    row, column = np.array([0.0, 10.0, 10.0]), np.array([5.0, 31.0, 20.0])
    cells, score = pursued_peaks(gaussian_heatmap((24, 32), row, column), 0.3, SHARP)
    assert {tuple(cell) for cell in cells} == {(0, 5), (10, 31), (10, 20)}
    np.testing.assert_allclose(score, 1.0, atol=1e-6)


def test_a_broad_hill_gives_as_many_peaks_as_its_mass_is_worth() -> None:
    """A plateau of 0.6 over 24 cells of one range: local maxima 3 cells apart give one peak at its middle; pursuit
    gives one every 3 to 5 cells (what a point explains has a standard deviation of 2.5)."""
    plateau = np.zeros((16, 48), np.float32)
    plateau[6:9, 12:36] = 0.6
    cells, score = pursued_peaks(plateau, 0.3, PursuitParams())
    assert 4 <= len(cells) <= 6
    assert (np.diff(np.sort(cells[:, 1])) >= 3).all()
    assert (score >= 0.3).all()
    assert (np.diff(score) <= 1e-12).all()


@pytest.mark.parametrize("seed", range(8))
def test_first_peak_is_the_highest_cell_of_the_blurred_map(seed: int) -> None:
    """Reference: SciPy's Gaussian filter with zeros beyond the edges. Where it stays under the threshold, no peak."""
    rng = np.random.default_rng(seed)
    confidence = (rng.random((int(rng.integers(1, 30)), int(rng.integers(1, 60)))) ** 6).astype(np.float32)
    confidence[rng.random(confidence.shape) < 0.05] = np.nan
    reference = gaussian_filter(np.nan_to_num(confidence.astype(np.float64)), (0.5, 2.0), mode="constant")
    for threshold in (0.01, 0.1, 0.3):
        cells, score = pursued_peaks(confidence, threshold, PursuitParams())
        assert (len(cells) > 0) == (reference.max() >= threshold)
        if len(cells):
            assert tuple(cells[0]) == np.unravel_index(reference.argmax(), reference.shape)
            assert score[0] == pytest.approx(reference.max(), rel=1e-12)


def test_threshold_only_cuts_the_list() -> None:
    """What a higher threshold gives is the head of what a lower one gives: thresholds may be chosen afterwards."""
    confidence = np.random.default_rng(0).random((40, 60)) ** 4
    low, low_score = pursued_peaks(confidence, 0.05, PursuitParams())
    high, high_score = pursued_peaks(confidence, 0.2, PursuitParams())
    assert 0 < len(high) < len(low)
    np.testing.assert_array_equal(high, low[: len(high)])
    np.testing.assert_array_equal(high_score, low_score[: len(high)])


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_empty_and_broken_maps_hold_nothing(value: float) -> None:
    cells, score = pursued_peaks(np.full((8, 8), value, np.float32), 0.1, PursuitParams())
    assert (cells.shape, score.shape) == ((0, 2), (0,))


def test_a_full_map_ends_at_the_limit() -> None:
    cells, _ = pursued_peaks(np.ones((64, 64), np.float32), 1e-6, PursuitParams(max_peaks=20))
    assert len(cells) == 20


def test_bad_parameters_are_named() -> None:
    with pytest.raises(ValueError, match=r"pursuit\.blur must lie in 0"):
        PursuitParams(blur=(-1.0, 0.0))
    with pytest.raises(ValueError, match=r"pursuit\.explained must lie in 0\.001"):
        PursuitParams(explained=(0.0, 1.0))
    with pytest.raises(ValueError, match=r"threshold must be positive, got 0"):
        pursued_peaks(np.zeros((2, 2)), 0.0, PursuitParams())
    with pytest.raises(ValueError, match=r"confidence must have shape \[range, azimuth\]"):
        pursued_peaks(np.zeros(2), 0.1, PursuitParams())
