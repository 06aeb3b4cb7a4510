"""Valid names of a type, added to msgspec's message on an unknown field or choice."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec.inspect

#: The messages that a list of valid names belongs to, and msgspec's path of the value.
_UNKNOWN = re.compile(
    r"(?P<what>Object contains unknown field|Invalid enum value) .*?(?: - at `\$(?P<path>[^`]*)`)?$", re.DOTALL
)
#: A step of msgspec's path: a field, the number of an item, or any value of a mapping.
_STEP = re.compile(r"\.(?P<field>\w+)|\[\d*\]|\[\.\.\.\]")
#: Text with which msgspec introduces the path, as the end of the message.
_PLACE = " - at `$"


def with_known_names(error: msgspec.ValidationError, wanted: Any) -> str:
    """Return msgspec's message for `wanted`; for an unknown field or choice, with a list of the valid ones."""
    text = str(error)
    match = _UNKNOWN.search(text)
    valid = _names_at(wanted, match["path"] or "", match["what"].startswith("Object")) if match else []
    if not valid:
        return text
    rule, location, path = text.partition(_PLACE)
    return f"{rule}; known are {', '.join(valid)}{location}{path}"


def _names_at(wanted: Any, path: str, fields: bool) -> list[str]:
    """Return the names of the fields, or of the choices, of all types at a path of msgspec's."""
    kinds = list(_plain(msgspec.inspect.type_info(wanted)))
    for step in _STEP.finditer(path):
        kinds = [inner for kind in kinds for inner in _inside(kind, step["field"])]
    names = [name for kind in kinds for name in (_fields(kind) if fields else _choices(kind))]
    return list(dict.fromkeys(names))


def _fields(kind: msgspec.inspect.Type) -> list[str]:
    return [field.encode_name for field in getattr(kind, "fields", ())]


def _choices(kind: msgspec.inspect.Type) -> list[str]:
    if isinstance(kind, msgspec.inspect.EnumType):
        return [str(item.value) for item in kind.cls]
    return [str(value) for value in kind.values] if isinstance(kind, msgspec.inspect.LiteralType) else []


def _inside(kind: Any, field: str | None) -> Iterator[msgspec.inspect.Type]:
    """Yield types of a field, or of the items or values where `field` is None."""
    if field is not None:
        inner = [item.type for item in getattr(kind, "fields", ()) if item.encode_name == field]
    else:
        inner = [getattr(kind, name) for name in ("item_type", "value_type") if hasattr(kind, name)]
        inner += getattr(kind, "item_types", ())
    for item in inner:
        yield from _plain(item)


def _plain(kind: msgspec.inspect.Type) -> Iterator[msgspec.inspect.Type]:
    """Yield the members of a union or an annotated type."""
    if isinstance(kind, msgspec.inspect.UnionType):
        for member in kind.types:
            yield from _plain(member)
    elif isinstance(kind, msgspec.inspect.Metadata):
        yield from _plain(kind.type)
    else:
        yield kind
