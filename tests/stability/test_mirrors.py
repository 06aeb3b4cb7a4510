"""Hard cases of mirror geometry: parallel rays, end points, far walls, tiny walls."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.curved_mirror import bounces
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


#: Nearly a half circle of 20 m radius around (0, 0), hollow to the left of a -> b (which runs upwards).
HOLLOW = np.array([1.0, -np.sqrt(399.0)]), np.array([1.0, np.sqrt(399.0)]), 1.0 / 20.0


@pytest.mark.parametrize(
    ("origin", "target"),
    [
        ((0.0, 0.0), (0.0, 0.0)),  # both at the centre: every point of the wall is a Fermat point
        ((0.0, 0.0), (1e-9, 1e-9)),
        ((0.0, 0.0), (3.0, 4.0)),
        ((-5.0, 2.0), (-5.0, 2.0)),  # target = radar
        ((5.0, 2.0), (20.0, 0.0)),  # target on the wall
        ((20.0, 0.0), (5.0, 2.0)),  # radar on the wall
        ((20.0, 0.0), (20.0, 0.0)),
        ((5.0, 2.0), (1.0, np.sqrt(399.0))),  # target on the wall's end
        ((-1e6, 0.0), (-1e6, 5.0)),
        ((5.0, 2.0), (20.0 - 1e-7, 0.0)),
        ((20.0 - 1e-4, 0.0), (19.0, 6.0)),
    ],
)
def test_curved_mirror_survives_what_a_scene_should_not_hold(
    origin: tuple[float, float], target: tuple[float, float]
) -> None:
    """No NaN, no infinity, no warning, and a field no larger than the whole wall in phase."""
    found = bounces(np.array(origin), np.array([target]), *HOLLOW, 0.03)
    for values in (found.share, found.point_m, found.normal, found.out_m, found.on_m, found.cos_incidence, found.gain):
        assert np.isfinite(values).all()
    assert ((found.share >= 0.0) & (found.share <= 1.0)).all()
    # sqrt(k / 2 pi) times the arc's 60 m, times the spread of legs of at least a wavelength
    assert (np.abs(found.gain) < 61.0 * np.sqrt(1.0 / 0.03) * np.sqrt(1.0 / 0.03)).all()


def test_whole_arc_in_phase_is_one_bounce() -> None:
    """Radar and target at the centre: field = sqrt(k / 2 pi) (2 r) / ((2 r)^1.5 r) times the arc, closed form."""
    found = bounces(np.zeros(2), np.zeros((1, 2)), *HOLLOW, 0.03)
    assert len(found) == 1
    arc_m = 40.0 * np.arcsin(np.sqrt(399.0) / 20.0)
    expected = np.sqrt(1.0 / 0.03) * arc_m / (np.sqrt(40.0) * 20.0) * 40.0
    np.testing.assert_allclose(np.abs(found.gain), expected, rtol=1e-9)


def test_nearly_flat_and_nearly_half_circles() -> None:
    """Curvature 1e-12 1/m, and |curvature| x chord from 2 down to one rounding below it; at 2 the arc is refused."""
    a, b = np.array([0.0, 0.0]), np.array([20.0, 0.0])
    rng = np.random.default_rng([40, 9])
    targets = rng.uniform(-30.0, 30.0, (200, 2))
    for curvature in (1e-12, -1e-12, 5e-324, 0.1 * (1.0 - 1e-9), -np.nextafter(0.1, 0.0)):
        found = bounces(np.array([4.0, 9.0]), targets, a, b, curvature, 0.03)
        assert len(found) > 0
        assert np.isfinite(found.gain).all()
        assert np.isfinite(found.point_m).all()
    with pytest.raises(ValueError, match="less than a half circle"):
        bounces(np.array([4.0, 9.0]), targets, a, b, 0.1, 0.03)


def test_no_targets_no_bounces() -> None:
    assert len(bounces(np.zeros(2), np.zeros((0, 2)), *HOLLOW, 0.03)) == 0
