"""A message of a topic from what a person writes: YAML of its fields, arrays as lists or files."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from msgs.bus.codec import CodecError, decode_inline
from msgs.bus.topics import topic_facts
from msgs.files.array_files import load_array
from msgs.values.known_names import with_known_names
from msgs.values.wording import did_you_mean


def message_of(topic: str, values: Mapping[str, Any], now_ns: int) -> msgspec.Struct:
    """Return a topic's message of plain values; a stamp that is not given is `now_ns`.

    An array is a list, whole numbers as int64 and others as float64; `{values: LIST, dtype: NAME}`; `{npy: FILE}`; or
    the form of `topic echo --json --full`. Raises `ValueError` naming topic, field and rule.
    """
    kind: Any = topic_facts(topic).type
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    names = fields.keys()
    if unknown := sorted(values.keys() - names):
        near = did_you_mean(unknown[0], names)
        raise ValueError(f"{topic}: unknown field {unknown[0]!r}; known are {', '.join(sorted(names))}{near}")
    body = {"stamp_ns": now_ns, **values} if "stamp_ns" in names else dict(values)
    arrays = {name for name, field in fields.items() if "ndarray" in str(field.type)}
    body = {name: _array_of(f"{topic}: {name}", value) if name in arrays else value for name, value in body.items()}
    encoded = msgspec.msgpack.encode({name: _encoded(f"{topic}: {name}", value) for name, value in body.items()})
    try:
        return decode_inline(kind, encoded)
    except CodecError as error:
        cause = error.__cause__
        rule = with_known_names(cause, kind) if isinstance(cause, msgspec.ValidationError) else str(cause or error)
        raise ValueError(f"{topic}: {rule.replace('`', '')}") from None


def _encoded(where: str, value: Any) -> msgspec.Raw:
    try:
        return msgspec.Raw(msgspec.msgpack.encode(value))
    except OverflowError:
        raise ValueError(f"{where} must have whole numbers of 64 bits, got {value!r}") from None


def _array_of(where: str, value: Any) -> Any:
    """Return the inline form of an array; None stays."""
    if value is None:
        return None
    if isinstance(value, Mapping) and value.keys() == {"npy"}:
        return _inline(_loaded(where, Path(str(value["npy"]))))
    if isinstance(value, Mapping) and value.keys() == {"dtype", "shape", "data"}:
        try:
            return {**value, "data": base64.b64decode(str(value["data"]), validate=True)}
        except binascii.Error as error:
            raise ValueError(f"{where}.data must be base64: {error}") from None
    dtype = None
    if isinstance(value, Mapping) and value.keys() == {"values", "dtype"}:
        value, dtype = value["values"], str(value["dtype"])
    if isinstance(value, list):
        try:
            return _inline(np.asarray(value, dtype))
        except (ValueError, TypeError, OverflowError):
            kind = f" of {dtype}" if dtype else ""
            raise ValueError(f"{where} must be a list of numbers{kind}, rows of equal length") from None
    raise ValueError(f"{where} must be a list, {{values: LIST, dtype: NAME}} or {{npy: FILE}}, got {value!r}")


def _loaded(where: str, path: Path) -> np.ndarray:
    try:
        return load_array(path)
    except ValueError as error:
        raise ValueError(f"{where}: {path} must hold an array, as numpy.save writes it: {error}") from None


def _inline(array: np.ndarray) -> dict[str, Any]:
    if array.dtype.kind not in "biufc":
        raise ValueError("must be numbers")
    wire = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return {"dtype": wire.dtype.str, "shape": wire.shape, "data": wire.tobytes()}
