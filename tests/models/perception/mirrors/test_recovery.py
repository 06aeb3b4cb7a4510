from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.image_walls import DirectReturns, RecoveryParams, associate_crossing, seen_through
from models.perception.mirrors.mirror_table import NO_WALL, wall_arrays
from models.perception.mirrors.peaks_to_view import GeometryParams, recover_bev
from models.perception.mirrors.recovery import cartesian_covariance, folded, recover, reflection_state
from models.perception.mirrors.rejection import hidden_mask
from models.physics.mirror import reflect, wall_from_ends
from msgs.values.frames import polar_from_xy, xy_from_polar
from msgs.values.perception import PathClass, Peaks, Wall
from tests.builders import peaks_at, wall_between

FACADE = ((20.0, -10.0), (20.0, 10.0))


def wall(a: tuple[float, float], b: tuple[float, float], angle_std: float = 0.01, offset_std: float = 0.05) -> Wall:
    return wall_between(a, b, angle_std_rad=angle_std, offset_std_m=offset_std)


def peaks_of(points: np.ndarray, path_class: list[int], snr_db: float = 30.0) -> Peaks:
    stamps_ns = np.arange(len(path_class), dtype=np.int64)
    classes, strengths_db = np.array(path_class, np.uint8), np.full(len(path_class), snr_db)
    return peaks_at(
        points, stds=(0.1, math.radians(1.5)), stamp_ns=5, scan_id=2, path_class=classes, peak_stamp_ns=stamps_ns,
        snr_db=strengths_db, sensitivity_db=109.0,
    )  # fmt: skip


def returns_at(points: list[list[float]], snr_db: float = 35.0, on_wall: int = NO_WALL) -> DirectReturns:
    count = len(points)
    return DirectReturns(
        np.array(points, np.float64).reshape(-1, 2), np.full(count, snr_db), np.zeros(count, np.int64),
        np.full(count, on_wall),
    )  # fmt: skip


def image_of(place: list[float], a: tuple[float, float], b: tuple[float, float]) -> np.ndarray:
    normal, offset_m = wall_from_ends(np.array(a), np.array(b), np.zeros(2))
    return reflect(np.array([place]), normal, offset_m)[0]


def folded_alone(place: list[float], walls: list[Wall], returns: DirectReturns) -> bool:
    """Whether the image of one place in the first wall is kept as hidden."""
    image = image_of(place, *walls[0].ends_m)
    recovered = recover(peaks_of(image, [PathClass.MIRRORED]), walls, returns, RecoveryParams())
    assert len(recovered) == 1
    return bool(hidden_mask(recovered, walls, returns, RecoveryParams())[0])


def test_equation_19_folds_an_image_back_exactly():
    """Wall x = 20, place (12, 8), image (28, 8): o = o' - 2 (n.o' + b) n; rounding of double precision."""
    image = image_of([12.0, 8.0], *FACADE)
    np.testing.assert_allclose(image, [28.0, 8.0], atol=1e-12)
    recovered = recover(peaks_of(image, [PathClass.MIRRORED]), [wall(*FACADE)], returns_at([]), RecoveryParams())
    np.testing.assert_allclose(recovered.points_m, [[12.0, 8.0]], atol=1e-12)
    assert (recovered.wall.tolist(), recovered.stamp_ns.tolist()) == ([0], [0])


def test_a_wall_that_the_ray_misses_is_not_the_images():
    """Both walls stand before the image; the ray at 16 degrees passes through the long one only."""
    walls = [wall((10.0, -8.0), (10.0, -3.0)), wall(*FACADE)]
    got, _ = associate_crossing(np.array([[28.0, 8.0]]), np.array([0.02]), wall_arrays(walls), RecoveryParams())
    assert got.tolist() == [1]


def test_of_two_walls_that_the_ray_passes_the_last_is_the_images():
    """The ray to (28, 2) passes a wall x = 10 at y = 0.71, 0.29 m short of its end: its last metre is no sure wall, so
    the way on to the facade, at (20, 1.43), is free. Folded in either wall the place is free too, (-8, 2) or (12, 2).
    That the echo came at all shows that the nearer wall does not reach this far. Their order in the list is nothing.
    """
    near, image = wall((10.0, -8.0), (10.0, 1.0)), np.array([[28.0, 2.0]])
    for walls, last in (([near, wall(*FACADE)], 1), ([wall(*FACADE), near], 0)):
        got, second = associate_crossing(image, np.array([1e-4]), wall_arrays(walls), RecoveryParams())
        assert (got.tolist(), second.tolist()) == ([last], [NO_WALL])
    recovered = recover(peaks_of(image, [PathClass.MIRRORED]), [near, wall(*FACADE)], returns_at([]), RecoveryParams())
    np.testing.assert_allclose(recovered.points_m, [[12.0, 2.0]], atol=1e-12)


@pytest.mark.parametrize(("beyond_m", "expected"), [(0.2, 0), (6.0, NO_WALL)])
def test_a_narrow_miss_of_the_end_counts_a_wide_one_does_not(beyond_m, expected):
    image = np.array([[28.0, (10.0 + beyond_m) * 28.0 / 20.0]])
    got, _ = associate_crossing(image, np.array([1e-4]), wall_arrays([wall(*FACADE)]), RecoveryParams())
    assert got.tolist() == [expected]


def test_the_margin_grows_with_the_angular_error():
    """1.5 m past the end: with 1.5 degrees at 23 m, two sigma are 1.4 m; with 0.1 degrees nothing."""
    image = np.array([[28.0, 11.5 * 28.0 / 20.0]])
    walls = wall_arrays([wall(*FACADE)])
    wide, narrow = (
        associate_crossing(image, np.array([math.radians(deg)]), walls, RecoveryParams())[0] for deg in (1.5, 0.1)
    )
    assert (wide.tolist(), narrow.tolist()) == ([0], [NO_WALL])


def test_an_image_in_front_of_the_wall_has_none():
    image, facade = np.array([[19.0, 0.0]]), wall_arrays([wall(*FACADE)])
    got, _ = associate_crossing(image, np.array([0.02]), facade, RecoveryParams())
    assert got.tolist() == [NO_WALL]


def test_a_path_that_a_third_wall_cuts_is_none():
    """The way from the facade at (20, 7.1) back to (6, 12) passes through a wall at y = 9, that to the facade not."""
    walls = [wall(*FACADE), wall((4.0, 9.0), (16.0, 9.0))]
    image = image_of([6.0, 12.0], *FACADE)[None]
    assert associate_crossing(image, np.array([0.02]), wall_arrays(walls[:1]), RecoveryParams())[0].tolist() == [0]
    alone = RecoveryParams(second_order=False)
    assert associate_crossing(image, np.array([0.02]), wall_arrays(walls), alone)[0].tolist() == [NO_WALL]


def test_covariance_is_that_of_sampled_errors():
    """Image at 30 m with 0.1 m and 1.5 degrees, wall angle 1 degree and offset 0.1 m: 40 000 draws; the relative
    error of a sampled variance is sqrt(2 / 40000) = 0.7 %, second order of 1.5 degrees adds 0.1 %: 4 %."""
    a, b = (18.0, -9.0), (21.0, 9.0)
    one = wall(a, b, angle_std=math.radians(1.0), offset_std=0.1)
    rng = np.random.default_rng(1)
    image = np.array([[28.0, 8.0]])
    range_m, azimuth_rad = polar_from_xy(image)
    polar = np.diag([0.1**2, math.radians(1.5) ** 2])[None]
    covariance = cartesian_covariance(range_m, azimuth_rad, polar)
    fold = folded(image, covariance, wall_arrays([one]), np.zeros(1, int), np.full(1, NO_WALL))
    draws = 40_000
    images = xy_from_polar(
        range_m + rng.normal(0.0, 0.1, draws), azimuth_rad + rng.normal(0.0, math.radians(1.5), draws)
    )
    middle = 0.5 * (np.array(a) + np.array(b))
    turn = rng.normal(0.0, math.radians(1.0), draws)
    nx, ny = one.normal
    normals = np.stack([nx * np.cos(turn) - ny * np.sin(turn), nx * np.sin(turn) + ny * np.cos(turn)], axis=1)
    offsets = -normals @ middle + rng.normal(0.0, 0.1, draws)
    sampled = np.cov(reflect(images, normals, offsets).T)
    np.testing.assert_allclose((fold.own_m2 + fold.common_m2)[0], sampled, atol=0.04 * np.trace(sampled))


def test_the_errors_of_both_walls_reach_a_place_that_was_folded_twice():
    """Image (60, 24); the facade x = 20 folds it to (-20, 24), met at (20, 8), and the way on crosses a second wall.

    That one is 0.6 x - 0.8 y + 9.6 = 0, n = (0.6, -0.8), from (0, 12) to (16, 24): n.p + b = -12 - 19.2 + 9.6 = -21.6,
    so the place is (-20, 24) + 43.2 n = (5.92, -10.56). The facade shifts by 0.1 m along its normal: 4 * 0.01 on x,
    diag(0.04, 0). The second wall turns that by M = I - 2 n n' = [[0.28, 0.96], [0.96, -0.28]]:
    0.04 [0.28, 0.96] [0.28, 0.96]' = [[0.003136, 0.010752], [0.010752, 0.036864]]; its own shift of 0.05 m adds
    4 * 0.0025 n n' = [[0.0036, -0.0048], [-0.0048, 0.0064]]. Turns are left out (both angles are exact). The image's
    own error, 0.3 m in all directions, stays what it is. Tolerance: rounding.
    """
    facade = wall(*FACADE, angle_std=0.0, offset_std=0.1)
    slanted = wall((0.0, 12.0), (16.0, 24.0), angle_std=0.0, offset_std=0.05)
    place = folded(
        np.array([[60.0, 24.0]]),
        0.09 * np.eye(2)[None],
        wall_arrays([facade, slanted]),
        np.zeros(1, int),
        np.ones(1, int),
    )
    np.testing.assert_allclose(place.points_m, [[5.92, -10.56]], atol=1e-12)
    np.testing.assert_allclose(place.common_m2[0], [[0.006736, 0.005952], [0.005952, 0.043264]], atol=1e-12)
    np.testing.assert_allclose(place.own_m2[0], 0.09 * np.eye(2), atol=1e-12)


def test_covariances_are_positive_definite():
    rng = np.random.default_rng(4)
    images = np.stack([np.full(50, 28.0), rng.uniform(-12.0, 12.0, 50)], axis=1)
    recovered = recover(peaks_of(images, [1] * 50), [wall(*FACADE)], returns_at([]), RecoveryParams())
    assert (np.linalg.eigvalsh(recovered.covariance_m2) > 0.0).all()


def test_hidden_behind_an_occluder_is_kept_and_at_a_visible_object_is_not():
    walls = [wall(*FACADE), wall((5.0, 5.0), (13.0, 5.0))]
    assert folded_alone([12.0, 8.5], walls, returns_at([]))
    # the image of a car whose front is seen directly, 2.5 m before the place
    front = returns_at([[11.0, -3.0], [11.0, -2.0], [11.0, -1.2]])
    assert not folded_alone([13.5, -2.0], walls[:1], front)
    # faint returns there explain nothing
    assert folded_alone([13.5, -2.0], walls[:1], returns_at([[11.0, -3.0], [11.0, -2.0], [11.0, -1.2]], snr_db=15.0))


def test_places_on_walls_and_direct_returns_are_explained():
    walls = [wall(*FACADE), wall((5.0, 5.0), (13.0, 5.0))]
    assert not folded_alone([12.0, 5.6], walls, returns_at([]))
    assert not folded_alone([12.0, -4.0], walls, returns_at([[12.5, -4.3]]))


def test_buddy_takes_the_wall_of_the_return_nearest_in_angle():
    """The published way: the buddy at 17 degrees stands on wall 0; a lone buddy stands for a wall across its ray."""
    walls = [wall(*FACADE)]
    params = RecoveryParams(association="buddy")
    on_wall = returns_at([[20.0, 6.0], [10.0, -8.0]], on_wall=0)
    recovered = recover(peaks_of(np.array([28.0, 8.0]), [1]), walls, on_wall, params)
    np.testing.assert_allclose(recovered.points_m, [[12.0, 8.0]], atol=1e-12)
    alone = recover(peaks_of(np.array([28.0, 0.0]), [1]), [], returns_at([[20.0, 0.0]]), params)
    np.testing.assert_allclose(alone.points_m, [[12.0, 0.0]], atol=1e-12)
    assert alone.wall.tolist() == [NO_WALL]
    state = reflection_state(alone, [], returns_at([[20.0, 0.0]]))
    np.testing.assert_allclose(state.state, [[28.0, 0.0, -1.0, 0.0, 20.0, 1.0]], atol=1e-12)


def test_patches_hold_the_nearest_returns_of_the_buddys_cluster():
    points = [[20.0, y] for y in np.linspace(-9.0, 9.0, 19)]
    returns = returns_at(points, on_wall=0)
    recovered = recover(peaks_of(np.array([28.0, 8.0]), [1]), [wall(*FACADE)], returns, RecoveryParams())
    patch = reflection_state(recovered, [wall(*FACADE)], returns).patch_m[0]
    assert patch.shape == (16, 2)
    assert patch[0].tolist() == [20.0, 8.0]
    assert patch[:, 1].min() == -6.0
    few = reflection_state(recovered, [wall(*FACADE)], returns_at(points[:3], on_wall=0)).patch_m[0]
    np.testing.assert_array_equal(few[3:], [points[2]] * 13)


def test_no_peaks_no_walls_no_failure():
    frame = recover_bev(peaks_of(np.zeros((0, 2)), []), GeometryParams())
    assert (frame.walls, frame.points, frame.objects) == ((), (), ())
    lonely = recover_bev(peaks_of(np.array([28.0, 8.0]), [PathClass.MIRRORED]), GeometryParams())
    assert lonely.points == ()


def test_a_residual_moves_the_places_and_flags_are_told():
    y = np.linspace(-9.0, 9.0, 19)
    points = np.vstack([np.stack([np.full(19, 20.0), y], axis=1), [[28.0, 8.0]]])
    peaks = peaks_of(points, [0] * 19 + [1])
    plain = recover_bev(peaks, GeometryParams())
    moved = recover_bev(peaks, GeometryParams(), residual=lambda seen: np.full((len(seen.images_m), 2), 0.25))
    assert moved.points[0].x_m == pytest.approx(plain.points[0].x_m + 0.25)
    assert moved.points[0].image_x_m == plain.points[0].image_x_m
    assert plain.flags == ()


def test_what_is_seen_behind_a_line_proves_that_it_is_no_wall() -> None:
    """A row of parked cars 6 m ahead, fitted as a line, and a long wall's returns behind it at 20 m."""
    row, facade = wall((6.0, -3.0), (6.0, 3.0)), wall((20.0, -8.0), (20.0, 8.0))
    points = np.array([[6.0, -2.0], [6.0, 2.0], [20.0, -2.0], [20.0, 0.0], [20.0, 2.0]])
    returns = DirectReturns(points, np.full(5, 30.0), np.zeros(5, np.int64), np.array([0, 0, 1, 1, 1]))
    arrays = wall_arrays([row, facade])
    assert seen_through(arrays, returns, RecoveryParams()).tolist() == [True, False]
    image, error = np.array([[30.0, 1.0]]), np.array([0.01])
    assert associate_crossing(image, error, arrays, RecoveryParams(), np.array([False, True]))[0].tolist() == [1]
    # two returns are not proof enough
    few = DirectReturns(points[:4], np.full(4, 30.0), np.zeros(4, np.int64), np.array([0, 0, 1, 1]))
    assert not seen_through(arrays, few, RecoveryParams()).any()
