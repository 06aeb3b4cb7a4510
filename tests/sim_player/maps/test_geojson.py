"""GeoJSON of others: what is read, and the line that a refused file gets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sim_player.maps import footprints
from sim_player.maps.geojson import read_geojson

SQUARE = [[10.0, 50.0], [10.001, 50.0], [10.001, 50.001], [10.0, 50.001], [10.0, 50.0]]
COURT = [[10.0004, 50.0004], [10.0006, 50.0004], [10.0006, 50.0006], [10.0004, 50.0004]]


def polygon(*rings: Any) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(geometry: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def collection(*features: Any, **members: Any) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": list(features), **members}


def read(tmp_path: Path, content: Any, metric: bool = False) -> footprints.FootprintFile:
    path = tmp_path / "a.geojson"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_geojson(path, metric)


def test_polygons_with_courtyards_and_several_parts_are_read(tmp_path: Path) -> None:
    parts = {"type": "MultiPolygon", "coordinates": [[SQUARE], [SQUARE, COURT]]}
    read_file = read(
        tmp_path,
        collection(feature(polygon(SQUARE, COURT), building="house", height=7), feature(parts, building="yes")),
    )
    assert [len(one.holes) for one in read_file.footprints] == [1, 0, 1]
    assert read_file.footprints[0].outer == tuple((x, y) for x, y in SQUARE[:-1])
    assert read_file.footprints[0].tags == {"building": "house", "height": "7"}
    assert [one.field for one in read_file.footprints[1:]] == [
        f"features[1].geometry.coordinates[{index}]" for index in (0, 1)
    ]
    assert not read_file.broken


def test_a_bare_geometry_or_feature_is_a_map(tmp_path: Path) -> None:
    assert len(read(tmp_path, polygon(SQUARE)).footprints) == 1
    assert len(read(tmp_path, feature(polygon(SQUARE))).footprints) == 1


def test_where_some_features_are_buildings_the_others_are_none(tmp_path: Path) -> None:
    plain, house, none = feature(polygon(SQUARE)), feature(polygon(SQUARE), building="house"), {"building": "no"}
    assert len(read(tmp_path, collection(plain, plain)).footprints) == 2
    tagged = read(tmp_path, collection(plain, house, feature(polygon(SQUARE), **none)))
    assert len(tagged.footprints) == 1
    assert tagged.left_out == {"features that are no building": 2}


def test_points_and_lines_are_counted(tmp_path: Path) -> None:
    point = feature({"type": "Point", "coordinates": [10.0, 50.0]}, building="yes")
    read_file = read(
        tmp_path, collection(point, feature(None, building="yes"), feature(polygon(SQUARE), building="yes"))
    )
    assert read_file.left_out == {"features without polygon (Point)": 1, "features without geometry": 1}


@pytest.mark.parametrize("name", ["EPSG:4326", "urn:ogc:def:crs:OGC:1.3:CRS84"])
def test_older_files_may_name_wgs84(tmp_path: Path, name: str) -> None:
    crs = {"type": "name", "properties": {"name": name}}
    assert len(read(tmp_path, collection(feature(polygon(SQUARE)), crs=crs)).footprints) == 1


def test_metres_are_read_where_they_are_said_to_be(tmp_path: Path) -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    metres = polygon(
        [[566_000.0, 5_930_000.0], [566_010.0, 5_930_000.0], [566_010.0, 5_930_010.0], [566_000.0, 5_930_000.0]]
    )
    assert read(tmp_path, collection(feature(metres), crs=crs), metric=True).metric
    with pytest.raises(ValueError, match=r"crs: must be WGS 84 .*EPSG::25832.*--metric"):
        read(tmp_path, collection(feature(metres), crs=crs))
    (line,) = read(tmp_path, collection(feature(metres))).broken
    assert "features[0].geometry.coordinates[0][0]: must be longitude and latitude" in line
    assert "566000.0" in line


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "must hold building footprints, got an empty file"),
        ("[1, 2]", "expected a GeoJSON object, got a list"),
        ('{"type": "FeatureColl', "not JSON"),
        ('{"type": "Topology"}', "type: must be FeatureCollection"),
        ('{"type": "FeatureCollection"}', "features: expected a list, got nothing"),
        ('{"type": "FeatureCollection", "features": [3]}', r"features\[0\]: expected a Feature"),
        ('{"type": "Polygon", "coordinates": [[[NaN, 1]]]}', "not JSON"),
        ('{"type": "Polygon", "coordinates": [[[1e999, 1]]]}', "not JSON"),
        ("[" * 100_000, "not"),
        (feature(polygon(SQUARE)) | {"properties": 3}, "properties: expected a mapping"),
        (feature({"type": "MultiPolygon", "coordinates": 3}), "coordinates: expected a list of polygons"),
        (feature(polygon(SQUARE)) | {"crs": 3}, "crs: must be WGS 84"),
    ],
)
def test_what_is_no_map_is_refused_in_one_line(tmp_path: Path, content: Any, line: str) -> None:
    with pytest.raises(ValueError, match=line) as refusal:
        read(tmp_path, content)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("ring", "line"),
    [
        (SQUARE[:3], "must be a closed ring of 4 points or more, got 3 points"),
        (SQUARE[:-1], "must be a closed ring of 4 points or more, got an open line"),
        ([[10.0, "x"], *SQUARE[1:]], "expected two numbers"),
        ([[10.0, True], *SQUARE[1:]], "expected two numbers"),
        ([[10.0], *SQUARE[1:]], "expected two numbers"),
        ([[10.0, 91.0], *SQUARE[1:]], "must be longitude and latitude in degrees"),
        (3, "expected a list of positions, got a number"),
        (None, "expected a list of positions, got nothing"),
    ],
)
def test_a_broken_footprint_is_named_and_the_others_are_read(tmp_path: Path, ring: Any, line: str) -> None:
    read_file = read(tmp_path, collection(feature(polygon(ring)), feature(polygon(SQUARE))))
    assert len(read_file.footprints) == 1
    (reason,) = read_file.broken
    assert reason.startswith("features[0].geometry.coordinates[0]")
    assert line in reason


def test_a_map_of_more_points_than_a_map_may_have_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(footprints, "MAX_POINTS", 9)
    for features in ([feature(polygon(SQUARE))] * 2, [{}] * 10):
        with pytest.raises(ValueError, match="must hold at most 9 points of outlines"):
            read(tmp_path, collection(*features))


def test_a_larger_file_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(footprints, "MAX_BYTES", 100)
    with pytest.raises(ValueError, match="must hold at most 100 bytes"):
        read(tmp_path, collection(feature(polygon(SQUARE))))
