"""Scenes of maps: walls in the radar's frame, and what becomes of footprints that are none."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("shapely", reason="maps need shapely")
pytest.importorskip("osmium", reason="maps need osmium")

import shapely

from msgs.files.shipped import LAUNCH
from sim_player.maps.facades import facades
from sim_player.maps.footprints import Footprint, FootprintFile
from sim_player.maps.local_frame import MapPose
from sim_player.maps.map_scene import MapScene, map_scene, read_map
from sim_player.maps.wall_rules import DEFAULT_RULES, read_rules
from sim_player.paths.ray_tracing import trace
from sim_player.scene.description import scene_from_yaml
from sim_player.scene.world import prepare

EXAMPLE = LAUNCH / "maps" / "invented_street.geojson"
Ring = list[tuple[float, float]]


def box(x: float, y: float, width: float = 10.0, depth: float = 10.0) -> Ring:
    return [(x, y), (x + width, y), (x + width, y + depth), (x, y + depth)]


def scene_of(*rings: Ring, heading: float = 0.0, holes: tuple[Ring, ...] = (), radius_m: float = 165.0) -> MapScene:
    """Scene of outlines in metres around a radar at (0, 0)."""
    footprints = tuple(
        Footprint(f"way {index}", tuple(ring), tuple(map(tuple, holes)), {}) for index, ring in enumerate(rings)
    )
    pose = MapPose(0.0, 0.0, heading, metric=True)
    return map_scene(FootprintFile(footprints, (), True, {}), pose, radius_m, DEFAULT_RULES, "a")


def pieces(made: MapScene) -> set[frozenset[tuple[float, float]]]:
    return {
        frozenset(pair)
        for surface in made.scene.surfaces
        for pair in zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True)
    }


def test_a_house_in_the_north_stands_ahead() -> None:
    """East of the map is right of a radar that looks north: y = -east."""
    made = scene_of(box(-5.0, 20.0))
    assert pieces(made) == {
        frozenset(pair)
        for pair in (
            ((20.0, 5.0), (20.0, -5.0)), ((20.0, -5.0), (30.0, -5.0)), ((30.0, -5.0), (30.0, 5.0)),
            ((30.0, 5.0), (20.0, 5.0)),
        )
    }  # fmt: skip
    assert (made.buildings, made.walls, made.default_heights) == (1, 4, 1)
    # a radar that looks east has the same house on its left
    assert all(
        y > 0.0 for surface in scene_of(box(-5.0, 20.0), heading=90.0).scene.surfaces for _, y in surface.polyline_m
    )


def test_walls_between_two_houses_are_left_out() -> None:
    made = scene_of(box(-10.0, 20.0), box(0.0, 20.0))
    assert made.walls == 6
    assert made.left_out["walls between two buildings"] == 2
    assert frozenset(((20.0, 0.0), (30.0, 0.0))) not in pieces(made)


HOUSE = box(-5.0, 20.0)
SHIFTED = [(x + 0.011, y - 0.007) for x, y in HOUSE]
NODE_MORE = [*HOUSE[:1], (0.0, 20.0), *HOUSE[1:]]
LEFT, RIGHT = box(-5.0, 20.0, 4.0), box(-1.0, 20.0, 6.0)
PARTED = [*HOUSE[:1], (-1.0, 20.0), *HOUSE[1:3], (-1.0, 30.0), *HOUSE[3:]]
UP_OR_DOWN = [(-1.0, 20.0), *HOUSE[1:3], (-1.0, 30.0)]


@pytest.mark.parametrize(
    ("rings", "length_m"),
    [
        ((HOUSE, HOUSE[2:] + HOUSE[:2]), 40.0),
        ((HOUSE, HOUSE[::-1]), 40.0),
        ((HOUSE, NODE_MORE), 40.0),
        ((NODE_MORE, HOUSE[::-1]), 40.0),
        ((HOUSE, SHIFTED, NODE_MORE), 40.0),
        ((HOUSE, HOUSE, HOUSE), 40.0),
        ((PARTED, LEFT, RIGHT), 40.0),
        ((HOUSE, LEFT, UP_OR_DOWN), 40.0),
        # a tower inside, flush with one side, and a room that touches none
        ((HOUSE, box(-5.0, 22.0, 3.0, 3.0)), 40.0),
        ((HOUSE, box(-2.0, 23.0, 3.0, 3.0)), 40.0),
        # parts that share walls of different length, and one that overlaps by a metre
        ((LEFT, RIGHT), 40.0),
        ((box(-5.0, 20.0, 5.0, 10.0), box(0.0, 22.0, 5.0, 4.0)), 40.0),
        ((HOUSE, box(4.0, 22.0, 10.0, 4.0)), 58.0),
        # neighbours a centimetre apart, and an alley of a metre
        ((HOUSE, box(5.01, 20.0)), 60.0),
        ((HOUSE, box(6.0, 20.0)), 80.0),
    ],
)
def test_what_coincides_has_its_outer_walls_once(rings: tuple[Ring, ...], length_m: float) -> None:
    """A house of 10 x 10 m drawn twice, shifted by a map's rounding, in parts, inside or beside another."""
    for order in (rings, rings[::-1]):
        made = scene_of(*order)
        assert sum(math.dist(*pair) for pair in pieces(made)) == pytest.approx(length_m, abs=0.05)


def test_what_is_left_out_is_said() -> None:
    """Of a house given three times the tags of all count; of parts in an outline the outline's own walls go."""
    made = scene_of(HOUSE, SHIFTED, NODE_MORE)
    assert (made.buildings, made.left_out["buildings given twice"]) == (1, 2)
    parts = scene_of(PARTED, LEFT, RIGHT)
    assert (parts.buildings, parts.walls) == (3, 6)
    assert parts.left_out["walls that another building has too"] == 6
    assert parts.left_out["walls between two buildings"] == 2
    # a courtyard is open air: what stands in it keeps its walls, but for those against it
    yard = Footprint("way 0", tuple(box(-20.0, 20.0, 40.0, 40.0)), (tuple(box(-10.0, 30.0, 20.0, 20.0)),), {})
    for ring, length_m in ((box(-5.0, 32.0, 4.0, 4.0), 256.0), (box(-10.0, 32.0, 4.0, 4.0), 248.0)):
        file = FootprintFile((Footprint("way 1", tuple(ring), (), {}), yard), (), True, {})
        made = map_scene(file, MapPose(0.0, 0.0, 0.0, metric=True), 165.0, DEFAULT_RULES, "a")
        assert sum(math.dist(*pair) for pair in pieces(made)) == pytest.approx(length_m)


def test_courtyards_have_walls() -> None:
    made = scene_of(box(-20.0, 20.0, 40.0, 40.0), holes=(box(-5.0, 30.0),))
    assert (made.buildings, made.walls) == (1, 8)


def test_houses_beyond_the_radius_are_counted() -> None:
    made = scene_of(box(-5.0, 20.0), box(-5.0, 60.0), radius_m=50.0)
    assert (made.buildings, made.left_out["buildings beyond the radius"]) == (1, 1)


def test_corners_that_lie_on_one_another_are_one() -> None:
    ring = [(-5.0, 20.0), (-5.0 + 1e-9, 20.0), (5.0, 20.0), (5.0, 20.004), (5.0, 30.0), (-5.0, 30.0)]
    assert scene_of(ring).walls == 4


@pytest.mark.parametrize(
    ("ring", "line"),
    [
        (
            [(0, 20), (10, 30), (10, 20), (0, 30)],
            "way 0: must be rings whose edges do not cross, got Self-intersection",
        ),
        ([(0, 20), (10, 20), (20, 20)], r"way 0: must enclose 0.01 m\^2 at least, got 0 m\^2"),
        ([(0, 20)] * 4, "way 0: must enclose"),
        (box(0, 20, 1e-3, 1e-3), "way 0: must enclose"),
    ],
)
def test_a_footprint_that_is_none_is_named(ring: Ring, line: str) -> None:
    with pytest.raises(ValueError, match=line):
        scene_of(ring)
    made = scene_of(ring, box(-40.0, 20.0))
    assert (made.buildings, len(made.broken)) == (1, 1)


@pytest.mark.parametrize(
    ("ring", "line"),
    [
        (box(-5.0, -5.0), "--position: must stand outside all buildings, got a place in way 0"),
        (box(0.05, -5.0), "--position: must stand 0.1 m off every wall, got 0.050 m to way 0"),
        (box(4000.0, 0.0), "--position: must have a building within 165 m on the map, the nearest is 4000 m away"),
    ],
)
def test_a_place_where_no_radar_stands_is_refused(ring: Ring, line: str) -> None:
    with pytest.raises(ValueError, match=line):
        scene_of(ring)


def test_an_empty_map_and_a_radius_that_is_none_are_refused() -> None:
    with pytest.raises(ValueError, match="must have a building within 165 m on the map, it has none"):
        scene_of()
    for radius_m in (1.0, 1e5, float("nan")):
        with pytest.raises(ValueError, match="--radius must be"):
            scene_of(box(0.0, 20.0), radius_m=radius_m)


def test_more_walls_than_a_scene_may_have_are_refused() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 10_002)[:-1]
    circle = [(float(x), float(y)) for x, y in zip(400.0 * np.cos(turn), 900.0 + 400.0 * np.sin(turn), strict=True)]
    with pytest.raises(ValueError, match="--radius: must hold at most 10000 walls, got 10001 within 600 m"):
        scene_of(circle, radius_m=600.0)


def test_the_example_becomes_a_scene_that_can_be_read_and_traced() -> None:
    """11 of 12 buildings within 165 m; three houses share two walls, which both have: four pieces are left out."""
    made = map_scene(read_map(EXAMPLE), MapPose(10.0, -30.0, 0.0), 165.0, read_rules([]), "example", ground="asphalt")
    assert (made.buildings, made.walls, made.default_heights) == (11, 47, 2)
    assert made.materials == {"brick": 16, "concrete": 11, "glass": 4, "metal": 12, "wood": 4}
    assert made.left_out == {
        "features that are no building": 2,
        "buildings beyond the radius": 1,
        "walls between two buildings": 4,
    }
    assert scene_from_yaml(made.yaml) == made.scene
    paths = trace(prepare(made.scene))
    ahead = paths.take(np.abs(paths.azimuth_rad) < 0.01)
    # the facade across the street, 26 m ahead, is met square on
    assert ahead.length_m[np.argmax(np.abs(ahead.amplitude))] == pytest.approx(52.0, abs=0.02)


def test_only_maps_are_read() -> None:
    with pytest.raises(ValueError, match=r"a\.txt: a map's name must end in .geojson, .json, .osm, .xml"):
        read_map(LAUNCH / "a.txt")
    with pytest.raises(ValueError, match=r"a\.osm: OpenStreetMap is in degrees"):
        read_map(LAUNCH / "a.osm", metric=True)


def test_facades_are_the_outline_of_the_union() -> None:
    """Drawn boxes on a grid, turned by 0.3 rad, corners off by millimetres: as long as shapely's union, to 0.5 m."""
    rng = np.random.default_rng(2)
    turn = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    for _ in range(40):
        low, size = rng.integers(0, 20, (6, 1, 2)), rng.integers(2, 12, (6, 1, 2))
        rings = (low + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size) @ turn + rng.normal(0.0, 5e-3, (6, 4, 2))
        found = facades([[ring] for ring in rings])
        length_m = sum(np.hypot(*np.diff(line, axis=0).T).sum() for lines in found.lines for line in lines)
        grown = [shapely.Polygon(ring).buffer(0.03, join_style="mitre") for ring in rings]
        assert length_m == pytest.approx(shapely.union_all(grown).buffer(-0.03, join_style="mitre").length, abs=0.5)
