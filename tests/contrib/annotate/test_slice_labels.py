"""Labels of a slice drawn by hand: what is in sight, what only a wall shows, and where it appears."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contrib.annotate.slice_labels import (
    Disc,
    PointLabel,
    SliceParams,
    WallRules,
    convex_hull,
    cut_slice,
    label_slice,
    thinned,
)

GROUND_M = -1.0
SLICE, RULES = SliceParams(), WallRules()


def upright(a: tuple[float, float], b: tuple[float, float], height_m: float, seed: int) -> np.ndarray:
    """Points [N, 3] every 5 cm or so on an upright face over the ground, 1 cm of noise."""
    rng = np.random.default_rng(seed)
    length_m = float(np.hypot(b[0] - a[0], b[1] - a[1]))
    share = rng.uniform(0.0, 1.0, int(300 * length_m * height_m / 4.0))
    plan = np.array(a) + share[:, None] * (np.array(b) - np.array(a)) + rng.normal(0.0, 0.01, (len(share), 2))
    return np.column_stack([plan, GROUND_M + rng.uniform(0.0, height_m, len(share))])


def corner_cloud() -> np.ndarray:
    """A wall across the lane at x = 20, a house at the left whose side runs along y = 4 to x = 10 and then away, and
    behind it two sides of a car, one facing the wall at x = 14, one at y = 8."""
    return np.concatenate(
        [
            upright((20.0, -8.0), (20.0, 16.0), 5.0, 0),
            upright((1.0, 4.0), (10.0, 4.0), 5.0, 1),
            upright((10.0, 4.0), (10.0, 16.0), 5.0, 2),
            upright((14.0, 8.0), (14.0, 10.0), 1.5, 3),
            upright((14.0, 8.0), (12.0, 8.0), 1.5, 4),
        ]
    )


def test_a_car_behind_the_corner_is_hidden_and_its_image_stands_behind_the_wall() -> None:
    """Analytic: the wall x = 20 shows (14, y) at (26, y). Rays to the car at (14, 8..10) pass x = 10 at y = 5.7..7.1,
    in the house, whose corner is (10, 4); rays to its image at (26, 8..10) pass there at y = 3.1..3.8: all of it is
    hidden and all of it is shown. Tolerance: 1 cm of noise, thinned."""
    labels = label_slice(corner_cloud(), GROUND_M, SLICE, RULES)
    assert len(labels.walls_m) == 3
    hidden_m = labels.hidden_m
    assert len(hidden_m) > 8
    assert (labels.label != PointLabel.LOS).all()
    side = labels.points_m[labels.image_point][:, 0] > 13.9
    assert np.abs(labels.image_m[side, 0] - 26.0).max() < 0.03
    assert labels.image_m[:, 1] == pytest.approx(labels.points_m[labels.image_point, 1], abs=1e-2)
    assert len(np.unique(labels.image_point)) == len(hidden_m)


def test_walls_come_back_with_their_corners_closed() -> None:
    """Ends to 0.25 m (a square of the spacing), the shared corner (10, 4) to 3 cm: no slit to look through."""
    walls_m = label_slice(corner_cloud(), GROUND_M, SLICE, RULES).walls_m
    ends = walls_m.reshape(-1, 2)
    for wanted in ((20.0, -8.0), (20.0, 16.0), (1.0, 4.0), (10.0, 16.0)):
        assert np.linalg.norm(ends - wanted, axis=1).min() < 0.25
    at_corner = np.sort(np.linalg.norm(ends - (10.0, 4.0), axis=1))
    assert (at_corner[:2] < 0.03).all()


def test_a_wall_is_visible_only_where_nothing_stands_before_it() -> None:
    """The house hides the wall from the ray through its corner on: y > 8 at x = 20."""
    labels = label_slice(corner_cloud(), GROUND_M, SLICE, RULES)
    across = np.abs(labels.points_m[:, 0] - 20.0) < 0.2
    assert labels.visible[across & (labels.points_m[:, 1] < 7.7)].all()
    assert not labels.visible[across & (labels.points_m[:, 1] > 8.3)].any()


def test_an_object_in_the_way_takes_the_image() -> None:
    """A van across the only way between the wall and the car: nothing of what is behind it is shown."""
    in_the_way = np.concatenate([upright((16.0, 2.0), (16.0, 7.0), 1.8, 5), upright((16.5, 2.0), (16.5, 7.0), 1.8, 6)])
    cloud = np.concatenate([corner_cloud(), in_the_way])
    labels = label_slice(cloud, GROUND_M, SLICE, RULES)
    of_car = np.abs(labels.points_m[labels.image_point, 0] - 14.0) < 0.1
    assert not of_car.any()


def test_a_direct_sight_of_an_object_is_los_and_its_far_side_hidden() -> None:
    """A box 10 m ahead: its near face is LOS, its far face is hidden by its own hull."""
    box = np.concatenate([upright((10.0, -1.0), (10.0, 1.0), 1.5, 0), upright((12.0, -0.8), (12.0, 0.8), 1.5, 1)])
    sides = np.concatenate([upright((10.0, -1.0), (12.0, -1.0), 1.5, 2), upright((10.0, 1.0), (12.0, 1.0), 1.5, 3)])
    labels = label_slice(np.concatenate([box, sides]), GROUND_M, SLICE, RULES)
    near, far = labels.points_m[:, 0] < 10.1, labels.points_m[:, 0] > 11.9
    assert labels.visible[near].all()
    assert not labels.visible[far].any()
    assert len(labels.walls_m) == len(labels.image_m) == 0


def test_a_low_straight_side_is_an_object_and_rules_overrule() -> None:
    """8 m of side, 1.5 m high: no wall. 3 m high: a wall, unless it is said to be an object. Given walls are taken."""
    low, tall = upright((10.0, -4.0), (10.0, 4.0), 1.5, 0), upright((10.0, -4.0), (10.0, 4.0), 3.0, 0)
    truck = msgspec.structs.replace(RULES, objects=(Disc(x_m=10.0, y_m=0.0, radius_m=6.0),))
    given = msgspec.structs.replace(RULES, given_m=(((10.0, -4.0), (10.0, 4.0)),))
    counts = [
        len(label_slice(cloud, GROUND_M, SLICE, rules).walls_m)
        for cloud, rules in ((low, RULES), (tall, RULES), (tall, truck), (low, given))
    ]
    assert counts == [0, 1, 0, 1]


def test_stray_points_are_left_out_and_counted() -> None:
    """Dust in the air: 40 lone points over a square of 40 m, among them hardly any with three others near."""
    rng = np.random.default_rng(3)
    dust = np.column_stack([rng.uniform(-20.0, 20.0, (40, 2)), rng.uniform(-0.1, 0.1, 40)])
    clean = label_slice(corner_cloud(), GROUND_M, SLICE, RULES)
    dusty = label_slice(np.concatenate([corner_cloud(), dust]), GROUND_M, SLICE, RULES)
    assert dusty.stray >= 30
    assert abs(len(dusty.points_m) - len(clean.points_m)) <= 5


def test_same_seed_same_labels() -> None:
    first, again = (label_slice(corner_cloud(), GROUND_M, SLICE, RULES, seed=4) for _ in range(2))
    assert first.points_m.tobytes() == again.points_m.tobytes()
    assert first.image_m.tobytes() == again.image_m.tobytes()


def test_slice_and_thinning() -> None:
    """Points at the antenna's height only; a square's points become their mean."""
    cloud = np.array([[1.0, 1.0, 0.0], [1.1, 1.1, 0.1], [1.05, 1.0, 0.0], [1.0, 1.1, 0.0], [1.0, 1.0, 0.5]])
    plan_m, stray = cut_slice(cloud, SLICE)
    assert stray == 0
    assert plan_m == pytest.approx(cloud[:4, :2].mean(axis=0)[None])
    assert thinned(np.array([[0.01, 0.01], [0.19, 0.01], [0.21, 0.01]]), 0.2) == pytest.approx(
        np.array([[0.1, 0.01], [0.21, 0.01]])
    )


def test_a_cloud_that_misses_the_slice_is_refused() -> None:
    with pytest.raises(ValueError, match=r"within 0\.15 m of the radar's height, has none"):
        cut_slice(np.array([[1.0, 1.0, 2.0]]), SLICE)
    with pytest.raises(ValueError, match="all 1 are stray"):
        cut_slice(np.array([[1.0, 1.0, 0.0]]), SLICE)


def test_hulls() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [1.0, 1.0], [1.0, 0.0]])
    assert sorted(convex_hull(square).tolist()) == [[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]]
    assert convex_hull(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])).tolist() == [[0.0, 0.0], [2.0, 2.0]]
