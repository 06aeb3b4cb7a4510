"""Hard cases of mirror geometry: parallel rays, end points, far walls, tiny walls."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.mirror import crosses, crossing_parameters, reflect, specular_points, wall_from_ends


def wall(*ends: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([ends[0]]), np.array([ends[1]])


def test_ray_along_a_wall_is_not_cut() -> None:
    """Parallel and collinear rays give NaN parameters, never a division warning, and see the wall's edge."""
    a, b = wall((2.0, 0.0), (8.0, 0.0))
    targets = np.array([[10.0, 0.0], [5.0, 0.0], [10.0, 1e-300]])
    assert np.isnan(crossing_parameters(np.zeros(2), targets, a, b)[0]).all()
    assert not crosses(np.zeros(2), targets, a, b).any()


def test_target_at_the_origin_is_not_cut() -> None:
    a, b = wall((0.0, -1.0), (0.0, 1.0))
    assert not crosses(np.zeros(2), np.zeros((1, 2)), a, b).any()


def test_a_point_on_a_wall_is_not_hidden_by_it() -> None:
    """10 000 points on random walls: rounding puts half of them behind. A test without clearance hides many."""
    rng = np.random.default_rng(5)
    a, b = rng.uniform(-40.0, 40.0, (2, 100, 2))
    points = a[:, None] + rng.uniform(0.05, 0.95, (100, 100, 1)) * (b - a)[:, None]
    hidden, naively = 0, 0
    for i in range(100):
        hidden += crosses(np.zeros(2), points[i], a[i : i + 1], b[i : i + 1]).sum()
        along_ray, along_wall = crossing_parameters(np.zeros(2), points[i], a[i : i + 1], b[i : i + 1])
        naively += ((along_ray > 0) & (along_ray < 1) & (along_wall >= 0) & (along_wall <= 1)).sum()
    assert hidden == 0
    assert naively > 1000


def test_two_walls_that_share_a_corner_leave_no_gap() -> None:
    """Rays aimed at the shared corner of thousands of bends, from every side, never slip through."""
    rng = np.random.default_rng(6)
    for _ in range(2000):
        corner = rng.uniform(5.0, 30.0, 2)
        ends = corner + rng.uniform(-9.0, 9.0, (2, 2))
        beyond = corner * rng.uniform(1.5, 3.0)
        a = np.array([ends[0], corner])
        b = np.array([corner, ends[1]])
        assert crosses(np.zeros(2), beyond[None], a, b).any()


@pytest.mark.parametrize("far_m", [1e3, 1e6])
def test_reflection_far_from_the_origin_keeps_its_precision(far_m: float) -> None:
    """Twice reflected is where it was, to the rounding of the coordinates' own size."""
    points = np.array([[far_m + 1.0, -far_m + 2.0]])
    normal, offset = wall_from_ends([far_m, -far_m], [far_m + 3.0, -far_m + 4.0], [0.0, 0.0])
    twice = reflect(reflect(points, normal, offset), normal, offset)
    np.testing.assert_allclose(twice, points, atol=4.0 * np.spacing(2.0 * far_m))


def test_grazing_mirror_paths_stay_on_the_wall() -> None:
    """Radar and target 1 um off a 60 m wall: the specular point lies on it, between both."""
    targets = np.array([[50.0, 1e-6]])
    point = specular_points(np.array([0.0, 1e-6]), targets, np.array([-5.0, 0.0]), np.array([55.0, 0.0]))
    np.testing.assert_allclose(point, [[25.0, 0.0]], atol=1e-9)


def test_shortest_walls_are_refused_and_the_next_are_not() -> None:
    with pytest.raises(ValueError, match="wall must be longer"):
        wall_from_ends([5.0, 5.0], [5.0, 5.0 + 1e-7], [0.0, 0.0])
    normal, _ = wall_from_ends([5.0, 5.0], [5.0, 5.0 + 2e-6], [0.0, 0.0])
    np.testing.assert_allclose(normal, [-1.0, 0.0])
