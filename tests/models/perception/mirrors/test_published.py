"""The published back end: a straight wall folds exactly, a lonely return stands for a wall, nothing is rejected."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan
from models.perception.mirrors.published import published_walls
from tests.builders import peaks_at


def test_images_fold_in_the_wall_of_their_buddy() -> None:
    """Wall x = 20 of nine returns; an image at (32, 3) came from (8, 3). Exact to 1e-9."""
    direct = np.stack([np.full(9, 20.0), np.arange(-4.0, 5.0)], axis=1)
    recovered = fold_scan(peaks_at(direct, np.array([[32.0, 3.0]])), GeometryParams(back_end="specification")).recovered
    assert recovered.points_m == pytest.approx(np.array([[8.0, 3.0]]), abs=1e-9)


def test_lonely_buddy_stands_for_a_wall_across_its_ray() -> None:
    """One return at (10, 0), in no cluster: its wall is x = 10, and (16, 0) folds to (4, 0)."""
    recovered = fold_scan(
        peaks_at(np.array([[10.0, 0.0]]), np.array([[16.0, 0.0]])), GeometryParams(back_end="specification")
    ).recovered
    assert recovered.points_m == pytest.approx(np.array([[4.0, 0.0]]), abs=1e-9)


def test_without_direct_returns_or_images_nothing_is_recovered() -> None:
    nothing = np.zeros((0, 2))
    assert (
        len(fold_scan(peaks_at(nothing, np.array([[9.0, 1.0]])), GeometryParams(back_end="specification")).recovered)
        == 0
    )
    assert (
        len(fold_scan(peaks_at(np.array([[9.0, 1.0]]), nothing), GeometryParams(back_end="specification")).recovered)
        == 0
    )


def test_two_lines_of_one_cluster_are_two_walls() -> None:
    """An L of two arms of six points each, one cluster: two walls, every point on one."""
    arm = np.arange(6.0)
    points = np.concatenate([np.stack([10 + arm, 0 * arm], 1), np.stack([0 * arm + 10, 1.0 + arm], 1)])
    walls, of_point = published_walls(points, np.zeros(12, int))
    assert len(walls) == 2
    assert (of_point >= 0).all()
    assert sorted(wall.inliers for wall in walls) == [5, 7]


def test_equal_points_end_the_search() -> None:
    walls, of_point = published_walls(np.ones((4, 2)), np.zeros(4, int))
    assert walls == []
    assert (of_point == -1).all()
