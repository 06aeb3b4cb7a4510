"""JSON Schemas of the messages for Foxglove, live and in files: its own types, and the numbers of the graph.

Field names and numbers of Foxglove's types are those of its public schemas; the schemas here are our own and name the
fields that are used. Viewers recognise a message by its schema's name.
"""

from __future__ import annotations

from typing import Any

from msgspec import inspect

from msgs.bus.topics import TOPICS, Topic

#: What an entity of a scene may hold; absent kinds are empty lists.
PRIMITIVES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")

#: Schema of each topic for Foxglove, in the order in which they are offered.
CHANNELS = {
    "/hidden_objects/scene": "foxglove.SceneUpdate",
    "/hidden_objects/visibility": "foxglove.Grid",
    "/radar/ra_map": "foxglove.RawImage",
    "/radar/ra_map/plane": "foxglove.Grid",
    "/radar/peaks": "foxglove.PointCloud",
    "/sim/truth": "foxglove.SceneUpdate",
    "/tf": "foxglove.FrameTransform",
    "/views": "mirrorwave.View",
    "/nodes": "mirrorwave.Node",
    "/vehicle/state": "mirrorwave.Vehicle",
    "/log": "foxglove.Log",
    "/lidar/points": "foxglove.PointCloud",
    "/camera/image": "foxglove.CompressedImage",
}


def _object(*optional: str, **properties: Any) -> dict[str, Any]:
    required = [name for name in properties if name not in optional]
    return {"type": "object", "properties": properties, "required": required}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _WHOLE, _TEXT, _FLAG = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))
_BYTES = {"type": "string", "contentEncoding": "base64"}
_TIME = _object(sec=_WHOLE, nsec=_WHOLE)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_TURN = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_TURN)
_COLOUR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_FIELDS = _list(_object(name=_TEXT, offset=_WHOLE, type=_WHOLE))
#: An array of a topic of other people: its numbers where they are few, real and finite.
_ARRAY = _object(
    *("min", "max", "mean", "values"),
    dtype=_TEXT,
    shape=_list(_WHOLE),
    **dict.fromkeys(("min", "max", "mean"), _NUMBER),
    values=_list(_NUMBER),
)
_STAMPED = {"timestamp": _TIME, "frame_id": _TEXT}


def _scene() -> dict[str, Any]:
    solid = _object(pose=_POSE, size=_VECTOR, color=_COLOUR)
    line = _object(
        type=_WHOLE,
        pose=_POSE,
        thickness=_NUMBER,
        scale_invariant=_FLAG,
        points=_list(_VECTOR),
        color=_COLOUR,
        colors=_list(_COLOUR),
        indices=_list(_WHOLE),
    )
    sizes = ("shaft_length", "shaft_diameter", "head_length", "head_diameter")
    arrow = _object(pose=_POSE, **dict.fromkeys(sizes, _NUMBER), color=_COLOUR)
    text = _object(pose=_POSE, billboard=_FLAG, font_size=_NUMBER, scale_invariant=_FLAG, color=_COLOUR, text=_TEXT)
    used = {"arrows": arrow, "cubes": solid, "spheres": solid, "lines": line, "texts": text}
    entity = _object(
        **_STAMPED,
        id=_TEXT,
        lifetime=_TIME,
        frame_locked=_FLAG,
        metadata=_list(_object(key=_TEXT, value=_TEXT)),
        **{kind: _list(used.get(kind, _object())) for kind in PRIMITIVES},
    )
    deletion = _object(timestamp=_TIME, type=_WHOLE, id=_TEXT)
    return _object(deletions=_list(deletion), entities=_list(entity))


def _grid() -> dict[str, Any]:
    return _object(
        **_STAMPED,
        pose=_POSE,
        column_count=_WHOLE,
        cell_size=_object(x=_NUMBER, y=_NUMBER),
        row_stride=_WHOLE,
        cell_stride=_WHOLE,
        fields=_FIELDS,
        data=_BYTES,
    )


def _view() -> dict[str, Any]:
    position = {"id": _WHOLE, "class": _TEXT, "x_m": _NUMBER, "y_m": _NUMBER}
    track = {**position, "speed_mps": _NUMBER, "age_s": _NUMBER, "existence": _NUMBER, "time_to_appear_s": _NUMBER}
    return _object(
        "latency_ms",
        "best_score",
        timestamp=_TIME,
        scan_id=_WHOLE,
        latency_ms=_NUMBER,
        walls=_WHOLE,
        points=_WHOLE,
        direct_points=_WHOLE,
        object_count=_WHOLE,
        track_count=_WHOLE,
        best_score=_NUMBER,
        flags=_TEXT,
        objects=_list(_object("score", **position, score=_NUMBER)),
        tracks=_list(_object("age_s", "existence", "time_to_appear_s", **track)),
    )


def _node() -> dict[str, Any]:
    stage = _object("last_ms", "mean_ms", "max_ms", name=_TEXT, last_ms=_NUMBER, mean_ms=_NUMBER, max_ms=_NUMBER)
    return _object(
        "cpu_cores",
        "uptime_s",
        timestamp=_TIME,
        node=_TEXT,
        state=_TEXT,
        reason=_TEXT,
        uptime_s=_NUMBER,
        cpu_cores=_NUMBER,
        memory_mib=_NUMBER,
        lost=_WHOLE,
        rejected=_WHOLE,
        shed=_WHOLE,
        stages=_list(stage),
    )


def _schemas() -> dict[str, dict[str, Any]]:
    """JSON Schemas without references and without unions of types, which not every viewer follows."""
    bodies = {
        "foxglove.SceneUpdate": _scene(),
        "foxglove.Grid": _grid(),
        "foxglove.RawImage": _object(**_STAMPED, width=_WHOLE, height=_WHOLE, encoding=_TEXT, step=_WHOLE, data=_BYTES),
        "foxglove.CompressedImage": _object(**_STAMPED, data=_BYTES, format=_TEXT),
        "foxglove.PointCloud": _object(**_STAMPED, pose=_POSE, point_stride=_WHOLE, fields=_FIELDS, data=_BYTES),
        "foxglove.FrameTransform": _object(
            timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_TURN
        ),
        "foxglove.Log": _object(timestamp=_TIME, level=_WHOLE, message=_TEXT, name=_TEXT, file=_TEXT, line=_WHOLE),
        "mirrorwave.View": _view(),
        "mirrorwave.Node": _node(),
        "mirrorwave.Vehicle": _object(
            timestamp=_TIME, speed_mps=_NUMBER, yaw_rate_rps=_NUMBER, steering_rad=_NUMBER, age_s=_NUMBER, valid=_FLAG
        ),
    }
    return {name: {"title": name, **body} for name, body in bodies.items()}


#: JSON Schema by message type.
SCHEMAS = _schemas()


def channels() -> dict[str, dict[str, Any]]:
    """Return the JSON Schema of each channel, of `CHANNELS` and of the topics of other people."""
    own = {
        own_channel(name): {"title": topic.type.__name__, **_own_schema(topic)} for name, topic in TOPICS.own().items()
    }
    return {topic: SCHEMAS[schema] for topic, schema in CHANNELS.items()} | own


def own_channel(topic: str) -> str:
    """Return the channel of a topic of other people: its name, unless one of `CHANNELS` has it."""
    return f"/{topic}" if f"/{topic}" not in CHANNELS else f"/topics/{topic}"


def _own_schema(topic: Topic) -> dict[str, Any]:
    info = inspect.type_info(topic.type)
    assert isinstance(info, inspect.StructType)
    return _of_fields(info, frozenset())


def _of_fields(info: inspect.StructType, outer: frozenset[type]) -> dict[str, Any]:
    """Return the schema of a Struct; no field is required, since one without a value is left out."""
    inside = {} if info.cls in outer else {field.encode_name: field.type for field in info.fields}
    parts = {name: _of_type(kind, outer | {info.cls}) for name, kind in inside.items()}
    times = {} if outer else {"timestamp": _TIME}
    return _object(*times, *parts, **(times | parts))


def _of_type(kind: inspect.Type, outer: frozenset[type]) -> dict[str, Any]:
    match kind:
        case inspect.Metadata():
            return _of_type(kind.type, outer)
        case inspect.UnionType():
            options = [option for option in kind.types if not isinstance(option, inspect.NoneType)]
            return _of_type(options[0], outer) if len(options) == 1 else {}
        case inspect.StructType():
            return _of_fields(kind, outer)
        case inspect.CustomType():
            return _ARRAY
        case inspect.BoolType():
            return _FLAG
        case inspect.IntType():
            return _WHOLE
        case inspect.FloatType():
            return _NUMBER
        case inspect.ListType() | inspect.VarTupleType() | inspect.SetType() | inspect.FrozenSetType():
            return _list(_of_type(kind.item_type, outer))
        case inspect.StrType() | inspect.BytesType():
            return _TEXT
    return {}
