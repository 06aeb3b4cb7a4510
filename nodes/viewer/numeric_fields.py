"""Numbers in messages, by the names under which a page plots them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

#: Numbers that name a message or its sender, say when it was made or how it is laid out: nothing to plot over time.
_NOT_MEASURED = ("stamp_ns", "scan_id", "id", "pid", "grid")
#: Fields by which the items of a list are told apart.
_KEYS = ("name", "topic", "node", "id")
#: A key is a text of any sender.
MAX_KEY_LENGTH = 60
#: Beyond, sums over a plot's axis would overflow.
_MAX_MAGNITUDE = 1e100


def numeric_fields(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield (name, number) of all numbers in a message, a mapping or a list, names joined with dots.

    Items of a list go by their name, topic or number ("stages.detect.mean_ms"); one of records or texts has a "count".
    Truth values are 0 and 1; what is not finite is NaN. Texts, arrays, coordinates and what is None are left out.
    """
    match value:
        case int() | float() | np.number():
            number = float(value)
            yield name, number if abs(number) <= _MAX_MAGNITUDE else math.nan
        case msgspec.Struct():
            fields = ((field, getattr(value, field)) for field in value.__struct_fields__)
            yield from _of_items(fields, name)
        case dict():
            yield from _of_items(iter(value.items()), name)
        case tuple() | list() if all(isinstance(item, msgspec.Struct | dict | str) for item in value):
            yield _joined(name, "count"), float(len(value))
            keyed = ((_key_of(item), item) for item in value if not isinstance(item, str))
            yield from _of_items(((key, item) for key, item in keyed if key), name)


def _of_items(items: Iterator[tuple[str, Any]], name: str) -> Iterator[tuple[str, float]]:
    for key, item in items:
        if key not in _NOT_MEASURED:
            yield from numeric_fields(item, _joined(name, str(key)[:MAX_KEY_LENGTH]))


def _joined(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


def _key_of(item: Any) -> str:
    """Return the name, topic, node or number of an item; empty where it has none."""
    values = item if isinstance(item, dict) else {key: getattr(item, key, None) for key in _KEYS}
    return next((str(values[key]) for key in _KEYS if values.get(key) is not None), "")
