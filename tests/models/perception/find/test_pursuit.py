from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lab.training.objectives.heatmaps import gaussian_heatmap
from models.perception.find import pursuit
from models.perception.find.pursuit import BLUR, EXPLAINED, MAX_PEAKS, pursued_peaks


def test_gaussians_of_points_are_found_where_they_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Layout: Eq. (22) heatmap of three points 4 cells apart at least, two at the border. Found: those cells, at 1."""
    monkeypatch.setattr(pursuit, "BLUR", (0.0, 0.0))
    row, column = np.array([0.0, 10.0, 10.0]), np.array([5.0, 31.0, 20.0])
    cells, score = pursued_peaks(gaussian_heatmap((24, 32), row, column), 0.3)
    assert {tuple(cell) for cell in cells} == {(0, 5), (10, 31), (10, 20)}
    np.testing.assert_allclose(score, 1.0, atol=1e-6)


def test_a_broad_hill_gives_as_many_peaks_as_its_mass_is_worth() -> None:
    """A plateau of 0.6 over 24 cells of one range: local maxima 3 cells apart give one peak at its middle; pursuit
    gives one every 3 to 5 cells (what a point explains has a standard deviation of 2.5)."""
    plateau = np.zeros((16, 48), np.float32)
    plateau[6:9, 12:36] = 0.6
    cells, score = pursued_peaks(plateau, 0.3)
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
        cells, score = pursued_peaks(confidence, threshold)
        assert (len(cells) > 0) == (reference.max() >= threshold)
        if len(cells):
            assert tuple(cells[0]) == np.unravel_index(reference.argmax(), reference.shape)
            assert score[0] == pytest.approx(reference.max(), rel=1e-12)


def plain_pursuit(confidence: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """The plain form: the whole map blurred axis by axis, and searched for its highest cell once a peak."""
    left = np.where(np.isfinite(confidence), confidence, 0.0).astype(np.float64)
    for axis, std in enumerate(BLUR):
        reach = int(4.0 * std + 0.5)
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(std, 1e-9)) ** 2)
        size = left.shape[axis]
        padded = np.pad(left, [(reach, reach) if k == axis else (0, 0) for k in range(2)])
        shifted = [weight * padded.take(range(k, k + size), axis) for k, weight in enumerate(weights / weights.sum())]
        # in the order of the cells, as the compiled form adds them
        left = np.add.accumulate([np.zeros_like(left), *shifted])[-1]
    row, column = np.indices(left.shape)
    cells, scores = [], []
    while len(cells) < MAX_PEAKS and left.max() >= threshold:
        i, j = np.unravel_index(left.argmax(), left.shape)
        cells.append((i, j))
        scores.append(left[i, j])
        down, across = row - i, column - j
        reach = (abs(down) <= np.ceil(3.0 * EXPLAINED[0])) & (abs(across) <= np.ceil(3.0 * EXPLAINED[1]))
        hill = np.exp(-0.5 * ((down / EXPLAINED[0]) ** 2 + (across / EXPLAINED[1]) ** 2))
        left = np.where(reach, left * (1.0 - hill), left)
    return np.array(cells, np.int64).reshape(-1, 2), np.array(scores)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_peaks_are_those_of_the_plain_form(dtype: type) -> None:
    """Rows that stay below the threshold are left out, and a row's highest is sought only where it fell: nothing of it
    shows, in broken maps and among equal cells neither."""
    rng = np.random.default_rng(0)
    for index in range(12):
        confidence = (rng.random((int(rng.integers(1, 40)), int(rng.integers(1, 80)))) ** 4).astype(dtype)
        confidence[rng.random(confidence.shape) < 0.05] = np.nan if index % 2 else -1.0
        confidence = np.round(confidence, 1) if index % 3 == 0 else confidence
        cells, score = pursued_peaks(confidence, 0.1)
        plain_cells, plain_score = plain_pursuit(confidence, 0.1)
        np.testing.assert_array_equal(cells, plain_cells)
        np.testing.assert_allclose(score, plain_score, rtol=1e-13)


def test_threshold_only_cuts_the_list() -> None:
    """What a higher threshold gives is the head of what a lower one gives: thresholds may be chosen afterwards."""
    confidence = np.random.default_rng(0).random((40, 60)) ** 4
    low, low_score = pursued_peaks(confidence, 0.05)
    high, high_score = pursued_peaks(confidence, 0.2)
    assert 0 < len(high) < len(low)
    np.testing.assert_array_equal(high, low[: len(high)])
    np.testing.assert_array_equal(high_score, low_score[: len(high)])


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_empty_and_broken_maps_hold_nothing(value: float) -> None:
    cells, score = pursued_peaks(np.full((8, 8), value, np.float32), 0.1)
    assert (cells.shape, score.shape) == ((0, 2), (0,))


def test_a_full_map_ends_at_the_limit() -> None:
    cells, _ = pursued_peaks(np.ones((256, 64), np.float32), 1e-6)
    assert len(cells) == MAX_PEAKS


def test_bad_parameters_are_named() -> None:
    with pytest.raises(ValueError, match=r"threshold must be positive, got 0"):
        pursued_peaks(np.zeros((2, 2)), 0.0)
    with pytest.raises(ValueError, match=r"confidence must have shape \[range, azimuth\]"):
        pursued_peaks(np.zeros(2), 0.1)
