"""Figures of one scan against the truth: walls and their bend, objects found and made up."""

from __future__ import annotations

import numpy as np
import pytest

from lab.compare.peak_scores import OBJECT_GATE_M, _false_groups, _near_box, true_walls
from sim_player.scene.description import Scene, SceneObject, Surface


def scene(*ends: tuple[float, float], curvature_per_m: float = 0.0, **more: object) -> Scene:
    values = {"role": "relay", "material": "metal", "height_m": 3.0, **more}
    wall = Surface(polyline_m=tuple(ends), curvature_per_m=curvature_per_m, **values)  # type: ignore[arg-type]
    return Scene(name="walls", surfaces=(wall,))


@pytest.mark.parametrize(("ends", "bend"), [(((12.0, 5.0), (12.0, -5.0)), -0.02), (((12.0, -5.0), (12.0, 5.0)), 0.02)])
def test_a_walls_bend_is_towards_the_radar_whichever_way_it_is_drawn(ends: tuple, bend: float) -> None:
    """An arc bends to the left of its way: upwards at x = 12 that is towards the radar, downwards away from it."""
    (wall,) = true_walls(scene(*ends, curvature_per_m=0.02))
    assert (wall.normal, wall.offset_m, wall.curvature_per_m) == ((-1.0, 0.0), 12.0, bend)
    assert wall.ends_m == ends


def test_ground_and_foliage_are_no_walls_and_a_polyline_is_one_a_piece() -> None:
    assert true_walls(scene((12.0, -5.0), (12.0, 5.0), material="vegetation", thickness_mm=900.0)) == []
    assert len(true_walls(scene((12.0, -5.0), (12.0, 5.0), (4.0, 5.0)))) == 2


def test_places_within_two_metres_of_a_box_are_its_own() -> None:
    """A car of 4.4 x 1.8 m about (10, 0): its middle, and 2 m from its front, are near; a centimetre more is not."""
    car = SceneObject(class_="car", x_m=10.0, y_m=0.0)
    front_m = 10.0 + 0.5 * car.kind.length_m
    places_m = np.array([[10.0, 0.0], [front_m + OBJECT_GATE_M - 0.01, 0.0], [front_m + OBJECT_GATE_M + 0.01, 0.0]])
    assert _near_box(places_m, car).tolist() == [True, True, False]


def test_made_up_objects_are_groups_without_any_place_near_one() -> None:
    """Two places 1.5 m apart, one of them near an object; two more far away; and one alone."""
    places_m = np.array([[0.0, 0.0], [1.5, 0.0], [20.0, 0.0], [21.0, 0.0], [40.0, 0.0]])
    assert _false_groups(places_m, np.array([True, False, False, False, False])) == 2
    assert _false_groups(places_m, np.zeros(5, bool)) == 3
    assert _false_groups(np.zeros((0, 2)), np.zeros(0, bool)) == 0
