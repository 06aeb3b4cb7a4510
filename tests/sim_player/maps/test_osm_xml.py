"""OpenStreetMap XML: buildings as ways and multipolygons, and files that were cut."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("osmium", reason="maps of OpenStreetMap need osmium")

from sim_player.maps.footprints import FootprintFile
from sim_player.maps.osm_xml import ATTRIBUTION, read_osm

NODES = {1: (0, 0), 2: (2, 0), 3: (2, 2), 4: (0, 2), 5: (0.5, 0.5), 6: (1.5, 0.5), 7: (1.5, 1.5)}
HOUSE = '<tag k="building" v="house"/>'


def way(number: int, nodes: tuple[int, ...], tags: str = "") -> str:
    return f'<way id="{number}">' + "".join(f'<nd ref="{node}"/>' for node in nodes) + tags + "</way>"


def relation(number: int, members: dict[int, str], tags: str = HOUSE) -> str:
    inner = "".join(f'<member type="way" ref="{ref}" role="{role}"/>' for ref, role in members.items())
    return f'<relation id="{number}">{inner}<tag k="type" v="multipolygon"/>{tags}</relation>'


def read(tmp_path: Path, *entities: str) -> FootprintFile:
    nodes = "".join(
        f'<node id="{n}" lat="{10 + y * 1e-4:.5f}" lon="{20 + x * 1e-4:.5f}"/>' for n, (x, y) in NODES.items()
    )
    path = tmp_path / "a.osm"
    path.write_text(f'<?xml version="1.0"?><osm version="0.6">{nodes}{"".join(entities)}</osm>')
    return read_osm(path)


def test_a_closed_way_is_a_building_and_others_are_not(tmp_path: Path) -> None:
    park = way(11, (1, 2, 3, 1), '<tag k="leisure" v="park"/>')
    read_file = read(tmp_path, way(10, (1, 2, 3, 4, 1), HOUSE + '<tag k="height" v="7"/>'), park)
    (house,) = read_file.footprints
    assert (house.field, dict(house.tags)) == ("way 10", {"building": "house", "height": "7"})
    assert house.outer == ((20.0, 10.0), (20.0002, 10.0), (20.0002, 10.0002), (20.0, 10.0002))
    assert read_file.attribution == ATTRIBUTION


def test_a_multipolygon_is_joined_from_its_ways(tmp_path: Path) -> None:
    ways = way(12, (1, 2, 3)), way(13, (3, 4, 1)), way(14, (5, 6, 7, 5))
    (building,) = read(tmp_path, *ways, relation(20, {12: "outer", 13: "outer", 14: "inner"})).footprints
    assert building.field == "relation 20"
    assert len(building.outer) == 4
    assert [len(hole) for hole in building.holes] == [3]


RING, COURT = (1, 2, 3, 4, 1), (5, 6, 7, 5)
BOTH = {10: "outer", 11: "inner"}


@pytest.mark.parametrize(
    "entities",
    [
        (way(10, RING, HOUSE), way(11, COURT), relation(20, BOTH)),
        # the tags of the outline count where the relation has none of its own
        (way(10, RING, HOUSE), way(11, COURT), relation(20, BOTH, "")),
        (relation(20, BOTH), way(11, COURT), way(10, RING)),
        (
            way(-2, (3, 4, 1), HOUSE),
            way(12, (1, 2, 3), HOUSE),
            way(11, COURT),
            relation(20, {12: "outer", -2: "outer", 11: "inner"}),
        ),
    ],
    ids=["tagged twice", "tagged on its way", "before its ways", "of open ways"],
)  # fmt: skip
def test_a_multipolygon_keeps_its_courtyard(tmp_path: Path, entities: tuple[str, ...]) -> None:
    read_file = read(tmp_path, *entities)
    (building,) = read_file.footprints
    assert (building.field, len(building.outer), [len(hole) for hole in building.holes]) == ("relation 20", 4, [3])
    assert building.tags["building"] == "house"
    assert not read_file.broken


def test_a_building_that_bounds_something_else_stays_whole(tmp_path: Path) -> None:
    """Grounds of a school whose outer way is a building, and a building in a courtyard of another."""
    school = relation(20, BOTH, '<tag k="amenity" v="school"/>')
    (building,) = read(tmp_path, way(10, RING, HOUSE), way(11, COURT), school).footprints
    assert (building.field, building.holes) == ("way 10", ())
    found = read(tmp_path, way(10, RING, HOUSE), way(11, COURT, HOUSE), relation(20, BOTH)).footprints
    assert [each.field for each in found] == ["way 11", "relation 20"]


@pytest.mark.parametrize(
    ("before", "entities"),
    [
        # ways before their nodes, as "out body; >; out skel qt;" gives them, and every element twice
        (way(10, RING, HOUSE), (way(10, RING),)),
        # JOSM keeps what was deleted
        ("", (way(10, RING, HOUSE), way(11, COURT, HOUSE).replace("<way", "<way action='delete'"))),
        # a history has every version, the newest anywhere
        (way(11, COURT, HOUSE).replace("<way", "<way version='12' visible='false'"),
         (way(10, RING, HOUSE), way(11, COURT, HOUSE).replace("<way", "<way version='9' visible='true'"))),
        (way(10, RING, HOUSE).replace("<way", "<way version='2'"),
         (way(10, (1, 2, 3, 1), HOUSE).replace("<way", "<way version='1'"),)),
    ],
    ids=["ways first", "josm", "history", "moved"],
)  # fmt: skip
def test_the_newest_of_each_element_that_exists(tmp_path: Path, before: str, entities: tuple[str, ...]) -> None:
    path = tmp_path / "b.osm"
    read(tmp_path, *entities)
    path.write_text((tmp_path / "a.osm").read_text().replace("<node", f"{before}<node", 1))
    (building,) = read_osm(path).footprints
    assert (building.field, len(building.outer)) == ("way 10", 4)


def test_ways_that_bring_their_geometry(tmp_path: Path) -> None:
    """`out geom;` of Overpass: no node stands alone."""
    corners = "".join(f'<nd ref="{ref + 100}" lat="{10 + NODES[ref][1]}" lon="{20 + NODES[ref][0]}"/>' for ref in RING)
    (building,) = read(tmp_path, f'<way id="10"><bounds minlat="1"/>{corners}{HOUSE}</way>').footprints
    assert building.outer == ((20.0, 10.0), (22.0, 10.0), (22.0, 12.0), (20.0, 12.0))


@pytest.mark.parametrize(
    ("entities", "line"),
    [
        ((way(10, (1, 99, 3, 1), HOUSE),), "way 10: must have all its nodes in the file, node 99 is missing"),
        ((way(10, (1, 2, 3), HOUSE),), "way 10: must be a closed ring of 4 points or more, got 3 points"),
        ((way(12, (1, 2, 3)), relation(21, {12: "outer"})), "relation 21: must be closed rings that do not cross"),
        ((way(10, RING), relation(20, BOTH)), "relation 20: must have all its ways in the file, way 11 is missing"),
        ((way(11, COURT), relation(20, BOTH)), "relation 20: must have all its ways in the file, way 10 is missing"),
    ],
)
def test_what_a_cut_left_of_a_building_is_named(tmp_path: Path, entities: tuple[str, ...], line: str) -> None:
    read_file = read(tmp_path, *entities)
    assert not read_file.footprints
    assert read_file.broken[0].startswith(line)


def test_an_outline_whose_courtyard_was_cut_off_stands_and_is_named(tmp_path: Path) -> None:
    read_file = read(tmp_path, way(10, RING, HOUSE), relation(20, BOTH, ""))
    assert [each.field for each in read_file.footprints] == ["way 10"]
    assert read_file.broken == ("relation 20: must have all its ways in the file, way 11 is missing",)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "got an empty file"),
        ("{}", "not OpenStreetMap XML"),
        ("<html></html>", "not OpenStreetMap XML"),
        ('<osm version="0.6"><node id="1" lat="1"', "not OpenStreetMap XML"),
        ('<osm version="0.6"><node id="1" lat="NaN" lon="1"/></osm>', "not OpenStreetMap XML: wrong format for coord"),
        ('<osm version="0.7"></osm>', "not OpenStreetMap XML"),
    ],
)
def test_what_is_no_map_is_refused_in_one_line(tmp_path: Path, content: str, line: str) -> None:
    path = tmp_path / "a.osm"
    path.write_text(content)
    with pytest.raises(ValueError, match=line) as refusal:
        read_osm(path)
    assert "\n" not in str(refusal.value)


def test_entities_that_grow_without_bound_are_refused(tmp_path: Path) -> None:
    """Ten levels of ten: a text of 10^10 characters from a file of some hundred bytes."""
    levels = "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 11))
    path = tmp_path / "a.osm"
    path.write_text(f'<!DOCTYPE o [<!ENTITY a0 "x">{levels}]><osm version="0.6"><note>&a10;</note></osm>')
    with pytest.raises(ValueError, match="not OpenStreetMap XML"):
        read_osm(path)
