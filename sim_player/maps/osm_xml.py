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
from sim_player.maps.geojson import NO_BUILDING

ATTRIBUTION = "map data: OpenStreetMap contributors, Open Database Licence"


def read_osm(path: Path) -> FootprintFile:
    """Read the buildings of a file; ValueError without the file's name where it is no OSM XML.

    A way whose nodes are missing and a multipolygon that does not close (maps that were cut) are broken footprints.
    """
    check_size(path)
    reader = _Reader()
    try:
        # said to be XML whatever the name is: no other format is tried
        for entity in osmium.FileProcessor(osmium.io.File(str(path), "osm")).with_areas():
            reader.take(entity)
    except (RuntimeError, osmium.InvalidLocationError) as error:
        raise ValueError(f"not OpenStreetMap XML: {' '.join(str(error).split())}") from None
    return FootprintFile(tuple(reader.footprints), tuple(reader.broken), False, dict(reader.left_out), ATTRIBUTION)


class _Reader:
    """Collects the buildings of one file; objects of libosmium live only while they are handed over."""

    def __init__(self) -> None:
        self.points = 0
        self.footprints: list[Footprint] = []
        self.broken: list[str] = []
        self.left_out: Counter[str] = Counter()

    def take(self, entity: Any) -> None:
        """Take a building; areas that come from ways were taken as ways."""
        tags = {tag.k: tag.v for tag in entity.tags}
        if tags.get("building", "no").lower() in NO_BUILDING:
            return
        try:
            if entity.is_way():
                self._way(entity, tags)
            elif entity.is_area() and not entity.from_way():
                self._relation(entity, tags)
            elif entity.is_node():
                self.left_out["buildings without outline"] += 1
        except ValueError as error:
            self.broken.append(str(error))
        check_count(self.points)

    def _way(self, closed: Any, tags: dict[str, str]) -> None:
        self._add(f"way {closed.id}", closed.nodes, (), tags)

    def _relation(self, area: Any, tags: dict[str, str]) -> None:
        field, outers = f"relation {area.orig_id()}", list(area.outer_rings())
        if not outers:
            raise ValueError(f"{field}: must be closed rings that do not cross, got ways that make none")
        for outer in outers:
            self._add(field, outer, tuple(area.inner_rings(outer)), tags)

    def _add(self, field: str, outer: Any, holes: tuple[Any, ...], tags: dict[str, str]) -> None:
        rings = [ring_of(field, self._positions(field, ring), False) for ring in (outer, *holes)]
        self.footprints.append(Footprint(field=field, outer=rings[0], holes=tuple(rings[1:]), tags=tags))

    def _positions(self, field: str, nodes: Any) -> list[Position]:
        positions = []
        for node in nodes:
            if not node.location.valid():
                raise ValueError(f"{field}: must have all its nodes in the file, node {node.ref} is missing")
            positions.append((float(node.lon), float(node.lat)))
        self.points += len(positions)
        return positions
