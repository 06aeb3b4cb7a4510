"""A scene: upright walls, objects and the radar's own motion, as YAML says it, checked at the door.

All in the radar frame at start (x forward, y left, metres; heights above the ground). Every complaint is one line:
file, field, value, rule.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import yaml

from models.physics.materials import permittivity
from models.physics.mirror import SHORTEST_WALL_M, crosses
from msgs.radar import ArrayParams, RadarParams, RadarSetup

#: Radar presets of a scene. The 77 GHz one has the aperture of section 2.1.1, a single row of 57.
PRESETS: dict[str, RadarSetup] = {
    "xband": RadarSetup(),
    "77ghz": RadarSetup(radar=RadarParams(carrier_hz=77e9), array=ArrayParams(columns=57, rows=1)),
}
#: The radar stands at least this far from every wall.
RADAR_CLEARANCE_M = 0.1

Point = tuple[float, float]
ObjectClass = Literal["car", "van", "truck", "bus", "bicycle", "pedestrian"]


class ObjectKind(msgspec.Struct, frozen=True):
    """Size of an object class, its RCS averaged over all aspects, and how sharply its flat faces reflect."""

    length_m: float
    width_m: float
    height_m: float
    mean_rcs_dbsm: float
    #: Faces reflect as cos^q around their normal: 12 is the 35 deg width of a car's flashes, 0 has no lobe.
    lobe_exponent: int = 12


#: Car and pedestrian: 3GPP TR 38.901 clause 7.9.2 (vehicle, human). The others: the middle of what is commonly
#: quoted (truck and bus 20-30 dBsm, bicycle with rider -3..+3); none of them was measured at X-band.
OBJECT_KINDS: dict[str, ObjectKind] = {
    "car": ObjectKind(4.5, 1.8, 1.5, 11.25),
    "van": ObjectKind(5.3, 2.0, 2.2, 13.0),
    "truck": ObjectKind(8.0, 2.5, 3.2, 20.0),
    "bus": ObjectKind(12.0, 2.55, 3.1, 21.0),
    "bicycle": ObjectKind(1.8, 0.6, 1.7, 0.0, lobe_exponent=0),
    "pedestrian": ObjectKind(0.5, 0.5, 1.75, -1.37, lobe_exponent=0),
}


class SceneRadar(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which radar, and how high above the ground it is mounted."""

    preset: Literal["xband", "77ghz"] = "xband"
    height_m: float = 1.0


class Surface(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An upright wall along a polyline, or the ground (which needs no polyline)."""

    role: Literal["relay", "occluder", "ground"]
    material: str
    polyline_m: tuple[Point, ...] = ()
    height_m: float = 3.0
    #: None: so thick that its back is never seen.
    thickness_mm: float | None = None
    roughness_mm: float = 0.0


class SceneObject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An object by its class, its centre on the ground, heading, and speed along the heading."""

    class_: ObjectClass = msgspec.field(name="class")
    x_m: float
    y_m: float
    yaw_deg: float = 0.0
    speed_mps: float = 0.0

    @property
    def kind(self) -> ObjectKind:
        """Size and RCS of its class."""
        return OBJECT_KINDS[self.class_]

    def corners_m(self) -> np.ndarray:
        """Corners of the box in the plane at start, counter-clockwise from front left, [4, 2]."""
        half = 0.5 * np.array([self.kind.length_m, self.kind.width_m])
        corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        return self.place(corners)

    def place(self, points_m: np.ndarray) -> np.ndarray:
        """Points [..., 2] of the object's own frame in the scene at start."""
        c, s = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        return points_m @ np.array([[c, s], [-s, c]]) + np.array([self.x_m, self.y_m])

    def contains(self, points_m: np.ndarray) -> np.ndarray:
        """Which points [N, 2] of the scene lie inside the box at start."""
        c, s = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        own = (points_m - np.array([self.x_m, self.y_m])) @ np.array([[c, -s], [s, c]])
        return (np.abs(own) <= 0.5 * np.array([self.kind.length_m, self.kind.width_m])).all(axis=-1)


class Ego(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Constant motion of the vehicle that carries the radar."""

    speed_mps: float = 0.0
    yaw_rate_dps: float = 0.0


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything the simulator is told about a place."""

    name: str
    radar: SceneRadar = SceneRadar()
    surfaces: tuple[Surface, ...] = ()
    objects: tuple[SceneObject, ...] = ()
    ego: Ego = Ego()

    @property
    def moves(self) -> bool:
        """Whether anything changes with time."""
        return bool(self.ego.speed_mps or self.ego.yaw_rate_dps or any(thing.speed_mps for thing in self.objects))

    @property
    def setup(self) -> RadarSetup:
        """The preset's radar at the scene's mounting height."""
        return msgspec.structs.replace(PRESETS[self.radar.preset], radar_height_m=self.radar.height_m)


def load_scene(path: Path) -> Scene:
    """Read and check a scene file; ValueError in one line that names file, field, value and rule."""
    try:
        return scene_from_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path}: no such scene file") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def scene_from_yaml(text: str) -> Scene:
    """A checked scene from YAML text; ValueError in one line."""
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())}") from None
    _refuse_meshes(content)
    try:
        scene = msgspec.convert(content, Scene)
    except msgspec.ValidationError as error:
        raise ValueError(_field_first(str(error))) from None
    check_scene(scene)
    return scene


def scene_to_yaml(scene: Scene) -> str:
    """YAML text that `scene_from_yaml` reads back to the same scene."""
    return yaml.safe_dump(msgspec.json.decode(msgspec.json.encode(scene)), sort_keys=False, allow_unicode=True)


def check_scene(scene: Scene) -> None:
    """Raise ValueError, field first, where a scene cannot be simulated."""
    if not scene.objects and not any(surface.role != "ground" for surface in scene.surfaces):
        raise ValueError("surfaces: a scene needs at least one wall or object, got none")
    for field, value in _numbers(msgspec.to_builtins(scene), ""):
        if not math.isfinite(value):
            raise ValueError(f"{field}: must be finite, got {value!r}")
    if not scene.radar.height_m > 0.0:
        raise ValueError(f"radar.height_m: must be positive, got {scene.radar.height_m!r}")
    for index, surface in enumerate(scene.surfaces):
        _check_surface(f"surfaces[{index}]", surface, scene.setup.radar.carrier_hz)
    for index, thing in enumerate(scene.objects):
        _check_object(f"objects[{index}]", thing, scene)


def _check_surface(field: str, surface: Surface, carrier_hz: float) -> None:
    """Material, sizes, polyline, and the radar's distance of one surface."""
    try:
        permittivity(surface.material, carrier_hz)
    except ValueError as error:
        raise ValueError(f"{field}.material: {error}") from None
    if surface.thickness_mm is not None and not surface.thickness_mm > 0.0:
        raise ValueError(f"{field}.thickness_mm: must be positive, got {surface.thickness_mm!r}")
    if surface.roughness_mm < 0.0:
        raise ValueError(f"{field}.roughness_mm: must not be negative, got {surface.roughness_mm!r}")
    if surface.role == "ground":
        return
    if not surface.height_m > 0.0:
        raise ValueError(f"{field}.height_m: must be positive, got {surface.height_m!r}")
    if len(surface.polyline_m) < 2:
        raise ValueError(f"{field}.polyline_m: needs two points or more, got {len(surface.polyline_m)}")
    for index, (a, b) in enumerate(_segments(surface)):
        if not math.dist(a, b) > SHORTEST_WALL_M:
            raise ValueError(f"{field}.polyline_m[{index + 1}]: a piece of wall must have a length, got {a} to {b}")
        if _distance_to_origin(np.array(a), np.array(b)) < RADAR_CLEARANCE_M:
            raise ValueError(
                f"{field}.polyline_m[{index}]: the radar at (0, 0) must stand {RADAR_CLEARANCE_M} m off every wall, "
                f"got {a} to {b}"
            )


def _check_object(field: str, thing: SceneObject, scene: Scene) -> None:
    """The radar outside the object, and the object clear of all walls."""
    if thing.contains(np.zeros((1, 2)))[0]:
        raise ValueError(f"{field}.x_m: the radar at (0, 0) must stand outside, got a {thing.class_} around it")
    index = wall_inside(thing, scene.surfaces)
    if index is not None:
        raise ValueError(
            f"{field}.x_m: must stand clear of surfaces[{index}], "
            f"got a {thing.class_} at ({thing.x_m:g}, {thing.y_m:g}) in its wall"
        )


def wall_inside(thing: SceneObject, surfaces: tuple[Surface, ...]) -> int | None:
    """Index of the first surface that runs through an object's box, None where it stands clear."""
    corners = thing.corners_m()
    for index, surface in enumerate(surfaces):
        for a, b in _segments(surface):
            ends = np.array([a, b])
            cut = crosses(ends[0], ends[1:], corners, np.roll(corners, -1, axis=0)).any()
            if cut or thing.contains(ends).any():
                return index
    return None


def _segments(surface: Surface) -> list[tuple[Point, Point]]:
    """The straight pieces of a wall; none for the ground."""
    if surface.role == "ground":
        return []
    return list(zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True))


def _distance_to_origin(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of the segment a -> b from (0, 0)."""
    along = b - a
    share = np.clip(-(a @ along) / (along @ along), 0.0, 1.0)
    return float(np.linalg.norm(a + share * along))


def _numbers(value: Any, field: str) -> Iterator[tuple[str, float]]:
    """All floats below a plain value with the path that leads to them."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{field}.{key}" if field else str(key))
    elif isinstance(value, (list, tuple)):
        for index, inner in enumerate(value):
            yield from _numbers(inner, f"{field}[{index}]")
    elif isinstance(value, float):
        yield field, value


def _field_first(message: str) -> str:
    """A validation message ("Expected `float`, got `str` - at `$.a[0].b`") as "a[0].b: expected ..."."""
    text, _, path = message.partition(" - at `$")
    field = path.rstrip("`").lstrip(".")
    text = text[0].lower() + text[1:]
    return f"{field}: {text}" if field else text


def _refuse_meshes(content: Any) -> None:
    """Say plainly that meshes are not simulated, rather than "unknown field"."""
    objects = content.get("objects") if isinstance(content, dict) else None
    for index, thing in enumerate(objects if isinstance(objects, list) else ()):
        if isinstance(thing, dict) and "mesh" in thing:
            raise ValueError(
                f"objects[{index}].mesh: meshes are not simulated, give a class of {', '.join(OBJECT_KINDS)}, "
                f"got {thing['mesh']!r}"
            )
