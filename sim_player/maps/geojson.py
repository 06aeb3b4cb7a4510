"""GeoJSON (RFC 7946): polygons and multipolygons of buildings, with their properties as tags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from msgs.files.text_files import decode_text
from msgs.files.yaml_loader import in_words
from sim_player.maps.footprints import Footprint, FootprintFile, Position, check_count, check_size, ring_of
from sim_player.maps.standing import KEYS, is_building, why_no_wall

#: Names of WGS 84 in the `crs` member of older files; RFC 7946 knows nothing else and has no such member.
WGS84_NAMES = ("urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:OGC::CRS84", "urn:ogc:def:crs:EPSG::4326", "EPSG:4326")


def read_geojson(path: Path, metric: bool = False) -> FootprintFile:
    """Read the building footprints of a file (metres if `metric`); ValueError without the file's name.

    Where some features have a property `building`, only these are buildings; else all polygons are.
    """
    check_size(path)
    try:
        content = msgspec.json.decode(decode_text(path.read_bytes()))
    except RecursionError:
        raise ValueError("not GeoJSON: nested too deep") from None
    except (msgspec.DecodeError, ValueError) as error:
        raise ValueError(f"not JSON: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"expected a GeoJSON object, got {in_words(content)}")
    _check_crs(content, metric)
    return _Reader(metric).read(content)


def _check_crs(content: dict[str, Any], metric: bool) -> None:
    """Refuse coordinates that are said to be something else."""
    crs = content.get("crs")
    if crs is None:
        return
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    degrees = name in WGS84_NAMES
    if degrees and metric:
        raise ValueError(f"crs: must be a system in metres for --metric, got {name!r}")
    if not degrees and not metric:
        raise ValueError(
            f"crs: must be WGS 84 (EPSG:4326) as RFC 7946 has it, got {name if name else crs!r}; "
            "convert the file (ogr2ogr -t_srs EPSG:4326), or give --metric and a position in its metres"
        )


class _Reader:
    """Collects the polygons of one file."""

    def __init__(self, metric: bool) -> None:
        self.metric = metric
        self.points = 0
        self.footprints: list[Footprint] = []
        self.broken: list[str] = []
        self.left_out: Counter[str] = Counter()

    def read(self, content: dict[str, Any]) -> FootprintFile:
        features = list(self._features(content))
        tags = [_tags(field, feature) for field, feature in features]
        tagged = any(key in own for own in tags for key in KEYS)
        for (field, feature), own in zip(features, tags, strict=True):
            if tagged and not is_building(own):
                self.left_out["features that are no building"] += 1
            elif reason := why_no_wall(own):
                self.left_out[reason] += 1
            else:
                self._geometry(field, feature.get("geometry"), own)
        return FootprintFile(tuple(self.footprints), tuple(self.broken), self.metric, dict(self.left_out))

    def _features(self, content: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield every feature with its field; a bare geometry is one."""
        kind = content.get("type")
        if kind == "FeatureCollection":
            features = content.get("features")
            if not isinstance(features, list):
                raise ValueError(f"features: expected a list, got {in_words(features)}")
            # each outline has points
            check_count(len(features))
            for index, feature in enumerate(features):
                if not isinstance(feature, dict):
                    raise ValueError(f"features[{index}]: expected a Feature, got {in_words(feature)}")
                yield f"features[{index}].", feature
        elif kind == "Feature":
            yield "", content
        elif kind in ("Polygon", "MultiPolygon"):
            yield "", {"geometry": content}
        else:
            raise ValueError(f"type: must be FeatureCollection, Feature, Polygon or MultiPolygon, got {kind!r}")

    def _geometry(self, field: str, geometry: Any, tags: dict[str, str]) -> None:
        """Take the polygons of one feature; others are counted."""
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        if kind not in ("Polygon", "MultiPolygon"):
            self.left_out[
                f"features without polygon ({kind})" if isinstance(kind, str) else "features without geometry"
            ] += 1
            return
        field = f"{field}geometry.coordinates" if "geometry" in field or field else "coordinates"
        coordinates = geometry.get("coordinates")
        polygons = [(field, coordinates)]
        if kind == "MultiPolygon":
            if not isinstance(coordinates, list):
                raise ValueError(f"{field}: expected a list of polygons, got {in_words(coordinates)}")
            polygons = [(f"{field}[{index}]", polygon) for index, polygon in enumerate(coordinates)]
        for place, polygon in polygons:
            try:
                self.footprints.append(self._footprint(place, polygon, tags))
            except ValueError as error:
                self.broken.append(str(error))
            check_count(self.points)

    def _footprint(self, field: str, polygon: Any, tags: dict[str, str]) -> Footprint:
        if not isinstance(polygon, list) or not polygon:
            raise ValueError(f"{field}: expected a list of rings, got {in_words(polygon) if polygon else 'nothing'}")
        rings = []
        for index, ring in enumerate(polygon):
            positions = _positions(f"{field}[{index}]", ring)
            self.points += len(positions)
            rings.append(ring_of(f"{field}[{index}]", positions, self.metric))
        return Footprint(field=field, outer=rings[0], holes=tuple(rings[1:]), tags=tags)


def _positions(field: str, ring: Any) -> list[Position]:
    """Return the positions of a ring; heights are left out."""
    if not isinstance(ring, list):
        raise ValueError(f"{field}: expected a list of positions, got {in_words(ring)}")
    positions = []
    for index, position in enumerate(ring):
        if not isinstance(position, list) or len(position) < 2:
            raise ValueError(f"{field}[{index}]: expected two numbers, got {position!r:.60}")
        x, y = position[:2]
        if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in (x, y)):
            raise ValueError(f"{field}[{index}]: expected two numbers, got {position!r:.60}")
        positions.append((float(x), float(y)))
    return positions


def _tags(field: str, feature: dict[str, Any]) -> dict[str, str]:
    """Return the properties as text; those below `tags`, where some tools put them, too."""
    properties = feature.get("properties")
    if properties is None:
        return {}
    if not isinstance(properties, dict):
        raise ValueError(f"{field}properties: expected a mapping, got {in_words(properties)}")
    inner = properties.get("tags")
    every = properties | inner if isinstance(inner, dict) else properties
    return {str(key): _text(value) for key, value in every.items() if isinstance(value, str | int | float)}


def _text(value: str | float) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)
