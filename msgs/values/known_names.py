"""The fields and choices that a type has, listed where a value names another."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
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


def refuse_unknown(value: Any, wanted: Any, where: str) -> None:
    """Raise `ValueError` for a field or a choice that `wanted` does not have; it lists those that are known.

    `where` names the value; keys of mappings are named as they are written. Values of a wrong type are passed over:
    what converts them says what is wrong with them.
    """
    _refuse(value, msgspec.inspect.type_info(wanted), where)


def _refuse(value: Any, wanted: msgspec.inspect.Type, where: str) -> None:
    for kind in _plain(wanted):
        if isinstance(kind, msgspec.inspect.StructType) and isinstance(value, Mapping):
            known = {field.encode_name: field.type for field in kind.fields}
            for name, inner in value.items():
                path = f"{where}.{name}" if where else str(name)
                if name not in known:
                    raise ValueError(f"{path}: unknown field; known are {', '.join(known)}")
                _refuse(inner, known[name], path)
        elif isinstance(kind, msgspec.inspect.DictType) and isinstance(value, Mapping):
            for name, inner in value.items():
                _refuse(inner, kind.value_type, f"{where}.{name}")
        elif (choices := _choices(kind)) and isinstance(value, str) and value not in choices:
            raise ValueError(f"{where}: unknown {value!r}; known are {', '.join(choices)}")


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
