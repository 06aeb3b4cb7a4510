"""Messages of the graph as Foxglove's: scenes, grids, transforms, the map as an image, peaks, log, numbers to plot.

Bodies are JSON values by `foxglove_schemas.SCHEMAS`; the live bridge and the conversion of recordings share them. The
bus accepts any number, so whatever lacks a finite position is left out: JSON has no other numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import msgspec
import numpy as np

from contrib.foxglove.foxglove_schemas import PRIMITIVES, own_channel
from msgs.bus.codec import to_builtins
from msgs.bus.topics import SHIPPED
from msgs.values.camera import CameraImage
from msgs.values.diagnostics import LogRecord, NodeStatus, StageTime
from msgs.values.frames import Pose2, xy_from_polar
from msgs.values.lidar import LidarPoints, LidarSetup
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, Peaks, SceneTruth, Track, TruthObject
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import GraphStart, Setup, latency_ns, on_one_clock
from nodes.recording.shapes import (
    DIRECT_COLOUR,
    OBJECT_COLOUR,
    OBJECT_HEIGHT_M,
    POINT_COLOUR,
    POINT_SIZE_M,
    TRACK_COLOUR,
    TRUTH_COLOUR,
    WALL_COLOUR,
    WALL_WIDTH_M,
    Colour,
    Odometry,
    quaternion_zw,
    stamp_parts,
    wall_line_m,
)
from nodes.viewer.view_model import map_level_db

#: Topics of the graph that become messages here, or say how to read others (the set-ups).
TOPICS = (
    "perception/hidden_objects",
    "radar/ra_map",
    "perception/peaks",
    "sim/truth",
    "vehicle/state",
    "diagnostics/node",
    "log",
    "radar/setup",
    "lidar/setup",
    "lidar/points",
    "camera/image",
)
RADAR, VEHICLE, ODOM, CAMERA = "radar", "vehicle", "odom", "camera"
#: Grey levels of a map: four a dB over the noise, or over `GREY_SPAN_DB` below the peak where no noise is known.
GREY_PER_DB = 4.0
GREY_SPAN_DB = 255.0 / GREY_PER_DB
#: Cells of the map's plane from the radar to the end of its range.
PLANE_COLUMNS = 256
#: Primitives of one kind in an entity at most; the number of those left out stands in its metadata.
MAX_PRIMITIVES = 2048
#: Nodes whose processor time is compared with that of their last heartbeat: names on the bus are anybody's.
MAX_NODES = 64

_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5, "fatal": 5}
_UINT8, _FLOAT32 = 1, 7
#: Types of a point's fields by their numbers; Foxglove has no whole numbers of 64 bits.
_NUMERIC = {
    "uint8": _UINT8,
    "int8": 2,
    "uint16": 3,
    "int16": 4,
    "uint32": 5,
    "int32": 6,
    "float32": _FLOAT32,
    "float64": 8,
}
_LINE_STRIP = 0
_TRACK_SHOWN_S = 1.0
_LABEL_M = 0.8
_LABEL_COLOUR: Colour = (0.95, 0.95, 0.95, 1.0)
_MIB = 1 << 20
#: JSON numbers are doubles to most readers: whole numbers are exact up to here.
_MAX_EXACT = 1 << 53

Body = dict[str, Any]


class Draft(NamedTuple):
    """A message for Foxglove that is built when somebody wants it: topic of `foxglove_schemas.CHANNELS`, its body."""

    topic: str
    build: Callable[[], Body]


class FoxgloveStream:
    """Turns messages of the graph, in order of their sending, into Foxglove's."""

    def __init__(self) -> None:
        self._odometry = Odometry()
        self._setup: Setup | None = None
        self._vehicle_from_radar = Pose2()
        self._heartbeats: dict[str, NodeStatus] = {}
        self._graph: GraphStart | None = None

    def drafts_of(self, topic: str, message: Any, at_ns: int) -> list[Draft]:
        """Return what a message of a topic becomes: of `TOPICS`, or of one of other people."""
        if topic in SHIPPED:
            return self.drafts(message, at_ns)
        return [Draft(own_channel(topic), partial(_own, message))]

    def drafts(self, message: Any, at_ns: int) -> list[Draft]:
        """Return what a message of `TOPICS` becomes, which arrived, or was sent, at a time of the graph's clock."""
        self._graph = self._graph or GraphStart(at_ns)
        match message:
            case BevFrame():
                return self._view_drafts(message, at_ns, self._graph.since_ns)
            case RangeAzimuthMap():
                self._vehicle_from_radar = message.vehicle_from_radar
                grey = functools.cache(partial(_grey, message))
                return [
                    Draft("/radar/ra_map", lambda: _image(message, grey())),
                    Draft("/radar/ra_map/plane", lambda: _plane(message, grey())),
                ]
            case Peaks():
                self._vehicle_from_radar = message.vehicle_from_radar
                return [Draft("/radar/peaks", partial(_cloud, message))]
            case SceneTruth():
                return [Draft("/sim/truth", partial(_truth_scene, message))]
            case VehicleState():
                drafts = [Draft("/vehicle/state", partial(_vehicle, message))]
                pose = self._odometry.advance(message)
                if pose is not None:
                    drafts.append(Draft("/tf", partial(_transform, message.stamp_ns, ODOM, VEHICLE, pose)))
                return drafts
            case LidarPoints():
                return [Draft("/lidar/points", partial(_lidar_cloud, message))]
            case CameraImage():
                return [Draft("/camera/image", partial(_camera_image, message))]
            case NodeStatus():
                self._graph.hear(message, at_ns)
                return [Draft("/nodes", partial(_node, message, self._last_heartbeat(message)))]
            case LogRecord():
                return [Draft("/log", partial(_log, message))]
            case RadarSetup() | LidarSetup():
                self._setup = message
        return []

    def _view_drafts(self, frame: BevFrame, at_ns: int, since_ns: int) -> list[Draft]:
        """The mounting comes with every view: who connects late needs it too."""
        same_clock = on_one_clock(frame.stamp_ns, at_ns, since_ns)
        latency_ms = 1e-6 * latency_ns(frame.stamp_ns, at_ns, self._setup) if same_clock else None
        mounting = partial(_transform, frame.stamp_ns, VEHICLE, RADAR, self._vehicle_from_radar)
        return [
            Draft("/tf", mounting),
            Draft("/hidden_objects/scene", partial(_scene, frame)),
            Draft("/hidden_objects/visibility", partial(_visibility, frame)),
            Draft("/views", partial(_view, frame, latency_ms)),
        ]

    def _last_heartbeat(self, status: NodeStatus) -> NodeStatus | None:
        last = self._heartbeats.pop(status.node, None)
        self._heartbeats[status.node] = status
        if len(self._heartbeats) > MAX_NODES:
            del self._heartbeats[next(iter(self._heartbeats))]
        return last


# scenes


def _scene(frame: BevFrame) -> Body:
    """Entities replace those of the scan before by their id, so empty ones are written too."""
    objects = frame.objects
    entity = partial(_entity, frame.stamp_ns)
    return _update(
        entity("walls", lines=[_line(wall_line_m(wall), WALL_COLOUR) for wall in frame.walls]),
        entity(
            "objects",
            [(f"object {hidden.id} score", f"{hidden.score:.6g}") for hidden in objects],
            cubes=[_cube(hidden, OBJECT_COLOUR) for hidden in objects],
            texts=[_label(hidden, f"{hidden.object_class} {hidden.score:.2f}".lstrip()) for hidden in objects],
        ),
        entity(
            "points",
            spheres=[_sphere(at.x_m, at.y_m, (*POINT_COLOUR[:3], min(max(at.score, 0.2), 1.0))) for at in frame.points],
        ),
        entity("direct", spheres=[_sphere(x_m, y_m, DIRECT_COLOUR) for x_m, y_m in frame.los_points_m.tolist()]),
        entity(
            "tracks",
            arrows=list(map(_arrow, frame.tracks)),
            texts=[_label(at, f"track {at.id}") for at in frame.tracks],
        ),
    )


def _truth_scene(truth: SceneTruth) -> Body:
    entity = partial(_entity, truth.stamp_ns)
    return _update(
        entity(
            "surfaces",
            lines=[_line(each.polyline_m, TRUTH_COLOUR) for each in truth.surfaces if len(each.polyline_m) > 1],
        ),
        entity("objects", cubes=[_cube(each, TRUTH_COLOUR) for each in truth.objects]),
        entity("points", spheres=[_sphere(x_m, y_m, TRUTH_COLOUR) for x_m, y_m, _ in truth.hidden_points_m.tolist()]),
    )


def _update(*entities: Body) -> Body:
    return {"deletions": [], "entities": list(entities)}


def _entity(stamp_ns: int, name: str, metadata: Iterable[tuple[str, str]] = (), **primitives: list[Body]) -> Body:
    drawn = {kind: primitives.get(kind, []) for kind in PRIMITIVES}
    surplus = {kind: len(each) - MAX_PRIMITIVES for kind, each in drawn.items()}
    missing = [(f"{kind} left out", str(count)) for kind, count in surplus.items() if count > 0]
    return {
        "timestamp": _time(stamp_ns),
        "frame_id": RADAR,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [{"key": key, "value": value} for key, value in [*list(metadata)[:MAX_PRIMITIVES], *missing]],
        **{kind: each[:MAX_PRIMITIVES] for kind, each in drawn.items()},
    }


def _line(points_m: Sequence[tuple[float, float]], colour: Colour) -> Body:
    return {
        "type": _LINE_STRIP,
        "pose": _pose(0.0, 0.0),
        "thickness": WALL_WIDTH_M,
        "scale_invariant": False,
        "points": [_vector(x_m, y_m) for x_m, y_m in points_m],
        "color": _colour(colour),
        "colors": [],
        "indices": [],
    }


def _cube(box: HiddenObject | TruthObject, colour: Colour) -> Body:
    centre_m = box.box_centre_m if isinstance(box, HiddenObject) else (box.x_m, box.y_m)
    return {
        "pose": _pose(*centre_m, box.yaw_rad, 0.5 * OBJECT_HEIGHT_M),
        "size": _vector(box.length_m, box.width_m, OBJECT_HEIGHT_M),
        "color": _colour(colour),
    }


def _label(item: HiddenObject | Track, text: str) -> Body:
    """A text that faces the reader, above an object."""
    return {
        "pose": _pose(item.x_m, item.y_m, 0.0, OBJECT_HEIGHT_M + _LABEL_M),
        "billboard": True,
        "font_size": _LABEL_M,
        "scale_invariant": False,
        "color": _colour(_LABEL_COLOUR),
        "text": text,
    }


def _sphere(x_m: float, y_m: float, colour: Colour) -> Body:
    size = _vector(POINT_SIZE_M, POINT_SIZE_M, POINT_SIZE_M)
    return {"pose": _pose(x_m, y_m), "size": size, "color": _colour(colour)}


def _arrow(track: Track) -> Body:
    """As long as the distance of one second, along the velocity."""
    return {
        "pose": _pose(track.x_m, track.y_m, math.atan2(track.velocity_y_mps, track.velocity_x_mps), OBJECT_HEIGHT_M),
        "shaft_length": _TRACK_SHOWN_S * _speed_mps(track),
        "shaft_diameter": 0.5 * POINT_SIZE_M,
        "head_length": POINT_SIZE_M,
        "head_diameter": POINT_SIZE_M,
        "color": _colour(TRACK_COLOUR),
    }


# grids, image, cloud


def _visibility(frame: BevFrame) -> Body:
    return _grid(frame.stamp_ns, frame.grid, "visibility", frame.visibility)


def _grid(stamp_ns: int, grid: BevGrid, name: str, cells: np.ndarray) -> Body:
    """Bytes [rows, columns]: rows run along y, columns along x, as Foxglove's do."""
    return {
        "timestamp": _time(stamp_ns),
        "frame_id": RADAR,
        "pose": _pose(grid.x_min_m, grid.y_min_m),
        "column_count": grid.columns,
        "cell_size": {"x": grid.cell_m, "y": grid.cell_m},
        "row_stride": grid.columns,
        "cell_stride": 1,
        "fields": [{"name": name, "offset": 0, "type": _UINT8}],
        "data": cells.tobytes(),
    }


def _grey(ra_map: RangeAzimuthMap) -> np.ndarray:
    """Return the map's levels as grey, uint8 [range, azimuth]."""
    level, reference = map_level_db(ra_map)
    bottom_db = 0.0 if reference == "noise" else -GREY_SPAN_DB
    grey: np.ndarray = np.clip(np.rint(GREY_PER_DB * (level - bottom_db)), 0.0, 255.0).astype(np.uint8)
    return grey


def _image(ra_map: RangeAzimuthMap, grey: np.ndarray) -> Body:
    """Cells as they are, far at the top and left on the left."""
    height, width = grey.shape
    return {
        "timestamp": _time(ra_map.stamp_ns),
        "frame_id": RADAR,
        "width": width,
        "height": height,
        "encoding": "mono8",
        "step": width,
        "data": grey[::-1, ::-1].tobytes(),
    }


def _plane(ra_map: RangeAzimuthMap, grey: np.ndarray) -> Body:
    """The map on the ground, beside walls and objects; 0 outside the radar's sector."""
    plane, fold, cells, inside = _plane_index(ra_map.grid)
    ranges = np.maximum.reduceat(grey, np.arange(0, len(grey), fold), axis=0)
    levels = np.where(inside, ranges.ravel()[cells], np.uint8(0))
    return _grid(ra_map.stamp_ns, plane, "level", levels)


@functools.lru_cache(maxsize=4)
def _plane_index(grid: RangeAzimuthGrid) -> tuple[BevGrid, int, np.ndarray, np.ndarray]:
    """Return the plane of a map, and how its cells are read from the map.

    Range bins are taken `fold` at a time, the strongest of each, so that none is skipped: of that map, the flat index
    [rows, columns] of the cell under each centre, and whether it is inside the sector.
    """
    max_range_m = grid.range_bin_m * grid.range_bins
    cell_m = max_range_m / PLANE_COLUMNS
    half = math.ceil(PLANE_COLUMNS * math.sin(math.radians(grid.azimuth_limit_deg)))
    plane = BevGrid(y_min_m=-half * cell_m, cell_m=cell_m, rows=2 * half, columns=PLANE_COLUMNS)
    fold = max(1, grid.range_bins // PLANE_COLUMNS)
    x_m, y_m = np.moveaxis(plane.cell_centres_m(), -1, 0)
    row = np.rint(grid.range_index(np.hypot(x_m, y_m))).astype(np.int64) // fold
    column = np.rint(grid.azimuth_index(np.arctan2(y_m, x_m))).astype(np.int64)
    rows = -(-grid.range_bins // fold)
    inside = (row < rows) & (column >= 0) & (column < grid.azimuth_bins)
    cells = np.minimum(row, rows - 1) * grid.azimuth_bins + np.clip(column, 0, grid.azimuth_bins - 1)
    return plane, fold, cells, inside


def _cloud(peaks: Peaks) -> Body:
    """Peaks where they appear: a mirrored one lies behind its wall."""
    names = ("x", "y", "z", "snr_db", "score", "radial_speed_mps")
    points = np.zeros(len(peaks), [*((name, "<f4") for name in names), ("path_class", "u1")])
    points["x"], points["y"] = np.moveaxis(xy_from_polar(peaks.range_m, peaks.azimuth_rad), -1, 0)
    points["snr_db"], points["score"], points["path_class"] = peaks.snr_db, peaks.score, peaks.path_class
    with np.errstate(over="ignore"):
        points["radial_speed_mps"] = np.nan if peaks.radial_speed_mps is None else peaks.radial_speed_mps
    fields = [{"name": name, "offset": 4 * at, "type": _FLOAT32} for at, name in enumerate(names)]
    return {
        "timestamp": _time(peaks.stamp_ns),
        "frame_id": RADAR,
        "pose": _pose(0.0, 0.0),
        "point_stride": points.itemsize,
        "fields": [*fields, {"name": "path_class", "offset": 4 * len(names), "type": _UINT8}],
        "data": points.tobytes(),
    }


def _lidar_cloud(points: LidarPoints) -> Body:
    """The sensor's own bytes, at the place of the LiDAR on the vehicle; Foxglove's points have single values alone."""
    at = points.vehicle_from_lidar
    fields = [
        {"name": field.name, "offset": field.offset, "type": _NUMERIC[field.datatype]}
        for field in points.fields
        if field.count == 1 and field.datatype in _NUMERIC
    ]
    return {
        "timestamp": _time(points.stamp_ns),
        "frame_id": VEHICLE,
        "pose": _pose(at.x_m, at.y_m, at.yaw_rad, points.lidar_height_m),
        "point_stride": points.data.shape[1],
        "fields": fields,
        "data": points.data.tobytes(),
    }


def _camera_image(image: CameraImage) -> Body:
    return {"timestamp": _time(image.stamp_ns), "frame_id": CAMERA, "data": image.jpeg.tobytes(), "format": "jpeg"}


# transforms, log, numbers


def _transform(stamp_ns: int, parent: str, child: str, parent_from_child: Pose2) -> Body:
    pose = _pose(parent_from_child.x_m, parent_from_child.y_m, parent_from_child.yaw_rad)
    return {
        "timestamp": _time(stamp_ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": pose["position"],
        "rotation": pose["orientation"],
    }


def _log(record: LogRecord) -> Body:
    return {
        "timestamp": _time(record.stamp_ns),
        "level": _LEVELS.get(record.level.lower(), 0),
        "message": record.text,
        "name": record.node,
        "file": "",
        "line": 0,
    }


def _view(frame: BevFrame, latency_ms: float | None) -> Body:
    objects, tracks = frame.objects, frame.tracks
    return _known(
        timestamp=_time(frame.stamp_ns),
        scan_id=frame.scan_id,
        latency_ms=latency_ms,
        walls=len(frame.walls),
        points=len(frame.points),
        direct_points=len(frame.los_points_m),
        object_count=len(frame.objects),
        track_count=len(frame.tracks),
        best_score=max((hidden.score for hidden in objects), default=None),
        flags=" ".join(frame.flags),
        objects=[_known(**_where(hidden), score=hidden.score) for hidden in objects[:MAX_PRIMITIVES]],
        tracks=[_track(track) for track in tracks[:MAX_PRIMITIVES]],
    )


def _track(track: Track) -> Body:
    return _known(
        **_where(track),
        speed_mps=_speed_mps(track),
        age_s=track.age_s,
        existence=track.existence,
        time_to_appear_s=track.time_to_appear_s,
    )


def _where(item: HiddenObject | Track) -> Body:
    return {"id": item.id, "class": item.object_class, "x_m": item.x_m, "y_m": item.y_m}


def _node(status: NodeStatus, last: NodeStatus | None) -> Body:
    return _known(
        timestamp=_time(status.stamp_ns),
        node=status.node,
        state=str(status.state),
        reason=status.reason,
        uptime_s=status.uptime_s,
        cpu_cores=_cores(status, last),
        memory_mib=status.resident_bytes / _MIB,
        lost=_total(count.lost for count in status.received),
        rejected=_total(count.rejected for count in status.received),
        shed=_total(count.count for count in status.shed),
        stages=[_stage(stage) for stage in status.stages[:MAX_PRIMITIVES]],
    )


def _stage(stage: StageTime) -> Body:
    return _known(name=stage.name, last_ms=stage.last_ms, mean_ms=stage.mean_ms, max_ms=stage.max_ms)


def _total(counts: Iterable[int]) -> int:
    """Return a sum that any reader of JSON can hold."""
    return min(max(sum(counts), 0), _MAX_EXACT)


def _cores(status: NodeStatus, last: NodeStatus | None) -> float | None:
    """Return the cores that a process used since its last heartbeat, None without one."""
    if last is None or last.pid != status.pid or not status.uptime_s > last.uptime_s:
        return None
    return (status.cpu_s - last.cpu_s) / (status.uptime_s - last.uptime_s)


def _vehicle(state: VehicleState) -> Body:
    return {
        "timestamp": _time(state.stamp_ns),
        "speed_mps": state.speed_mps,
        "yaw_rate_rps": state.yaw_rate_rps,
        "steering_rad": state.steering_rad,
        "age_s": state.age_s,
        "valid": state.valid,
    }


def _own(message: msgspec.Struct) -> Body:
    """A message of a topic of other people: its fields, with the time that viewers look for."""
    stamp_ns = getattr(message, "stamp_ns", None)
    time = {"timestamp": _time(stamp_ns)} if isinstance(stamp_ns, int) else {}
    return time | _without_none(to_builtins(message, "numbers"))


def _without_none(value: Any) -> Any:
    """Return plain values without those that are missing; a list that lacks one is left out, as places would shift."""
    if isinstance(value, dict):
        return {name: kept for name, inner in value.items() if (kept := _without_none(inner)) is not None}
    if isinstance(value, list):
        items = [_without_none(inner) for inner in value]
        return None if any(item is None for item in items) else items
    return value


# parts


def _known(**fields: Any) -> Body:
    """Return the fields that have a value: a missing number is left out, because viewers plot no null."""
    return {name: value for name, value in fields.items() if value is not None}


def _speed_mps(track: Track) -> float:
    return math.hypot(track.velocity_x_mps, track.velocity_y_mps)


def _time(stamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = stamp_parts(stamp_ns)
    return {"sec": seconds, "nsec": nanoseconds}


def _vector(x: float, y: float, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _pose(x_m: float, y_m: float, yaw_rad: float = 0.0, z_m: float = 0.0) -> Body:
    z, w = quaternion_zw(yaw_rad)
    return {"position": _vector(x_m, y_m, z_m), "orientation": {"x": 0.0, "y": 0.0, "z": z, "w": w}}


def _colour(colour: Colour) -> dict[str, float]:
    return dict(zip("rgba", colour, strict=True))
