"""Priors against the walls of a scan: agreement, contradiction, silence; the radar in the origin looks along x."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest

from models.perception.track.wall_fusion import (
    FLATNESS_M,
    MAX_WALLS,
    SCAN_OFFSET_STD_M,
    PlacedPrior,
    ScanReturns,
    fused,
)
from models.perception.track.wall_lines import WallLine
from msgs.values.perception import Wall

Ends = tuple[tuple[float, float], tuple[float, float]]


def prior(ends_m: Ends, source: str = "map", offset_std_m: float = 0.1, angle_std_rad: float = 0.01) -> PlacedPrior:
    return PlacedPrior(source, WallLine.between(np.array(ends_m), offset_std_m, angle_std_rad, 0.1))


def wall(ends_m: Ends, inliers: int = 8, offset_std_m: float = 0.1, angle_std_rad: float = 0.01) -> Wall:
    return WallLine.between(np.array(ends_m), offset_std_m, angle_std_rad).as_wall(inliers)


def returns(points_m: list[tuple[float, float]], numbers: list[int]) -> ScanReturns:
    points = np.array(points_m, np.float64).reshape(-1, 2)
    return ScanReturns(points, np.tile(0.05**2 * np.eye(2), (len(points), 1, 1)), np.array(numbers, np.int64))


NOTHING = returns([], [])
#: 10 m of facade ahead, as a scan measures it, with its returns.
FACADE = wall(((20.0, -5.0), (20.0, 5.0)))
ON_FACADE = [(20.0, float(y)) for y in range(-5, 6)]


def walls_of(priors: list[PlacedPrior], walls: list[Wall], seen: ScanReturns = NOTHING) -> list[Wall]:
    return fused(priors, seen, walls)[0]


def reach_m(wall: Wall) -> list[float]:
    """Ends along y, lower first."""
    return sorted(y for _, y in wall.ends_m)


def test_without_priors_nothing_changes() -> None:
    seen = returns(ON_FACADE, [0] * 11)
    walls = [FACADE]
    same, numbers = fused([], seen, walls)
    assert same is walls
    assert numbers is seen.wall


def test_a_prior_on_a_measured_wall_extends_it() -> None:
    """One wall of both, as long as both; a return beyond its measured end now lies on it."""
    seen = returns([*ON_FACADE, (20.02, 9.0), (16.0, 9.0)], [*[0] * 11, -1, -1])
    walls, numbers = fused([prior(((20.0, -2.0), (20.0, 14.0)))], seen, [FACADE])
    assert len(walls) == 1
    assert reach_m(walls[0]) == pytest.approx([-5.0, 14.0])
    assert numbers.tolist() == [*[0] * 12, -1]
    assert walls[0].inliers == FACADE.inliers + 1


def test_a_prior_on_a_measured_wall_is_weighed_by_the_errors_of_both() -> None:
    """0.2 m apart; the scan's 0.1 m with the 0.03 m that its returns share against 0.1 m of the map."""
    (both,) = walls_of([prior(((20.2, -5.0), (20.2, 5.0)))], [FACADE])
    measured = 0.1**2 + SCAN_OFFSET_STD_M**2
    assert both.offset_m == pytest.approx(20.0 + 0.2 * measured / (measured + 0.01))
    assert both.offset_std_m == pytest.approx(math.sqrt(measured * 0.01 / (measured + 0.01)), rel=1e-6)
    assert both.offset_std_m < FACADE.offset_std_m


def test_a_vague_prior_moves_a_measured_wall_by_nothing() -> None:
    """20 m against 0.1 m: by 0.2 m x 0.0109 / 400, whatever the prior's direction says."""
    (both,) = walls_of([prior(((20.2, -5.0), (20.2, 5.0)), offset_std_m=20.0, angle_std_rad=1.0)], [FACADE])
    assert both.offset_m == pytest.approx(20.0, abs=1e-5)


def test_one_prior_joins_two_parts_of_a_wall() -> None:
    """A scan sees both ends of a facade: with the map it is one, and the returns of both are its own."""
    parts = [wall(((20.0, -9.0), (20.0, -2.0)), 5), FACADE, wall(((20.0, 7.0), (20.0, 15.0)), 4)]
    beside = wall(((5.0, 12.0), (15.0, 12.0)), 3)
    seen = returns([(20.0, -5.0), (10.0, 12.0), (20.0, 3.0), (20.0, 9.0)], [0, 3, 1, 2])
    walls, numbers = fused([prior(((20.0, -9.0), (20.0, 15.0)))], seen, [*parts, beside])
    assert [item.inliers for item in walls] == [17, 3]
    assert reach_m(walls[0]) == pytest.approx([-9.0, 15.0])
    assert walls[1] is beside
    assert numbers.tolist() == [0, 1, 0, 0]


def test_where_the_scan_shows_nothing_the_prior_is_a_wall() -> None:
    """Behind the measured ones, with the errors that it states, and no returns."""
    walls = walls_of([prior(((5.0, 12.0), (15.0, 12.0)))], [FACADE])
    assert walls[0] is FACADE
    added = walls[1]
    assert (added.inliers, added.offset_m, added.offset_std_m) == (0, pytest.approx(12.0), pytest.approx(0.1))
    assert added.normal == pytest.approx((0.0, -1.0))


def test_single_returns_correct_a_prior_that_no_wall_was_fitted_to() -> None:
    """Two returns 0.1 m before a wall known to 0.2 m: it comes nearer, and its direction stays."""
    seen = returns([(7.0, 11.9), (13.0, 11.9)], [-1, -1])
    walls, numbers = fused([prior(((5.0, 12.0), (15.0, 12.0)), offset_std_m=0.2)], seen, [])
    noise = (0.05**2 + FLATNESS_M**2) / 2.0
    assert walls[0].offset_m == pytest.approx(12.0 - 0.1 * 0.04 / (0.04 + noise), abs=1e-6)
    assert (walls[0].inliers, numbers.tolist()) == (2, [0, 0])


@pytest.mark.parametrize(
    "ends_m",
    [
        pytest.param(((18.5, -4.0), (18.5, 9.0)), id="before it"),
        pytest.param(((21.5, -4.0), (21.5, 9.0)), id="behind it"),
        pytest.param(((15.0, -9.0), (25.0, 9.0)), id="at an angle to it"),
        pytest.param(((10.0, 1.0), (30.0, 1.0)), id="across it"),
    ],
)
def test_a_measured_wall_denies_a_prior_beside_or_across_it(ends_m: Ends) -> None:
    """1.5 m off, or through it: the scan stays as it is."""
    assert walls_of([prior(ends_m)], [FACADE]) == [FACADE]


def test_the_side_of_a_vehicle_denies_nothing() -> None:
    """5 m of a parked van before a facade that the map knows."""
    van = wall(((18.0, -2.5), (18.0, 2.5)))
    walls = walls_of([prior(((20.0, -15.0), (20.0, 15.0)))], [van])
    assert [item.inliers for item in walls] == [8, 0]


@pytest.mark.parametrize(("count", "walls"), [(2, 1), (3, 0)])
def test_returns_behind_a_prior_prove_that_it_is_no_wall(count: int, walls: int) -> None:
    """Direct returns 5 m behind it, none of them near the rays past its ends; two may be chance."""
    seen = returns([(25.0, float(y)) for y in range(count)], [-1] * count)
    assert len(walls_of([prior(((20.0, -5.0), (20.0, 5.0)))], [], seen)) == walls


def test_returns_past_the_end_of_a_prior_prove_nothing() -> None:
    """The map's end may be half a metre off: rays within a metre of it may pass."""
    seen = returns([(25.0, 5.8), (25.0, 5.9), (25.0, 6.0)], [-1] * 3)
    assert len(walls_of([prior(((20.0, -5.0), (20.0, 5.0)))], [], seen)) == 1


def test_a_prior_that_is_seen_through_beside_its_wall_extends_nothing() -> None:
    """The facade is there, the rest of the map's wall is not: it is corrected, and as long as measured."""
    seen = returns([*ON_FACADE, (30.0, 12.0), (30.0, 13.0), (30.0, 14.0)], [*[0] * 11, -1, -1, -1])
    walls, _ = fused([prior(((20.1, -5.0), (20.1, 14.0)))], seen, [FACADE])
    assert len(walls) == 1
    assert reach_m(walls[0]) == pytest.approx([-5.0, 5.0], abs=0.01)
    assert 20.0 < walls[0].offset_m < 20.1


def test_returns_behind_the_measured_part_of_a_prior_prove_nothing_about_the_rest() -> None:
    """What the scan itself took for a wall, though no longer than a vehicle, is extended all the same."""
    part = wall(((20.0, -2.5), (20.0, 2.5)))
    seen = returns([(30.0, -1.0), (30.0, 0.0), (30.0, 1.0)], [-1] * 3)
    walls, _ = fused([prior(((20.0, -10.0), (20.0, 10.0)))], seen, [part])
    assert [reach_m(item) for item in walls] == [pytest.approx([-10.0, 10.0])]


def test_ghosts_behind_a_measured_wall_prove_nothing() -> None:
    """What lies behind the facade is not seen directly, whatever its class: the prior behind it, in sight beside it,
    stays."""
    seen = returns([(30.0, -4.0), (30.0, -3.0), (30.0, -2.0)], [-1] * 3)
    assert len(walls_of([prior(((25.0, -6.0), (25.0, 20.0)))], [FACADE], seen)) == 2


def test_a_prior_hidden_behind_the_walls_of_the_scan_is_left_out() -> None:
    assert walls_of([prior(((30.0, -4.0), (30.0, 4.0)))], [FACADE]) == [FACADE]


@pytest.mark.parametrize(
    "ends_m",
    [
        pytest.param(((-20.0, -5.0), (-20.0, 5.0)), id="behind the radar"),
        pytest.param(((200.0, -5.0), (200.0, 5.0)), id="beyond its range"),
        pytest.param(((10.0, -1.0), (10.0, 1.0)), id="too short"),
        pytest.param(((0.1, 0.0), (20.0, 0.0)), id="through it"),
    ],
)
def test_a_prior_that_cannot_mirror_is_left_out(ends_m: Ends) -> None:
    assert walls_of([prior(ends_m)], []) == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_curved_wall_stands_for_the_chords_that_a_map_has_of_it(sign: float) -> None:
    """20 m of arc with a sagitta of 2.5 m, hollow towards the radar or away from it; a map's pieces lie on the arc."""
    arc = Wall(
        normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -10.0), (20.0, 10.0)), inliers=12, angle_std_rad=0.01,
        offset_std_m=0.1, curvature_per_m=sign * 0.05,
    )  # fmt: skip
    middle_m, side_m = 20.0 + 2.5 * sign, 20.0 + 1.6 * sign
    pieces = [prior(((middle_m, -3.0), (middle_m, 3.0))), prior(((middle_m, 3.0), (side_m, 6.0)))]
    assert walls_of(pieces, [arc]) == [arc]


def test_two_sources_that_agree_are_one_wall() -> None:
    """Known to half of the variance of each."""
    ends_m = ((5.0, 12.0), (15.0, 12.0))
    (both,) = walls_of([prior(ends_m, "map"), prior(ends_m, "lidar")], [])
    assert both.offset_std_m == pytest.approx(0.1 / math.sqrt(2.0))


def test_a_source_counts_once_a_wall() -> None:
    """Twice the same wall in one map is no second measurement of it."""
    ends_m = ((5.0, 12.0), (15.0, 12.0))
    (alone,) = walls_of([prior(ends_m)], [])
    (twice,) = walls_of([prior(ends_m)] * 2, [])
    assert twice == alone
    (measured,), (again,) = (walls_of([prior(((20.1, -5.0), (20.1, 5.0)))] * count, [FACADE]) for count in (1, 5))
    assert again == measured


def test_of_two_sources_that_contradict_each_other_the_more_certain_is_believed() -> None:
    """1 m apart, known to 0.05 m and 0.1 m."""
    sure = prior(((5.0, 13.0), (15.0, 13.0)), "lidar", offset_std_m=0.05)
    for priors in permutations([sure, prior(((5.0, 12.0), (15.0, 12.0)))]):
        (believed,) = walls_of(list(priors), [])
        assert believed.offset_m == pytest.approx(13.0)


def test_two_walls_of_one_map_stay_two() -> None:
    """A recess of a metre: their source knows them apart, whatever their errors."""
    near, far = prior(((5.0, 12.0), (15.0, 12.0)), offset_std_m=0.5), prior(((16.0, 13.0), (26.0, 13.0)))
    assert len(walls_of([near, far], [])) == 2


def test_the_order_of_priors_changes_nothing() -> None:
    priors = [
        prior(((20.1, 0.0), (20.1, 14.0))),
        prior(((5.0, 12.0), (15.0, 12.0)), "lidar"),
        prior(((5.0, 12.1), (18.0, 12.1))),
        prior(((5.0, -13.0), (15.0, -14.0)), "radar"),
    ]
    expected = walls_of(priors, [FACADE])
    assert len(expected) == 3
    for order in permutations(priors):
        assert walls_of(list(order), [FACADE]) == expected


def test_a_scan_takes_the_nearest_priors() -> None:
    """Walls side by side up the street, one of them more than a scan takes."""
    count = MAX_WALLS + 1
    priors = [prior(((10.0 + 3.5 * i, 8.0 + i), (10.0 + 3.5 * i, 12.0 + i))) for i in range(count)]
    believed = walls_of(priors, [])
    farthest_m = max(x for item in believed for x, _ in item.ends_m)
    assert len(believed) <= MAX_WALLS
    assert farthest_m < 10.0 + 3.5 * (count - 1)


@pytest.mark.parametrize(("behind_m", "walls"), [(1.25, 1), (1.35, 0), (-1.35, 1)])
def test_returns_prove_something_a_metre_and_three_deviations_behind_a_prior(behind_m: float, walls: int) -> None:
    """1 m and 3 x 0.1 m; those before it prove nothing."""
    seen = returns([(20.0 + behind_m, y) for y in (-2.0, 0.0, 2.0)], [-1] * 3)
    assert len(walls_of([prior(((20.0, -8.0), (20.0, 8.0)))], [], seen)) == walls
