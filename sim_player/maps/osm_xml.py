"""OpenStreetMap XML: closed ways and multipolygons with the tag `building`, read by libosmium."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

try:
    import osmium
except ImportError:
    raise ImportError("osmium, which maps of OpenStreetMap need: pip install 'mirrorwave[maps]'") from None

from sim_player.maps.footprints import Footprint, FootprintFile, Position, check_count, check_size, ring_of
from sim_player.maps.osm_elements import plain_osm
from sim_player.maps.standing import is_building, why_no_wall

#: Tags of a multipolygon that say nothing of what it is.
_NO_OBJECT = frozenset(("type", "source", "created_by", "note", "fixme"))
ATTRIBUTION = "map data: OpenStreetMap contributors, Open Database Licence"


def read_osm(path: Path) -> FootprintFile:
    """Read the buildings of a file; ValueError without the file's name where it is no OSM XML.

    Cut ways and multipolygons are broken footprints; an outer ring's outline is read as its multipolygon.
    """
    check_size(path)
    reader = _Reader()
    try:
        # said to be XML whatever the name is: no other format is tried
        file = osmium.io.FileBuffer(plain_osm(path.read_bytes()), "osm")
        for entity in osmium.FileProcessor(file, osmium.osm.WAY | osmium.osm.RELATION):
            reader.note_outline(entity)
        for entity in osmium.FileProcessor(file).with_areas():
            reader.take(entity)
    except (RuntimeError, osmium.InvalidLocationError) as error:
        raise ValueError(f"not OpenStreetMap XML: {' '.join(str(error).split())}") from None
    return reader.file()


class _Reader:
    """Collects the buildings of one file; objects of libosmium live only while they are handed over."""

    def __init__(self) -> None:
        self.points = 0
        #: Footprints, or why there is none, of each element.
        self._footprints: dict[str, list[Footprint | str]] = {}
        #: Tags of all ways.
        self._tags_of_ways: dict[int, dict[str, str]] = {}
        #: Outer ways of each multipolygon.
        self._outlines: dict[int, list[int]] = {}
        self._in_multipolygons: set[str] = set()
        self.left_out: Counter[str] = Counter()

    def file(self) -> FootprintFile:
        """Return all footprints; outlines that are those of a multipolygon are not given again."""
        kept = [
            each for field, items in self._footprints.items() if field not in self._in_multipolygons for each in items
        ]
        footprints = tuple(each for each in kept if isinstance(each, Footprint))
        broken = tuple(each for each in kept if isinstance(each, str))
        return FootprintFile(footprints, broken, False, dict(self.left_out), ATTRIBUTION)

    def note_outline(self, entity: Any) -> None:
        """Note the tags of a way, or the outer ways of a relation, which come after all ways: an area may come before.

        libosmium makes no area of a relation that lacks a way: it is a broken footprint until one is taken.
        """
        tags = {tag.k: tag.v for tag in entity.tags}
        if not entity.is_relation():
            self._tags_of_ways[entity.id] = tags
            return
        roles = {member.ref: member.role for member in entity.members if member.type == "w"}
        self._outlines[entity.id] = outlines = [number for number, role in roles.items() if role != "inner"]
        lost = next((number for number in roles if number not in self._tags_of_ways), None)
        if lost is not None and tags.get("type") == "multipolygon" and is_building(self._tags_of(tags, outlines)):
            field = f"relation {entity.id}"
            self._footprints[field] = [f"{field}: must have all its ways in the file, way {lost} is missing"]

    def take(self, entity: Any) -> None:
        """Take a building; areas that come from ways were taken as ways."""
        tags = {tag.k: tag.v for tag in entity.tags}
        if entity.is_way() and is_building(tags):
            self._take(f"way {entity.id}", tags, [(entity.nodes, ())])
        elif entity.is_node() and is_building(tags):
            self.left_out["buildings without outline"] += 1
        elif entity.is_area() and not entity.from_way():
            self._multipolygon(entity, tags)
        check_count(self.points)

    def _multipolygon(self, area: Any, tags: dict[str, str]) -> None:
        outlines = self._outlines.get(area.orig_id(), [])
        if not is_building(tags := self._tags_of(tags, outlines)):
            return
        rings = [(outer, tuple(area.inner_rings(outer))) for outer in area.outer_rings()]
        field = f"relation {area.orig_id()}"
        self._take(field, tags, rings)
        if not any(isinstance(each, str) for each in self._footprints[field]):
            # ways may come after the area that they make
            self._in_multipolygons.update(f"way {number}" for number in outlines)

    def _tags_of(self, tags: dict[str, str], outlines: list[int]) -> dict[str, str]:
        """Return the tags of a multipolygon: until 2016 they stood on its outer ways; heights often still do."""
        of_ways = [self._tags_of_ways[number] for number in outlines if number in self._tags_of_ways]
        if (is_building(tags) or not tags.keys() - _NO_OBJECT) and of_ways and all(map(is_building, of_ways)):
            return of_ways[0] | tags
        return tags

    def _take(self, field: str, tags: dict[str, str], rings: list[tuple[Any, tuple[Any, ...]]]) -> None:
        """Note the footprints of one element, or why it has none."""
        if reason := why_no_wall(tags):
            self.left_out[reason] += 1
            self._footprints[field] = []
            return
        try:
            if not rings:
                raise ValueError(f"{field}: must be closed rings that do not cross, got ways that make none")
            self._footprints[field] = [self._footprint(field, outer, holes, tags) for outer, holes in rings]
        except ValueError as error:
            self._footprints[field] = [str(error)]

    def _footprint(self, field: str, outer: Any, holes: tuple[Any, ...], tags: dict[str, str]) -> Footprint:
        rings = [ring_of(field, self._positions(field, ring), False) for ring in (outer, *holes)]
        return Footprint(field=field, outer=rings[0], holes=tuple(rings[1:]), tags=tags)

    def _positions(self, field: str, nodes: Any) -> list[Position]:
        positions = []
        for node in nodes:
            if not node.location.valid():
                raise ValueError(f"{field}: must have all its nodes in the file, node {node.ref} is missing")
            positions.append((float(node.lon), float(node.lat)))
        self.points += len(positions)
        return positions
