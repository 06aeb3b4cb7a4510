"""Recordings as MCAP with Foxglove's message types in JSON: scenes, observability grid, transforms, log.

Field names and numbers are those of Foxglove's public schemas; the JSON Schemas written into the file are our own and
name the fields that are used. Viewers recognise a message by its schema's name.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.diagnostics import LogRecord
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, HiddenObject, SceneTruth, TruthObject
from msgs.values.vehicle import VehicleState
from nodes.bridges.shapes import (
    DIRECT_COLOUR,
    OBJECT_COLOUR,
    OBJECT_HEIGHT_M,
    POINT_COLOUR,
    POINT_SIZE_M,
    TRACK_COLOUR,
    TRUTH_COLOUR,
    WALL_COLOUR,
    WALL_WIDTH_M,
    Account,
    Colour,
    Odometry,
    counted,
    quaternion_zw,
    stamp_parts,
    wall_line_m,
)

TOPICS = ("perception/hidden_objects", "sim/truth", "vehicle/state", "log")
RADAR, VEHICLE, ODOM = "radar", "vehicle", "odom"

_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5, "fatal": 5}
_UINT8 = 1
_LINE_STRIP = 0
_TRACK_SHOWN_S = 1.0
#: What an entity may hold; absent kinds are empty lists.
_PRIMITIVES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")


def write(
    reader: RecordingReader, out: Path, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> None:
    """Write the topics as an MCAP file of JSON messages; log times stay, publish times are the messages' stamps."""
    with out.open("xb") as file:
        sink = _Sink(file, account)
        for recorded in counted(reader, topics, account, advance):
            sink.take(recorded)
        sink.finish()


class _Sink:
    """Turns messages into Foxglove's and writes them."""

    def __init__(self, file: Any, account: Account) -> None:
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="mirrorwave")
        self._account = account
        self._channels: dict[str, int] = {}
        self._odometry = Odometry()

    def take(self, recorded: Recorded) -> None:
        """Write what a message becomes."""
        message: Any = recorded.message
        if isinstance(message, BevFrame):
            self._put("/hidden_objects/scene", "SceneUpdate", _scene(message), recorded)
            self._put("/hidden_objects/visibility", "Grid", _grid(message), recorded)
        elif isinstance(message, SceneTruth):
            self._put("/sim/truth", "SceneUpdate", _truth_scene(message), recorded)
        elif isinstance(message, LogRecord):
            self._put("/log", "Log", _log(message), recorded)
        elif isinstance(message, VehicleState):
            self._take_state(message, recorded)

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()

    def _take_state(self, state: VehicleState, recorded: Recorded) -> None:
        pose = self._odometry.advance(state)
        if pose is None:
            self._account.leave_out(recorded.topic, Odometry.REFUSED)
            return
        if "/tf" not in self._channels:
            self._put("/tf", "FrameTransform", _transform(state.stamp_ns, VEHICLE, RADAR, Pose2()), recorded)
        self._put("/tf", "FrameTransform", _transform(state.stamp_ns, ODOM, VEHICLE, pose), recorded)

    def _put(self, topic: str, schema: str, body: dict[str, Any], recorded: Recorded) -> None:
        if topic not in self._channels:
            text = msgspec.json.encode(SCHEMAS[schema])
            schema_id = self._writer.register_schema(f"foxglove.{schema}", SchemaEncoding.JSONSchema, text)
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.JSON, schema_id)
        self._writer.add_message(
            self._channels[topic],
            log_time=recorded.log_time_ns,
            publish_time=max(getattr(recorded.message, "stamp_ns", 0), 0),
            sequence=recorded.sequence,
            data=msgspec.json.encode(body),
        )


def _scene(frame: BevFrame) -> dict[str, Any]:
    """Entities replace those of the scan before by their id, so empty ones are written too."""
    points = [
        _sphere(point.x_m, point.y_m, (*POINT_COLOUR[:3], min(max(point.score, 0.2), 1.0))) for point in frame.points
    ]
    tracks = [_arrow(track.x_m, track.y_m, track.velocity_x_mps, track.velocity_y_mps) for track in frame.tracks]
    scores = [(f"object {hidden.id} score", f"{hidden.score:.6g}") for hidden in frame.objects]
    entities = [
        _entity(frame.stamp_ns, "walls", lines=[_line(wall_line_m(wall), WALL_COLOUR) for wall in frame.walls]),
        _entity(frame.stamp_ns, "objects", scores, cubes=[_cube(hidden, OBJECT_COLOUR) for hidden in frame.objects]),
        _entity(frame.stamp_ns, "points", spheres=points),
        _entity(frame.stamp_ns, "direct", spheres=[_sphere(x, y, DIRECT_COLOUR) for x, y in frame.los_points_m]),
        _entity(frame.stamp_ns, "tracks", arrows=tracks),
    ]
    return {"deletions": [], "entities": entities}


def _truth_scene(truth: SceneTruth) -> dict[str, Any]:
    surfaces = [_line(surface.polyline_m, TRUTH_COLOUR) for surface in truth.surfaces]
    spheres = [_sphere(x, y, TRUTH_COLOUR) for x, y, _ in truth.hidden_points_m]
    entities = [
        _entity(truth.stamp_ns, "surfaces", lines=surfaces),
        _entity(truth.stamp_ns, "objects", cubes=[_cube(true_object, TRUTH_COLOUR) for true_object in truth.objects]),
        _entity(truth.stamp_ns, "points", spheres=spheres),
    ]
    return {"deletions": [], "entities": entities}


def _entity(
    stamp_ns: int, name: str, metadata: Iterable[tuple[str, str]] = (), **primitives: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "timestamp": _time(stamp_ns),
        "frame_id": RADAR,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [{"key": key, "value": value} for key, value in metadata],
        **{kind: primitives.get(kind, []) for kind in _PRIMITIVES},
    }


def _line(points_m: Sequence[tuple[float, float]], colour: Colour) -> dict[str, Any]:
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


def _cube(box: HiddenObject | TruthObject, colour: Colour) -> dict[str, Any]:
    return {
        "pose": _pose(box.x_m, box.y_m, box.yaw_rad, 0.5 * OBJECT_HEIGHT_M),
        "size": _vector(box.length_m, box.width_m, OBJECT_HEIGHT_M),
        "color": _colour(colour),
    }


def _sphere(x_m: float, y_m: float, colour: Colour) -> dict[str, Any]:
    size = _vector(POINT_SIZE_M, POINT_SIZE_M, POINT_SIZE_M)
    return {"pose": _pose(float(x_m), float(y_m)), "size": size, "color": _colour(colour)}


def _arrow(x_m: float, y_m: float, velocity_x_mps: float, velocity_y_mps: float) -> dict[str, Any]:
    """As long as the way of one second, along the velocity."""
    return {
        "pose": _pose(x_m, y_m, float(np.arctan2(velocity_y_mps, velocity_x_mps)), OBJECT_HEIGHT_M),
        "shaft_length": _TRACK_SHOWN_S * float(np.hypot(velocity_x_mps, velocity_y_mps)),
        "shaft_diameter": 0.5 * POINT_SIZE_M,
        "head_length": POINT_SIZE_M,
        "head_diameter": POINT_SIZE_M,
        "color": _colour(TRACK_COLOUR),
    }


def _grid(frame: BevFrame) -> dict[str, Any]:
    """Rows of the mask run along y, columns along x, as Foxglove's do."""
    grid = frame.grid
    return {
        "timestamp": _time(frame.stamp_ns),
        "frame_id": RADAR,
        "pose": _pose(grid.x_min_m, grid.y_min_m),
        "column_count": grid.columns,
        "cell_size": {"x": grid.cell_m, "y": grid.cell_m},
        "row_stride": grid.columns,
        "cell_stride": 1,
        "fields": [{"name": "visibility", "offset": 0, "type": _UINT8}],
        "data": base64.b64encode(frame.visibility.tobytes()).decode(),
    }


def _transform(stamp_ns: int, parent: str, child: str, parent_from_child: Pose2) -> dict[str, Any]:
    pose = _pose(parent_from_child.x_m, parent_from_child.y_m, parent_from_child.yaw_rad)
    return {
        "timestamp": _time(stamp_ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": pose["position"],
        "rotation": pose["orientation"],
    }


def _log(record: LogRecord) -> dict[str, Any]:
    return {
        "timestamp": _time(record.stamp_ns),
        "level": _LEVELS.get(record.level.lower(), 0),
        "message": record.text,
        "name": record.node,
        "file": "",
        "line": 0,
    }


def _time(stamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = stamp_parts(stamp_ns)
    return {"sec": seconds, "nsec": nanoseconds}


def _vector(x: float, y: float, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _pose(x_m: float, y_m: float, yaw_rad: float = 0.0, z_m: float = 0.0) -> dict[str, Any]:
    z, w = quaternion_zw(yaw_rad)
    return {"position": _vector(x_m, y_m, z_m), "orientation": {"x": 0.0, "y": 0.0, "z": z, "w": w}}


def _colour(colour: Colour) -> dict[str, float]:
    return dict(zip("rgba", colour, strict=True))


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _schemas() -> dict[str, dict[str, Any]]:
    """JSON Schemas without references, which not every viewer follows."""
    number, whole, text, flag = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))
    time = _object(sec=whole, nsec=whole)
    vector = _object(x=number, y=number, z=number)
    turn = _object(x=number, y=number, z=number, w=number)
    pose = _object(position=vector, orientation=turn)
    colour = _object(r=number, g=number, b=number, a=number)
    solid = _object(pose=pose, size=vector, color=colour)
    line = _object(
        type=whole,
        pose=pose,
        thickness=number,
        scale_invariant=flag,
        points=_list(vector),
        color=colour,
        colors=_list(colour),
        indices=_list(whole),
    )
    sizes = ("shaft_length", "shaft_diameter", "head_length", "head_diameter")
    arrow = _object(pose=pose, **dict.fromkeys(sizes, number), color=colour)
    used = {"arrows": arrow, "cubes": solid, "spheres": solid, "lines": line}
    entity = _object(
        timestamp=time,
        frame_id=text,
        id=text,
        lifetime=time,
        frame_locked=flag,
        metadata=_list(_object(key=text, value=text)),
        **{kind: _list(used.get(kind, _object())) for kind in _PRIMITIVES},
    )
    grid = _object(
        timestamp=time,
        frame_id=text,
        pose=pose,
        column_count=whole,
        cell_size=_object(x=number, y=number),
        row_stride=whole,
        cell_stride=whole,
        fields=_list(_object(name=text, offset=whole, type=whole)),
        data={"type": "string", "contentEncoding": "base64"},
    )
    transform = _object(timestamp=time, parent_frame_id=text, child_frame_id=text, translation=vector, rotation=turn)
    log = _object(timestamp=time, level=whole, message=text, name=text, file=text, line=whole)
    deletion = _object(timestamp=time, type=whole, id=text)
    bodies = {
        "SceneUpdate": _object(deletions=_list(deletion), entities=_list(entity)),
        "Grid": grid,
        "FrameTransform": transform,
        "Log": log,
    }
    return {name: {"title": f"foxglove.{name}", **body} for name, body in bodies.items()}


#: JSON Schema by message type, without the prefix "foxglove.".
SCHEMAS = _schemas()
