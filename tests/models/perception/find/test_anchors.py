from __future__ import annotations

import numpy as np
import pytest

from models.perception.find.anchors import anchor_points


def quiet(rows: int = 8, columns: int = 8) -> np.ndarray:
    """An answer in which every anchor says noise: its logit is 10 over the others."""
    output = np.zeros((5, rows, columns), np.float32)
    output[2] = 10.0
    return output


def put(output: np.ndarray, at: tuple[int, int], path_class: int, logit: float, offset: tuple[float, float]) -> None:
    output[path_class, at[0], at[1]] = logit
    output[3:, at[0], at[1]] = offset


def test_point_is_its_anchor_plus_its_offset() -> None:
    """Anchor (3, 5) of stride 2 lies on cell (6.5, 10.5). Probability by hand: e^12 / (e^12 + e^10 + 1)."""
    output = quiet()
    put(output, (3, 5), 1, 12.0, (-0.75, 1.25))
    found = anchor_points(output, stride=2, threshold=0.3, min_distance=3)
    cells, score, path_class = found.cells, found.score, found.path_class
    np.testing.assert_allclose(cells, [[5.75, 11.75]], atol=1e-6)
    np.testing.assert_allclose(score, [1.0 / (1.0 + np.exp(-2.0) + np.exp(-12.0))], rtol=1e-6)
    assert path_class.tolist() == [1]
    assert path_class.dtype == np.uint8


def test_line_of_sight_first_and_strongest_first() -> None:
    output = quiet()
    put(output, (1, 1), 1, 15.0, (0.0, 0.0))
    put(output, (6, 1), 0, 11.0, (0.0, 0.0))
    put(output, (1, 6), 0, 13.0, (0.0, 0.0))
    put(output, (6, 6), 1, 14.0, (0.0, 0.0))
    found = anchor_points(output, stride=1, threshold=0.3, min_distance=3)
    cells, score, path_class = found.cells, found.score, found.path_class
    np.testing.assert_array_equal(cells, [[1, 6], [6, 1], [1, 1], [6, 6]])
    assert path_class.tolist() == [0, 0, 1, 1]
    assert score[0] > score[1]
    assert score[2] > score[3]


def test_noise_and_weak_anchors_are_suppressed() -> None:
    output = quiet()
    assert len(anchor_points(output, 1, 0.3, 3).cells) == 0
    put(output, (3, 3), 0, 10.0, (0.0, 0.0))  # as likely as noise: 0.5
    assert len(anchor_points(output, 1, 0.49, 3).cells) == 1
    assert len(anchor_points(output, 1, 0.51, 3).cells) == 0


def test_anchors_that_mean_one_point_give_one() -> None:
    """Two separate anchors, three apart, that both point at cell (4.0, 3.5); the stronger one speaks."""
    output = quiet()
    put(output, (4, 2), 0, 14.0, (0.0, 1.5))
    put(output, (4, 5), 0, 13.0, (0.0, -1.6))
    cells = anchor_points(output, stride=1, threshold=0.3, min_distance=3).cells
    np.testing.assert_allclose(cells, [[4.0, 3.5]], atol=1e-6)


def test_shoulder_of_a_point_is_no_point() -> None:
    """An anchor over the threshold beside a stronger one stays silent, even where it points far away."""
    output = quiet()
    put(output, (4, 4), 0, 14.0, (0.0, 0.0))
    put(output, (4, 5), 0, 11.0, (-4.0, 0.0))
    cells = anchor_points(output, stride=1, threshold=0.3, min_distance=3).cells
    np.testing.assert_array_equal(cells, [[4.0, 4.0]])


def test_neighbours_that_mean_two_points_give_two() -> None:
    """Points four cells apart, the closest that truth has, lie two anchors apart at stride 2: both are told."""
    output = quiet()
    put(output, (2, 4), 0, 14.0, (0.0, 0.0))
    put(output, (4, 4), 0, 14.0, (0.0, 0.0))
    cells = anchor_points(output, stride=2, threshold=0.3, min_distance=3).cells
    np.testing.assert_array_equal(cells, [[4.5, 8.5], [8.5, 8.5]])


def test_classes_do_not_suppress_each_other() -> None:
    output = quiet()
    put(output, (4, 3), 0, 14.0, (0.0, 0.0))
    put(output, (4, 4), 1, 14.0, (0.0, 0.0))
    assert anchor_points(output, 1, 0.3, 3).path_class.tolist() == [0, 1]


def test_points_stay_on_the_map() -> None:
    output = quiet()
    put(output, (0, 0), 0, 14.0, (-5.0, -1e30))
    put(output, (7, 7), 0, 14.0, (5.0, 1e30))
    cells = anchor_points(output, stride=2, threshold=0.3, min_distance=3).cells
    np.testing.assert_array_equal(cells, [[0.0, 0.0], [15.0, 15.0]])


def test_huge_logits_stay_finite() -> None:
    output = quiet() * 1e30
    put(output, (3, 3), 0, 2e31, (0.0, 0.0))
    found = anchor_points(output, 1, 0.3, 3)
    cells, score = found.cells, found.score
    np.testing.assert_array_equal(cells, [[3.0, 3.0]])
    assert score.tolist() == [1.0]


@pytest.mark.parametrize(
    ("output", "stride", "message"),
    [
        (np.zeros((4, 8, 8)), 1, r"output must have shape \(5, rows, columns\), got \(4, 8, 8\)"),
        (np.zeros((1, 5, 8, 8)), 1, r"got \(1, 5, 8, 8\)"),
        (np.zeros((5, 8, 8)), 0, "stride must be at least 1, got 0"),
        (np.where(np.arange(320).reshape(5, 8, 8) == 7, np.nan, 0.0), 1, "output must be finite, got 1 values"),
    ],
)
def test_what_is_no_answer_is_refused(output: np.ndarray, stride: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        anchor_points(output, stride, 0.3, 3)
