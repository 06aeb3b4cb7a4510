"""Returns of walls told from blobs, and from what moves."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.target_lists.wall_points import _weighted_line, wall_like


def mask(points_m: np.ndarray, speed_mps: np.ndarray | None = None) -> np.ndarray:
    count = len(points_m)
    return wall_like(points_m, np.tile(0.01 * np.eye(2), (count, 1, 1)), np.full(count, 20.0), speed_mps)


@pytest.mark.parametrize("direction_rad", [0.0, 0.7, 1.5707963])
def test_a_line_is_a_wall_and_a_blob_is_none(direction_rad: float) -> None:
    """Uniform points of a disc share the strip by area: contrast 1, where a wall has 3 or more."""
    rng = np.random.default_rng(1)
    wall = np.stack([np.linspace(0.0, 20.0, 60), rng.normal(0.0, 0.1, 60)], axis=1)
    blob = np.array([10.0, 12.0]) + rng.uniform(-3.0, 3.0, (200, 2))
    cos, sin = np.cos(direction_rad), np.sin(direction_rad)
    result = mask(np.concatenate([wall, blob]) @ np.array([[cos, sin], [-sin, cos]]))
    assert result[:60].mean() > 0.95
    assert result[60:].mean() < 0.05


def test_a_line_is_the_principal_axis_of_its_weighted_points() -> None:
    """Against the eigenvector of their weighted covariance; points that are no members count for nothing."""
    rng = np.random.default_rng(3)
    points, weight = rng.normal(0.0, 1.0, (30, 2)) @ np.array([[2.0, 0.5], [0.3, 1.0]]), rng.uniform(0.1, 3.0, 30)
    members = np.arange(5, 30)
    cx, cy, nx, ny = _weighted_line(points, weight, members)
    values, axes = np.linalg.eigh(np.cov(points[members].T, aweights=weight[members]))
    assert (cx, cy) == pytest.approx(tuple(np.average(points[members], axis=0, weights=weight[members])))
    assert abs(np.array([nx, ny]) @ axes[:, values.argmin()]) == pytest.approx(1.0)


def test_what_moves_is_no_wall() -> None:
    wall = np.stack([np.linspace(0.0, 20.0, 60), np.zeros(60)], axis=1)
    assert not mask(wall, np.full(60, 2.0)).any()
    assert mask(wall, np.full(60, np.nan)).all()


def test_few_points_are_no_wall() -> None:
    assert not mask(np.stack([np.linspace(0.0, 20.0, 6), np.zeros(6)], axis=1)).any()
    assert mask(np.zeros((0, 2))).shape == (0,)
