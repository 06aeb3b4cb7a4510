"""Hypotheses of cells in a corner of two walls, each value worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.geometry.mirrors import RADAR, WallArrays, hits
from models.perception.objects.hypotheses import (
    FEATURES,
    PLACE_M,
    SINGLES,
)
from models.perception.objects.wall_table import CUT_DEPTH_M, FAR_M, TRIM_M, VEHICLE_LENGTH_M
from models.physics.plane import segment_distance_m
from tests.models.perception.objects.object_scenes import ACROSS, ALONG, GRID, cell, centre, hypotheses, walls


def feature(name: str) -> int:
    return FEATURES.index(name)


def test_a_cell_behind_one_wall_is_the_mirror_image_of_its_place() -> None:
    """Behind x = 12 the place has the same y and 24 - x; depth, way and incidence follow from the ray."""
    found = hypotheses(walls(ACROSS))
    row, column = cell(17.0, 2.0)
    x, y = centre(row, column)
    values = found.features[0, :, row, column]
    assert found.wall[:, row, column].tolist() == [ACROSS, -1, -1, -1]
    assert values[feature("valid")] == 1.0
    assert 40.0 * values[feature("x")] == pytest.approx(24.0 - x, abs=1e-4)
    assert 40.0 * values[feature("y")] == pytest.approx(y, abs=1e-4)
    assert np.exp(4.0 * values[feature("depth")]) == pytest.approx(x - 12.0, rel=1e-5)
    assert np.exp(4.0 * values[feature("to_wall")]) == pytest.approx(12.0 * np.hypot(x, y) / x, rel=1e-5)
    assert values[feature("incidence")] == pytest.approx(x / np.hypot(x, y), rel=1e-5)
    assert values[feature("missed")] == 0.0
    assert np.exp(4.0 * values[feature("wall_length")]) == pytest.approx(20.0, rel=1e-5)
    # the only return lies at (12, 0)
    assert np.exp(4.0 * values[feature("mirror_gap")]) == pytest.approx(12.0 * y / x, rel=1e-4)
    assert (
        values[[feature("first_segment_free"), feature("second_segment_free"), feature("in_view")]].tolist()
        == [1.0] * 3
    )


def test_cells_before_a_wall_or_beside_it_have_none() -> None:
    found = hypotheses(walls(ACROSS))
    before, beside = cell(8.0, 0.0), cell(8.0, 13.0)
    for row, column in (before, beside):
        assert (found.wall[:, row, column] == -1).all()
        assert not found.features[:, :, row, column].any()


def test_two_walls_in_a_row_are_the_last_hypothesis() -> None:
    """The image of (6, 4) in y = 10 and then x = 12 is (18, 16): its ray meets x = 12 at y = 10.67, past the corner,
    that of (7, 2), at (17, 18), meets y = 10 first. The image of (4, -2) by x = 12, y = 10 lies at (20, 22)."""
    found = hypotheses(walls())
    row, column = cell(20.0, 22.0)
    x, y = centre(row, column)
    assert found.wall[SINGLES, row, column] == ALONG
    assert found.second[SINGLES, row, column] == ACROSS
    values = found.features[SINGLES, :, row, column]
    assert 40.0 * values[feature("x")] == pytest.approx(24.0 - x, abs=1e-4)
    assert 40.0 * values[feature("y")] == pytest.approx(20.0 - y, abs=1e-4)


def test_the_wall_crossed_last_comes_first() -> None:
    """A ray at 42 deg crosses both lines near the corner: y = 10 at 14.9 m and x = 12 at 16.1 m, missed by 0.8 m."""
    found = hypotheses(walls())
    row, column = cell(14.86, 13.38)
    crossed = [wall for wall in found.wall[:SINGLES, row, column] if wall >= 0]
    assert crossed[0] == ALONG
    assert found.features[0, feature("missed"), row, column] == 0.0


def test_what_the_map_shows_at_the_place_and_in_another_wall() -> None:
    """An object at (9, 7): by x = 12 its image is (15, 7), by y = 10 it is (9, 13)."""
    row, column = cell(15.0, 7.0)
    x, y = centre(row, column)
    place, other = cell(24.0 - x, y), cell(24.0 - x, 20.0 - y)
    shape = hypotheses(walls()).wall.shape[1:]
    level, scores = np.zeros(shape), np.zeros((2, *shape))
    level[other], scores[(1, *other)] = 0.7, 0.6
    level[place], scores[(0, *place)] = 0.9, 0.8
    found = hypotheses(walls(), level, scores)
    values = found.features[0, :, row, column]
    assert values[feature("other_images")] == 0.5
    assert values[feature("other_level")] == pytest.approx(0.7)
    assert values[feature("other_score")] == pytest.approx(0.6)
    assert values[feature("is_hidden")] == 0.0
    assert values[feature("direct_level")] == pytest.approx(0.9)
    assert values[feature("direct_score")] == pytest.approx(0.8)


def test_left_and_right_differ_by_the_sign_of_y_alone() -> None:
    """The wall across is its own mirror image about the x axis."""
    found = hypotheses(walls(ACROSS))
    flipped = found.features[:, :, :, ::-1].copy()
    flipped[:, feature("y")] *= -1.0
    np.testing.assert_allclose(flipped, found.features, atol=1e-6)
    np.testing.assert_array_equal(found.wall[:, :, ::-1], found.wall)


def test_without_a_wall_there_is_no_hypothesis() -> None:
    found = hypotheses(walls().take(np.zeros(0, int)))
    assert (found.wall == -1).all()
    assert not found.features.any()


def facing(a: np.ndarray, b: np.ndarray) -> WallArrays:
    """Walls by their ends [W, 2], their normals towards the radar."""
    normal = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], axis=1) / np.linalg.norm(b - a, axis=1)[:, None]
    normal *= -np.sign(np.sum(normal * a, axis=1))[:, None]
    nothing = np.zeros(len(a))
    return WallArrays(normal, -np.sum(normal * a, axis=1), a, b, nothing, nothing, nothing)


def random_walls(seed: int, count: int = 9) -> WallArrays:
    """Walls anywhere before the radar, short and long, facing it."""
    rng = np.random.default_rng(seed)
    a = np.stack([rng.uniform(2.0, 50.0, count), rng.uniform(-30.0, 30.0, count)], axis=1)
    return facing(a, a + rng.uniform(-15.0, 15.0, (count, 2)))


def is_free(origin_m: np.ndarray, end_m: np.ndarray, walls: WallArrays, own: int = -1) -> bool:
    """Whether no long wall but `own` is crossed and passed by enough: the plain form, a quotient for every wall."""
    for index, (a, b) in enumerate(zip(*walls.trimmed(TRIM_M), strict=True)):
        if index == own or walls.length_m[index] <= VEHICLE_LENGTH_M:
            continue
        (rx, ry), (sx, sy), (ox, oy) = end_m - origin_m, b - a, a - origin_m
        turn = rx * sy - ry * sx
        along, across = (ox * sy - oy * sx) / turn, (ox * ry - oy * rx) / turn
        if 1e-9 < along < 1.0 and 0.0 <= across <= 1.0 and abs(walls.distance_m(end_m)[index]) > CUT_DEPTH_M:
            return False
    return True


@pytest.mark.parametrize("seed", range(3))
def test_what_blocks_a_segment_is_what_the_plain_form_says(seed: int) -> None:
    """Walls that cannot block are passed over, quotients and roots left out where they decide nothing: nothing of it
    shows."""
    arrays = random_walls(seed)
    found = hypotheses(arrays)
    direction = np.stack([np.cos(GRID.azimuth_rad), np.sin(GRID.azimuth_rad)], axis=1)
    to_wall_m = FAR_M * hits(RADAR, FAR_M * direction, arrays).along_ray
    blocked = 0
    for which, row, column in np.argwhere(found.wall[:SINGLES, ::5] >= 0) * [1, 5, 1]:
        wall, values = found.wall[which, row, column], found.features[which, :, row, column]
        mirror_m, image_m = to_wall_m[column, wall] * direction[column], GRID.range_m[row] * direction[column]
        place_m = image_m - 2.0 * arrays.distance_m(image_m)[wall] * arrays.normal[wall]
        np.testing.assert_allclose(PLACE_M * values[[feature("x"), feature("y")]], place_m, atol=1e-4)
        assert values[feature("first_segment_free")] == is_free(RADAR, mirror_m, arrays, wall)
        assert values[feature("second_segment_free")] == is_free(mirror_m, place_m, arrays, wall)
        assert values[feature("is_hidden")] == (not is_free(RADAR, place_m, arrays))
        nearest_m = segment_distance_m(place_m[None], arrays.a, arrays.b).min()
        if nearest_m > 0.2:
            assert np.exp(4.0 * values[feature("nearest_wall")]) == pytest.approx(nearest_m, rel=1e-5)
        blocked += not values[feature("second_segment_free")]
    assert blocked > 30


def test_images_in_other_walls_are_counted() -> None:
    """Between y = 7 and y = -7 before x = 12 an object at (10, 1) shows in all three: of one, two others, 2 of 2."""
    around = facing(
        np.array([[12.0, -7.0], [0.0, 7.0], [0.0, -7.0]]), np.array([[12.0, 7.0], [12.0, 7.0], [12.0, -7.0]])
    )
    found = hypotheses(around)
    row, column = cell(14.0, 1.0)
    assert found.wall[0, row, column] == 0
    assert found.features[0, feature("other_images"), row, column] == 1.0


@pytest.mark.parametrize(("y_m", "is_mirror"), [(3.2, True), (3.6, True), (4.8, False)])
def test_a_wall_mirrors_beyond_its_end_by_half_a_metre_and_two_deviations(y_m: float, is_mirror: bool) -> None:
    """A wall at x = 30 that ends at y = 1: two deviations of a beam are 2 * 0.035 * 30 m, so it reaches to y = 3.6."""
    row, column = cell(35.0, y_m * 35.0 / 30.0)
    found = hypotheses(facing(np.array([[30.0, -9.0]]), np.array([[30.0, 1.0]])))
    assert (found.wall[0, row, column] == 0) == is_mirror
