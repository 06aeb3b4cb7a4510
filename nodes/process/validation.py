"""Plain data to typed values, with the field's own path in every error."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Mapping
from enum import Enum
from typing import Any, TypeVar

import msgspec

from msgs.values.known_names import with_known_names

T = TypeVar("T")

LONGEST_REST_S = 3600.0
#: Clocks that count from the start of their machine differ by less: 31 years.
MAX_CLOCK_OFFSET_S = 1e9

_PATH = re.compile(r" - at `\$(?P<path>[^`]*)`$")


def convert_at(value: Any, wanted: type[T], where: str) -> T:
    """Return `value` as `wanted`; errors are `where.field: rule`, or `where: field: rule` if `where` ends in ": ".

    Raises `ValueError` for a wrong type, an unknown field (it lists the valid ones) or a value its type refuses.
    """
    try:
        return msgspec.convert(value, wanted)
    except msgspec.ValidationError as error:
        raise ValueError(explain(with_known_names(error, wanted), where)) from None


def explain(text: str, where: str) -> str:
    """Return msgspec's message with its `$.path` appended to `where`, as a person would write the field."""
    match = _PATH.search(text)
    path = match["path"] if match else ""
    rule = _PATH.sub("", text).replace("`", "")
    # a file's own fields follow its name as those of a node follow the node's
    location = f"{where}{path.lstrip('.')}".removesuffix(": ") if where.endswith(": ") else f"{where}{path}"
    # a name from the file may have several lines
    return " ".join(f"{location}: {rule}".split())


def refuse_unknown(value: Any, wanted: Any, where: str) -> None:
    """Raise `ValueError` for a field or a choice that `wanted` does not have; it lists the valid ones.

    `where` names the value; keys of mappings are named as written. Values of a wrong type are skipped:
    `convert_at` reports them.
    """
    for part in _alternatives(wanted):
        if isinstance(part, type) and issubclass(part, msgspec.Struct) and isinstance(value, Mapping):
            fields = {field.encode_name: field.type for field in msgspec.structs.fields(part)}
            for name, inner in value.items():
                path = f"{where}.{name}" if where else str(name)
                if name not in fields:
                    raise ValueError(f"{path}: unknown field; known are {', '.join(fields)}")
                refuse_unknown(inner, fields[name], path)
        elif typing.get_origin(part) is dict and isinstance(value, Mapping):
            for name, inner in value.items():
                refuse_unknown(inner, typing.get_args(part)[1], f"{where}.{name}")
        elif (choices := _choices(part)) and isinstance(value, str) and value not in choices:
            raise ValueError(f"{where}: unknown {value!r}; known are {', '.join(map(str, choices))}")


def _alternatives(wanted: Any) -> tuple[Any, ...]:
    """Return the possible types of a value."""
    is_union = typing.get_origin(wanted) in (typing.Union, types.UnionType)
    return typing.get_args(wanted) if is_union else (wanted,)


def _choices(wanted: Any) -> tuple[Any, ...]:
    """Return the permitted texts of a value, if only some are."""
    if typing.get_origin(wanted) is typing.Literal:
        return typing.get_args(wanted)
    return tuple(item.value for item in wanted) if isinstance(wanted, type) and issubclass(wanted, Enum) else ()


def require_rest(name: str, value_s: float) -> None:
    """Raise `ValueError` unless a rest is 0 s to an hour: an infinite one would only fail once the node runs."""
    if not 0.0 <= value_s <= LONGEST_REST_S:
        raise ValueError(f"{name} must be 0..{LONGEST_REST_S:g} s, got {value_s!r}")


def require_clock_offset(name: str, value_s: float) -> None:
    """Raise `ValueError` unless a clock's offset is within the range of stamps."""
    if not abs(value_s) <= MAX_CLOCK_OFFSET_S:
        raise ValueError(f"{name} must be finite, within {MAX_CLOCK_OFFSET_S:g} s of zero, got {value_s!r}")
