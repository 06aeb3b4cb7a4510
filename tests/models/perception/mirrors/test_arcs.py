"""Arcs that replace lines: curvature, its sign, ends and errors of points on a circle; runs without a gap."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors import arcs
from models.perception.mirrors.arcs import _across, _unbroken, with_arcs
from models.perception.mirrors.lines import LineFit, fit_line

STD_M = 0.05


def line_through(points_m: np.ndarray, covariance_m2: np.ndarray, members: np.ndarray, score: float) -> LineFit:
    normal, offset_m, angle_std_rad, offset_std_m = fit_line(points_m[members], covariance_m2[members])
    ends_m = points_m[members[[0, -1]]]
    return LineFit(normal, offset_m, members, score, ends_m, angle_std_rad, offset_std_m)


def circle(bend: float, y_m: np.ndarray) -> np.ndarray:
    """Points of a circle of radius 1 / |bend| through (20, 0), its centre on the radar's side if positive."""
    radius_m = 1.0 / bend
    return np.stack([20.0 - radius_m + np.sign(bend) * np.sqrt(radius_m**2 - y_m**2), y_m], axis=1)


@pytest.mark.parametrize("bend", [0.02, -0.02, 0.04])
def test_points_of_a_circle_are_one_wall_of_its_curvature(bend: float) -> None:
    """Hollow towards the radar is positive. Over 16 m in 17 points of 5 cm the least squares of a parabola say: the
    error of the curvature is 2 * 6 sqrt(5) std / (L^2 sqrt(n)), some 6e-4 per metre; ends lie where they are.
    """
    y_m = np.linspace(-8.0, 8.0, 17)
    points_m, covariance_m2 = circle(bend, y_m), np.tile(STD_M**2 * np.eye(2), (17, 1, 1))
    line = line_through(points_m, covariance_m2, np.arange(17), score=1.0)
    (arc,) = with_arcs(points_m, covariance_m2, [line])
    assert arc.curvature_per_m == pytest.approx(bend, rel=0.05)
    np.testing.assert_allclose(arc.ends_m[np.argsort(arc.ends_m[:, 1])], points_m[[0, -1]], atol=0.05)
    np.testing.assert_array_equal(arc.members, np.arange(17))
    assert (arc.normal @ [-1.0, 0.0], arc.offset_m) == pytest.approx((1.0, points_m[0, 0]), abs=0.05)
    # the middle of a parabola through n points is known to 3/2 of a mean's error, its chord's direction to a line's
    assert arc.offset_std_m == pytest.approx(1.5 * STD_M / math.sqrt(17.0), rel=0.05)
    flat = STD_M / math.sqrt(((y_m - y_m.mean()) ** 2).sum())
    error_of_bend = 12.0 * math.sqrt(5.0) * STD_M / (16.0**2 * math.sqrt(17.0))
    assert arc.angle_std_rad == pytest.approx(math.hypot(flat, 0.25 * 16.0 * error_of_bend), rel=0.12)


@pytest.mark.parametrize(
    ("bend", "limits"),
    [
        (1e-4, {}),
        (0.05, {"MAX_CURVATURE_PER_M": 0.045}),
        (0.05, {"MAX_TURN_RAD": 0.75}),
        (0.02, {"MIN_POINTS": 18}),
        (0.02, {"MIN_SIGMAS": 60.0}),
        (0.02, {"MIN_GAIN": 1e6}),
    ],
)
def test_what_is_not_clearly_bent_stays_a_line(
    bend: float, limits: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Straight to its error; over the largest curvature; 16 m at 0.05 per metre are 0.8 rad; too few points."""
    for name, value in limits.items():
        monkeypatch.setattr(arcs, name, value)
    y_m = np.linspace(-8.0, 8.0, 17)
    points_m, covariance_m2 = circle(bend, y_m), np.tile(STD_M**2 * np.eye(2), (17, 1, 1))
    line = line_through(points_m, covariance_m2, np.arange(17), score=1.0)
    assert with_arcs(points_m, covariance_m2, [line]) == [line]


def test_two_lines_of_a_circle_become_one_wall() -> None:
    y_m = np.linspace(-8.0, 8.0, 18)
    points_m, covariance_m2 = circle(0.05, y_m), np.tile(STD_M**2 * np.eye(2), (18, 1, 1))
    lines = [line_through(points_m, covariance_m2, members, score=1.0) for members in (np.arange(9), np.arange(9, 18))]
    (arc,) = with_arcs(points_m, covariance_m2, lines)
    np.testing.assert_array_equal(arc.members, np.arange(18))
    assert arc.curvature_per_m == pytest.approx(0.05, rel=0.08)


@pytest.mark.parametrize(
    ("members", "gap_m", "run"),
    [
        ([0, 1, 2, 3, 4, 5], 2.0, [0, 1, 2, 3, 4, 5]),
        # the run about s = 0; a gap as large as allowed breaks nothing
        ([0, 1, 2, 3, 4, 5], 1.99, [2, 3]),
        ([4, 0, 5, 1], 1.5, [4, 5]),
        ([4, 5], 1.5, [4, 5]),
    ],
)
def test_the_run_about_the_middle_that_no_gap_breaks(members: list[int], gap_m: float, run: list[int]) -> None:
    """Places along the line at -4, -3, -1, 0, 2 and 3 m."""
    s = np.array([-4.0, -3.0, -1.0, 0.0, 2.0, 3.0])
    assert _unbroken(s, np.array(members), gap_m).tolist() == run


def test_a_distance_from_an_arc_is_along_its_own_normal() -> None:
    """d = 1 + 0.75 s: a point 1 above it is 0.8 off along the normal (-0.6, 0.8), whose error is 0.36 + 0.64 * 4."""
    axes, covariance_m2 = np.eye(2), np.diag([1.0, 4.0])
    off_m, variance_m2 = _across(2.0, 3.5, covariance_m2, axes, np.array([1.0, 0.75, 0.0]))
    assert (off_m, variance_m2) == pytest.approx((0.8, 0.36 + 0.64 * 4.0))
    # with a bend of 0.5 the slope at 2 is 1 and the arc there at 1 + 2 * 0 + 1
    off_m, _ = _across(2.0, 3.0, covariance_m2, axes, np.array([1.0, 0.0, 0.5]))
    assert off_m == pytest.approx(1.0 / math.sqrt(2.0))
