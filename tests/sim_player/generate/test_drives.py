"""Drives: nobody runs into anything, classes as on streets, fixed by their arguments."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from models.physics.plane import segment_distance_m
from msgs.values.vehicle import ego_motion
from sim_player.generate.drives import STREET_MIX, draw_drive
from sim_player.generate.placement import Boxes, Walls
from sim_player.generate.places import MAX_SPEED_MPS, Place, draw_place
from sim_player.scene.description import SceneObject, check_scene

DURATION_S = 3.6


@pytest.fixture(scope="module")
def drives() -> list[Place]:
    return [draw_drive(5, index, "xband", DURATION_S) for index in range(16)]


def moved(road_user: SceneObject, time_s: float) -> Boxes:
    """The outline of a road user at a time."""
    yaw_rad = math.radians(road_user.yaw_deg)
    way_m = road_user.speed_mps * time_s * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
    return Boxes(road_user.corners_m()[None] + way_m)


def test_nobody_runs_into_anything(drives: list[Place]) -> None:
    """Boxes at 41 times: movers clear of walls, of others and, by 1.5 m, of the radar, which keeps 0.9 m off walls."""
    for place in drives:
        scene = place.scene
        check_scene(scene)
        walls = Walls.of(tuple(surface for surface in scene.surfaces if surface.role != "ground"))
        for time_s in np.linspace(0.0, DURATION_S, 41):
            pose = ego_motion(scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps), float(time_s))
            radar_m = np.array([[pose.x_m, pose.y_m]])
            assert segment_distance_m(radar_m, walls.a, walls.b).min() > 0.9
            boxes = [moved(road_user, float(time_s)) for road_user in scene.objects]
            for index, (road_user, box) in enumerate(zip(scene.objects, boxes, strict=True)):
                assert segment_distance_m(radar_m, *box.faces).min() > 1.5
                if not road_user.speed_mps:
                    continue
                assert not box.crossed_by(*walls.footing)[0]
                for other in boxes[:index] + boxes[index + 1 :]:
                    assert not box.crossed_by(*other.faces)[0]


def test_most_drives_move_and_parked_vehicles_do_not(drives: list[Place]) -> None:
    assert sum(place.scene.ego.speed_mps > 0.0 for place in drives) >= 14
    moving = 0
    for place in drives:
        for index, road_user in enumerate(place.scene.objects):
            assert 0.0 <= road_user.speed_mps <= MAX_SPEED_MPS[str(road_user.class_)]
            assert index >= place.parked or road_user.speed_mps == 0.0
            moving += road_user.speed_mps > 0.5
    assert moving >= len(drives)


def test_longer_drives_are_slower() -> None:
    """The same draws over ten times as long leave no room for the same speeds."""
    short, long = (
        np.mean([draw_drive(5, index, "xband", duration_s).scene.ego.speed_mps for index in range(8)])
        for duration_s in (1.2, 12.0)
    )
    assert long < 0.7 * short


def test_a_drive_is_fixed_by_its_arguments(drives: list[Place]) -> None:
    assert draw_drive(5, 3, "xband", DURATION_S) == drives[3]
    assert draw_drive(5, 3, "xband", DURATION_S, "street").kind == "street"
    with pytest.raises(ValueError, match=r"duration_s must be positive, got 0\.0"):
        draw_drive(5, 3, "xband", 0.0)


def test_classes_are_those_of_streets() -> None:
    """120 places: pedestrians are one in five of those placed out of sight, one in three without a mix; cars lead."""

    def shares(mix: dict[str, float] | None) -> dict[str, float]:
        counted = Counter[str]()
        for index in range(120):
            place = draw_place(5, index, class_mix=mix)
            counted.update(place.scene.objects[number].object_class for number in place.hidden)
        return {name: count / counted.total() for name, count in counted.items()}

    assert sum(STREET_MIX.values()) == pytest.approx(1.0, rel=1e-12)
    street, small = shares(STREET_MIX), shares(None)
    assert street["pedestrian"] < 0.24 < 0.28 < small["pedestrian"]
    assert street["car"] > 0.4
    assert set(street) == set(STREET_MIX)
