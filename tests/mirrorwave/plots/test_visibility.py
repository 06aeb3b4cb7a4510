"""Sight past true walls, against areas and crossings worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from matplotlib.path import Path as Outline

from mirrorwave.plots.visibility import direct_sight, mirror_sight, true_segments
from msgs.values.perception import TruthSurface, Wall
from tests.builders import example_truth

#: A wall across the way, 10 m ahead, 5 m to either side: its ends stand at atan(1/2) = 26.57 degrees.
ACROSS = (np.array([[10.0, -5.0]]), np.array([[10.0, 5.0]]))
LIMIT_RAD = math.radians(60.0)
NOTHING = (np.zeros((0, 2)), np.zeros((0, 2)))


@pytest.mark.parametrize(
    ("point", "seen"),
    [
        ((9.9, 0.0), True),
        ((10.1, 0.0), False),
        ((30.0, 0.0), False),
        # 26.3 and 26.8 degrees: just in and just out of the wall's shadow
        ((20.0, 9.88), False),
        ((20.0, 10.12), True),
        ((20.0, -9.88), False),
        # 59 and 61 degrees: the end of the field of view
        ((10.0, 16.6), True),
        ((10.0, 18.1), False),
        # 39 and 41 m
        ((33.8, 19.5), True),
        ((35.5, 20.5), False),
    ],
)
def test_direct_sight_ends_at_the_wall(point: tuple[float, float], seen: bool) -> None:
    polygon = direct_sight(*ACROSS, 40.0, LIMIT_RAD)
    assert Outline(polygon).contains_point(point) is seen


def area_m2(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return float(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def test_direct_sight_has_the_area_of_its_sectors_and_triangle() -> None:
    """Two sectors of 60 - 26.57 degrees and the triangle before the wall; chords of 0.25 degrees lack 3e-6 of it."""
    sectors = 40.0**2 * (LIMIT_RAD - math.atan(0.5))
    assert area_m2(direct_sight(*ACROSS, 40.0, LIMIT_RAD)) == pytest.approx(sectors + 50.0, rel=2e-5)
    assert area_m2(direct_sight(*NOTHING, 40.0, LIMIT_RAD)) == pytest.approx(40.0**2 * LIMIT_RAD, rel=2e-5)


def test_two_walls_that_share_a_corner_leave_no_gap() -> None:
    corner = (np.array([[10.0, -5.0], [10.0, 1.0]]), np.array([[10.0, 1.0], [4.0, 9.0]]))
    polygon = direct_sight(*corner, 40.0, LIMIT_RAD)
    assert np.hypot(*polygon[np.abs(np.arctan2(polygon[:, 1], polygon[:, 0])) < 0.4].T).max() < 12.0


def mirror(x_m: float = 20.0) -> Wall:
    return Wall(normal=(-1.0, 0.0), offset_m=x_m, ends_m=((x_m, -10.0), (x_m, 10.0)), inliers=9)


@pytest.mark.parametrize(
    ("blocker", "seen"),
    [
        # the image of (10, 10) in x = 20 is (30, 10): the mirror is met at (20, 6.67), the way out passes (12, 4)
        (((12.0, 5.0), (12.0, 9.0)), True),
        (((12.0, 3.0), (12.0, 5.0)), False),
        # the way back passes (12, 9.33)
        (((12.0, 9.0), (12.0, 9.8)), False),
        # the mirror's own true wall, half a metre nearer than it was fitted
        (((19.5, -10.0), (19.5, 10.0)), True),
    ],
)
def test_a_mirror_shows_what_no_true_wall_hides(blocker: tuple[tuple[float, float], ...], seen: bool) -> None:
    a, b = np.array(blocker)[:, None]
    point = np.array([[10.0, 10.0]])
    assert mirror_sight(point, (mirror(),), a, b).tolist() == [seen]
    # where one mirror is blocked another may show it: x = 30 meets the way at (30, 6), past (12, 2.4) and (12, 9.6)
    assert mirror_sight(point, (mirror(), mirror(30.0)), a, b).tolist() == [blocker != ((12.0, 9.0), (12.0, 9.8))]


def test_a_mirror_shows_nothing_beyond_its_ends_or_behind_it() -> None:
    points = np.array([[10.0, 40.0], [25.0, 0.0]])
    assert mirror_sight(points, (mirror(),), *NOTHING).tolist() == [False, False]


def test_segments_of_polylines() -> None:
    surfaces = (
        TruthSurface(role="relay", material="brick", polyline_m=((1.0, 2.0), (3.0, 4.0), (5.0, 6.0))),
        TruthSurface(role="occluder", material="glass", polyline_m=((7.0, 8.0), (9.0, 10.0))),
    )
    empty = np.zeros((0, 3), np.float32)
    truth = example_truth(los_points_m=empty, mirrored_points_m=empty, hidden_points_m=empty, surfaces=surfaces)
    a, b = true_segments(truth)
    assert a.tolist() == [[1.0, 2.0], [3.0, 4.0], [7.0, 8.0]]
    assert b.tolist() == [[3.0, 4.0], [5.0, 6.0], [9.0, 10.0]]
