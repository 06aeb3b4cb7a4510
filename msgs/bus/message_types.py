"""What may be the type of a topic: a msgspec Struct whose fields can all be written and read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from msgspec import inspect

#: Types of fields that the codec has no form for, or that say nothing of their content.
_WITHOUT_FORM = (inspect.CustomType, inspect.RawType, inspect.ExtType)


def refusal_of(kind: Any) -> str:
    """Return why a type cannot be that of a topic, in one line that begins with the rule; empty if it can."""
    if not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
        return f"type must be a msgspec Struct, got {getattr(kind, '__name__', type(kind).__name__)}"
    if kind.__struct_config__.array_like:
        return f"type must name its fields on the wire, but {kind.__name__} is array_like"
    if not kind.__struct_fields__:
        return f"type must have a field to encode, but {kind.__name__} has none"
    try:
        info = inspect.type_info(kind)
    except (TypeError, NameError, msgspec.MsgspecError) as error:
        return f"type must be one that msgspec reads, but of {kind.__name__} it says: {' '.join(str(error).split())}"
    assert isinstance(info, inspect.StructType)
    for path, inner in _parts(info, "", frozenset()):
        if isinstance(inner, _WITHOUT_FORM) and getattr(inner, "cls", None) is not np.ndarray:
            name = getattr(getattr(inner, "cls", None), "__name__", type(inner).__name__.removesuffix("Type"))
            return f"type must have fields that can be encoded, but {kind.__name__}.{path} is {name}"
    return ""


def _parts(kind: Any, path: str, outer: frozenset[type]) -> Iterator[tuple[str, Any]]:
    """Yield the types inside a type, each with the path of its field; one inside itself is visited once."""
    if isinstance(kind, inspect.Metadata):
        yield from _parts(kind.type, path, outer)
        return
    yield path, kind
    if isinstance(kind, inspect.StructType | inspect.DataclassType | inspect.TypedDictType | inspect.NamedTupleType):
        if kind.cls not in outer:
            for field in kind.fields:
                where = f"{path}.{field.name}" if path else field.name
                yield from _parts(field.type, where, outer | {kind.cls})
        return
    for name in ("item_type", "key_type", "value_type"):
        if hasattr(kind, name):
            yield from _parts(getattr(kind, name), path, outer)
    for inner in (*getattr(kind, "item_types", ()), *getattr(kind, "types", ())):
        yield from _parts(inner, path, outer)
