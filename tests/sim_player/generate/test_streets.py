"""Random streets: legal, varied, repeatable."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from sim_player.generate.streets import ROUGHNESS_MM, THICKNESS_MM, random_street
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import hidden_objects
from sim_player.scene.description import scene_from_yaml, scene_to_yaml
from sim_player.scene.world import prepare

STREETS = [random_street(11, index) for index in range(60)]


def test_streets_repeat_and_differ() -> None:
    assert [random_street(11, index) for index in range(10)] == STREETS[:10]
    assert len({scene_to_yaml(scene) for scene in STREETS}) == len(STREETS)
    assert random_street(12, 0) != STREETS[0]


def test_streets_stay_as_they_were() -> None:
    """Networks were trained on these scenes: a digest of 40 of them, rounded to nanometres, may never change."""
    digest = hashlib.sha256()
    for scene in STREETS[:40]:
        for wall in scene.surfaces:
            numbers = [*sum(wall.polyline_m, ()), wall.height_m, wall.thickness_mm or 0.0, wall.roughness_mm]
            digest.update(f"{wall.role} {wall.material} {[round(x, 9) for x in numbers]}".encode())
        for thing in scene.objects:
            digest.update(f"{thing.class_} {[round(x, 9) for x in (thing.x_m, thing.y_m, thing.yaw_deg)]}".encode())
    assert digest.hexdigest() == "df4216d1f77d263fc38513ea0751e820b1318103f360b85164bf9c8289cfc700"


def test_streets_survive_yaml() -> None:
    for scene in STREETS[:20]:
        assert scene_from_yaml(scene_to_yaml(scene)) == scene


def test_streets_cover_materials_and_classes() -> None:
    """60 scenes of 2-3 walls and up to 6 objects: each of 5 materials and 6 classes is missed with p < 1e-6."""
    walls = [surface for scene in STREETS for surface in scene.surfaces]
    assert {surface.material for surface in walls} == set(THICKNESS_MM)
    assert {thing.class_ for scene in STREETS for thing in scene.objects} == {
        "car",
        "van",
        "truck",
        "bus",
        "bicycle",
        "pedestrian",
    }
    roughness = np.array([surface.roughness_mm for surface in walls])
    assert roughness.min() >= ROUGHNESS_MM[0]
    assert roughness.max() <= ROUGHNESS_MM[1]


@pytest.mark.slow
def test_most_streets_hide_something_and_some_nothing() -> None:
    """15 % are drawn empty, about as many find no place to hide: 70 % hide something (60 scenes, 3 sigma = 18 %)."""
    share = np.mean([bool(hidden_objects(trace(prepare(scene)))) for scene in STREETS])
    assert 0.52 < share < 0.88
