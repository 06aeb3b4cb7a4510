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
MOST_CLOCK_OFFSET_S = 1e9

_PATH = re.compile(r" - at `\$(?P<path>[^`]*)`$")


def convert_at(value: Any, wanted: type[T], where: str) -> T:
    """`value` as `wanted`; an error reads `where.field: rule`, or `where: field: rule` where `where` ends in ": ".

    Raises `ValueError` for a wrong type, an unknown field (it lists the known) or a value its type refuses.
    """
    try:
        return msgspec.convert(value, wanted)
    except msgspec.ValidationError as error:
        raise ValueError(explain(with_known_names(error, wanted), where)) from None


def explain(text: str, where: str) -> str:
    """Return msgspec's message with its `$.path` put behind `where`, the way a person would write the field."""
    found = _PATH.search(text)
    path = found["path"] if found else ""
    rule = _PATH.sub("", text).replace("`", "")
    # a file's own fields stand behind its name as those of a node stand behind the node's
    place = f"{where}{path.lstrip('.')}".removesuffix(": ") if where.endswith(": ") else f"{where}{path}"
    # a name that the file made up may be of several lines
    return " ".join(f"{place}: {rule}".split())


def refuse_unknown(value: Any, wanted: Any, where: str) -> None:
    """Raise `ValueError` for a field or a choice that `wanted` does not have; it lists those that are known.

    `where` names the value; keys of mappings are named as they are written. Values of a wrong type are passed over:
    `convert_at` says what is wrong with them.
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
    """Return the types that a value may have."""
    is_union = typing.get_origin(wanted) in (typing.Union, types.UnionType)
    return typing.get_args(wanted) if is_union else (wanted,)


def _choices(wanted: Any) -> tuple[Any, ...]:
    """Return the texts that a value may be, where only some may."""
    if typing.get_origin(wanted) is typing.Literal:
        return typing.get_args(wanted)
    return tuple(item.value for item in wanted) if isinstance(wanted, type) and issubclass(wanted, Enum) else ()


def require_rest(name: str, value_s: float) -> None:
    """Raise `ValueError` unless a rest is 0 s to an hour: what has no end fails only once the node runs."""
    if not 0.0 <= value_s <= LONGEST_REST_S:
        raise ValueError(f"{name} must be 0..{LONGEST_REST_S:g} s, got {value_s!r}")


def require_clock_offset(name: str, value_s: float) -> None:
    """Raise `ValueError` unless a clock's offset is one that stamps can take."""
    if not abs(value_s) <= MOST_CLOCK_OFFSET_S:
        raise ValueError(f"{name} must be finite, within {MOST_CLOCK_OFFSET_S:g} s of zero, got {value_s!r}")
