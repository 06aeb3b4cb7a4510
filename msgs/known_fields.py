"""What a type would have known, said beside msgspec's word on a field that it does not."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec.inspect

_UNKNOWN = re.compile(r"Object contains unknown field `.*?`(?: - at `\$(?P<path>[^`]*)`)?$", re.DOTALL)
#: A step of msgspec's path: a field, the number of an item, or any value of a mapping.
_STEP = re.compile(r"\.(?P<field>\w+)|\[\d*\]|\[\.\.\.\]")
#: Where msgspec's text names the place, as the end of the message.
_PLACE = " - at `$"


def with_known_fields(error: msgspec.ValidationError, wanted: Any) -> str:
    """msgspec's message for `wanted`; one about an unknown field lists those that stand in its place."""
    text = str(error)
    found = _UNKNOWN.search(text)
    known = _fields_at(wanted, found["path"] or "") if found else []
    if not known:
        return text
    rule, place, path = text.partition(_PLACE)
    return f"{rule}; known are {', '.join(known)}{place}{path}"


def _fields_at(wanted: Any, path: str) -> list[str]:
    """Names of the fields of all objects that may stand at a path of msgspec's."""
    kinds = list(_plain(msgspec.inspect.type_info(wanted)))
    for step in _STEP.finditer(path):
        kinds = [inner for kind in kinds for inner in _inside(kind, step["field"])]
    fields = [field.encode_name for kind in kinds for field in getattr(kind, "fields", ())]
    return list(dict.fromkeys(fields))


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
