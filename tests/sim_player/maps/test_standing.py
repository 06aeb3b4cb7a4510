"""What tags say that a building stands and has walls at the height of a car."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sim_player.maps.geojson import read_geojson
from sim_player.maps.standing import is_building, why_no_wall

GONE, NOT_YET, BELOW = "buildings that are gone", "buildings that are not built yet", "buildings below ground"
ABOVE, OPEN = "buildings above a car", "roofs without walls"


@pytest.mark.parametrize(
    ("tags", "reason"),
    [
        ("building=yes", None),
        ("building=house height=0.5", None),
        ("building=yes disused=yes abandoned=yes historic=castle", None),
        ("disused:building=yes", None),
        ("abandoned:building=house", None),
        ("building=yes construction=minor", None),
        ("building=yes layer=1 location=overground", None),
        ("building=yes min_height=1.2 wall=yes", None),
        ("building=yes building:levels=2 building:levels:underground=1", None),
        ("building=yes demolished=no bridge=no was:building=no", None),
        ("building=yes layer=0;-1", None),
        ("building=demolished", GONE),
        ("building=Ruins", GONE),
        ("building=yes demolished=yes", GONE),
        ("building=yes demolished:building=yes", GONE),
        ("building=yes razed:building=house", GONE),
        ("building=yes removed:building=house", GONE),
        ("building=yes end_date=2019-05", GONE),
        ("building=construction construction=apartments", NOT_YET),
        ("building=proposed", NOT_YET),
        ("building=yes proposed=yes", NOT_YET),
        ("building=yes planned:building=yes", NOT_YET),
        ("building=yes location=underground", BELOW),
        ("building=yes layer=-1", BELOW),
        ("building=yes layer=-1;-2", BELOW),
        ("building=garage parking=underground", BELOW),
        ("building=yes building:levels=0 building:levels:underground=2", BELOW),
        ("building=yes min_height=4", ABOVE),
        ("building=yes min_height=9'", ABOVE),
        ("building=yes building:min_level=1", ABOVE),
        ("building=bridge", ABOVE),
        ("building=yes bridge=yes", ABOVE),
        ("building=yes location=rooftop", ABOVE),
        ("building=roof", OPEN),
        ("building=carport", OPEN),
        ("building=yes wall=no", OPEN),
        ("building=yes building:part=roof", OPEN),
    ],
)
def test_the_table(tags: str, reason: str | None) -> None:
    plain = dict(word.split("=") for word in tags.split())
    assert is_building(plain)
    assert why_no_wall(plain) == reason


@pytest.mark.parametrize("tags", [{}, {"building": "no"}, {"demolished:building": "yes"}, {"building": " No "}])
def test_no_building_at_all(tags: dict[str, str]) -> None:
    assert not is_building(tags)


def test_geojson_follows_the_same_table(tmp_path: Path) -> None:
    """With the property `building` on some features, and without any."""
    ring = [[[11.0, 48.0], [11.1, 48.0], [11.1, 48.1], [11.0, 48.0]]]
    kinds: list[dict] = [
        {"building": "yes"},
        {"building": "roof"},
        {"building": True, "layer": -1},
        {"building": False},
        {"demolished:building": "yes"},
    ]

    def read(kinds: list[dict]) -> tuple[int, dict]:
        features = [
            {"type": "Feature", "properties": kind, "geometry": {"type": "Polygon", "coordinates": ring}}
            for kind in kinds
        ]
        path = tmp_path / "a.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
        file = read_geojson(path)
        return len(file.footprints), dict(file.left_out)

    assert read(kinds) == (1, {OPEN: 1, BELOW: 1, "features that are no building": 2})
    assert read([{}, {"layer": -1}, {"name": "x"}]) == (2, {BELOW: 1})
