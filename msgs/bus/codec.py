"""Messages as bytes: msgpack header and raw array frames on the wire, one msgpack map in recordings, JSON for people.

Wire: `[topic\0][header][array]...`, the header `{"envelope": ..., "body": ...}`, each array of the body `{"dtype",
"shape", "frame"}`. Inline: the body alone, arrays with their little-endian C-order bytes in `data`. Nothing received is
trusted: sizes, names, types, array layouts and unknown fields are checked before a value is built.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from msgs.bus.interface import Envelope, Received
from msgs.bus.topics import TOPIC_NAME, TOPICS, Topic, topic_facts
from msgs.values.arrays import DTYPES, MAX_NDIM
from msgs.values.wording import as_utf8

Buffer = bytes | memoryview
StructType = TypeVar("StructType", bound=msgspec.Struct)

PROTOCOL = 1
MAX_HEADER_BYTES = 1 << 20
#: An inline message has all its arrays inside, and beside them no more than a header: a byte there may become a
#: value of a hundred. No message of this project comes near the limit.
MAX_INLINE_BYTES = 1 << 28
_MAX_REASON = 300
#: First bytes of binary values in msgpack.
_BINARY = (b"\xc4", b"\xc5", b"\xc6")
#: Values of an array that are given one by one.
MAX_VALUES = 1024
#: A hundred thousand years of beams.
_MAX_SEQUENCE = 1 << 48
#: Exceptions that building a value from hostile input may raise; all of them become a `CodecError`. Nesting deeper than
#: the interpreter allows ends in RecursionError.
_TROUBLE = (
    *(msgspec.MsgspecError, ValueError, TypeError, ArithmeticError, RecursionError),
    # of a check in a type of somebody else
    *(LookupError, AttributeError),
)


class CodecError(ValueError):
    """A message that cannot be encoded or decoded; one line, with the path of the field."""

    def __init__(self, reason: object) -> None:
        super().__init__(" ".join(str(reason).split())[:_MAX_REASON])


class _ArrayHead(msgspec.Struct, forbid_unknown_fields=True):
    """Placeholder of an array in a header."""

    dtype: str
    shape: tuple[int, ...]
    frame: int


class _ArrayInline(msgspec.Struct, forbid_unknown_fields=True):
    """Form of an array in a recording."""

    dtype: str
    shape: tuple[int, ...]
    data: bytes


class _ArrayData(msgspec.Struct):
    """An inline array without its description."""

    data: msgspec.Raw


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    """The header with its body still untyped: the topic decides the type."""

    envelope: Envelope
    body: dict[str, Any]


def encode(envelope: Envelope, message: msgspec.Struct, any_size: bool = False) -> list[Buffer]:
    """Return the frames of a message; arrays are not copied, so they must not change while the frames are in use.

    Raises `CodecError` when the message is not the topic's type, is too large for it (unless `any_size`), or holds a
    value that may not be sent.
    """
    topic = _topic_of(envelope)
    if type(message) is not topic.type:
        raise CodecError(f"{topic.name} carries {topic.type.__name__}, got {type(message).__name__}")
    try:
        frames = _frames(topic, envelope, message)
    except UnicodeEncodeError:
        # a path in a parameter or a reason; looked for where it fails alone, as most messages have none
        frames = _frames(topic, envelope, _with_utf8(message))
    if not any_size:
        _require_size(topic, frames)
    return frames


def _frames(topic: Topic, envelope: Envelope, message: msgspec.Struct) -> list[Buffer]:
    arrays: list[Buffer] = []

    def array_head(array: np.ndarray) -> dict[str, Any]:
        wire = _wire_array(array)
        arrays.append(_bytes_of(wire))
        return {"dtype": wire.dtype.str, "shape": wire.shape, "frame": len(arrays) - 1}

    header = _pack({"envelope": envelope, "body": message}, array_head)
    if len(header) > MAX_HEADER_BYTES:
        raise CodecError(f"{topic.name}: header of {len(header)} bytes exceeds {MAX_HEADER_BYTES}")
    return [topic_frame(topic.name), header, *arrays]


def decode(frames: Sequence[Buffer], any_size: bool = False) -> Received:
    """Return the message of `frames`, arrays as read-only views on them; raises `CodecError` and nothing else."""
    if len(frames) < 2:
        raise CodecError(f"message must have at least 2 frames, got {len(frames)}")
    topic = _topic_of_frame(bytes(frames[0][:256]))
    if not any_size:
        _require_size(topic, frames)
    if len(frames[1]) > MAX_HEADER_BYTES:
        raise CodecError(f"{topic.name}: header of {len(frames[1])} bytes exceeds {MAX_HEADER_BYTES}")
    try:
        return _decode_known(topic, frames[1], frames[2:])
    except _TROUBLE as error:
        raise CodecError(f"{topic.name}: {error}") from error


def encode_inline(message: msgspec.Struct) -> bytes:
    """Return one msgpack map with the arrays inside, for recordings."""
    try:
        return _pack(message, _inline_array)
    except UnicodeEncodeError:
        return _pack(_with_utf8(message), _inline_array)


def decode_inline(message_type: type[StructType], data: Buffer) -> StructType:
    """Return the message that `encode_inline` wrote; raises `CodecError`, and nothing else, on any other bytes."""
    if len(data) > MAX_INLINE_BYTES:
        raise CodecError(f"{message_type.__name__}: {len(data)} bytes exceed {MAX_INLINE_BYTES}")

    def array(reference: object) -> np.ndarray:
        inline = _described(reference, _ArrayInline)
        return _view(inline.dtype, inline.shape, inline.data)

    try:
        if len(data) > MAX_HEADER_BYTES:
            _require_arrays(message_type, data)
        return _convert(message_type, msgspec.msgpack.decode(data), array)
    except _TROUBLE as error:
        raise CodecError(f"{message_type.__name__}: {error}") from error


def topic_frame(topic: str) -> bytes:
    """Return the first frame of a topic's messages; the end mark keeps one topic from being a prefix of another."""
    return topic.encode() + b"\0"


def json_schema(message_type: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON Schema of the inline form; `data` is binary in msgpack and base64 in JSON."""
    return msgspec.json.schema(message_type, schema_hook=_array_schema)


def to_builtins(message: msgspec.Struct, arrays: Literal["summary", "numbers", "full"] = "summary") -> dict[str, Any]:
    """Return plain values that any JSON writer takes: non-finite numbers become None.

    "summary" gives each array's dtype, shape and finite min, max and mean (of the magnitude where complex); "numbers"
    its values too, flat, where they are few, real and finite; "full" is the inline form with base64 data, which
    `json_schema` describes.
    """
    forms = {"summary": _array_summary, "numbers": _array_numbers, "full": _inline_array}
    return _finite_or_none(msgspec.to_builtins(message, enc_hook=_encoder_hook(forms[arrays])))


def _require_arrays(message_type: type[msgspec.Struct], data: Buffer) -> None:
    """Raise `ValueError` unless all of an inline message but a header's size is bytes of its arrays."""
    rest = len(data)
    for value in msgspec.structs.astuple(msgspec.msgpack.decode(data, type=_unread(message_type))):
        with contextlib.suppress(msgspec.MsgspecError):
            array = bytes(msgspec.msgpack.decode(value, type=_ArrayData).data)
            rest -= len(array) * (array[:1] in _BINARY)
    if rest > MAX_HEADER_BYTES:
        raise ValueError(f"{rest} bytes beside arrays exceed {MAX_HEADER_BYTES}")


@functools.cache
def _unread(message_type: type[msgspec.Struct]) -> type[msgspec.Struct]:
    """Return a message type whose fields stay bytes, or are empty."""
    fields = [(name, msgspec.Raw, msgspec.Raw()) for name in message_type.__struct_fields__]
    return msgspec.defstruct(f"_{message_type.__name__}", fields)


def _decode_known(topic: Topic, header: Buffer, arrays: Sequence[Buffer]) -> Received:
    """Decode once the topic is known; may raise anything of `_TROUBLE`."""
    head = msgspec.msgpack.decode(header, type=_Header, strict=True)
    _check_envelope(head.envelope, topic)
    unused = set(range(len(arrays)))

    def array(reference: object) -> np.ndarray:
        at = _described(reference, _ArrayHead)
        if at.frame not in unused:
            raise ValueError(f"frame must be one of {len(arrays)}, each used once, got {at.frame}")
        unused.discard(at.frame)
        return _view(at.dtype, at.shape, arrays[at.frame])

    message: msgspec.Struct = _convert(topic.type, head.body, array)
    if unused:
        raise ValueError(f"{len(unused)} of {len(arrays)} array frames belong to no field")
    return Received(topic.name, message, head.envelope)


def _convert(message_type: type[StructType], body: object, array_from: Callable[[object], np.ndarray]) -> StructType:
    """Return a strictly typed message made of plain values; unknown fields are refused."""

    def hook(field_type: type, value: object) -> np.ndarray:
        if field_type is not np.ndarray:
            raise TypeError(f"{field_type.__name__} cannot travel")
        return array_from(value)

    message = msgspec.convert(body, message_type, strict=True, dec_hook=hook)
    _refuse_unknown(body, msgspec.to_builtins(message, enc_hook=lambda array: None), "$")
    return message


def _described(reference: object, form: type[StructType]) -> StructType:
    """Return the header entry of one array."""
    try:
        return msgspec.convert(reference, form, strict=True)
    except msgspec.ValidationError as error:
        # msgspec adds the field's path to a plain ValueError only
        raise ValueError(str(error)) from error


def _refuse_unknown(raw: object, accepted: object, path: str) -> None:
    """Raise `ValueError` for the first field of `raw` that `accepted`, the same message in full, does not have."""
    if isinstance(raw, dict) and isinstance(accepted, dict):
        for name, value in raw.items():
            if name not in accepted:
                raise ValueError(f"unknown field - at `{path}.{name}`")
            _refuse_unknown(value, accepted[name], f"{path}.{name}")
    elif isinstance(raw, list) and isinstance(accepted, list | tuple):
        for value, accepted_value in zip(raw, accepted, strict=True):
            if isinstance(value, dict | list):
                _refuse_unknown(value, accepted_value, f"{path}[...]")


def _check_envelope(envelope: Envelope, topic: Topic) -> None:
    if envelope.protocol != PROTOCOL:
        raise ValueError(f"protocol must be {PROTOCOL}, got {envelope.protocol} - at `$.envelope.protocol`")
    if envelope.topic != topic.name:
        raise ValueError(f"topic must be that of the first frame, got {envelope.topic!r} - at `$.envelope.topic`")
    for name in ("sequence", "sent_ns"):
        if getattr(envelope, name) < 0:
            raise ValueError(f"{name} must not be negative, got {getattr(envelope, name)} - at `$.envelope.{name}`")
    if envelope.sequence > _MAX_SEQUENCE:
        # gaps are added up, and their sum has to fit a heartbeat
        raise ValueError(
            f"sequence must be at most {_MAX_SEQUENCE}, got {envelope.sequence} - at `$.envelope.sequence`"
        )


def _topic_of(envelope: Envelope) -> Topic:
    try:
        return topic_facts(envelope.topic)
    except ValueError as error:
        raise CodecError(error) from error


def _topic_of_frame(frame: bytes) -> Topic:
    name = frame[:-1].decode("ascii", "replace")
    if not frame.endswith(b"\0") or not TOPIC_NAME.fullmatch(name) or name not in TOPICS:
        raise CodecError(f"first frame must be a known topic and a zero byte, got {frame!r}")
    return TOPICS[name]


def _require_size(topic: Topic, frames: Sequence[Buffer]) -> None:
    size = sum(len(frame) for frame in frames)
    if size > topic.max_bytes:
        raise CodecError(f"{topic.name}: message of {size} bytes exceeds {topic.max_bytes}")


def _pack(value: object, array_form: Callable[[np.ndarray], object]) -> bytes:
    try:
        return msgspec.msgpack.encode(value, enc_hook=_encoder_hook(array_form))
    except UnicodeEncodeError:
        raise
    except _TROUBLE as error:
        raise CodecError(error) from error


def _with_utf8(value: Any) -> Any:
    """Return a value whose texts can be written as UTF-8."""
    if isinstance(value, str):
        return as_utf8(value)
    if isinstance(value, msgspec.Struct):
        fields = {name: getattr(value, name) for name in value.__struct_fields__}
        return msgspec.structs.replace(value, **{name: _with_utf8(each) for name, each in fields.items()})
    if isinstance(value, list | tuple):
        # a named tuple takes its items one by one
        items = [_with_utf8(each) for each in value]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    if isinstance(value, dict):
        return {_with_utf8(key): _with_utf8(each) for key, each in value.items()}
    return value


def _encoder_hook(array_form: Callable[[np.ndarray], object]) -> Callable[[Any], object]:
    """Return encoder hook: arrays in the given form, numpy numbers as plain ones, nothing else."""

    def hook(value: Any) -> object:
        if isinstance(value, np.ndarray):
            return array_form(value)
        if isinstance(value, np.bool_ | np.integer | np.floating):
            return value.item()
        raise TypeError(f"{type(value).__name__} cannot travel")

    return hook


def _wire_array(array: np.ndarray) -> np.ndarray:
    """Return `array` itself if it is C-contiguous and little-endian already, else a copy that is."""
    wire = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).reshape(array.shape)
    if wire.dtype.str not in DTYPES:
        raise TypeError(f"dtype {array.dtype.str} cannot travel")
    if wire.ndim > MAX_NDIM:
        raise ValueError(f"arrays have at most {MAX_NDIM} dimensions, got {wire.ndim}")
    return wire


def _bytes_of(array: np.ndarray) -> memoryview:
    """Return the flat bytes of a contiguous array without a copy."""
    return array.reshape(-1).view(np.uint8).data


def _inline_array(array: np.ndarray) -> dict[str, Any]:
    wire = _wire_array(array)
    return {"dtype": wire.dtype.str, "shape": wire.shape, "data": _bytes_of(wire)}


def _view(dtype: str, shape: tuple[int, ...], data: Buffer) -> np.ndarray:
    """Return a read-only array on `data`; its layout is checked with exact integers before numpy reads it."""
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be one of the permitted, got {dtype!r}")
    if len(shape) > MAX_NDIM or any(length < 0 for length in shape):
        raise ValueError(f"shape must have at most {MAX_NDIM} lengths, none negative, got {shape[: MAX_NDIM + 1]}")
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size != len(data):
        raise ValueError(f"shape {shape} of {dtype} needs {size} bytes, got {len(data)}")
    array: np.ndarray = np.ndarray(shape, dtype, buffer=data)
    if not array.flags.aligned:
        # compiled kernels take aligned arrays only; the transport misaligns nothing but small frames
        array = array.copy()
    array.flags.writeable = False
    return array


def _array_schema(value_type: type) -> dict[str, Any]:
    if value_type is not np.ndarray:
        raise TypeError(f"{value_type.__name__} cannot travel")
    return {
        "type": "object",
        "title": "Array",
        "description": "n-dimensional array: little-endian, C order",
        "properties": {
            "dtype": {"type": "string", "enum": sorted(DTYPES)},
            "shape": {"type": "array", "items": {"type": "integer", "minimum": 0}, "maxItems": MAX_NDIM},
            "data": {"type": "string", "contentEncoding": "base64"},
        },
        "required": ["dtype", "shape", "data"],
        "additionalProperties": False,
    }


def _array_summary(array: np.ndarray) -> dict[str, Any]:
    summary: dict[str, Any] = {"dtype": array.dtype.str, "shape": array.shape}
    # a number beyond the largest float becomes None, like every non-finite number
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.abs(array.astype(np.complex128)) if np.iscomplexobj(array) else array
        finite = values[np.isfinite(values)]
        if finite.size:
            mean = finite.mean(dtype=np.float64)
            summary |= {"min": finite.min().item(), "max": finite.max().item(), "mean": mean.item()}
    return summary


def _array_numbers(array: np.ndarray) -> dict[str, Any]:
    """Return the summary with the values; flags are numbers, as viewers plot them."""
    plain = array.astype(np.uint8) if array.dtype.kind == "b" else array
    summary = _array_summary(plain) | {"dtype": array.dtype.str}
    if array.size > MAX_VALUES or plain.dtype.kind not in "iuf" or not np.isfinite(plain).all():
        return summary
    return summary | {"values": plain.ravel().tolist()}


def _finite_or_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite_or_none(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_or_none(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
