"""Lines with covariances: heights, offsets seen from another line, and their combination, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.perception.track.wall_lines import WallLine

ANGLES = st.floats(-1.2, 1.2)


def line(offset_m: float = 20.0, angle_rad: float = 0.0, shift_m: float = 0.0, **stds: float) -> WallLine:
    """A wall of 10 m ahead, its normal turned by an angle about its middle."""
    tangent = np.array([-math.sin(angle_rad), math.cos(angle_rad)])
    middle_m = np.array([offset_m, shift_m])
    ends_m = middle_m + np.array([[-5.0], [5.0]]) * tangent
    return WallLine.between(ends_m, stds.get("offset_std_m", 0.1), stds.get("angle_std_rad", 0.01))


def test_a_line_faces_the_radar() -> None:
    ahead = line()
    assert ahead.normal.tolist() == [-1.0, 0.0]
    assert ahead.offset_m == 20.0
    assert ahead.height_m(np.array([[18.0, 3.0], [23.0, 0.0]])).tolist() == [2.0, -3.0]
    assert sorted(ahead.along_m(ahead.ends_m).tolist()) == [-5.0, 5.0]
    assert ahead.range_m == 20.0


@given(angle_rad=ANGLES, turn_rad=st.floats(-0.2, 0.2), apart_m=st.floats(-1.0, 1.0), shift_m=st.floats(-8.0, 8.0))
def test_a_line_is_seen_at_the_middle_of_another(
    angle_rad: float, turn_rad: float, apart_m: float, shift_m: float
) -> None:
    """Where the second line meets the first one's normal, and the turn between them; 1e-9: rounding."""
    first = line(angle_rad=angle_rad)
    normal = first.normal
    turned = np.array([[math.cos(turn_rad), -math.sin(turn_rad)], [math.sin(turn_rad), math.cos(turn_rad)]])
    along = turned @ first.tangent
    # through a point at the height -apart_m over the middle of the first
    middle_m = first.middle_m - apart_m * normal + shift_m * along
    second = WallLine.between(middle_m + np.array([[-4.0], [4.0]]) * along, 0.2, 0.02)
    off, _ = second.seen_at(first)
    assert off == pytest.approx([apart_m, turn_rad], abs=1e-9)


def test_the_variance_of_an_offset_grows_with_the_square_of_the_distance() -> None:
    """0.1 m at the middle and 0.01 rad: at 30 m along, sqrt(0.01 + 0.09) m."""
    far = line(offset_std_m=0.1, angle_std_rad=0.01)
    assert far.variance_at(np.array([0.0, 30.0])) == pytest.approx([0.01, 0.10])
    _, covariance = far.seen_at(line(shift_m=30.0))
    assert covariance[0, 0] == pytest.approx(0.10)


@given(angle_rad=ANGLES)
def test_equal_lines_meet_in_the_middle(angle_rad: float) -> None:
    """Two measurements of equal covariance: the mean, with half of the variance; 1e-9: rounding."""
    first = line(angle_rad=angle_rad)
    second = WallLine(first.middle_m - 0.4 * first.normal, first.normal, 5.0, first.covariance)
    off, noise = second.seen_at(first)
    both = first.corrected(np.eye(2), off, noise)
    assert both.middle_m == pytest.approx(first.middle_m - 0.2 * first.normal, abs=1e-9)
    np.testing.assert_allclose(both.covariance, 0.5 * first.covariance, atol=1e-12)
    # the same from either side
    off, noise = first.seen_at(second)
    back = second.corrected(np.eye(2), off, noise)
    assert back.middle_m == pytest.approx(both.middle_m, abs=1e-9)


def test_a_turn_is_shared_by_the_weights_of_its_directions() -> None:
    """0.01 rad against 0.03 rad: a tenth of the difference, 0.4 deg, is taken over."""
    first, second = line(angle_std_rad=0.01), line(angle_rad=math.radians(0.4), angle_std_rad=0.03)
    off, noise = second.seen_at(first)
    both = first.corrected(np.eye(2), off, noise)
    turn_rad = math.atan2(*(both.normal @ np.stack([first.tangent, first.normal]).T))
    assert turn_rad == pytest.approx(math.radians(0.04), rel=1e-6)


def test_a_stretch_of_a_line_keeps_its_points_and_moves_its_covariance() -> None:
    """10 m on, the offset's variance is that of the line there: 0.01 + (10 x 0.01)^2 m^2."""
    longer = line().reaching(np.array([[20.0, -5.0], [20.0, 25.0]]))
    assert longer.half_m == pytest.approx(15.0)
    assert longer.middle_m == pytest.approx([20.0, 10.0])
    assert longer.covariance[0, 0] == pytest.approx(0.02)
    np.testing.assert_allclose(longer.variance_at(longer.along_m(np.array([[20.0, 0.0]]))), 0.01, rtol=1e-9)


def test_a_line_turned_to_face_another_says_the_same() -> None:
    """A long wall beside the radar: correlated errors keep their meaning when its normal is turned."""
    longer = line().reaching(np.array([[20.0, -5.0], [20.0, 25.0]]))
    back = WallLine(longer.middle_m, -longer.normal, longer.half_m, longer.covariance * [[1, -1], [-1, 1]])
    at_m = np.array([[20.0, 3.0]])
    turned = back.facing(longer)
    np.testing.assert_allclose(turned.covariance, longer.covariance)
    np.testing.assert_allclose(back.variance_at(back.along_m(at_m)), longer.variance_at(longer.along_m(at_m)))


def test_a_wall_is_told_with_its_normal_towards_the_radar() -> None:
    wall = line(angle_rad=0.3).as_wall(7)
    assert wall.inliers == 7
    assert wall.offset_m == pytest.approx(20.0 * math.cos(0.3))
    assert wall.angle_std_rad == pytest.approx(0.01)
    behind = WallLine(np.array([0.01, 0.0]), np.array([1.0, 0.0]), 5.0, np.eye(2)).as_wall(0)
    assert behind.normal == (-1.0, 0.0)
    assert behind.offset_m == pytest.approx(0.01)


def test_ends_drawn_in_leave_half_of_a_wall() -> None:
    assert np.abs(line().trimmed_m(1.0)[:, 1]).tolist() == [4.0, 4.0]
    assert np.abs(line().trimmed_m(100.0)[:, 1]).tolist() == [2.5, 2.5]


@pytest.mark.parametrize(("shift_m", "gap_m", "middle_m"), [(4.0, -6.0, 2.0), (12.0, 2.0, 5.0), (-30.0, 20.0, -5.0)])
def test_gap_and_common_stretch(shift_m: float, gap_m: float, middle_m: float) -> None:
    first, second = line(), line(shift_m=shift_m)
    assert first.gap_m(second) == pytest.approx(gap_m)
    # along the tangent, which for a wall ahead runs to the right
    assert -first.common_m(second) == pytest.approx(middle_m)
