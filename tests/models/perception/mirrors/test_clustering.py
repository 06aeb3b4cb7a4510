from __future__ import annotations

import numpy as np
import pytest

from models.perception.mirrors.clustering import NOISE, dbscan, fits_box


def brute_force(points: np.ndarray, eps: float, min_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The definition: core flags, reachability among cores by repeated squaring, and all distances."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    near = distance <= eps
    core = near.sum(axis=1) >= min_points
    linked = near & core & core[:, None]
    for _ in range(len(points)):
        linked = linked | (linked.astype(int) @ linked.astype(int) > 0)
    return core, linked, distance


@pytest.mark.parametrize("seed", range(12))
def test_equals_the_definition(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 20.0, (60, 2))
    eps, min_points = 2.0, 2 + seed % 4
    core, linked, distance = brute_force(points, eps, min_points)
    labels = dbscan(points, eps, min_points)
    assert (labels[core] != NOISE).all()
    for i in np.flatnonzero(core):
        for j in np.flatnonzero(core):
            assert (labels[i] == labels[j]) == (i == j or linked[i, j])
    for i in np.flatnonzero(~core):
        reached = np.flatnonzero(core & (distance[i] <= eps))
        expected = labels[reached[distance[i, reached].argmin()]] if len(reached) else NOISE
        assert labels[i] == expected


def test_labels_follow_the_first_point_of_each_cluster():
    points = np.array([[50.0, 0.0], [0.0, 0.0], [0.5, 0.0], [51.0, 0.0], [20.0, 20.0]])
    assert dbscan(points, 1.5, 2).tolist() == [0, 1, 1, 0, NOISE]


def test_reach_includes_eps_itself():
    assert dbscan(np.array([[0.0, 0.0], [4.0, 0.0]]), 4.0, 2).tolist() == [0, 0]


def test_no_points_and_equal_points():
    assert dbscan(np.zeros((0, 2)), 1.0, 2).shape == (0,)
    assert dbscan(np.zeros((5, 2)), 1.0, 5).tolist() == [0] * 5


def test_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match=r"\[N, 2\]"):
        dbscan(np.zeros((3, 3)), 1.0, 2)
    with pytest.raises(ValueError, match="eps_m"):
        dbscan(np.zeros((3, 2)), 0.0, 2)


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, 45.0, 90.0, 145.0])
def test_fits_box_in_any_orientation(yaw_deg):
    """A 4.0 x 1.5 m rectangle: turned by up to 2.5 degrees from a tried angle it widens by 4 sin(2.5) = 0.17 m."""
    yaw = np.radians(yaw_deg)
    corners = np.array([[2.0, 0.75], [-2.0, 0.75], [-2.0, -0.75], [2.0, -0.75]])
    turned = corners @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    assert fits_box(turned, 4.1, 1.7)
    assert not fits_box(turned, 3.9, 1.7)
    assert not fits_box(turned, 4.1, 1.4)
