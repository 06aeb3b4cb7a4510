"""Objects in direct sight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.perception import PathClass
from sim_player.scene.description import Scene, SceneObject
from sim_player.scene.world import prepare
from tests.sim_player.trace.point_scenes import points_world, traced, unit_weight, wall

NAME = "los_objects"


def test_radar_equation_and_direction() -> None:
    """1 m^2 at (9, 4) and 2.5 m high, radar 1 m high: weight 1 / R^2, R and angles by hand; rounding."""
    echo = traced(points_world([(9.0, 4.0, 2.5)]), NAME).echoes[NAME]
    distance = math.sqrt(81.0 + 16.0 + 2.25)
    np.testing.assert_allclose(unit_weight(echo), [1.0 / distance**2], rtol=1e-12)
    np.testing.assert_allclose(echo.depart, [[9.0 / distance, 4.0 / distance, 1.5 / distance]], atol=1e-12)
    assert echo.out_m[0] == echo.back_m[0] == pytest.approx(distance, rel=1e-12)
    assert (echo.kind[0], echo.order[0], echo.surface[0], echo.object_index[0]) == (PathClass.LOS, 0, -1, 0)


def test_walls_hide_and_foliage_thins() -> None:
    point = [(9.0, 0.0, 1.0)]
    assert len(traced(points_world(point, wall((5.0, -1.0), (5.0, 1.0))), NAME).echoes[NAME]) == 0
    hedge = wall((5.0, -1.0), (5.0, 1.0), material="vegetation", thickness_mm=800.0)
    thinned = traced(points_world(point, hedge), NAME).echoes[NAME]
    assert 0.0 < thinned.foliage[0] < 1.0


def test_a_body_hides_its_own_far_side() -> None:
    """Of a car ahead only centres of the sides that face the radar return anything."""
    world = prepare(Scene(name="t", objects=(SceneObject(class_="car", x_m=15.0, y_m=0.0),)))
    echoes = traced(world, NAME).echoes[NAME]
    assert len(echoes) > 4
    assert echoes.point[:, 0].max() < 12.76
