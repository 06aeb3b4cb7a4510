"""Plane mirrors: reflection, wall lines, crossings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.mirror import (
    _all_cuts,
    _crossings,
    blocked,
    crosses,
    crossing_parameters,
    mirrored,
    reflect,
    segments_cross,
    specular_points,
    wall_from_ends,
)


def test_reflection_is_its_own_inverse_and_keeps_heights_and_distances() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-50, 50, (200, 3))
    normal, offset = wall_from_ends(np.array([3.0, -7.0]), np.array([20.0, 11.0]), np.zeros(2))
    image = reflect(points, normal, offset)
    np.testing.assert_allclose(reflect(image, normal, offset), points, atol=1e-12)
    np.testing.assert_array_equal(image[:, 2], points[:, 2])
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(image, axis=0), axis=1), np.linalg.norm(np.diff(points, axis=0), axis=1), rtol=1e-12
    )
    # the foot of each pair lies on the wall
    middle = 0.5 * (points + image)[:, :2]
    np.testing.assert_allclose(middle @ normal + offset, 0.0, atol=1e-12)


def test_reflection_takes_normals_of_any_length() -> None:
    points = np.array([[1.0, 2.0]])
    np.testing.assert_allclose(reflect(points, [2.0, 0.0], -10.0), reflect(points, [1.0, 0.0], -5.0))


def test_wall_normal_points_towards_the_asker() -> None:
    a, b = np.array([10.0, -5.0]), np.array([10.0, 5.0])
    for towards, sign in ((np.zeros(2), -1.0), (np.array([20.0, 0.0]), 1.0)):
        normal, offset = wall_from_ends(a, b, towards)
        np.testing.assert_allclose(normal, [sign, 0.0])
        assert normal @ towards + offset == pytest.approx(10.0)


def test_a_point_on_the_line_leaves_the_left_hand_normal() -> None:
    """Along +x the left hand is +y, along -x it is -y; the same line, y = 3, either way."""
    for ends, sign in ((([0.0, 3.0], [8.0, 3.0]), 1.0), (([8.0, 3.0], [0.0, 3.0]), -1.0)):
        for towards in ([5.0, 3.0], [-9.0, 3.0], ends[0]):
            normal, offset_m = wall_from_ends(*ends, towards)
            np.testing.assert_array_equal(normal, [0.0, sign])
            assert offset_m == -3.0 * sign


def test_wall_without_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"wall must be longer.*\[1\.0, 2\.0\]"):
        wall_from_ends([1.0, 2.0], [1.0, 2.0], [0.0, 0.0])


@pytest.mark.parametrize(
    ("target", "is_blocked"),
    [((10.0, 0.0), True), ((10.0, 9.9), True), ((10.0, 10.1), False), ((4.9, 0.0), False), ((-10.0, 0.0), False)],
)
def test_a_wall_blocks_what_is_behind_it_and_nothing_else(target: tuple[float, float], is_blocked: bool) -> None:
    """Wall x = 5, |y| <= 5, seen from the origin: its shadow at x = 10 reaches |y| = 10."""
    a, b = np.array([[5.0, -5.0]]), np.array([[5.0, 5.0]])
    assert crosses(np.zeros(2), np.array([target]), a, b)[0, 0] == is_blocked


def test_each_ray_may_have_its_own_origin() -> None:
    origins = np.array([[0.0, 0.0], [0.0, 20.0]])
    targets = np.array([[10.0, 0.0], [10.0, 20.0]])
    wall = np.array([[5.0, -5.0]]), np.array([[5.0, 5.0]])
    np.testing.assert_array_equal(blocked(origins, targets, *wall), [True, False])


def test_no_walls_block_nothing() -> None:
    assert not blocked(np.zeros(2), np.ones((3, 2)), np.zeros((0, 2)), np.zeros((0, 2))).any()


def test_specular_points_obey_the_law_of_reflection() -> None:
    """Layout: random walls, radar and targets on one side. Law: equal angles on both sides of the normal.

    Exact up to rounding: the cosines of both angles agree to 1e-12.
    """
    rng = np.random.default_rng(3)
    found = 0
    for _ in range(50):
        a, b = rng.uniform(-30, 30, (2, 2))
        targets = rng.uniform(-30, 30, (40, 2))
        point = specular_points(np.zeros(2), targets, a, b)
        seen = ~np.isnan(point[:, 0])
        normal, offset = wall_from_ends(a, b, np.zeros(2))
        np.testing.assert_allclose(point[seen] @ normal + offset, 0.0, atol=1e-11)
        incoming = -point[seen] / np.linalg.norm(point[seen], axis=1, keepdims=True)
        leaving = targets[seen] - point[seen]
        leaving /= np.linalg.norm(leaving, axis=1, keepdims=True)
        np.testing.assert_allclose(incoming @ normal, leaving @ normal, atol=1e-12)
        along = np.array([-normal[1], normal[0]])
        np.testing.assert_allclose(incoming @ along, -(leaving @ along), atol=1e-12)
        found += seen.sum()
    assert found > 100


def test_a_mirror_shows_nothing_beyond_its_ends_or_behind_it() -> None:
    a, b = np.array([10.0, -1.0]), np.array([10.0, 1.0])
    targets = np.array([[2.0, 0.5], [2.0, 9.0], [12.0, 0.5]])
    assert np.isnan(specular_points(np.zeros(2), targets, a, b)[:, 0]).tolist() == [False, True, True]


def test_specular_path_is_the_shortest_over_the_wall() -> None:
    """Fermat: the path over the specular point is as long as to the image, any other point makes it longer."""
    a, b, target = np.array([12.0, -8.0]), np.array([15.0, 9.0]), np.array([3.0, 6.0])
    point = specular_points(np.zeros(2), target[None], a, b)[0]
    image = reflect(target, *wall_from_ends(a, b, np.zeros(2)))
    shortest = math.hypot(*image)
    assert math.hypot(*point) + math.dist(point, target) == pytest.approx(shortest, rel=1e-14)
    for share in np.linspace(0.0, 1.0, 21):
        other = a + share * (b - a)
        assert math.hypot(*other) + math.dist(other, target) >= shortest - 1e-12


@pytest.mark.parametrize("seed", range(4))
def test_crossings_are_solutions_of_the_two_lines(seed: int) -> None:
    """Parameters s and t of o + s r = a + t w from a linear solver; a cut has both between 0 and 1."""
    rng = np.random.default_rng(seed)
    origin, targets = rng.uniform(-20.0, 20.0, (2, 30, 2))
    a, b = rng.uniform(-20.0, 20.0, (2, 12, 2))
    systems = np.stack(np.broadcast_arrays((targets - origin)[:, None], (a - b)[None]), axis=-1)
    s, t = np.moveaxis(np.linalg.solve(systems, (a[None] - origin[:, None])[..., None])[..., 0], -1, 0)
    along_ray, along_wall = crossing_parameters(origin, targets, a, b)
    np.testing.assert_allclose(along_ray, s, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(along_wall, t, rtol=1e-9, atol=1e-9)
    expected = (s > 0.0) & (s < 1.0) & (t >= 0.0) & (t <= 1.0)
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(crosses(origin, targets, a, b), expected)
    np.testing.assert_array_equal(blocked(origin, targets, a, b), expected.any(axis=1))


def test_crossings_of_any_layout_use_one_kernel() -> None:
    """One ray (whose broadcast is contiguous), read-only and strided arrays: nothing is compiled for them anew."""
    origin, targets, a, b = np.zeros(2), np.array([[4.0, 0.0], [4.0, 1.0]]), np.array([[2.0, -1.0]]), np.ones((1, 2))
    expected = crosses(origin, targets, a, b), crossing_parameters(origin, targets, a, b)
    known = len(_all_cuts.signatures), len(_crossings.signatures)
    strided = np.repeat(targets, 2, axis=0)[::2]
    strided.flags.writeable = False
    for rays in (strided, targets.tolist(), np.asfortranarray(targets)):
        np.testing.assert_array_equal(crosses(origin, rays, a, b), expected[0])
        np.testing.assert_array_equal(crossing_parameters(origin, rays, a, b), expected[1])
    np.testing.assert_array_equal(crosses(origin, targets[:1], a, b), expected[0][:1])
    assert (len(_all_cuts.signatures), len(_crossings.signatures)) == known


def test_compiled_forms_are_the_same_law() -> None:
    rng = np.random.default_rng(3)
    for (x, y), (nx, ny), offset in zip(*rng.uniform(-9.0, 9.0, (2, 50, 2)), rng.uniform(0.0, 9.0, 50), strict=True):
        np.testing.assert_array_equal(mirrored(x, y, nx, ny, offset), reflect(np.array([x, y]), [nx, ny], offset))
    rays, walls = rng.uniform(-9.0, 9.0, (2, 50, 4))
    together = [segments_cross(*ray, *wall, 1e-6) for ray in rays for wall in walls]
    for n, ray in enumerate(rays):
        alone = crosses(ray[:2], ray[None, 2:], walls[:, :2], walls[:, 2:])[0]
        np.testing.assert_array_equal(together[50 * n : 50 * n + 50], alone)
