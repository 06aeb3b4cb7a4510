"""Rules by which a folded position is explained by what is seen directly, each alone, at its limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from models.perception.mirrors.image_walls import DirectReturns, RecoveryParams
from models.perception.mirrors.mirror_table import NO_WALL
from models.perception.mirrors.recovery import Recovered
from models.perception.mirrors.rejection import hidden_mask, in_open_view, in_plain_sight
from msgs.values.perception import Wall

#: Ends at (10, 4) and (16, 4), the radar's side below it.
WALL = Wall(normal=(0.0, -1.0), offset_m=4.0, ends_m=((10.0, 4.0), (16.0, 4.0)), inliers=9)


def recovered(*points_m: tuple[float, float], snr_db: float = 20.0, score: float = 0.5, speed_mps: float = math.nan):  # type: ignore[no-untyped-def]
    """Positions with an error of 0.3 m in the worst direction: 0.18 m of the image and 0.24 m of the wall."""
    count = len(points_m)
    return Recovered(
        points_m=np.array(points_m),
        images_m=np.array(points_m),
        image_covariance_m2=np.tile(np.diag([0.01, 0.18**2]), (count, 1, 1)),
        wall_covariance_m2=np.tile(np.diag([0.0, 0.24**2]), (count, 1, 1)),
        wall=np.zeros(count, int),
        second=np.full(count, NO_WALL),
        score=np.full(count, score),
        snr_db=np.full(count, snr_db),
        stamp_ns=np.zeros(count, np.int64),
        radial_speed_mps=np.full(count, speed_mps),
    )


def returns(*points_m: tuple[float, float], snr_db: float = 20.0, speed_mps: float | None = None) -> DirectReturns:
    none = np.full(len(points_m), NO_WALL)
    speeds = None if speed_mps is None else np.full(len(points_m), speed_mps)
    return DirectReturns(np.array(points_m).reshape(-1, 2), np.full(len(points_m), snr_db), none, none, speeds)


def mask(found: Recovered, seen: DirectReturns, walls: tuple[Wall, ...] = (WALL,), **params: Any) -> list[bool]:
    return hidden_mask(found, list(walls), seen, RecoveryParams(**params)).tolist()


def test_a_position_without_a_score_is_no_objects() -> None:
    assert mask(recovered((5.0, 5.0), score=0.0), returns()) == [False]
    assert mask(recovered((5.0, 5.0), score=0.01), returns()) == [True]


@pytest.mark.parametrize(("sigmas", "reach_m"), [(0.0, 1.0), (2.0, 1.6)])
def test_reach_of_a_wall_is_a_metre_and_so_many_deviations(sigmas: float, reach_m: float) -> None:
    """Above the wall's middle, and beyond its end, at a centimetre less and more than the reach."""
    points_m = [(13.0, 4.0 + reach_m + off) for off in (-0.01, 0.01)] + [
        (16.0 + reach_m + off, 4.0) for off in (-0.01, 0.01)
    ]
    found = recovered(*points_m)
    assert mask(found, returns(), same_place_sigmas=sigmas) == [False, True, False, True]


@pytest.mark.parametrize(
    ("distance_m", "return_db", "hidden"),
    [(0.99, 20.0, False), (1.01, 20.0, True), (0.5, 14.01, False), (0.5, 13.99, True)],
)
def test_a_return_of_like_strength_at_the_place_explains_it(distance_m: float, return_db: float, hidden: bool) -> None:
    """Within a metre and at most 6 dB weaker than the image of 20 dB."""
    seen = returns((30.0, 0.0), (8.0, 1.0), snr_db=return_db)
    assert mask(recovered((8.0, 1.0 + distance_m)), seen) == [hidden]


@pytest.mark.parametrize(
    ("image_mps", "return_mps", "hidden"),
    [(3.0, 0.1, True), (0.1, -3.0, True), (3.0, -4.0, False), (0.1, 0.2, False), (math.nan, 3.0, False)],
)
def test_what_moves_does_not_explain_what_stands(image_mps: float, return_mps: float, hidden: bool) -> None:
    """At 0.5 m/s; of two that move, and of an unknown speed, nothing is told apart."""
    seen = returns((8.0, 1.0), speed_mps=return_mps)
    found = recovered((8.0, 1.0), speed_mps=image_mps)
    assert mask(found, seen, moving_mps=0.5) == [hidden]
    assert mask(found, seen) == [False]


def test_a_wall_hides_what_lies_behind_it_and_two_and_a_half_metres_more() -> None:
    """The wall's end at (16, 4), lengthened to (18.5, 4) along it: a ray through x = 18.4 is blocked, 18.6 is not."""
    points_m = np.array(
        [[26.0, 8.0], [13.0, 3.9], [2.0 * 18.4, 8.0], [2.0 * 18.6, 8.0], [2.0 * 7.6, 8.0], [2.0 * 7.4, 8.0]]
    )
    assert in_open_view(points_m, [WALL], 2.5).tolist() == [False, True, False, True, False, True]
    assert in_open_view(points_m, [WALL], 0.0).tolist() == [False, True, True, True, True, True]
    shown = mask(recovered(*map(tuple, points_m.tolist())), returns(), reject_in_open_view=True)
    assert shown == [True, False, True, False, True, False]


def test_a_vehicle_in_sight_hides_what_is_more_than_a_metre_behind_it() -> None:
    """Returns at (10, -1) and (10, 1): behind it within their angles from a range of sqrt(101) + 1 m on. An image
    10 dB stronger is no other side of the vehicle.
    """
    front_m = math.hypot(10.0, 1.0)
    found = recovered((front_m + 0.9, 0.0), (front_m + 1.1, 0.0), (12.0, 2.0), snr_db=30.0)
    seen = returns((10.0, -1.0), (10.0, 1.0))
    assert mask(found, seen, (), reject_in_open_view=True) == [False, True, False]


@pytest.mark.parametrize(
    ("x_m", "snr_db", "hidden"), [(15.0, 20.0, False), (15.9, 20.0, True), (15.0, 26.1, True), (15.0, 25.9, False)]
)
def test_another_side_of_a_visible_vehicle_fits_in_its_box(x_m: float, snr_db: float, hidden: bool) -> None:
    """Returns of its rear at x = 10, 2 m wide: what lies within 5.5 m and the image's own error (0.18 m) is its side,
    unless it is over 6 dB stronger.
    """
    seen = returns((10.0, -1.0), (10.0, 1.0))
    assert mask(recovered((x_m, 0.0), snr_db=snr_db), seen, ()) == [hidden]


@pytest.mark.parametrize(
    ("seen_m", "is_seen"),
    [
        # 12 m straight ahead of a point at 10 m; not 2 m farther; 4.1 degrees beside it; nothing at all
        ([(12.1, 0.0)], True),
        ([(11.9, 0.0)], False),
        ([(12.1, 12.1 * math.tan(math.radians(4.1)))], False),
        ([], False),
        # something stands before it, or just beside the way
        ([(12.1, 0.0), (9.4, 0.0)], False),
        ([(12.1, 0.0), (9.6, 0.0)], True),
        ([(12.1, 0.0), (5.0, 5.0 * math.tan(math.radians(7.9)))], False),
        ([(12.1, 0.0), (5.0, 5.0 * math.tan(math.radians(8.1)))], True),
    ],
)
def test_a_point_that_the_radar_looks_past_is_in_plain_sight(seen_m: list[tuple[float, float]], is_seen: bool) -> None:
    assert in_plain_sight(np.array([(10.0, 0.0)]), [], returns(*seen_m)).tolist() == [is_seen]


def test_nothing_behind_a_wall_is_in_plain_sight() -> None:
    """Returns past it are images, or come over the wall."""
    hidden, beside = (13.0, 6.0), (13.0, -6.0)
    seen = returns(*(tuple(1.5 * np.array(point)) for point in (hidden, beside)))
    assert in_plain_sight(np.array([hidden, beside]), [WALL], seen).tolist() == [False, True]
    assert in_plain_sight(np.zeros((0, 2)), [WALL], seen).tolist() == []
