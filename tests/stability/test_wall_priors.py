"""Hard cases of walls known from elsewhere: nearly the same, contradictory, by the thousand, through the radar."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.track.wall_fusion import MAX_WALLS, PlacedPrior, ScanReturns, fused
from models.perception.track.wall_lines import WallLine
from models.perception.track.wall_priors import WallPriorStore
from msgs.values.environment import MAX_PRIOR_WALLS, PriorWall, WallPriors
from msgs.values.frames import Pose2
from msgs.values.perception import Wall
from tests.stability.catalogue import Errors

NOTHING = ScanReturns(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64))
STDS = {"offset_std_m": 0.1, "angle_std_rad": 0.01}
FACADE = WallLine.between(np.array([[20.0, -5.0], [20.0, 5.0]]), **STDS).as_wall(8)


def walls_of(priors: list[PlacedPrior], walls: list[Wall]) -> list[Wall]:
    return fused(priors, NOTHING, walls)[0]


@pytest.mark.hard("models.perception.track.wall_lines.WallLine.corrected", "inverse of the sum of inverse covariances",
                  1e-9, "", "rounding, 2e-16 of numbers of order 1")  # fmt: skip
def test_a_prior_as_certain_as_it_may_be_and_one_as_vague(errors: Errors) -> None:
    """0.1 mm and 1e-5 rad on a wall known to 100 m and pi: the covariance stays that of the sharper one."""
    vague = WallLine.between(np.array([[20.0, -1000.0], [20.0, 1000.0]]), 100.0, math.pi)
    sharp = WallLine.between(np.array([[20.0, 900.0], [20.0, 900.1]]), 1e-3, 1e-4)
    off, noise = sharp.seen_at(vague)
    both = vague.corrected(np.eye(2), off, noise).reaching(sharp.ends_m)
    assert np.linalg.eigvalsh(both.covariance).min() > 0.0
    with np.errstate(all="ignore"):
        # in the frame of the vague one the sharp one's covariance is nearly singular
        naive = np.linalg.inv(np.linalg.inv(vague.covariance.astype("f4")) + np.linalg.inv(noise.astype("f4")))
    move = np.array([[1.0, float(vague.along_m(sharp.middle_m))], [0.0, 1.0]])
    naive = move @ naive @ move.T
    errors(
        naive=abs(naive[0, 0] / sharp.covariance[0, 0] - 1.0),
        ours=abs(both.covariance[0, 0] / sharp.covariance[0, 0] - 1.0),
    )


def test_eight_sources_full_of_random_walls() -> None:
    """2,048 priors, most of them wrong: finite walls, no more than a scan takes, and the measured ones first."""
    rng = np.random.default_rng(0)
    priors = []
    for number in range(8 * MAX_PRIOR_WALLS):
        middle_m, angle_rad, half_m = rng.uniform(-80.0, 80.0, 2), rng.uniform(0.0, math.pi), rng.uniform(0.1, 30.0)
        ends_m = middle_m + half_m * np.array([[-1.0], [1.0]]) * [math.cos(angle_rad), math.sin(angle_rad)]
        priors.append(PlacedPrior(f"map {number % 8}", WallLine.between(ends_m, **STDS)))
    walls = walls_of(priors, [FACADE])
    assert len(walls) <= 1 + MAX_WALLS
    # what else agrees with the facade may have corrected it, within the errors of both
    assert abs(walls[0].offset_m - FACADE.offset_m) < 1.0
    assert all(
        np.isfinite([*wall.ends_m[0], *wall.ends_m[1], wall.offset_std_m, wall.angle_std_rad]).all() for wall in walls
    )


@pytest.mark.parametrize("stamp_ns", [1, 1 << 62])
def test_stamps_at_the_ends_of_time(stamp_ns: int) -> None:
    """Messages of other clocks are neither used nor in the way of those that are."""
    wall = PriorWall(ends_m=((20.0, 1.0), (20.0, 9.0)), **STDS, end_std_m=0.1)
    store = WallPriorStore()
    for ns in (stamp_ns, 0, stamp_ns):
        store.add(WallPriors(stamp_ns=ns, source="map", walls=(wall,)))
    assert len(store.at(0, lambda ns: None, Pose2())) == 1
    assert store.at(1 << 61, lambda ns: None, Pose2()) == []


def test_walls_at_the_limit_of_their_distance() -> None:
    """Ends 10 km off in a frame far from its origin: refused by no stage, used by no scan."""
    wall = PriorWall(ends_m=((1e4, 1e4), (1e4, 9e3)), **STDS, end_std_m=0.1)
    store = WallPriorStore()
    store.add(WallPriors(stamp_ns=0, source="map", walls=(wall,)))
    placed = store.at(0, lambda ns: None, Pose2(1e3, -1e3, 3.0))
    assert len(placed) == 1
    assert walls_of(placed, [FACADE]) == [FACADE]
