"""Description of a scene in YAML: upright walls, objects and the radar's own motion, validated on input.

Radar frame at start, heights above the ground. Every error is one line: file, field, value, rule.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import yaml

from models.physics.curved_mirror import arc_points
from models.physics.materials import is_volume, permittivity, wall_layers, wall_name
from models.physics.mirror import SHORTEST_WALL_M, crosses
from models.physics.plane import segment_distance_m
from msgs.files.shipped import shipped_path
from msgs.files.text_files import decode_text
from msgs.files.yaml_loader import PlainDumper, StrictLoader, in_words
from msgs.values.arrays import require_sensor_name
from msgs.values.frames import Mounting
from msgs.values.known_names import with_known_names
from msgs.values.lidar import LidarSetup, SpadParams
from msgs.values.radar import (
    PRESETS,
    ArrayParams,
    BeamGrid,
    RadarParams,
    RadarSetup,
    RangeAzimuthGrid,
    orthogonal_beams,
)
from msgs.values.units import SPEED_OF_LIGHT_MPS, db_from_ratio
from sim_player.bodies.meshes import Mesh, Unit, UpAxis, load_mesh, primitive_mesh
from sim_player.scene.front_end import FrontEnd

#: Larger files are no scenes.
MAX_BYTES = 1 << 20
#: Least distance of the radar from every wall.
RADAR_CLEARANCE_M = 0.1
#: Largest deviation from an arc of the straight pieces that replace it in checks.
ARC_ERROR_M = 1e-3
#: A mesh without thickness counts as this thick in plan.
THINNEST_M = 0.01
#: Valid ranges of the weather, wider than observed on Earth.
WEATHER_RANGES: dict[str, tuple[float, float]] = {
    "rain_mm_per_h": (0.0, 200.0),
    "snow_mm_per_h": (0.0, 50.0),
    "fog_g_per_m3": (0.0, 5.0),
    "temperature_c": (-60.0, 60.0),
    "pressure_hpa": (500.0, 1100.0),
    "water_vapour_g_per_m3": (0.0, 50.0),
}

#: Largest coordinate or size in a scene: a larger number is an input error.
FARTHEST_M = 1e4
#: Scenes of so many pieces of wall or fewer are traced whole.
WHOLE_WALLS = 64
#: Reach over the range of a map: echoes beyond the map leak into it, the less the further.
REACH_SHARE = 1.5
#: Greatest thickness of foliage and of a wall.
DEEPEST_FOLIAGE_MM, THICKEST_WALL_MM = 1e6, 1e4
#: Greatest speed of the radar and of objects, and yaw rate: faster ones belong to no road.
MAX_SPEED_MPS, MAX_YAW_RATE_DPS = 100.0, 720.0
#: Objects may touch each other: their boxes overlap by no more than this.
TOUCH_M = 0.05
#: Radars on one vehicle, and how far one of them may be from its origin.
MAX_RADARS, FARTHEST_MOUNTING_M = 8, 20.0
#: They reflect nothing.
_NO_MATTER = frozenset({"vacuum"})

Point = tuple[float, float]
ObjectClass = Literal["car", "van", "truck", "bus", "bicycle", "pedestrian"]
Primitive = Literal["box", "plate", "dihedral", "trihedral", "cylinder", "sphere"]


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


class SceneArray(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What differs from the preset's array, fields of `ArrayParams`; None: as the preset has it."""

    columns: int | None = None
    rows: int | None = None
    column_spacing_m: float | None = None
    row_spacing_m: float | None = None
    phase_bits: int | None = None
    phases_from_centre: bool | None = None
    steered_ways: int | None = None
    digital: bool | None = None


class SceneRadar(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The radar of a scene and its height above the ground: a preset, and what differs from it."""

    preset: Literal["xband", "77ghz", "spad"] = "xband"
    height_m: float = 1.0
    #: The LiDAR of preset "spad".
    spad: SpadParams = SpadParams()
    #: Time from one scan of the LiDAR to the next; None: as long as its measurements take.
    spad_scan_period_s: float | None = None
    #: Distance between the transmitting and the receiving array, along y; the radar's position is the middle.
    separation_m: float = 0.0
    #: Over the preset's, fields of `RadarParams`; None: the preset's.
    noise_figure_db: float | None = None
    bandwidth_hz: float | None = None
    transmit_power_w: float | None = None
    chirps_per_beam: int | None = None
    #: Boards of one array each stand `separation_m` apart; both are steered unless `steered_ways` is 1.
    array: SceneArray = SceneArray()
    #: Steering azimuths; None: the preset's, of a digital array one orthogonal beam for each column.
    beams_deg: tuple[float, ...] | None = None
    front_end: FrontEnd = FrontEnd()
    #: On the vehicle, whose frame at start is then that of the scene.
    mounting: Mounting = Mounting()

    @property
    def setup(self) -> RadarSetup:
        """The radar as set up; of a LiDAR the X-band radar whose labels it shares. ValueError, field first."""
        preset = PRESETS["xband" if self.preset == "spad" else self.preset]
        names = "noise_figure_db", "bandwidth_hz", "transmit_power_w", "chirps_per_beam"
        radar, array = (
            {name: value for name in every if (value := getattr(given, name)) is not None}
            for given, every in ((self, names), (self.array, SceneArray.__struct_fields__))
        )
        try:
            params = RadarParams(**{**msgspec.structs.asdict(preset.radar), **radar})
            columns = ArrayParams(**{**msgspec.structs.asdict(preset.array), **array})
            beams = preset.beams if self.beams_deg is None else BeamGrid(azimuth_deg=self.beams_deg)
        except ValueError as error:
            field, _, rule = str(error).replace("beams.azimuth_deg", "radar.beams_deg", 1).partition(" ")
            raise ValueError(f"{'radar.' if field.startswith('array.') else ''}{field}: {rule}") from None
        if self.beams_deg is None and columns.digital and columns.columns != preset.array.columns:
            beams = orthogonal_beams(columns.columns)
        mounted = None if self.mounting == Mounting() else self.mounting.vehicle_from_radar
        return msgspec.structs.replace(
            preset,
            radar=params,
            array=columns,
            beams=beams,
            radar_height_m=self.height_m,
            vehicle_from_radar=mounted,
        )


class Surface(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An upright wall along a polyline, or the ground (which needs no polyline)."""

    role: Literal["relay", "occluder", "ground"]
    material: str
    polyline_m: tuple[Point, ...] = ()
    height_m: float = 3.0
    #: None: so thick that its back is never seen.
    thickness_mm: float | None = None
    roughness_mm: float = 0.0
    #: Distance along the wall over which its heights stay alike.
    correlation_mm: float = 30.0
    #: Directions of what roughness takes from the mirror: those of its height and correlation length.
    diffuse_lobe: Literal["kirchhoff"] = "kirchhoff"
    #: Every piece of the polyline is an arc of this curvature; positive: its centre lies left of the direction of the
    #: polyline.
    curvature_per_m: float = 0.0


class SceneObject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """An object by exactly one of `class`, `mesh`, `primitive`; its centre on the ground, heading, speed along it."""

    class_: ObjectClass | None = msgspec.field(name="class", default=None)
    #: File, relative to the scene's; formats as in `sim_player.bodies.meshes.load_mesh`.
    mesh: str | None = None
    unit: Unit = "m"
    #: None: as defined by the format, else z.
    up: UpAxis | None = None
    #: Sizes that `sim_player.bodies.meshes.PRIMITIVES` lists for it.
    primitive: Primitive | None = None
    size_m: tuple[float, ...] = ()
    material: str = "metal"
    #: Height of its lowest point over the ground.
    z_m: float = 0.0
    x_m: float
    y_m: float
    yaw_deg: float = 0.0
    speed_mps: float = 0.0

    @property
    def object_class(self) -> str:
        """Its class; of a mesh the file's stem, of a primitive its name."""
        return self.class_ or self.primitive or Path(self.mesh or "").stem

    @property
    def kind(self) -> ObjectKind:
        """Size and RCS of its class; of a mesh those of its box, in metal: RCS a quarter of its surface."""
        return OBJECT_KINDS[self.class_] if self.class_ else _kind_of(self._key())

    @property
    def shape(self) -> Mesh | None:
        """Its mesh in its own frame, lifted to `z_m`; None for a class. ValueError where it cannot be loaded."""
        return None if self.class_ else _shape_of(self._key())

    def _key(self) -> SceneObject:
        """Return the same shape at rest at the origin: the fields that its mesh depends on."""
        return msgspec.structs.replace(self, x_m=0.0, y_m=0.0, yaw_deg=0.0, speed_mps=0.0)

    def corners_m(self) -> np.ndarray:
        """Return the corners of the box in the plane at start, counter-clockwise from front left, [4, 2]."""
        half = 0.5 * np.array([self.kind.length_m, self.kind.width_m])
        corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        return self.place(corners)

    def place(self, points_m: np.ndarray) -> np.ndarray:
        """Return the points [..., 2] of the object's own frame in the scene at start."""
        c, s = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        return points_m @ np.array([[c, s], [-s, c]]) + np.array([self.x_m, self.y_m])

    def contains(self, points_m: np.ndarray) -> np.ndarray:
        """Return which points [N, 2] of the scene lie inside the box at start."""
        c, s = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        own = (points_m - np.array([self.x_m, self.y_m])) @ np.array([[c, -s], [s, c]])
        return (np.abs(own) <= 0.5 * np.array([self.kind.length_m, self.kind.width_m])).all(axis=-1)


@lru_cache(maxsize=16)
def _shape_of(scene_object: SceneObject) -> Mesh:
    """Return the mesh of a mesh or primitive object, read once."""
    if scene_object.primitive:
        mesh = primitive_mesh(scene_object.primitive, scene_object.size_m, scene_object.material)
    else:
        mesh = load_mesh(Path(scene_object.mesh or ""), scene_object.unit, scene_object.material, scene_object.up)
    return dataclasses.replace(mesh, vertices_m=mesh.vertices_m + np.array([0.0, 0.0, scene_object.z_m]))


@lru_cache(maxsize=256)
def _kind_of(scene_object: SceneObject) -> ObjectKind:
    """Return the box and mean RCS of a mesh or primitive object."""
    length, width, height = np.maximum(_shape_of(scene_object).extent_m, THINNEST_M).tolist()
    surface = 2.0 * (length * width + width * height + height * length)
    return ObjectKind(length, width, scene_object.z_m + height, db_from_ratio(surface / 4.0))


class Ego(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Constant motion of the vehicle that carries the radar."""

    speed_mps: float = 0.0
    yaw_rate_dps: float = 0.0


class Weather(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Air between everything, and what falls and floats in it: it takes power off each path and sends some back."""

    rain_mm_per_h: float = 0.0
    #: Dry snow, in melted water.
    snow_mm_per_h: float = 0.0
    #: Liquid water in the air.
    fog_g_per_m3: float = 0.0
    temperature_c: float = 15.0
    pressure_hpa: float = 1013.25
    water_vapour_g_per_m3: float = 7.5


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scene: the complete input of the simulator."""

    name: str
    radar: SceneRadar = SceneRadar()
    surfaces: tuple[Surface, ...] = ()
    objects: tuple[SceneObject, ...] = ()
    ego: Ego = Ego()
    weather: Weather = Weather()
    #: Several radars on the vehicle by their names, each as `radar` but for its mounting.
    radars: dict[str, Mounting] = {}

    def __hash__(self) -> int:
        values = (getattr(self, name) for name in self.__struct_fields__ if name != "radars")
        return hash((*values, frozenset(self.radars.items())))

    def of_radar(self, name: str) -> Scene:
        """Return the scene of one of several radars."""
        radar = msgspec.structs.replace(self.radar, mounting=self.radars[name])
        return msgspec.structs.replace(self, radar=radar, radars={})

    @property
    def moves(self) -> bool:
        """True where the radar or an object moves."""
        return bool(
            self.ego.speed_mps or self.ego.yaw_rate_dps or any(scene_object.speed_mps for scene_object in self.objects)
        )

    @property
    def setup(self) -> RadarSetup:
        """The radar as set up; of a LiDAR the X-band radar whose labels it shares."""
        return self.radar.setup

    @property
    def lidar(self) -> LidarSetup:
        """The scene's LiDAR at the mounting height; ValueError where a scan period is too short for it."""
        return LidarSetup(
            spad=self.radar.spad, lidar_height_m=self.radar.height_m, scan_period_s=self.radar.spad_scan_period_s
        )


def load_scene(path: Path) -> Scene:
    """Read and check a scene file, or the shipped one of that name; ValueError in one line with the file."""
    try:
        path = shipped_path(path)
        # check before reading: a foreign scene must not exhaust the memory of a graph
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"a scene is YAML of at most {MAX_BYTES} bytes, got {path.stat().st_size}")
        return scene_from_yaml(decode_text(path.read_bytes()), path.parent)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such scene file") from None
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def scene_from_yaml(text: str, folder: Path = Path()) -> Scene:
    """Return a checked scene from YAML text; `folder` is put before its mesh files. ValueError in one line."""
    try:
        content = yaml.load(text, Loader=StrictLoader)
    except yaml.YAMLError as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ValueError(f"expected a mapping of {', '.join(Scene.__struct_fields__)}, got {in_words(content)}")
    if isinstance(content.get("nodes"), dict):
        raise ValueError("is a launch file, no scene; the parameter scene of its player names one")
    try:
        scene = msgspec.convert(content, Scene)
    except msgspec.ValidationError as error:
        # "Expected `float`, got `str` - at `$.a[0].b`" as "a[0].b: expected ..."
        text, _, where = with_known_names(error, Scene).partition(" - at `$")
        field = where.rstrip("`").lstrip(".")
        raise ValueError(f"{field}{': ' if field else ''}{text[0].lower()}{text[1:]}") from None
    objects = tuple(
        msgspec.structs.replace(scene_object, mesh=str(folder / scene_object.mesh))
        if scene_object.mesh
        else scene_object
        for scene_object in scene.objects
    )
    scene = msgspec.structs.replace(scene, objects=objects)
    check_scene(scene)
    return scene


#: Fields that came after places were drawn. At their defaults they are not written: scenes drawn before keep their
#: bytes and their hashes.
_LATER_FIELDS: dict[type[msgspec.Struct], tuple[str, ...]] = {
    Scene: ("radars",),
    SceneRadar: ("bandwidth_hz", "transmit_power_w", "chirps_per_beam", "array", "beams_deg", "mounting"),
    SpadParams: ("tail_share", "tail_s"),
    FrontEnd: ("leakage_range_m",),
    Surface: ("diffuse_lobe",),
    Weather: ("snow_mm_per_h", "fog_g_per_m3"),
}


def scene_sha256(scene: Scene) -> str:
    """Return the SHA-256 of a scene with its numbers to 1e-6: processors round the last digit of a draw differently."""
    return hashlib.sha256(msgspec.json.encode(_rounded(_plain(scene)), order="sorted")).hexdigest()


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        # no zero with a sign
        return round(value, 6) + 0.0
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value


def scene_to_yaml(scene: Scene) -> str:
    """Return the YAML text that `scene_from_yaml` reads back to the same scene."""
    return yaml.dump(_plain(scene), Dumper=PlainDumper, sort_keys=False, allow_unicode=True)


def _plain(scene: Scene) -> dict[str, Any]:
    """Return a scene as plain data, later fields left out where they say nothing."""
    plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(scene))
    blocks: list[tuple[msgspec.Struct, dict[str, Any]]] = [
        (scene, plain),
        (scene.radar.spad, plain["radar"]["spad"]),
        (scene.radar.front_end, plain["radar"]["front_end"]),
        (scene.radar, plain["radar"]),
        (scene.weather, plain["weather"]),
        *zip(scene.surfaces, plain["surfaces"], strict=True),
    ]
    for block, written in blocks:
        defaults = {
            field.name: field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
            for field in msgspec.structs.fields(block)
        }
        for name in _LATER_FIELDS[type(block)]:
            if getattr(block, name) == defaults[name]:
                del written[name]
    return plain


def _require(holds: bool, field: str, rule: str, got: object) -> None:
    """Raise ValueError, field first, unless a rule holds."""
    if not holds:
        raise ValueError(f"{field}: {rule}, got {got!r}")


def check_scene(scene: Scene) -> None:
    """Raise ValueError, field first, where a scene cannot be simulated."""
    if not scene.name.strip():
        raise ValueError("name: must not be empty: recordings and pictures are named by it")
    if scene.radars:
        _check_radars(scene)
        return
    numbers = list(_numbers(msgspec.to_builtins(scene), ""))
    for field, value in numbers:
        _require(math.isfinite(value), field, "must be finite", value)
    _check_radar(scene.radar)
    _check_distances(scene, numbers)
    _require_speed("ego.speed_mps", scene.ego.speed_mps, MAX_SPEED_MPS)
    _require_speed("ego.yaw_rate_dps", scene.ego.yaw_rate_dps, MAX_YAW_RATE_DPS)
    try:
        _ = scene.lidar
    except ValueError as error:
        raise ValueError(f"radar.spad_scan_period_s: {error}") from None
    for field, (least, greatest) in WEATHER_RANGES.items():
        value = getattr(scene.weather, field)
        _require(least <= value <= greatest, f"weather.{field}", f"must lie in {least:g}..{greatest:g}", value)
    carrier_hz = scene.setup.radar.carrier_hz
    radar_m = scene.radar.mounting.x_m, scene.radar.mounting.y_m
    for index, surface in enumerate(scene.surfaces):
        _check_surface(f"surfaces[{index}]", surface, carrier_hz, radar_m)
    for index, scene_object in enumerate(scene.objects):
        _check_object(f"objects[{index}]", scene_object, scene, carrier_hz)
    _check_overlaps(scene.objects)


def _check_radars(scene: Scene) -> None:
    """Check the names and mountings of several radars, and the scene of each."""
    _require(len(scene.radars) <= MAX_RADARS, "radars", f"must be at most {MAX_RADARS}", len(scene.radars))
    _require(scene.radar.preset != "spad", "radars", "must be radars, and preset 'spad' is a LiDAR", scene.radar.preset)
    _require(scene.radar.mounting == Mounting(), "radar.mounting", "is of a single radar", scene.radar.mounting)
    for name in scene.radars:
        try:
            require_sensor_name(name)
            check_scene(scene.of_radar(name))
        except ValueError as error:
            raise ValueError(f"radars.{name}: {error}") from None


def farthest_m(setup: RadarSetup) -> float:
    """Return how far what a radar at rest sees may stand: as far as echoes return within a chirp, and its reach."""
    return 0.5 * SPEED_OF_LIGHT_MPS * setup.radar.chirp_period_s + reach_m(setup)


def reach_m(setup: RadarSetup) -> float:
    """Return the half round trip up to which a part of a world has all paths."""
    return REACH_SHARE * RangeAzimuthGrid().range_bins * setup.radar.range_bin_m


def _check_distances(scene: Scene, numbers: list[tuple[str, float]]) -> None:
    """Check that no coordinate or size is beyond what the radar can see; it may drive far, and a city may be large."""
    limit_m = FARTHEST_M if scene.moves else min(farthest_m(scene.setup), FARTHEST_M)
    is_city = sum(max(len(surface.polyline_m) - 1, 0) for surface in scene.surfaces) > WHOLE_WALLS
    for field, value in numbers:
        block, _, name = field.partition("].")
        kind = block.partition("[")[0]
        # thicknesses have ranges of their own
        if kind not in ("surfaces", "objects") or name == "thickness_mm":
            continue
        is_place = name in ("x_m", "y_m") or name.startswith("polyline_m")
        within_m = FARTHEST_M if (kind == "surfaces" and is_city) or not is_place else limit_m
        if abs(value) > within_m:
            why = ", which is as far as the radar sees" if within_m < FARTHEST_M else ""
            raise ValueError(f"{field}: must lie within {within_m:g} of 0{why}, got {value!r}")


def _require_speed(field: str, value: float, limit: float) -> None:
    _require(abs(value) <= limit, field, f"must lie in {-limit:g}..{limit:g}", value)


def _check_radar(radar: SceneRadar) -> None:
    """Check the mounting, the faults of the front end and the set-up."""
    front_end, noise_db, mounting = radar.front_end, radar.noise_figure_db, radar.mounting
    of_front_end = "radar.front_end."
    for holds, field, rule, got in (
        (radar.height_m > 0.0, "radar.height_m", "must be positive", radar.height_m),
        (0.0 <= radar.separation_m < 1.0, "radar.separation_m", "must be at least 0 and below 1 m", radar.separation_m),
        (noise_db is None or -30.0 <= noise_db <= 100.0, "radar.noise_figure_db", "must be -30..100", noise_db),
        (4 <= front_end.adc_bits <= 16, f"{of_front_end}adc_bits", "must be 4..16", front_end.adc_bits),
        (
            front_end.coupling_db is None or front_end.coupling_db < 0.0,
            f"{of_front_end}coupling_db",
            "must be negative",
            front_end.coupling_db,
        ),
        *(
            (
                abs(getattr(mounting, name)) <= most,
                f"radar.mounting.{name}",
                f"must lie in {-most:g}..{most:g}",
                getattr(mounting, name),
            )
            for name, most in (("x_m", FARTHEST_MOUNTING_M), ("y_m", FARTHEST_MOUNTING_M), ("yaw_deg", 360.0))
        ),
        *(
            (getattr(front_end, name) >= 0.0, of_front_end + name, "must not be negative", getattr(front_end, name))
            for name in ("leakage_range_m", "flicker_corner_hz")
        ),
    ):
        _require(holds, field, rule, got)
    _ = radar.setup


def _check_surface(field: str, surface: Surface, carrier_hz: float, radar_m: Point) -> None:
    """Check material, sizes and polyline of one surface, and its distance from the radar."""
    thickness_mm = surface.thickness_mm
    _require(thickness_mm is None or thickness_mm > 0.0, f"{field}.thickness_mm", "must be positive", thickness_mm)
    _check_material(field, surface, carrier_hz)
    _require(surface.roughness_mm >= 0.0, f"{field}.roughness_mm", "must not be negative", surface.roughness_mm)
    _require(surface.correlation_mm > 0.0, f"{field}.correlation_mm", "must be positive", surface.correlation_mm)
    if surface.role == "ground":
        return
    _require(surface.height_m > 0.0, f"{field}.height_m", "must be positive", surface.height_m)
    points = len(surface.polyline_m)
    _require(points >= 2, f"{field}.polyline_m", "needs two points or more", points)
    for index, (a, b) in enumerate(pairwise(surface.polyline_m)):
        _check_piece(field, index, surface.curvature_per_m, a, b, radar_m)


def _check_material(field: str, surface: Surface, carrier_hz: float) -> None:
    """Check that the build is known at the carrier and not too thick, and that foliage is no ground."""
    thickness_m = None if surface.thickness_mm is None else 1e-3 * surface.thickness_mm
    try:
        if not is_volume(surface.material):
            _require_matter(surface.material)
            wall_layers(surface.material, thickness_m, carrier_hz)
        elif surface.role == "ground":
            raise ValueError(f"a ground must be a surface, got {surface.material!r}")
    except ValueError as error:
        raise ValueError(f"{field}.material: {error}") from None
    limit_mm = DEEPEST_FOLIAGE_MM if is_volume(surface.material) else THICKEST_WALL_MM
    if surface.thickness_mm is not None:
        is_allowed = surface.thickness_mm <= limit_mm
        _require(is_allowed, f"{field}.thickness_mm", f"must be at most {limit_mm:g}", surface.thickness_mm)


def _require_matter(material: str) -> None:
    """Raise ValueError for a known material of which nothing comes back."""
    if wall_name(material) in _NO_MATTER:
        raise ValueError(f"must reflect, got {material!r}")


def _check_piece(field: str, index: int, curvature_per_m: float, a: Point, b: Point, radar_m: Point) -> None:
    """Check the length of one piece of wall, its arc, and the radar's distance from it."""
    chord = math.dist(a, b)
    if not chord > SHORTEST_WALL_M:
        raise ValueError(f"{field}.polyline_m[{index + 1}]: a piece of wall must have a length, got {a} to {b}")
    if not abs(curvature_per_m) * chord < 2.0:
        raise ValueError(
            f"{field}.curvature_per_m: |curvature| times the length of a piece must be below 2, the arc of a "
            f"half circle, got {curvature_per_m!r} for polyline_m[{index}] to [{index + 1}] of {chord:g} m"
        )
    start_m, end_m = (np.array(ends) for ends in zip(*_arc_pieces(a, b, curvature_per_m), strict=True))
    if segment_distance_m(np.array([radar_m]), start_m, end_m).min() < RADAR_CLEARANCE_M:
        raise ValueError(
            f"{field}.polyline_m[{index}]: the radar at {_at(radar_m)} must stand {RADAR_CLEARANCE_M} m off every "
            f"wall, got {a} to {b}" + (f" with curvature {curvature_per_m!r}" if curvature_per_m else "")
        )


def _check_object(field: str, scene_object: SceneObject, scene: Scene, carrier_hz: float) -> None:
    """Check that an object has one form, a loadable mesh, the radar outside it, and no wall through it."""
    _check_form(field, scene_object, carrier_hz)
    _require_speed(f"{field}.speed_mps", scene_object.speed_mps, MAX_SPEED_MPS)
    radar_m = scene.radar.mounting.x_m, scene.radar.mounting.y_m
    if scene_object.contains(np.array([radar_m]))[0]:
        raise ValueError(
            f"{field}.x_m: the radar at {_at(radar_m)} must stand outside, got a {scene_object.object_class} around it"
        )
    index = wall_inside(scene_object, scene.surfaces)
    if index is not None:
        raise ValueError(
            f"{field}.x_m: must stand clear of surfaces[{index}], "
            f"got a {scene_object.object_class} at ({scene_object.x_m:g}, {scene_object.y_m:g}) in its wall"
        )


def _at(position_m: Point) -> str:
    return f"({position_m[0]:g}, {position_m[1]:g})"


def _check_form(field: str, scene_object: SceneObject, carrier_hz: float) -> None:
    """Check class, mesh or primitive with its fields, its material and shape."""
    given = [
        name for name in ("class", "mesh", "primitive") if getattr(scene_object, "class_" if name == "class" else name)
    ]
    if len(given) != 1:
        raise ValueError(f"{field}: must have one of class, mesh, primitive, got {' and '.join(given) or 'none'}")
    allowed = {"class": (), "mesh": ("unit", "up", "material", "z_m"), "primitive": ("size_m", "material", "z_m")}
    plain = SceneObject(x_m=0.0, y_m=0.0)
    for name in ("unit", "up", "size_m", "material", "z_m"):
        if name not in allowed[given[0]] and getattr(scene_object, name) != getattr(plain, name):
            raise ValueError(f"{field}.{name}: does not belong to a {given[0]}, got {getattr(scene_object, name)!r}")
    _require(scene_object.z_m >= 0.0, f"{field}.z_m", "must not be negative", scene_object.z_m)
    if scene_object.class_:
        return
    try:
        permittivity(scene_object.material, carrier_hz)
        _require_matter(scene_object.material)
    except ValueError as error:
        raise ValueError(f"{field}.material: {error}") from None
    try:
        _ = scene_object.shape
    except ValueError as error:
        raise ValueError(f"{field}.mesh: {error}" if scene_object.mesh else f"{field}.{error}") from None


def wall_inside(scene_object: SceneObject, surfaces: tuple[Surface, ...]) -> int | None:
    """Return the index of the first surface that runs through an object's box, None for none."""
    owner, a, b = wall_pieces(surfaces)
    if not len(owner):
        return None
    corners = scene_object.corners_m()
    crossed = crosses(a, b, corners, np.roll(corners, -1, axis=0)).any(axis=1)
    inside = crossed | scene_object.contains(a) | scene_object.contains(b)
    return int(owner[inside][0]) if inside.any() else None


def wall_pieces(surfaces: tuple[Surface, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the straight pieces of all walls: the number of the surface of each [N], and its ends [N, 2], [N, 2]."""
    pieces = [
        (index, *piece)
        for index, surface in enumerate(surfaces)
        if surface.role != "ground"
        for a, b in pairwise(surface.polyline_m)
        for piece in _arc_pieces(a, b, surface.curvature_per_m)
    ]
    owner = np.array([index for index, _, _ in pieces], np.int64)
    a, b = (np.array([piece[end] for piece in pieces], np.float64).reshape(-1, 2) for end in (1, 2))
    return owner, a, b


def _check_overlaps(objects: tuple[SceneObject, ...]) -> None:
    """Raise ValueError, field first, for two objects in one place at start."""
    if len(objects) < 2:
        return
    centre = np.array([(each.x_m, each.y_m) for each in objects])
    reach = np.array([0.5 * math.hypot(each.kind.length_m, each.kind.width_m) for each in objects])
    for first in range(len(objects) - 1):
        distance = np.hypot(*(centre[first + 1 :] - centre[first]).T)
        for second in first + 1 + np.flatnonzero(distance < reach[first + 1 :] + reach[first]):
            if overlap(objects[first], objects[second]):
                inner, outer = (
                    f"a {each.object_class} at ({each.x_m:g}, {each.y_m:g})"
                    for each in (objects[second], objects[first])
                )
                raise ValueError(f"objects[{second}].x_m: must stand clear of objects[{first}], got {inner} in {outer}")


def overlap(left: SceneObject, right: SceneObject) -> bool:
    """Return whether two objects are in one place; of a mesh, which may have a yard, whether their centres meet."""
    if left.z_m >= right.kind.height_m or right.z_m >= left.kind.height_m:
        return False
    if left.mesh or right.mesh:
        return math.hypot(left.x_m - right.x_m, left.y_m - right.y_m) < TOUCH_M
    first, second = _outline(left), _outline(right)
    for outline in (first, second):
        sides = np.roll(outline, -1, axis=0) - outline
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.hypot(*sides.T)[:, None]
        ours, theirs = first @ normals.T, second @ normals.T
        depth = np.minimum(ours.max(axis=0), theirs.max(axis=0)) - np.maximum(ours.min(axis=0), theirs.min(axis=0))
        # thin ones touch by their whole thickness
        thinnest = np.minimum(np.ptp(ours, axis=0), np.ptp(theirs, axis=0))
        if (depth <= np.minimum(TOUCH_M, 0.5 * thinnest)).any():
            return False
    return True


def _outline(scene_object: SceneObject) -> np.ndarray:
    """Return the outline of an object in plan: its box, or a polygon of 16 corners where it is round; [N, 2]."""
    if scene_object.primitive not in ("cylinder", "sphere"):
        return scene_object.corners_m()
    angle = np.arange(16) * (np.pi / 8.0)
    radius = 0.5 * scene_object.kind.length_m
    return scene_object.place(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _arc_pieces(a: Point, b: Point, curvature_per_m: float) -> list[tuple[Point, Point]]:
    """Return the straight pieces that follow an arc to `ARC_ERROR_M`; the chord itself where the wall is straight."""
    if not curvature_per_m:
        return [(a, b)]
    half_angle = math.asin(0.5 * math.dist(a, b) * abs(curvature_per_m))
    step = math.acos(max(1.0 - ARC_ERROR_M * abs(curvature_per_m), 0.0))
    share = np.linspace(0.0, 1.0, max(math.ceil(half_angle / max(step, 1e-6)), 1) + 1)
    points = [(float(x), float(y)) for x, y in arc_points(np.array(a), np.array(b), curvature_per_m, share)]
    return list(pairwise(points))


def _numbers(value: Any, field: str) -> Iterator[tuple[str, float]]:
    """Yield all floats below a plain value with their paths."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{field}.{key}" if field else str(key))
    elif isinstance(value, (list, tuple)):
        for index, inner in enumerate(value):
            yield from _numbers(inner, f"{field}[{index}]")
    elif isinstance(value, float):
        yield field, value
