"""Scenes as YAML: what is read, and what is refused in one line."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from msgs.files.shipped import CHECKOUT
from sim_player.scene.description import load_scene, scene_from_yaml, scene_sha256, scene_to_yaml

SCENES = sorted((CHECKOUT / "launch" / "scenes").glob("*.yaml"))
MESHES = CHECKOUT / "tests" / "data" / "meshes"
WALL = "{role: relay, material: concrete, polyline_m: [[10, -5], [10, 5]]}"

#: SHA-256 of `scene()`, found before surfaces had a lobe.
BEFORE_LOBES = "764035c7b2ee65c23f178c920c77cf88a4386342e74206a882714de84e8d7d2e"


def scene(surfaces: str = f"[{WALL}]", objects: str = "[]", more: str = "") -> str:
    return f"name: test\nsurfaces: {surfaces}\nobjects: {objects}\n{more}"


def wall(old: str, new: str, more: str = "") -> str:
    """A scene of one wall, its text changed."""
    return scene(f"[{WALL.replace(old, new)}]", more=more)


def built(fields: str) -> str:
    """A scene of one wall with more fields."""
    return wall("}", f", {fields}}}")


def stands(*fields: str) -> str:
    """A scene of a wall and objects."""
    return scene(objects=", ".join(f"{{{each}}}" for each in fields).join("[]"))


def radar(fields: str) -> str:
    return scene(more=f"radar: {{{fields}}}")


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


def test_a_radar_is_a_preset_and_what_differs_from_it() -> None:
    """Every field reaches the set-up; a digital array of other columns has as many orthogonal beams."""
    stated = "radar: {array: {columns: 6, rows: 2, row_spacing_m: 0.02}, bandwidth_hz: 5.0e+8, chirps_per_beam: 16,"
    read = scene_from_yaml(
        scene(more=f"{stated} transmit_power_w: 0.01, noise_figure_db: 6, beams_deg: [-15, 0, 15]}}")
    )
    setup, preset = read.setup, scene_from_yaml(scene()).setup
    assert (setup.array.columns, setup.array.rows, setup.array.row_spacing_m) == (6, 2, 0.02)
    assert (setup.array.phase_bits, setup.array.steered_ways) == (preset.array.phase_bits, preset.array.steered_ways)
    assert (setup.radar.bandwidth_hz, setup.radar.transmit_power_w, setup.radar.noise_figure_db) == (5e8, 0.01, 6.0)
    assert (setup.radar.chirps_per_beam, setup.beams.azimuth_deg) == (16, (-15.0, 0.0, 15.0))
    assert setup.map_grid.range_bin_m == pytest.approx(0.29979, abs=1e-5)
    assert scene_from_yaml(scene_to_yaml(read)) == read
    assert "array" not in scene_to_yaml(scene_from_yaml(scene()))
    digital = scene_from_yaml(scene(more="radar: {preset: 77ghz, array: {columns: 16}}")).setup
    assert len(digital.beams) == digital.array.columns == 16


def test_default_lobe_is_not_written() -> None:
    """Scenes drawn before surfaces had it keep their text and their hash."""
    plain = scene_from_yaml(scene())
    stated = scene_from_yaml(scene(WALL.replace("}", ", diffuse_lobe: kirchhoff}").join("[]")))
    assert "diffuse_lobe" not in scene_to_yaml(plain)
    assert (scene_to_yaml(stated), scene_sha256(stated)) == (scene_to_yaml(plain), scene_sha256(plain))
    assert scene_sha256(plain) == BEFORE_LOBES


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "expected a mapping of name, radar, surfaces, objects, ego, weather, radars, got nothing"),
        ("[1]", "expected a mapping of name, radar, surfaces, objects, ego, weather, radars, got a list"),
        ("name: x\nradar: {heigth_m: 1}", "radar: object contains unknown field `heigth_m`; known are preset, height"),
        (wall("concrete", "cheese"), "surfaces[0].material: unknown material 'cheese'"),
        (wall("10, -5", "10, -5000"), "surfaces[0].polyline_m[0][1]: must lie within 983.091"),
        (stands("class: car, x_m: 1.0e+300, y_m: 0"), "objects[0].x_m: must lie within 983.091 of 0"),
        (stands("class: car, x_m: 8000, y_m: 0"), "objects[0].x_m: must lie within 983.091 of 0, which is as"),
        (radar("array: {columns: 0}"), "radar.array.columns: must lie in 1..256, got 0"),
        (radar("array: {row: 2}"), "radar.array: object contains unknown field `row`; known are columns"),
        (radar("preset: 77ghz, array: {steered_ways: 2}"), "radar.array.digital: needs array.steered_ways 1"),
        (radar("bandwidth_hz: -7e8"), "radar.bandwidth_hz: must lie in 1..1e+13, got -700000000.0"),
        (radar("transmit_power_w: .nan"), "radar.transmit_power_w: must be finite, got nan"),
        (radar("chirps_per_beam: 0"), "radar.chirps_per_beam: must lie in 1..16384, got 0"),
        (radar("beams_deg: []"), "radar.beams_deg: must name at least one beam"),
        (radar("beams_deg: [95]"), "radar.beams_deg: must lie inside -90..90, got (95.0,)"),
        (scene(more="weather: {rain_mm_per_h: -3}"), "weather.rain_mm_per_h: must lie in 0..200, got -3.0"),
        (scene(more="weather: {snow_mm_per_h: 51}"), "weather.snow_mm_per_h: must lie in 0..50, got 51.0"),
        (wall("[10, 5]", "[10, -5]"), "surfaces[0].polyline_m[1]: a piece of wall must have"),
        (wall("[10, 5]", "[.nan, 5]"), "surfaces[0].polyline_m[1][0]: must be finite"),
        (wall(", [10, 5]", ""), "surfaces[0].polyline_m: needs two points or more, got 1"),
        (wall("relay", "mirror"), "surfaces[0].role: "),
        (built("thickness_mm: 0"), "surfaces[0].thickness_mm: must be positive"),
        (built("roughness_mm: -1"), "surfaces[0].roughness_mm: must not be negative"),
        (built("height_m: 0"), "surfaces[0].height_m: must be positive"),
        (built("colour: red"), "surfaces[0]: "),
        (wall("10", "0.05"), "surfaces[0].polyline_m[0]: the radar at (0, 0) must stand"),
        (stands("class: tank, x_m: 5, y_m: 0"), "objects[0].class: "),
        (stands("class: car, x_m: 5"), "objects[0]: object missing required field `y_m`"),
        (stands("class: car, x_m: .inf, y_m: 0"), "objects[0].x_m: must be finite, got inf"),
        (stands("class: car, x_m: 1, y_m: 0"), "objects[0].x_m: the radar at (0, 0) must stand outside"),
        (stands("class: car, x_m: 9, y_m: 0"), "objects[0].x_m: must stand clear of surfaces[0]"),
        (stands("class: car, x_m: 5, y_m: one"), "objects[0].y_m: expected `float`, got `str`"),
        (stands("mesh: car.obj, x_m: 5, y_m: 0"), "car.obj: no such mesh file"),
        (stands("mesh: car.obj, unit: cm, x_m: 5, y_m: 0"), "objects[0].unit: "),
        (stands("mesh: car.dae, x_m: 5, y_m: 0"), "car.dae: format: must be one of .obj, .ply"),
        (stands("x_m: 5, y_m: 0"), "objects[0]: must have one of class, mesh, primitive, got none"),
        (stands("class: car, mesh: a.obj, x_m: 5, y_m: 0"), "objects[0]: must have one of class, mesh, prim"),
        (stands("class: car, unit: mm, x_m: 5, y_m: 0"), "objects[0].unit: does not belong to a class"),
        (stands("class: car, z_m: 1, x_m: 5, y_m: 0"), "objects[0].z_m: does not belong to a class"),
        (stands("primitive: cone, size_m: [1], x_m: 5, y_m: 0"), "objects[0].primitive: "),
        (stands("primitive: box, size_m: [1, 2], x_m: 5, y_m: 0"), "objects[0].size_m: a box takes [length"),
        (stands("primitive: box, size_m: [1, .nan, 1], x_m: 5, y_m: 0"), "size_m[1]: must be finite"),
        (stands("primitive: sphere, size_m: [99], x_m: 5, y_m: 0"), "objects[0].size_m: the longest must lie"),
        (stands("primitive: sphere, size_m: [1], up: y, x_m: 5, y_m: 0"), "objects[0].up: does not belong"),
        (stands("primitive: sphere, size_m: [1], z_m: -1, x_m: 5, y_m: 0"), "objects[0].z_m: must not be"),
        (stands("primitive: sphere, size_m: [1], material: jam, x_m: 5, y_m: 0"), "objects[0].material: unk"),
        (stands("primitive: box, size_m: [2, 2, 2], x_m: 0.5, y_m: 0"), "must stand outside, got a box"),
        (stands("primitive: plate, size_m: [2, 2], x_m: 10, y_m: 0"), "must stand clear of surfaces[0]"),
        (scene(f"[{WALL}, {{role: ground, material: hedge}}]"), "a ground must be a surf"),
        (scene(WALL.replace("concrete", "double_glazing").replace("}", ", thickness_mm: 6}").join("[]")), "thickness"),
        (built("correlation_mm: 0"), "surfaces[0].correlation_mm: must be positive"),
        (built("correlation_mm: .nan"), "surfaces[0].correlation_mm: must be finite"),
        (built("diffuse_lobe: lambert"), "surfaces[0].diffuse_lobe: invalid enum value 'lambert'; known are kirchhoff"),
        (built("curvature_per_m: 0.2"), "surfaces[0].curvature_per_m: |curvature| times"),
        (built("curvature_per_m: .nan"), "surfaces[0].curvature_per_m: must be finite"),
        (radar("separation_m: -0.1"), "radar.separation_m: must be at least 0 and below 1 m, got -0.1"),
        (radar("separation_m: 1"), "radar.separation_m: must be at least 0 and below 1 m, got 1.0"),
        (radar("front_end: {adc_bits: 3}"), "radar.front_end.adc_bits: must be 4..16, got 3"),
        (radar("front_end: {adc_bits: 17}"), "radar.front_end.adc_bits: must be 4..16, got 17"),
        (radar("front_end: {coupling_db: 0}"), "radar.front_end.coupling_db: must be negative, got 0.0"),
        (radar("front_end: {iq_gain_db: .inf}"), "radar.front_end.iq_gain_db: must be finite, got inf"),
        (radar("front_end: {flicker_corner_hz: -1}"), "radar.front_end.flicker_corner_hz: must not be"),
        (radar("front_end: {spurs: [{frequency_hz: .nan, power_dbm: 0}]}"), "spurs[0].frequency_hz: must"),
        (scene(more="weather: {rain_mm_per_h: 201}"), "weather.rain_mm_per_h: must lie in 0..200, got 201.0"),
        (scene(more="weather: {temperature_c: -61}"), "weather.temperature_c: must lie in -60..60, got -61.0"),
        (scene(more="weather: {pressure_hpa: 101325}"), "weather.pressure_hpa: must lie in 500..1100, got 101325.0"),
        (scene(more="weather: {water_vapour_g_per_m3: 51}"), "weather.water_vapour_g_per_m3: must lie in 0..50"),
        (scene(more="ego: {speed_mps: 9000}"), "ego.speed_mps: must lie in -100..100, got 9000.0"),
        (scene(more="ego: {yaw_rate_dps: -1e3}"), "ego.yaw_rate_dps: must lie in -720..720, got -1000.0"),
        (
            stands("class: car, x_m: 5, y_m: 0, speed_mps: -101"),
            "objects[0].speed_mps: must lie in -100..100, got -101.0",
        ),
        (
            stands("primitive: sphere, size_m: [1], material: air, x_m: 5, y_m: 0"),
            "objects[0].material: must reflect, got 'air'",
        ),
        (wall("concrete", "vacuum"), "surfaces[0].material: must reflect, got 'vacuum'"),
        (
            wall("concrete", "vegetation, thickness_mm: 2e6"),
            "surfaces[0].thickness_mm: must be at most 1e+06, got 2000000.0",
        ),
        (built("thickness_mm: 10001"), "surfaces[0].thickness_mm: must be at most 10000, got 10001.0"),
        (
            stands("class: car, x_m: 5, y_m: 9", "class: bicycle, x_m: 6, y_m: 9.5, yaw_deg: 40"),
            "objects[1].x_m: must stand clear of objects[0], got a bicycle at (6, 9.5) in a car at (5, 9)",
        ),
        (
            stands(
                "primitive: sphere, size_m: [2], x_m: 5, y_m: 9", "primitive: plate, size_m: [2, 2], x_m: 5.5, y_m: 9"
            ),
            "objects[1].x_m: must stand clear of objects[0], got a plate at (5.5, 9) in a sphere at (5, 9)",
        ),
        (radar("preset: sonar"), "radar.preset: "),
        (radar("height_m: 0"), "radar.height_m: must be positive"),
        (wall("concrete", "plywood", "radar: {preset: 77ghz}"), "got 77 GHz"),
        ("name: [", "not YAML: "),
        ("just words", "radars, got text"),
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
    (tmp_path / "binary.yaml").write_bytes(b"\xff\x00\xfe")
    with pytest.raises(ValueError, match=r"binary\.yaml: must be UTF-8 text, got byte 0xff at 0$"):
        load_scene(tmp_path / "binary.yaml")
    with pytest.raises(ValueError, match=r": Is a directory$"):
        load_scene(tmp_path)


def test_wall_that_swallows_a_wall_end_is_refused() -> None:
    """A short wall wholly inside a bus crosses none of its faces, and is still in its way."""
    text = scene(
        "[{role: relay, material: metal, polyline_m: [[20, -0.2], [20, 0.2]]}]", "[{class: bus, x_m: 20, y_m: 0}]"
    )
    with pytest.raises(ValueError, match=r"objects\[0\]\.x_m: must stand clear of surfaces\[0\]"):
        scene_from_yaml(text)


@pytest.mark.parametrize(
    "objects",
    [
        # 4.5 m by 1.8 m each: bumper to bumper, door to door, corner past corner
        "[{class: car, x_m: 5, y_m: 9}, {class: car, x_m: 9.5, y_m: 9}]",
        "[{class: car, x_m: 5, y_m: 9}, {class: car, x_m: 5, y_m: 10.8}]",
        "[{class: car, x_m: 5, y_m: 9}, {class: car, x_m: 8.9, y_m: 11.5, yaw_deg: 45}]",
        # the corners of their boxes overlap, they do not
        "[{primitive: sphere, size_m: [2], x_m: 5, y_m: 9}, {primitive: sphere, size_m: [2], x_m: 6.5, y_m: 10.5}]",
        "[{class: car, x_m: 5, y_m: 9}, {primitive: box, size_m: [1, 1, 1], z_m: 1.5, x_m: 5, y_m: 9}]",
    ],
)
def test_objects_may_stand_close_touch_and_lie_on_each_other(objects: str) -> None:
    assert len(scene_from_yaml(scene(objects=objects)).objects) == 2


def test_numbers_are_those_of_yaml_1_2_and_foliage_may_be_deep() -> None:
    read = scene_from_yaml(
        scene(WALL.replace("concrete", "vegetation, thickness_mm: 6e4, roughness_mm: 1e-07").join("[]"))
    )
    assert (read.surfaces[0].thickness_mm, read.surfaces[0].roughness_mm) == (6e4, 1e-7)
    named = msgspec.structs.replace(read, name="1e5")
    assert scene_from_yaml(scene_to_yaml(named)) == named


def test_meshes_are_found_beside_the_scene(tmp_path: Path) -> None:
    """A scene names its mesh by file; the object has the mesh's box and name, and the scene reads back alike."""
    (tmp_path / "shapes").mkdir()
    shutil.copy(MESHES / "two_box_car.glb", tmp_path / "shapes")
    path = tmp_path / "x.yaml"
    path.write_text(scene(objects="[{mesh: shapes/two_box_car.glb, x_m: 5, y_m: 3, yaw_deg: 90, speed_mps: 1}]"))
    read = load_scene(path)
    car = read.objects[0]
    assert car.object_class == "two_box_car"
    assert (car.kind.length_m, car.kind.width_m, car.kind.height_m) == pytest.approx((4.2, 1.8, 1.4), abs=1e-5)
    # a quarter of the box's surface
    assert car.kind.mean_rcs_dbsm == pytest.approx(10.0 * math.log10(2 * (4.2 * 1.8 + 1.8 * 1.4 + 1.4 * 4.2) / 4))
    assert car.corners_m() == pytest.approx(np.array([[4.1, 5.1], [4.1, 0.9], [5.9, 0.9], [5.9, 5.1]]), abs=1e-5)
    assert car.contains(np.array([[5.8, 5.0], [5.8, 5.2]])).tolist() == [True, False]
    assert car.shape is not None
    assert len(car.shape.faces) == 24
    assert scene_from_yaml(scene_to_yaml(read)) == read


def test_millimetres_read_as_metres_name_file_field_value_and_rule(tmp_path: Path) -> None:
    shutil.copy(MESHES / "two_box_car_mm.ply", tmp_path / "car.ply")
    path = tmp_path / "x.yaml"
    path.write_text(scene(objects="[{mesh: car.ply, x_m: 5, y_m: 0}]"))
    with pytest.raises(ValueError) as caught:
        load_scene(path)
    assert str(caught.value) == (
        f"{path}: objects[0].mesh: {tmp_path / 'car.ply'}: unit: the longest extent must lie in 0.05..40 m, "
        "got 4200 m in m: give unit: mm?"
    )
    path.write_text(scene(objects="[{mesh: car.ply, unit: mm, x_m: 5, y_m: 0}]"))
    assert load_scene(path).objects[0].kind.length_m == pytest.approx(4.2, abs=1e-5)


def test_primitives_stand_where_told() -> None:
    """A thin plate keeps a body in plan; z_m lifts the mesh and its top."""
    text = scene(
        objects="[{primitive: plate, size_m: [2, 1], material: glass, z_m: 0.5, x_m: 5, y_m: 1, yaw_deg: 180}]"
    )
    read = scene_from_yaml(text)
    sign = read.objects[0]
    assert (sign.object_class, sign.kind.height_m, sign.kind.width_m) == ("plate", 1.5, 2.0)
    assert sign.kind.length_m > 0.0
    assert sign.shape is not None
    assert sign.shape.material == "glass"
    assert sign.shape.vertices_m[:, 2].min() == pytest.approx(0.5)
    assert scene_from_yaml(scene_to_yaml(read)) == read
    assert "class" not in scene_to_yaml(read)


def test_walls_may_be_built_of_layers_or_be_foliage() -> None:
    for material in ("double_glazing", "insulated_wall", "vegetation", "hedge"):
        assert scene_from_yaml(scene(WALL.replace("concrete", material).join("[]"))).surfaces[0].material == material


BULGE_M = (1.0 - math.sqrt(1.0 - (5.0 * 0.19) ** 2)) / 0.19


@pytest.mark.parametrize(
    ("curvature_per_m", "gap_m", "clear"), [(-0.19, 0.09, False), (-0.19, 0.11, True), (0.19, 0.09, True)]
)
def test_radar_keeps_off_arcs(curvature_per_m: float, gap_m: float, clear: bool) -> None:
    """An arc over a chord of 10 m along +y must pass the radar 0.1 m off, wherever its chord is.

    Left of +y is -x, where the centre of a positive curvature lies; with a negative one the arc bulges towards the
    radar by `BULGE_M`, and its vertex passes at `gap_m`.
    """
    chord_m = BULGE_M + gap_m
    wall = (
        f"[{{role: relay, material: metal, polyline_m: [[{chord_m}, -5], [{chord_m}, 5]],"
        f" curvature_per_m: {curvature_per_m}}}]"
    )
    if clear:
        scene_from_yaml(scene(wall))
    else:
        with pytest.raises(ValueError, match=r"surfaces\[0\]\.polyline_m\[0\]: the radar .* with curvature -0\.19"):
            scene_from_yaml(scene(wall))


def test_object_in_the_bulge_of_an_arc_is_refused() -> None:
    """The arc passes 3.6 m beyond its chord: there a car stands in the wall, on the chord it does not."""
    wall = "[{role: relay, material: metal, polyline_m: [[9, -5], [9, 5]], curvature_per_m: 0.19}]"
    scene_from_yaml(scene(wall, "[{class: car, x_m: 9, y_m: 0, yaw_deg: 90}]"))
    with pytest.raises(ValueError, match=r"objects\[0\]\.x_m: must stand clear of surfaces\[0\]"):
        scene_from_yaml(scene(wall, f"[{{class: car, x_m: {9.0 + BULGE_M}, y_m: 0, yaw_deg: 90}}]"))
