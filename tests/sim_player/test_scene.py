"""Scenes as YAML: what is read, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_player.scene import OBJECT_KINDS, load_scene, scene_from_yaml, scene_to_yaml

SCENES = sorted((Path(__file__).parents[2] / "launch" / "scenes").glob("*.yaml"))
WALL = "{role: relay, material: concrete, polyline_m: [[10, -5], [10, 5]]}"


def scene(surfaces: str = f"[{WALL}]", objects: str = "[]", more: str = "") -> str:
    return f"name: test\nsurfaces: {surfaces}\nobjects: {objects}\n{more}"


def test_all_fields_are_read() -> None:
    text = scene(
        "[{role: occluder, material: glass, polyline_m: [[5, 2], [8, 2], [8, 9]], height_m: 4, thickness_mm: 6,"
        " roughness_mm: 0.2}, {role: ground, material: wet_ground}]",
        "[{class: van, x_m: 12, y_m: 3.5, yaw_deg: 30, speed_mps: 2}]",
        "radar: {preset: xband, height_m: 0.8}\nego: {speed_mps: 8, yaw_rate_dps: 3}",
    )
    read = scene_from_yaml(text)
    assert read.surfaces[0].polyline_m == ((5.0, 2.0), (8.0, 2.0), (8.0, 9.0))
    assert read.surfaces[0].thickness_mm == 6.0
    assert (read.objects[0].class_, read.objects[0].speed_mps) == ("van", 2.0)
    assert read.setup.radar_height_m == 0.8
    assert read.moves


def test_written_scene_reads_back_the_same() -> None:
    for path in SCENES:
        read = load_scene(path)
        assert scene_from_yaml(scene_to_yaml(read)) == read


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (scene(WALL.replace("concrete", "cheese").join("[]")), "surfaces[0].material: unknown material 'cheese'"),
        (scene("[]"), "surfaces: a scene needs at least one wall or object"),
        (scene("[{role: ground, material: concrete}]"), "surfaces: a scene needs at least one wall or object"),
        (scene(WALL.replace("[10, 5]", "[10, -5]").join("[]")), "surfaces[0].polyline_m[1]: a piece of wall must have"),
        (scene(WALL.replace("[10, 5]", "[.nan, 5]").join("[]")), "surfaces[0].polyline_m[1][0]: must be finite"),
        (scene(WALL.replace(", [10, 5]", "").join("[]")), "surfaces[0].polyline_m: needs two points or more, got 1"),
        (scene(WALL.replace("relay", "mirror").join("[]")), "surfaces[0].role: "),
        (scene(WALL.replace("}", ", thickness_mm: 0}").join("[]")), "surfaces[0].thickness_mm: must be positive"),
        (scene(WALL.replace("}", ", roughness_mm: -1}").join("[]")), "surfaces[0].roughness_mm: must not be negative"),
        (scene(WALL.replace("}", ", height_m: 0}").join("[]")), "surfaces[0].height_m: must be positive"),
        (scene(WALL.replace("}", ", colour: red}").join("[]")), "surfaces[0]: "),
        (scene(WALL.replace("10", "0.05").join("[]")), "surfaces[0].polyline_m[0]: the radar at (0, 0) must stand"),
        (scene(objects="[{class: tank, x_m: 5, y_m: 0}]"), "objects[0].class: "),
        (scene(objects="[{class: car, x_m: 5}]"), "objects[0]: object missing required field `y_m`"),
        (scene(objects="[{class: car, x_m: .inf, y_m: 0}]"), "objects[0].x_m: must be finite, got inf"),
        (scene(objects="[{class: car, x_m: 1, y_m: 0}]"), "objects[0].x_m: the radar at (0, 0) must stand outside"),
        (scene(objects="[{class: car, x_m: 9, y_m: 0}]"), "objects[0].x_m: must stand clear of surfaces[0]"),
        (scene(objects="[{class: car, x_m: 5, y_m: one}]"), "objects[0].y_m: expected `float`, got `str`"),
        (scene(objects="[{mesh: car.obj, unit: m}]"), "objects[0].mesh: meshes are not simulated"),
        (scene(more="radar: {preset: spad}"), "radar.preset: "),
        (scene(more="radar: {height_m: 0}"), "radar.height_m: must be positive"),
        (scene(WALL.replace("concrete", "brick").join("[]"), more="radar: {preset: 77ghz}"), "got 77 GHz"),
        ("name: [", "not YAML: "),
        ("just words", "expected `object`, got `str`"),
    ],
)
def test_bad_scenes_are_refused_in_one_line(text: str, complaint: str, tmp_path: Path) -> None:
    """Every complaint starts with the file, then the field; it has one line."""
    path = tmp_path / "x.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert complaint in message
    assert "\n" not in message


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.yaml: no such scene file"):
        load_scene(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"binary\.yaml: "):
        load_scene(tmp_path / "binary.yaml")


def test_wall_that_swallows_a_wall_end_is_refused() -> None:
    """A short wall wholly inside a bus crosses none of its faces, and is still in its way."""
    text = scene(
        "[{role: relay, material: metal, polyline_m: [[20, -0.2], [20, 0.2]]}]", "[{class: bus, x_m: 20, y_m: 0}]"
    )
    with pytest.raises(ValueError, match=r"objects\[0\]\.x_m: must stand clear of surfaces\[0\]"):
        scene_from_yaml(text)


def test_every_class_has_a_size() -> None:
    assert list(OBJECT_KINDS) == ["car", "van", "truck", "bus", "bicycle", "pedestrian"]
    for kind in OBJECT_KINDS.values():
        assert min(kind.length_m, kind.width_m, kind.height_m) > 0.0
