"""Walls that mirror by what they show of the returns before them."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.mirrors.image_walls import DirectReturns
from models.perception.mirrors.mirror_table import NO_WALL
from models.perception.target_lists.mirror_evidence import shows_what_is_before
from models.physics.mirror import wall_from_ends
from msgs.values.perception import Wall
from tests.models.perception.target_lists.street import FACADE_Y_M, images

A, B = (4.0, FACADE_Y_M), (44.0, FACADE_Y_M)


def facade() -> Wall:
    normal, offset_m = wall_from_ends(np.array(A), np.array(B), np.zeros(2))
    return Wall(normal=(float(normal[0]), float(normal[1])), offset_m=offset_m, ends_m=(A, B), inliers=9)


def returns(count: int) -> DirectReturns:
    rng = np.random.default_rng(3)
    points_m = np.stack([rng.uniform(8.0, 40.0, count), rng.uniform(-8.0, 10.0, count)], axis=1)
    return DirectReturns(points_m, np.full(count, 20.0), np.zeros(count, int), np.full(count, NO_WALL))


@pytest.mark.parametrize(("shown", "expected"), [(0, False), (3, False), (15, True), (60, True)])
def test_a_mirror_repeats_what_is_before_it(shown: int, expected: bool) -> None:
    """Of 60 returns so many have an image; 40 returns behind the wall lie anywhere."""
    rng = np.random.default_rng(4)
    clutter_m = np.stack([rng.uniform(8.0, 40.0, 40), rng.uniform(-40.0, -14.0, 40)], axis=1)
    direct = returns(60)
    seen_m = np.concatenate([images(direct.points_m[:shown]), clutter_m])
    assert shows_what_is_before([facade()], direct, seen_m, 100.0).tolist() == [expected]


def test_too_few_places_say_nothing() -> None:
    direct, far_m = returns(4), np.array([[20.0, -30.0]])
    assert shows_what_is_before([facade()], direct, far_m, 100.0).tolist() == [True]
    assert shows_what_is_before([facade()], returns(60), np.zeros((0, 2)), 100.0).tolist() == [True]
    assert shows_what_is_before([], returns(60), far_m, 100.0).tolist() == []
