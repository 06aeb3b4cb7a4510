from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lab.training.objectives.heatmaps import class_heatmaps, gaussian_heatmap

SHAPE = (40, 30)
cells = st.tuples(st.floats(-20, 60), st.floats(-20, 50))


def eq_22(row: np.ndarray, column: np.ndarray, sigma: float) -> np.ndarray:
    """Eq. (22) as printed: every cell, every point, the largest."""
    x, y = np.meshgrid(np.arange(SHAPE[0]), np.arange(SHAPE[1]), indexing="ij")
    each = [np.exp(-((x - r) ** 2 + (y - c) ** 2) / (2 * sigma**2)) for r, c in zip(row, column, strict=True)]
    return np.max(each, axis=0) if each else np.zeros(SHAPE)


@given(st.lists(cells, max_size=6), st.sampled_from([0.7, 1.0, 2.0]))
def test_equals_the_equation(points: list[tuple[float, float]], sigma: float) -> None:
    """Points are rounded to their cells; those off the map are left out. Bias: a Gaussian is cut beyond 5.4 sigma,
    exp(-5.4^2/2) = 4.6e-7. Tolerance 1e-6.
    """
    rounded = [(round(r), round(c)) for r, c in points if 0 <= round(r) < SHAPE[0] and 0 <= round(c) < SHAPE[1]]
    row, column = np.array(points).reshape(-1, 2).T
    inside_row, inside_column = np.array(rounded).reshape(-1, 2).T
    np.testing.assert_allclose(
        gaussian_heatmap(SHAPE, row, column, sigma), eq_22(inside_row, inside_column, sigma), atol=1e-6
    )


def test_exactly_one_at_the_peak_and_nowhere_else() -> None:
    heatmap = gaussian_heatmap(SHAPE, np.array([10.2, 10.2, 39.0]), np.array([5.4, 9.0, 0.0]))
    assert sorted(map(tuple, np.argwhere(heatmap == 1.0).tolist())) == [(10, 5), (10, 9), (39, 0)]


def test_classes_go_to_their_channel() -> None:
    heatmaps = class_heatmaps(SHAPE, np.array([3.0, 7.0]), np.array([4.0, 8.0]), np.array([1, 0]))
    assert heatmaps.shape == (2, *SHAPE)
    assert heatmaps[1, 3, 4] == 1.0
    assert heatmaps[0, 7, 8] == 1.0
    assert (heatmaps == 1.0).sum() == 2
