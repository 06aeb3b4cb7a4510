"""The scene of a map: walls of the buildings around a radar, in its frame."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import yaml

from msgs.files.yaml_loader import PlainDumper

try:
    import shapely
except ImportError:
    raise ImportError("shapely, which maps need: pip install 'mirrorwave[maps]'") from None

from models.physics.materials import material_name
from models.physics.mirror import SHORTEST_WALL_M
from sim_player.maps.facades import TOUCH_M, facades
from sim_player.maps.footprints import Footprint, FootprintFile
from sim_player.maps.geojson import read_geojson
from sim_player.maps.local_frame import MapPose
from sim_player.maps.osm_xml import read_osm
from sim_player.maps.wall_rules import DEFAULT_HEIGHT_M, WallRule, height_of, read_rules, rule_of
from sim_player.scene.description import MAX_BYTES, RADAR_CLEARANCE_M, Point, Scene, SceneRadar, Surface, check_scene

#: Pieces of wall of a scene.
MAX_WALLS = 10_000
#: Least and greatest radius of a scene.
RADIUS_M = (5.0, 5000.0)
#: Corners are rounded to this, and points nearer to the last are left out: finer than any map.
CORNER_M = 1e-3
#: The same in digits of metres.
CORNER_DIGITS = 3
NEAREST_CORNERS_M = 0.05
#: Footprints of less area are none.
SMALLEST_M2 = 0.01

GEOJSON_ENDINGS, OSM_ENDINGS = (".geojson", ".json"), (".osm", ".xml")


@dataclass(frozen=True)
class MapScene:
    """A scene made of a map, and what became of the map."""

    scene: Scene
    buildings: int
    walls: int
    #: What was left out, and how many of each.
    left_out: dict[str, int]
    #: Pieces of wall by material, and buildings that have the default height.
    materials: dict[str, int]
    default_heights: int
    #: Footprints that could not be used, one line each.
    broken: tuple[str, ...]
    attribution: str = ""

    @property
    def yaml(self) -> str:
        """The scene as text that `load_scene` reads."""
        comment = f"# {self.attribution}\n" if self.attribution else ""
        defaults = {field.name: field.default for field in msgspec.structs.fields(Surface)}
        content = {
            "name": self.scene.name,
            "radar": {"preset": self.scene.radar.preset, "height_m": self.scene.radar.height_m},
            "surfaces": [
                {
                    name: value
                    for name, value in msgspec.to_builtins(surface).items()
                    if getattr(surface, name) != defaults[name]
                }
                for surface in self.scene.surfaces
            ],
        }
        return comment + yaml.dump(
            content, Dumper=PlainDumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
        )


def read_map(path: Path, metric: bool = False) -> FootprintFile:
    """Read the footprints of a GeoJSON or OSM XML file, by its ending; ValueError in one line that names the file."""
    try:
        if path.suffix.lower() in GEOJSON_ENDINGS:
            return read_geojson(path, metric)
        if path.suffix.lower() not in OSM_ENDINGS:
            raise ValueError(f"a map's name must end in {', '.join(GEOJSON_ENDINGS + OSM_ENDINGS)}, got {path.name!r}")
        if metric:
            raise ValueError("OpenStreetMap is in degrees, --metric must not be given")
        return read_osm(path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def map_scene(
    footprints: FootprintFile,
    pose: MapPose,
    radius_m: float,
    rules: tuple[WallRule, ...],
    name: str,
    radar: SceneRadar | None = None,
    ground: str | None = None,
) -> MapScene:
    """Return the scene of all buildings within a radius, without walls that border another building.

    ValueError where there is none, the radar stands in one, or there are more walls than a scene may have.
    """
    if not RADIUS_M[0] <= radius_m <= RADIUS_M[1]:
        raise ValueError(f"--radius must be {RADIUS_M[0]:g}..{RADIUS_M[1]:g} m, got {radius_m!r}")
    builder = _Builder(pose, radius_m, rules)
    for footprint in footprints.footprints:
        builder.add(footprint)
    surfaces, broken = builder.surfaces(), (*footprints.broken, *builder.broken)
    if not surfaces and broken:
        raise ValueError(broken[0])
    if not surfaces:
        nearest = (
            f"the nearest is {builder.nearest_m:.0f} m away" if math.isfinite(builder.nearest_m) else "it has none"
        )
        raise ValueError(f"--position: must have a building within {radius_m:g} m on the map, {nearest}")
    walls = sum(builder.materials.values())
    grounds = (Surface(role="ground", material=_ground(ground)),) if ground else ()
    scene = Scene(name=name, radar=radar or SceneRadar(), surfaces=(*surfaces, *grounds))
    if walls > MAX_WALLS:
        raise ValueError(f"--radius: must hold at most {MAX_WALLS} walls, got {walls} within {radius_m:g} m")
    check_scene(scene)
    made = MapScene(
        scene=scene,
        buildings=len(builder.placed),
        walls=walls,
        left_out={**footprints.left_out, **builder.left_out},
        materials=dict(builder.materials),
        default_heights=builder.default_heights,
        broken=broken,
        attribution=footprints.attribution,
    )
    if (size := len(made.yaml.encode())) > MAX_BYTES:
        raise ValueError(f"--radius: a scene holds at most {MAX_BYTES} bytes, got {size} within {radius_m:g} m")
    return made


def map_surfaces(footprints: FootprintFile, pose: MapPose, radius_m: float) -> tuple[Surface, ...]:
    """Return the walls of a map's buildings within a radius, in the frame of a pose that may lie in one of them: a
    measured one errs. What is no footprint is left out.
    """
    builder = _Builder(pose, radius_m, read_rules([]), clearance_m=None)
    for footprint in footprints.footprints:
        builder.add(footprint)
    return tuple(builder.surfaces())


def _once(outlines: list[tuple[shapely.Polygon, Footprint]]) -> list[tuple[shapely.Polygon, Footprint]]:
    """Return buildings of different outlines, with the courtyards and tags that any of the same outline has."""
    rings = np.array([shape.exterior for shape, _ in outlines], object)
    first, second = shapely.STRtree(rings).query(rings, predicate="dwithin", distance=TOUCH_M)
    ahead = first < second
    first, second = first[ahead], second[ahead]
    same = shapely.hausdorff_distance(rings[first], rings[second]) <= TOUCH_M
    once = dict(enumerate(outlines))
    for kept, other in sorted(zip(first[same].tolist(), second[same].tolist(), strict=True)):
        if kept in once and other in once:
            ours, theirs = sorted((once[kept], once.pop(other)), key=lambda each: len(each[1].holes), reverse=True)
            once[kept] = ours[0], replace(ours[1], tags={**theirs[1].tags, **ours[1].tags})
    return list(once.values())


def _ground(material: str) -> str:
    try:
        return material_name(material)
    except ValueError as error:
        raise ValueError(f"--ground: {error}") from None


@dataclass(frozen=True)
class _Building:
    """A building in the radar's frame: its rings and its walls."""

    rings: tuple[tuple[Point, ...], ...]
    rule: WallRule
    height_m: float


class _Builder:
    """Places footprints around a radar."""

    def __init__(
        self, pose: MapPose, radius_m: float, rules: tuple[WallRule, ...], clearance_m: float | None = RADAR_CLEARANCE_M
    ) -> None:
        self.pose, self.radius_m, self.rules = pose, radius_m, rules
        #: Of the radar from every building; None: it may stand anywhere.
        self.clearance_m = clearance_m
        self.outlines: list[tuple[shapely.Polygon, Footprint]] = []
        self.placed: list[_Building] = []
        self.broken: list[str] = []
        self.left_out: Counter[str] = Counter()
        self.materials: Counter[str] = Counter()
        self.default_heights = 0
        #: Distance of the nearest building beyond the radius.
        self.nearest_m = math.inf

    def add(self, footprint: Footprint) -> None:
        """Place a footprint, count it among those beyond the radius, or among the broken."""
        rings = [self._ring(ring) for ring in (footprint.outer, *footprint.holes)]
        away_m = float(np.hypot(*rings[0].T).min(initial=math.inf))
        low, high = rings[0].min(axis=0), rings[0].max(axis=0)
        # the box around a ring
        if float(np.hypot(*np.maximum(np.maximum(low, -high), 0.0))) > self.radius_m:
            self._beyond(away_m)
            return
        try:
            shape = _polygon(footprint.field, rings)
        except ValueError as error:
            self.broken.append(str(error))
            return
        radar = shapely.Point(0.0, 0.0)
        if self.clearance_m is not None and shape.contains(radar):
            raise ValueError(f"--position: must stand outside all buildings, got a place in {footprint.field}")
        if (distance_m := shape.distance(radar)) > self.radius_m:
            self._beyond(distance_m)
            return
        if self.clearance_m is not None and distance_m < self.clearance_m:
            raise ValueError(
                f"--position: must stand {self.clearance_m} m off every wall, "
                f"got {distance_m:.3f} m to {footprint.field}"
            )
        self.outlines.append((shape, footprint))

    def surfaces(self) -> list[Surface]:
        """Return the walls of all buildings that border open air, each once."""
        once = _once(self.outlines)
        if repeated := len(self.outlines) - len(once):
            self.left_out["buildings given twice"] = repeated
        for shape, footprint in once:
            self._place(shape, footprint)
        outer = facades([[np.array(ring) for ring in building.rings] for building in self.placed])
        self.left_out["walls between two buildings"] = outer.between
        if outer.twice:
            self.left_out["walls that another building has too"] = outer.twice
        surfaces = []
        for building, lines in zip(self.placed, outer.lines, strict=True):
            for line in lines:
                self.materials[building.rule.material] += len(line) - 1
                surfaces.append(_surface(building, line))
        return surfaces

    def _beyond(self, away_m: float) -> None:
        self.left_out["buildings beyond the radius"] += 1
        self.nearest_m = min(self.nearest_m, away_m)

    def _ring(self, ring: tuple[Point, ...]) -> np.ndarray:
        return np.round(self.pose.local(np.array(ring, np.float64)) / CORNER_M) * CORNER_M

    def _place(self, shape: shapely.Polygon, footprint: Footprint) -> None:
        rings = [_corners(np.asarray(ring.coords)[:-1]) for ring in (shape.exterior, *shape.interiors)]
        height_m = height_of(footprint.tags)
        self.default_heights += height_m is None
        self.placed.append(
            _Building(
                rings=tuple(ring for ring in rings if len(ring) > 2),
                rule=rule_of(footprint.tags, self.rules),
                height_m=DEFAULT_HEIGHT_M if height_m is None else height_m,
            )
        )


def _polygon(field: str, rings: list[np.ndarray]) -> shapely.Polygon:
    """Return the polygon of rings; ValueError, field first, for one that is none."""
    shape = shapely.Polygon(rings[0], rings[1:])
    if not (area_m2 := shape.convex_hull.area) >= SMALLEST_M2:
        raise ValueError(f"{field}: must enclose {SMALLEST_M2} m^2 at least, got {area_m2:.3g} m^2")
    if not shape.is_valid:
        raise ValueError(
            f"{field}: must be rings whose edges do not cross, got {shapely.is_valid_reason(shape)} m from the radar"
        )
    return shape


def _corners(ring: np.ndarray) -> tuple[Point, ...]:
    """Return the corners of a ring, those left out that lie nearly on the one before."""
    kept: list[Point] = []
    for x, y in ring.tolist():
        if not kept or math.dist(kept[-1], (x, y)) >= max(NEAREST_CORNERS_M, SHORTEST_WALL_M):
            kept.append((round(x, 3) + 0.0, round(y, 3) + 0.0))
    while len(kept) > 1 and math.dist(kept[0], kept[-1]) < max(NEAREST_CORNERS_M, SHORTEST_WALL_M):
        kept.pop()
    return tuple(kept)


def _surface(building: _Building, line: np.ndarray) -> Surface:
    return Surface(
        role="relay",
        material=building.rule.material,
        polyline_m=tuple((round(x, CORNER_DIGITS) + 0.0, round(y, CORNER_DIGITS) + 0.0) for x, y in line.tolist()),
        height_m=round(building.height_m, 2),
        thickness_mm=building.rule.thickness_mm,
        roughness_mm=building.rule.roughness_mm,
    )
