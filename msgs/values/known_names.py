"""Fields and choices of a type, listed in the error about an unknown one."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Mapping
from enum import Enum
from typing import Any

import msgspec

from msgs.values.wording import did_you_mean

#: The messages that a list of what is known belongs to, and msgspec's place of the value.
_UNKNOWN = re.compile(
    r"(?P<what>Object contains unknown field|Invalid enum value) .*?(?: - at `\$(?P<path>[^`]*)`)?$", re.DOTALL
)
#: The unknown name in such a message.
_NAME = re.compile(r"(?<=[`'])[^`']+(?=[`']$)")
#: A step of msgspec's path: a field, the number of an item, or any value of a mapping.
_STEP = re.compile(r"\.(?P<field>\w+)|\[\d*\]|\[\.\.\.\]")
#: Where msgspec's text names the place, as the end of the message.
_PLACE = " - at `$"


def with_known_names(error: msgspec.ValidationError, wanted: Any) -> str:
    """Return msgspec's message for `wanted`; for an unknown field or choice with a list of the known ones."""
    text = str(error)
    match = _UNKNOWN.search(text)
    valid = _names_at(wanted, match["path"] or "", match["what"].startswith("Object")) if match else []
    if not valid:
        return text
    rule, place, path = text.partition(_PLACE)
    name = _NAME.search(rule)
    return f"{rule}; known are {', '.join(valid)}{did_you_mean(name[0], valid) if name else ''}{place}{path}"


def refuse_unknown(value: Any, wanted: Any, where: str) -> None:
    """Raise `ValueError` for a field or choice that `wanted` lacks, listing the known; `where` names the value."""
    for kind in alternatives(wanted):
        if _is_struct(kind) and isinstance(value, Mapping):
            valid = fields_of(kind)
            for name, inner in value.items():
                path = f"{where}.{name}" if where else str(name)
                if name not in valid:
                    raise ValueError(
                        f"{path}: unknown field; known are {', '.join(valid)}{did_you_mean(str(name), valid)}"
                    )
                refuse_unknown(inner, valid[name], path)
        elif typing.get_origin(kind) is dict and isinstance(value, Mapping):
            for name, inner in value.items():
                refuse_unknown(inner, typing.get_args(kind)[1], f"{where}.{name}")
        elif (choices := _choices(kind)) and isinstance(value, str) and value not in choices:
            raise ValueError(
                f"{where}: unknown {value!r}; known are {', '.join(choices)}{did_you_mean(value, choices)}"
            )


def _names_at(wanted: Any, path: str, fields: bool) -> list[str]:
    """Return the names of the fields, or of the choices, of all types that a path of msgspec's may hold."""
    kinds = alternatives(wanted)
    for step in _STEP.finditer(path):
        kinds = [inner for kind in kinds for inner in _inside(kind, step["field"])]
    # of a Literal msgspec keeps no order
    names = [name for kind in kinds for name in (fields_of(kind) if fields else _choices(kind, in_order=False))]
    return list(dict.fromkeys(names))


def alternatives(wanted: Any) -> list[Any]:
    """Return the types that a union or an annotated type stands for."""
    origin = typing.get_origin(wanted)
    if origin is typing.Annotated:
        return alternatives(typing.get_args(wanted)[0])
    if origin in (typing.Union, types.UnionType):
        return [inner for kind in typing.get_args(wanted) for inner in alternatives(kind)]
    return [wanted]


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def fields_of(kind: Any) -> dict[str, Any]:
    """Return the fields of a struct and their types; none of another type."""
    return {field.encode_name: field.type for field in msgspec.structs.fields(kind)} if _is_struct(kind) else {}


def _choices(kind: Any, in_order: bool = True) -> list[str]:
    """Return the values of a type that has only some; those of a Literal in their order or sorted."""
    if typing.get_origin(kind) is typing.Literal:
        values = [str(value) for value in typing.get_args(kind)]
        return values if in_order else sorted(values)
    return [str(item.value) for item in kind] if isinstance(kind, type) and issubclass(kind, Enum) else []


def _inside(kind: Any, field: str | None) -> list[Any]:
    """Return the types of a field, or of the items or values where `field` is None."""
    if field is not None:
        fields = fields_of(kind)
        return alternatives(fields[field]) if field in fields else []
    arguments = [inner for inner in typing.get_args(kind) if inner is not Ellipsis]
    # of a mapping the values: its keys are no step
    inside = arguments[1:] if typing.get_origin(kind) in (dict, Mapping) else arguments
    return [alternative for inner in inside for alternative in alternatives(inner)]
