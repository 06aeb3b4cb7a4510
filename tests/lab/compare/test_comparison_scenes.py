"""Corners of the comparison: the hidden object is hidden, and in the mirror where it was asked for."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from lab.compare.comparison_scenes import (
    TRUTH_SPACING_M,
    WALLS,
    Corner,
    comparison_place,
    corner_scene,
    mirror_path,
    shown_points,
    with_sensor,
)
from sim_player.scene.description import check_scene

CORNERS = {
    "near": Corner(range_m=7.0),
    "far": Corner(range_m=105.0),
    "steep": Corner(range_m=20.0, incidence_deg=15.0),
    "grazing": Corner(range_m=20.0, incidence_deg=75.0),
    "pedestrian": Corner(range_m=4.0, object_class="pedestrian"),
    "glass": Corner(range_m=30.0, wall="float_glass"),
}


@pytest.mark.parametrize("corner", CORNERS.values(), ids=CORNERS)
def test_a_hidden_object_is_seen_in_the_mirror_alone(corner: Corner) -> None:
    for viewpoint in range(3):
        scene = corner_scene(corner, 3, viewpoint)
        check_scene(scene)
        truth, way = shown_points(scene), mirror_path(scene)
        assert truth.hidden == {0}
        assert len(truth) >= 2
        # shifted by 0.3 m in both directions of the wall at most
        assert way.range_m == pytest.approx(corner.range_m, abs=0.5)
        assert np.degrees(np.arccos(way.cos_incidence)) == pytest.approx(corner.incidence_deg, abs=8.0)
        assert abs(np.degrees(way.azimuth_rad)) < 25.0


def test_truth_lies_on_the_object_and_its_image_behind_the_wall() -> None:
    """Image method: |image| is the length of the way by the wall, so R = r1 + r2 for the object's middle."""
    scene = corner_scene(Corner(range_m=12.0), 1)
    truth, way = shown_points(scene), mirror_path(scene)
    grown = msgspec.structs.replace(scene.objects[0])
    half = 0.5 * np.hypot(grown.kind.length_m, grown.kind.width_m)
    centre = np.array([grown.x_m, grown.y_m])
    assert (np.linalg.norm(truth.position_m - centre, axis=1) <= half + 1e-9).all()
    assert np.abs(np.linalg.norm(truth.image_m, axis=1) - way.range_m).max() <= half
    apart = np.linalg.norm(truth.position_m[:, None] - truth.position_m, axis=2) + 9.0 * np.eye(len(truth))
    assert apart.min() >= TRUTH_SPACING_M


def test_viewpoints_differ_and_settings_share_them() -> None:
    one, other = (corner_scene(Corner(), 2, viewpoint) for viewpoint in (0, 1))
    assert one != other
    assert one == corner_scene(Corner(), 2, 0)
    rough = corner_scene(Corner(roughness_mm=5.0), 2, 0)
    assert rough.objects == one.objects
    assert [surface.polyline_m for surface in rough.surfaces] == [surface.polyline_m for surface in one.surfaces]
    assert [surface.roughness_mm for surface in rough.surfaces] == [5.0, WALLS["concrete"].roughness_mm]


def test_a_place_stands_before_every_sensor() -> None:
    scene = comparison_place(4, 0, "street")
    for preset in ("xband", "77ghz", "spad"):
        swapped = with_sensor(scene, preset)
        assert (swapped.surfaces, swapped.objects) == (scene.surfaces, scene.objects)
        assert swapped.radar.preset == preset


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"range_m": -1.0}, "corner.range_m must lie in 3..1000, got -1.0"),
        ({"range_m": float("nan")}, "corner.range_m must lie in"),
        ({"incidence_deg": 90.0}, "corner.incidence_deg must lie in 5..80, got 90.0"),
        ({"wall": "cheese"}, "corner.wall must be one of .*, got 'cheese'"),
        ({"roughness_mm": -0.1}, "corner.roughness_mm must lie in 0..1000, got -0.1"),
    ],
)
def test_wrong_settings_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        msgspec.structs.replace(Corner(), **wrong)


def test_no_room_is_said() -> None:
    with pytest.raises(ValueError, match="range_m must leave room to hide a bus at 45 deg, got 5"):
        corner_scene(Corner(range_m=5.0, object_class="bus"))
    with pytest.raises(ValueError, match="viewpoint must not be negative, got -1"):
        corner_scene(Corner(), 0, -1)
