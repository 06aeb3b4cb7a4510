"""What a type would have known, said beside msgspec's word on a field or a choice that it does not."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec.inspect

#: The messages that a list of what is known belongs to, and msgspec's place of the value.
_UNKNOWN = re.compile(
    r"(?P<what>Object contains unknown field|Invalid enum value) .*?(?: - at `\$(?P<path>[^`]*)`)?$", re.DOTALL
)
#: A step of msgspec's path: a field, the number of an item, or any value of a mapping.
_STEP = re.compile(r"\.(?P<field>\w+)|\[\d*\]|\[\.\.\.\]")
#: Where msgspec's text names the place, as the end of the message.
_PLACE = " - at `$"


def with_known_names(error: msgspec.ValidationError, wanted: Any) -> str:
    """msgspec's message for `wanted`; about an unknown field or choice, it lists those that stand in its place."""
    text = str(error)
    found = _UNKNOWN.search(text)
    known = _names_at(wanted, found["path"] or "", found["what"].startswith("Object")) if found else []
    if not known:
        return text
    rule, place, path = text.partition(_PLACE)
    return f"{rule}; known are {', '.join(known)}{place}{path}"


def _names_at(wanted: Any, path: str, fields: bool) -> list[str]:
    """Names of the fields, or of the choices, of all that may stand at a path of msgspec's."""
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
    """Types of a field, or of the items or values where `field` is None."""
    if field is not None:
        inner = [one.type for one in getattr(kind, "fields", ()) if one.encode_name == field]
    else:
        inner = [getattr(kind, name) for name in ("item_type", "value_type") if hasattr(kind, name)]
        inner += getattr(kind, "item_types", ())
    for one in inner:
        yield from _plain(one)


def _plain(kind: msgspec.inspect.Type) -> Iterator[msgspec.inspect.Type]:
    """The types that a union or an annotated type stands for."""
    if isinstance(kind, msgspec.inspect.UnionType):
        for one in kind.types:
            yield from _plain(one)
    elif isinstance(kind, msgspec.inspect.Metadata):
        yield from _plain(kind.type)
    else:
        yield kind
