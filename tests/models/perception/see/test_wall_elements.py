"""Walls grown from what a field network says of each direction."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.training.data.field_samples import first_walls
from models.perception.mirrors.mirror_table import nearest_walls, wall_arrays
from models.perception.see.scan_evidence import certainties
from models.perception.see.wall_elements import ELEMENT_STD_M, further_walls, grown_walls, wall_elements
from msgs.values.perception import Wall
from tests.models.perception.see.fields import AZIMUTH_RAD, GRID, Ends, perfect_answer, walls_of


def grown(answer: np.ndarray) -> list[Wall]:
    return grown_walls(wall_elements(answer, GRID))[0]


@pytest.mark.parametrize(
    "ends_m",
    [((20.0, -8.0), (20.0, 9.0)), ((8.0, -6.0), (30.0, -6.5)), ((25.0, -3.0), (17.0, 12.0))],
    ids=["across", "along", "oblique"],
)
def test_a_straight_wall_is_where_it_is(ends_m: Ends) -> None:
    """Within 3 cm and 0.3 degrees; its ends within a metre: where the last rays that meet it meet it."""
    (wall,) = grown(perfect_answer(walls_of(ends_m)))
    a, b = np.array(ends_m)
    normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a))
    normal *= -np.sign(normal @ a)
    assert math.acos(min(normal @ wall.normal, 1.0)) < math.radians(0.3)
    assert abs(wall.offset_m + normal @ a) < 0.03
    said = np.array(wall.ends_m)
    assert min(np.abs(said - [a, b]).max(), np.abs(said - [b, a]).max()) < 1.0
    assert wall.curvature_per_m == 0.0
    # elements within a metre share their error
    assert wall.offset_std_m > 0.5 * ELEMENT_STD_M / math.sqrt(np.hypot(*(b - a)) + 1.0)


@pytest.mark.parametrize("curvature_per_m", [0.05, -0.05], ids=["hollow", "bulging"])
def test_an_arc_has_its_curvature(curvature_per_m: float) -> None:
    """Chords of 1 m over 16 m at 20 m: sagitta 1.6 m, positive where it is hollow towards the radar; within a fifth."""
    y_m = np.linspace(-8.0, 8.0, 17)
    radius_m = 1.0 / abs(curvature_per_m)
    sag_m = math.copysign(1.0, curvature_per_m) * (np.sqrt(radius_m**2 - y_m**2) - math.sqrt(radius_m**2 - 64.0))
    points = list(zip((20.0 + sag_m).tolist(), y_m.tolist(), strict=True))
    chords: list[Ends] = [(points[k], points[k + 1]) for k in range(16)]
    longest = max(grown(perfect_answer(walls_of(*chords))), key=lambda wall: wall.inliers)
    assert longest.curvature_per_m == pytest.approx(curvature_per_m, rel=0.2)


def test_a_corner_is_two_walls_and_what_lies_behind_is_none() -> None:
    hidden: Ends = ((30.0, -5.0), (30.0, 0.0))
    answer = perfect_answer(walls_of(((20.0, -8.0), (20.0, 2.0)), ((20.0, 2.0), (10.0, 12.0)), hidden))
    assert len(grown(answer)) == 2


def test_a_mirrored_answer_gives_mirrored_walls() -> None:
    answer = perfect_answer(walls_of(((20.0, -8.0), (22.0, 9.0)), ((8.0, 5.0), (14.0, 5.5))))
    turned = answer[..., ::-1].copy()
    turned[3] *= -1.0
    walls, mirrored = grown(answer), grown(turned)
    assert len(walls) == len(mirrored) == 2
    for wall, other in zip(walls, mirrored, strict=True):
        np.testing.assert_allclose(wall.normal, np.array(other.normal) * [1.0, -1.0], atol=1e-6)
        assert wall.offset_m == pytest.approx(other.offset_m, abs=1e-6)


def test_nothing_and_noise_give_no_walls_that_are_not_numbers() -> None:
    assert grown(np.full_like(perfect_answer([]), -8.0)) == []
    noise = np.random.default_rng(0).normal(0.0, 3.0, perfect_answer([]).shape).astype(np.float32)
    assert all(math.isfinite(wall.offset_m) and wall.offset_m > 0.0 for wall in grown(noise))


def test_a_direction_meets_its_nearest_wall() -> None:
    """x = 20 m at azimuth a is met at 20 / cos a, turned by -a; a nearer wall hides it; beyond its ends nothing."""
    walls = walls_of(((20.0, -8.0), (20.0, 9.0)), ((10.0, -1.0), (10.0, 1.0)))
    azimuth_rad = np.radians([0.0, 15.0, -20.0, 40.0])
    first = first_walls(walls, azimuth_rad)
    np.testing.assert_allclose(
        first.range_m, [10.0, 20.0 / math.cos(azimuth_rad[1]), 20.0 / math.cos(azimuth_rad[2]), np.inf]
    )
    np.testing.assert_allclose(first.angle_rad[:3], -azimuth_rad[:3], atol=1e-6)
    assert len(first_walls([], AZIMUTH_RAD).range_m) == len(AZIMUTH_RAD)


def test_certainty_support_and_walls_known_already() -> None:
    answer = perfect_answer(walls_of(((20.0, -8.0), (20.0, 9.0))))
    elements = wall_elements(answer, GRID)
    walls, _ = grown_walls(elements)
    elsewhere = Wall(normal=(0.0, -1.0), offset_m=6.0, ends_m=((10.0, 6.0), (20.0, 6.0)), inliers=4)
    arrays = wall_arrays([*walls, elsewhere])
    certainty = certainties(arrays, answer, GRID)
    assert certainty[0] > 0.9
    assert certainty[1] < 0.1
    assert (nearest_walls(elements.place_m, arrays) == 0).all()
    assert further_walls(walls, [elsewhere]) == walls
    assert further_walls(walls, walls) == []
