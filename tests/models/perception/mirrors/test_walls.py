from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.clustering import dbscan
from models.perception.mirrors.lines import fit_line
from models.perception.mirrors.recovery import cartesian_covariance
from models.perception.mirrors.walls import WallParams, find_walls
from msgs.values.frames import polar_from_xy, xy_from_polar
from msgs.values.perception import Wall

RANGE_STD_M, AZIMUTH_STD_RAD = 0.1, math.radians(1.5)


def polar_errors(points: np.ndarray) -> np.ndarray:
    range_m, azimuth_rad = polar_from_xy(points)
    polar = np.broadcast_to(np.diag([RANGE_STD_M**2, AZIMUTH_STD_RAD**2]), (len(points), 2, 2))
    return cartesian_covariance(range_m, azimuth_rad, polar)


def measured(points: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    range_m, azimuth_rad = polar_from_xy(points)
    return xy_from_polar(
        range_m + rng.normal(0.0, RANGE_STD_M, len(points)), azimuth_rad + rng.normal(0.0, AZIMUTH_STD_RAD, len(points))
    )


def line(a: tuple[float, float], b: tuple[float, float], count: int) -> np.ndarray:
    return np.array(a) + np.linspace(0.0, 1.0, count)[:, None] * (np.array(b) - np.array(a))


def walls_of(points: np.ndarray, params: WallParams | None = None) -> list[Wall]:
    return find_walls(points, polar_errors(points), dbscan(points, 4.0, 2), params or WallParams())[0]


def angle_error_rad(wall: Wall, a: tuple[float, float], b: tuple[float, float]) -> float:
    along = (np.array(b) - np.array(a)) / math.dist(a, b)
    return abs(math.asin(float(along @ np.array(wall.normal))))


@pytest.mark.parametrize(
    ("a", "b"), [((20.0, -8.0), (20.0, 8.0)), ((6.0, -7.0), (30.0, -7.0)), ((10.0, 4.0), (18.0, -6.0))]
)
def test_clean_wall_is_exact(a, b):
    points = line(a, b, 15)
    (wall,) = walls_of(points)
    assert wall.inliers == 15
    assert angle_error_rad(wall, a, b) < 1e-6
    assert wall.offset_m == pytest.approx(abs(np.cross([*a, 0.0], [*b, 0.0])[2]) / math.dist(a, b), abs=1e-6)
    assert wall.offset_m > 0.0, "the normal points towards the radar at the origin"
    found = sorted(wall.ends_m)
    for end, true_end in zip(found, sorted([a, b]), strict=True):
        assert end == pytest.approx(true_end, abs=1e-6)


def test_stated_uncertainty_is_that_of_repeated_fits():
    """A faced wall of 16 points, polar errors: 300 fits. The scatter of the angle has a relative error of
    1 / sqrt(2 * 300) = 4 %, the flatness term and the gate on inliers make the statement cautious: 0.7 .. 1.15."""
    truth = line((20.0, -8.0), (20.0, 8.0), 16)
    angles, stated = [], []
    for seed in range(300):
        points = measured(truth, seed)
        normal, _, angle_std_rad, _ = fit_line(points, polar_errors(points) + 0.08**2 * np.eye(2))
        angles.append(math.asin(normal[1]))
        stated.append(angle_std_rad)
    assert 0.7 < np.std(angles) / np.mean(stated) < 1.15


def test_polar_model_beats_the_euclidean_one_on_an_oblique_wall():
    """A street wall 7 m aside: cross-range errors grow to 1 m at its far end, where a fixed 0.3 m gate is blind."""
    a, b = (6.0, -7.0), (36.0, -7.0)
    errors: dict[str, list[float]] = {"polar": [], "euclidean": []}
    for seed in range(40):
        points = measured(line(a, b, 30), seed)
        for model in errors:
            found = walls_of(points, WallParams(error_model=model, rounds=200))
            wall = max(found, key=lambda one: one.inliers, default=None)
            errors[model].append(math.pi / 2 if wall is None else angle_error_rad(wall, a, b))
    assert np.median(errors["polar"]) < 0.8 * np.median(errors["euclidean"])
    assert np.median(errors["polar"]) < math.radians(1.0)


def test_corner_gives_two_walls():
    points = np.concatenate([line((20.0, -8.0), (20.0, 6.0), 15), line((10.0, 6.0), (19.0, 6.0), 10)])
    walls = walls_of(points)
    assert len(walls) == 2
    assert abs(np.dot(walls[0].normal, walls[1].normal)) < 1e-6


def test_parallel_walls_in_one_cluster_stay_two():
    points = np.concatenate([line((8.0, -2.0), (24.0, -2.0), 17), line((8.0, -5.0), (24.0, -5.0), 17)])
    labels = np.zeros(len(points), np.int64)
    walls, _ = find_walls(points, polar_errors(points), labels, WallParams())
    assert sorted(round(wall.offset_m, 3) for wall in walls) == [2.0, 5.0]


def test_gap_splits_and_small_gap_does_not():
    whole = np.concatenate([line((20.0, -10.0), (20.0, -4.0), 7), line((20.0, 1.0), (20.0, 7.0), 7)])
    split = np.concatenate([line((20.0, -12.0), (20.0, -6.0), 7), line((20.0, 4.0), (20.0, 10.0), 7)])
    assert len(walls_of(whole)) == 1
    assert len(walls_of(split)) == 2


def test_a_lone_flash_continues_its_wall():
    """The foot of the perpendicular, 6 m off the rest and so in no cluster, still lengthens and steadies the wall."""
    rest = line((20.0, 6.0), (20.0, 12.0), 7)
    (alone,) = walls_of(rest)
    (both,) = walls_of(np.vstack([rest, [20.0, 0.0]]))
    assert both.inliers == 8
    assert both.angle_std_rad < 0.7 * alone.angle_std_rad


def test_wall_behind_a_wall_is_no_mirror():
    front, back = line((15.0, -8.0), (15.0, 8.0), 17), line((22.0, -3.0), (22.0, 3.0), 7)
    (wall,) = walls_of(np.concatenate([front, back]))
    assert wall.offset_m == pytest.approx(15.0)
    kept = walls_of(np.concatenate([front, back]), WallParams(behind_walls=True))
    assert [item.offset_m for item in kept] == pytest.approx([15.0, 22.0])


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_too_few_points_make_no_wall(count):
    assert walls_of(line((20.0, 0.0), (20.0, 3.0), 4)[:count]) == []


def test_equal_points_make_no_wall():
    assert walls_of(np.tile([[20.0, 3.0]], (12, 1))) == []


def test_scatter_makes_few_walls():
    """20 points over a sector of 45 m, far more than a scan's clutter: at most one false wall in four draws."""
    total = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        total += len(walls_of(xy_from_polar(rng.uniform(5, 45, 20), rng.uniform(-1.0, 1.0, 20))))
    assert total <= 5


def test_a_wall_among_four_times_as_much_scatter():
    """80 % outliers: the wall is found, within 2 degrees, in each of 20 draws."""
    a, b = (20.0, -9.0), (20.0, 9.0)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        scatter = xy_from_polar(rng.uniform(5, 45, 76), rng.uniform(-1.0, 1.0, 76))
        points = np.concatenate([measured(line(a, b, 19), seed), scatter])
        wall = walls_of(points)[0]
        assert angle_error_rad(wall, a, b) < math.radians(2.0)


def test_deterministic_and_independent_of_a_global_generator():
    points = measured(np.concatenate([line((20.0, -8.0), (20.0, 8.0), 30), line((8.0, 6.0), (18.0, 6.0), 30)]), 3)
    first = walls_of(points)
    np.random.default_rng(99).normal(size=5)
    assert walls_of(points) == first


def test_refuses_parameters_that_make_no_sense():
    with pytest.raises(ValueError, match="min_inliers"):
        WallParams(min_inliers=1)
    with pytest.raises(ValueError, match="max_gap_m"):
        WallParams(max_gap_m=0.0)


def test_a_wall_that_answers_at_few_spots() -> None:
    """A smooth facade 22 m ahead: its flash and four far-apart joints, 7.7 m and more between them: no cluster."""
    along = np.array([-10.2, -7.7, 0.0, 8.0, 9.2])
    points = np.stack([np.full(5, 22.0), along], axis=1)
    covariance = np.tile(np.diag([0.06**2, 0.3**2]), (5, 1, 1))
    labels = np.array([0, 0, -1, 1, 1])
    walls, wall_of_point = find_walls(points, covariance, labels, WallParams())
    assert len(walls) == 1
    assert wall_of_point.tolist() == [0] * 5
    assert walls[0].offset_m == pytest.approx(22.0, abs=0.05)
    assert find_walls(points, covariance, labels, WallParams(sparse_min_score=1e9))[0] == []
