"""Hard cases of the geometry stage: two mirrors, arcs, openings, the published preset and empty scans."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.clustering import dbscan
from models.perception.mirrors.image_walls import RecoveryParams, associate_crossing, facing_radar, nearest_in_angle
from models.perception.mirrors.mirror_table import NO_WALL, RADAR, hits, wall_arrays
from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan
from models.perception.mirrors.recovered_objects import ObjectParams, form_objects
from models.perception.mirrors.recovery import Recovered, cartesian_covariance, folded
from models.perception.mirrors.walls import WallParams, find_walls
from models.physics.curved_mirror import arc_points
from models.physics.mirror import reflect
from msgs.values.frames import polar_from_xy, xy_from_polar
from msgs.values.perception import Peaks, Wall
from tests.builders import peaks_at, wall_between
from tests.models.physics.curved_reference import fermat_points
from tests.stability.catalogue import Errors

RANGE_STD_M, AZIMUTH_STD_RAD = 0.06, math.radians(0.7)
FAR, SIDE = ((20.0, -8.0), (20.0, 6.0)), ((8.0, 6.0), (20.0, 6.0))


def wall(a, b, curvature_per_m: float = 0.0) -> Wall:
    return wall_between(a, b, curvature_per_m=curvature_per_m)


def mirrored(point, one: Wall) -> np.ndarray:
    return reflect(np.asarray(point, np.float64), np.array(one.normal), one.offset_m)


def peaks_of(direct: np.ndarray, images: np.ndarray) -> Peaks:
    return peaks_at(direct, images, (RANGE_STD_M, AZIMUTH_STD_RAD))


def spread(a, b, count: int) -> np.ndarray:
    return np.array(a) + np.linspace(0.0, 1.0, count)[:, None] * (np.array(b) - np.array(a))


def measured(points: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    range_m, azimuth_rad = polar_from_xy(points)
    return xy_from_polar(
        range_m + rng.normal(0.0, RANGE_STD_M, len(points)), azimuth_rad + rng.normal(0.0, AZIMUTH_STD_RAD, len(points))
    )


def walls_of(points: np.ndarray, params: WallParams | None = None) -> list[Wall]:
    polar = np.broadcast_to(np.diag([RANGE_STD_M**2, AZIMUTH_STD_RAD**2]), (len(points), 2, 2))
    errors = cartesian_covariance(*polar_from_xy(points), polar)
    return find_walls(points, errors, dbscan(points, 4.0, 2), params or WallParams())[0]


@pytest.mark.parametrize("order", [1, -1])
def test_an_image_in_two_walls_is_folded_twice_and_only_with_the_switch(order):
    """Place (14, 1) in the corner of x = 20 and y = 6: seen by way of both, image (26, 11), by whichever the ray meets
    first: exact to rounding. Folded once about x = 20 it would stand at (14, 11), behind y = 6."""
    walls = [wall(*FAR), wall(*SIDE)][::order]
    image = mirrored(mirrored([14.0, 1.0], walls[0]), walls[1])[None]
    np.testing.assert_allclose(image, [[26.0, 11.0]], atol=1e-12)
    arrays = wall_arrays(walls)
    first, second = associate_crossing(image, np.array([0.01]), arrays, RecoveryParams())
    assert sorted([int(first[0]), int(second[0])]) == [0, 1]
    place = folded(image, np.eye(2)[None], arrays, first, second).points_m
    np.testing.assert_allclose(place, [[14.0, 1.0]], atol=1e-9)
    once = associate_crossing(image, np.array([0.01]), arrays, RecoveryParams(second_order=False))
    assert [index.tolist() for index in once] == [[NO_WALL], [NO_WALL]]


def test_covariance_through_two_folds_is_that_of_sampled_errors():
    """No error of the walls: two reflections turn the image's errors, 20 000 draws, 5 % of the trace."""
    walls = wall_arrays([wall(*FAR), wall(*SIDE)])
    image, covariance = np.array([[26.0, 11.0]]), np.array([[[0.3, 0.1], [0.1, 0.05]]])
    fold = folded(image, covariance, walls, np.zeros(1, int), np.ones(1, int))
    draws = np.random.default_rng(2).multivariate_normal(image[0], covariance[0], 20_000)
    count = np.zeros(len(draws), int)
    places = folded(draws, np.tile(covariance, (len(draws), 1, 1)), walls, count, count + 1).points_m
    np.testing.assert_allclose(fold.own_m2[0], np.cov(places.T), atol=0.05 * np.trace(covariance[0]))
    assert (np.linalg.eigvalsh(fold.common_m2[0]) > 0.0).all()


@pytest.mark.parametrize("curvature", [-0.025, -0.01, 0.01, 0.025])
def test_an_image_in_an_arc_folds_back_to_its_place(curvature):
    """The simulator's Fermat point gives range and azimuth of the image of (12, 3): folded back to within 1 mm."""
    a, b, place = np.array([24.0, -10.0]), np.array([24.0, 10.0]), np.array([[12.0, 3.0]])
    _, share, _ = fermat_points(RADAR, place, a, b, curvature)
    at = arc_points(a, b, curvature, share[:1])[0]
    length_m = np.hypot(*at) + np.hypot(*(place[0] - at))
    image = (length_m * at / np.hypot(*at))[None]
    arrays = wall_arrays([wall((24.0, -10.0), (24.0, 10.0), curvature)])
    fold = folded(image, np.eye(2)[None] * 1e-4, arrays, np.zeros(1, int), np.full(1, NO_WALL))
    np.testing.assert_allclose(fold.points_m, place, atol=1e-3)


def test_covariance_through_an_arc_is_that_of_sampled_errors():
    """Curvature 0.02, errors 0.05 m and 0.3 degrees: 20 000 draws, second order below 2 %: 6 % of the trace."""
    arrays = wall_arrays([wall((24.0, -10.0), (24.0, 10.0), 0.02)])
    image = np.array([[36.0, 5.0]])
    range_m, azimuth_rad = polar_from_xy(image)
    covariance = cartesian_covariance(range_m, azimuth_rad, np.diag([0.05**2, math.radians(0.3) ** 2])[None])
    fold = folded(image, covariance, arrays, np.zeros(1, int), np.full(1, NO_WALL))
    draws = np.random.default_rng(3).multivariate_normal(image[0], covariance[0], 20_000)
    count = np.zeros(len(draws), int)
    places = folded(draws, np.tile(covariance, (len(draws), 1, 1)), arrays, count, count + NO_WALL).points_m
    sampled = np.cov(places.T)
    np.testing.assert_allclose(fold.own_m2[0], sampled, atol=0.06 * np.trace(sampled))
    flat = folded(image, covariance, wall_arrays([wall((24.0, -10.0), (24.0, 10.0))]), np.zeros(1, int), count[:1] - 1)
    assert abs(np.trace(flat.own_m2[0]) / np.trace(sampled) - 1.0) > 0.1, "the bend must matter here"


def test_straight_walls_stay_straight():
    """In 30 draws of a faced wall and of an oblique one: 3 sigma and 5 nepers leave none bent."""
    for seed in range(30):
        for a, b in (((20.0, -9.0), (20.0, 9.0)), ((6.0, -7.0), (28.0, -7.0))):
            assert all(one.curvature_per_m == 0.0 for one in walls_of(measured(spread(a, b, 18), seed)))


def test_a_ray_that_misses_the_circle_has_no_hit():
    """The circle of a wall bulging at 24 m with a radius of 40 m ends at azimuth 39 degrees."""
    bulging = wall_arrays([wall((24.0, -9.0), (24.0, 9.0), -0.025)])
    met = hits(RADAR, xy_from_polar(np.full(2, 40.0), np.radians([5.0, 75.0])), bulging)
    assert np.isfinite(met.along_ray[0, 0])
    assert np.isnan(met.along_ray[1, 0])
    assert np.isinf(met.missed_m(np.array([18.0]))[1, 0])


def test_what_is_seen_through_a_gap_opens_the_wall(monkeypatch):
    """Two fences of 6 m along one line, 6 m apart, a wall seen through the gap: one fence of 18 m, or two of 6 m."""
    fences = np.concatenate([spread((4.0, 4.0), (10.0, 4.0), 9), spread((16.0, 4.0), (22.0, 4.0), 9)])
    back = spread((19.0, 5.0), (19.0, 7.5), 7)
    open_walls = walls_of(np.concatenate([fences, back]), WallParams(max_gap_m=7.0))
    monkeypatch.setattr("models.perception.mirrors.walls.OPEN_GAP_M", math.inf)
    closed = walls_of(np.concatenate([fences, back]), WallParams(max_gap_m=7.0))
    assert [len(closed), len(open_walls)] == [2, 3]
    assert max(math.dist(*one.ends_m) for one in closed) == pytest.approx(18.0, abs=0.1)
    assert max(math.dist(*one.ends_m) for one in open_walls) == pytest.approx(6.0, abs=0.1)


def test_a_return_at_the_radar_itself_faces_back():
    normal, offset_m = facing_radar(np.array([[0.0, 0.0], [3.0, 4.0]]))
    np.testing.assert_allclose(normal, [[-1.0, 0.0], [-0.6, -0.8]])
    np.testing.assert_allclose(offset_m, [0.0, 5.0])
    peaks = peaks_of(np.array([[0.0, 0.0]]), np.array([[20.0, 1.0]]))
    assert np.isfinite(fold_scan(peaks, GeometryParams(back_end="specification")).recovered.points_m).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ObjectParams(score_table=((0.5, 0.2), (0.4, 0.3))), "objects.score_table"),
        (lambda: Wall(normal=(1.0, 0.0), offset_m=0.0, ends_m=((0.0, 0.0), (0.0, 1.0)), inliers=2,
                      curvature_per_m=math.nan), "wall"),
    ],
)  # fmt: skip
def test_bad_parameters_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def centre_hit_share(image_m: np.ndarray, one: Wall) -> float:
    """Share of the ray to an image at which it meets an arc, by the arc's centre and radius."""
    radius_m, (a, b) = 1.0 / one.curvature_per_m, np.array(one.ends_m)
    rise_m = math.sqrt(radius_m**2 - 0.25 * float(np.sum((b - a) ** 2)))
    centre = 0.5 * (a + b) + rise_m * np.array(one.normal)
    second, first = float(image_m @ image_m), -float(image_m @ centre)
    root = first**2 - second * (float(centre @ centre) - radius_m**2)
    if root < 0.0:
        return math.inf
    ways = (np.array([-1.0, 1.0]) * math.sqrt(root) - first) / second
    return float(ways[np.abs(ways - 2.0 / 3.0).argmin()])


@pytest.mark.hard("models.perception.mirrors.mirror_table", "circle about its centre", 1e-12, "m",
                  "sagitta below 1e-14 m, rounding")  # fmt: skip
def test_all_but_flat_arc_is_its_chord(errors: Errors) -> None:
    """Curvature 1e-16 1/m: a centre 1e16 m away is off by metres, and the squares of both legs are all the same."""
    arc, image_m = wall((24.0, -10.0), (24.0, 10.0), 1e-16), np.array([36.0, 5.0])
    met = hits(RADAR, image_m[None], wall_arrays([arc]))
    length_m, exact = float(np.hypot(*image_m)), 24.0 / 36.0
    errors(
        naive=abs(centre_hit_share(image_m, arc) - exact) * length_m,
        ours=abs(float(met.along_ray[0, 0]) - exact) * length_m + abs(float(met.offset_m[0, 0]) - 24.0),
    )


@pytest.mark.hard("models.perception.mirrors.image_walls", "difference of two arctan2", 0.0, "rad",
                  "the nearest of three, by hand")  # fmt: skip
def test_nearest_direction_behind_the_radar(errors: Errors) -> None:
    """An image at 179 degrees, returns at -179, 170 and 0: 2 degrees across the cut of the angles, or 358."""
    image_rad, returns_rad = math.radians(179.0), np.radians([-179.0, 170.0, 0.0])
    exact = 0
    chosen = nearest_in_angle(xy_from_polar(np.array([9.0]), image_rad), xy_from_polar(np.array(5.0), returns_rad))[0]
    naive = int(np.abs(returns_rad - image_rad).argmin())
    apart_rad = np.radians([2.0, 9.0, 179.0])
    errors(naive=apart_rad[naive] - apart_rad[exact], ours=apart_rad[chosen] - apart_rad[exact])


def face_of(points_m: np.ndarray, variance_m2: float = 1e-6) -> Recovered:
    """Folded places of one face, alike in all but where they stand."""
    count = len(points_m)
    return Recovered(
        points_m=points_m, images_m=points_m + np.array([30.0, 0.0]),
        image_covariance_m2=np.tile(variance_m2 * np.eye(2), (count, 1, 1)),
        wall_covariance_m2=np.zeros((count, 2, 2)), wall=np.zeros(count, int), second=np.full(count, NO_WALL),
        score=np.full(count, 0.9), snr_db=np.full(count, 30.0), stamp_ns=1_700_000_000_123_456_789 + np.arange(count),
        radial_speed_mps=np.full(count, np.nan),
    )  # fmt: skip


@pytest.mark.hard("models.perception.mirrors.recovered_objects", "mean of the directions from point to point", 1e-12,
                  "rad", "symmetry; rounding of 15 m over 4 m of face")  # fmt: skip
def test_yaw_of_a_face_across_the_view(errors: Errors) -> None:
    """Points a centimetre to either side of x = 15: directions near +90 and -90 degrees, the same, mean 0."""
    points_m = np.stack([15.0 + 0.01 * np.cos(np.pi * np.arange(9)), np.linspace(9.0, 13.0, 9)], axis=1)
    (box,) = form_objects(face_of(points_m), [], ObjectParams())
    step = np.diff(points_m, axis=0)
    naive_rad = float(np.arctan(step[:, 1] / step[:, 0]).mean())
    quarter = 0.5 * math.pi
    errors(naive=abs(abs(naive_rad) - quarter), ours=abs(abs(box.yaw_rad) - quarter))


@pytest.mark.hard("models.perception.mirrors.recovered_objects", "E[p p'] - E[p] E[p]'", 0.0, "boxes",
                  "scatter is no less than nothing, errors are more")  # fmt: skip
def test_covariance_of_a_face_without_depth(errors: Errors) -> None:
    """50 faces of exactly collinear points 100 m away: moments about the radar leave negative variances across them."""
    rng = np.random.default_rng(4)
    naive = ours = 0
    for _ in range(50):
        along = xy_from_polar(np.array(1.0), rng.uniform(-3.0, 3.0))
        points_m = rng.uniform(60.0, 80.0, 2) + rng.uniform(-2.0, 2.0, 12)[:, None] * along
        (box,) = form_objects(face_of(points_m), [], ObjectParams())
        mean = points_m.mean(axis=0)
        naive += not is_positive(points_m.T @ points_m / len(points_m) - np.outer(mean, mean))
        ours += not is_positive(np.array(box.cov_m2))
    errors(naive=naive, ours=ours)


def is_positive(covariance: np.ndarray) -> bool:
    """Whether a matrix has a Cholesky factor."""
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return False
    return True


@pytest.mark.hard("models.perception.mirrors.recovery", "(J C) J' in float32", 0.0, "peaks",
                  "J is invertible: J C J' is positive definite")  # fmt: skip
def test_covariance_of_far_peaks_with_fine_range(errors: Errors) -> None:
    """100 peaks at 100 m, 1 mm by 4 degrees: 5e7 between the variances, more than float32 holds off the axes."""
    rng = np.random.default_rng(5)
    range_m, azimuth_rad = rng.uniform(90.0, 109.0, 100), rng.uniform(-1.0, 1.0, 100)
    polar = np.tile(np.diag([0.001**2, math.radians(4.0) ** 2]), (100, 1, 1))
    ours = cartesian_covariance(range_m, azimuth_rad, polar)
    cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
    turn = np.stack([np.stack([cos, -range_m * sin], -1), np.stack([sin, range_m * cos], -1)], -2).astype(np.float32)
    naive = turn @ polar.astype(np.float32) @ turn.transpose(0, 2, 1)
    errors(
        naive=sum(not is_positive(one) for one in naive),
        ours=sum(not is_positive(one) for one in ours),
    )


@pytest.mark.hard("models.perception.mirrors.recovered_objects", "int64 sum over the number", 1.0, "ns",
                  "rounded towards the first stamp")  # fmt: skip
def test_stamp_of_an_object(errors: Errors) -> None:
    """Nine stamps of 1.7e18 ns add up to 1.5e19: int64 ends at 9.2e18."""
    points_m = np.stack([np.full(9, 15.0), np.linspace(9.0, 13.0, 9)], axis=1)
    face = face_of(points_m)
    (box,) = form_objects(face, [], ObjectParams())
    exact_ns = int(face.stamp_ns[0]) + 4
    errors(naive=abs(int(face.stamp_ns.sum()) // 9 - exact_ns), ours=abs(box.stamp_ns - exact_ns))
