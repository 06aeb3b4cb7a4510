"""`mirrorwave sim import map`, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("shapely", reason="maps need shapely")
pytest.importorskip("osmium", reason="maps need osmium")

from fuzz.seeds import OSM
from mirrorwave.cli import main
from sim_player.scene.description import load_scene

EXAMPLE = "launch/maps/invented_street.geojson"
HERE = ["--position", "10.0,-30.0"]


def imported(out: Path, *options: str, file: str = EXAMPLE) -> int:
    return main(["sim", "import", "map", file, *HERE, "--out", str(out), *options])


def test_the_example_as_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out, picture = tmp_path / "scene.yaml", tmp_path / "scene.png"
    assert imported(out, "--plot", str(picture), "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["scene"], report["buildings"], report["walls"]) == (str(out), 11, 47)
    assert sum(report["materials"].values()) == 47
    assert report["left_out"]["buildings beyond the radius"] == 1
    assert report["broken"] == []
    assert picture.stat().st_size > 10_000
    assert sum(len(surface.polyline_m) - 1 for surface in load_scene(out).surfaces) == 47


def test_options_reach_the_scene(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "scene.yaml"
    options = ("--materials", "*=*:wood,20", "--ground", "asphalt", "--radius", "30", "--height-m", "0.6")
    assert imported(out, "--heading", "90", *options) == 0
    said = capsys.readouterr().out
    assert "wood" in said
    assert "without a height on the map" in said
    scene = load_scene(out)
    assert scene.radar.height_m == 0.6
    assert {surface.material for surface in scene.surfaces} == {"wood", "asphalt"}
    assert {surface.thickness_mm for surface in scene.surfaces if surface.role != "ground"} == {20.0}
    # the facade that lay ahead lies on the left of a radar that looks east
    assert any(y > 25.0 for surface in scene.surfaces for _, y in surface.polyline_m)


def test_openstreetmap_says_whose_data_it_is(tmp_path: Path) -> None:
    file, out = tmp_path / "a.osm", tmp_path / "scene.yaml"
    file.write_bytes(OSM)
    assert imported(out, file=str(file)) == 0
    assert out.read_text(encoding="utf-8").startswith("# map data: OpenStreetMap contributors")
    assert len(load_scene(out).surfaces) == 3


def test_broken_footprints_end_it_or_are_left_out(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    content = json.loads(Path(EXAMPLE).read_text())
    ring = content["features"][4]["geometry"]["coordinates"][0]
    ring[1], ring[2] = ring[2], ring[1]
    file, out = tmp_path / "a.geojson", tmp_path / "scene.yaml"
    file.write_text(json.dumps(content))
    assert imported(out, file=str(file)) == 2
    line = capsys.readouterr().err
    assert f"{file}: features[4].geometry.coordinates: must be rings whose edges do not cross" in line
    assert line.count("\n") == 1
    assert not out.exists()
    assert imported(out, "--skip-broken", file=str(file)) == 3
    assert "left out: features[4]" in capsys.readouterr().err
    assert out.exists()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--position", "10"], "--position must be LAT,LON in degrees (X,Y in metres with --metric), got '10'"),
        (["--position", "nan,3"], "--position must be LAT,LON"),
        (["--position", "95,3"], "--position: latitude must be within 89.9 deg, got 95.0"),
        (["--position", "48.1,11.5"], "--position: must have a building within 165 m on the map, the nearest is"),
        (["--position", "10.0,-30.0", "--radius", "nan"], "--radius must be 5..5000 m, got nan"),
        (["--position", "10.0,-30.0", "--materials", "x"], "--materials must be KEY=VALUE:MATERIAL"),
        (["--position", "10.0,-30.0", "--ground", "cheese"], "--ground: unknown material 'cheese'"),
        (["--position", "10.0,-30.0", "--metric"], "must enclose 0.01 m^2 at least"),
    ],
)
def test_a_wrong_option_is_named(
    arguments: list[str], line: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "scene.yaml"
    assert main(["sim", "import", "map", EXAMPLE, "--out", str(out), *arguments]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_nothing_is_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scene.yaml"
    out.write_text("mine")
    assert imported(out) == 2
    assert "exists already" in capsys.readouterr().err
    assert out.read_text() == "mine"
