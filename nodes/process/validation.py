"""Conversion of plain data to typed values, with the field's own path in every error."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from msgs.files.former_fields import without_former
from msgs.values.known_names import with_known_names

_LOG = logging.getLogger(__name__)

T = TypeVar("T")

LONGEST_REST_S = 3600.0
#: Clocks that count from the start of their machine differ by less: 31 years.
MAX_CLOCK_OFFSET_S = 1e9

#: Types and their former fields that were warned of: a file is converted several times on its way to a node.
_WARNED: set[tuple[Any, str]] = set()
_PATH = re.compile(r" - at `\$(?P<path>[^`]*)`$")


def convert_at(value: Any, wanted: type[T], where: str) -> T:
    """Convert `value` to `wanted`; an error reads `where.field: rule`, `where: field: rule` where `where` ends in ": ".

    Raises `ValueError` for a wrong type, an unknown field (it lists the known) or a value its type refuses. A former
    field of the type is left out, with a warning.
    """
    try:
        return msgspec.convert(value, wanted)
    except msgspec.ValidationError as error:
        kept, former = without_former(value, wanted)
        for field in former:
            if (wanted, field.place) not in _WARNED:
                _WARNED.add((wanted, field.place))
                _LOG.warning("%s%s", where if where.endswith(": ") else f"{where}.", field)
        if former:
            return convert_at(kept, wanted, where)
        raise ValueError(explain(with_known_names(error, wanted), where)) from None


def explain(text: str, where: str) -> str:
    """Return msgspec's message with its `$.path` put behind `where`, the way a person would write the field."""
    match = _PATH.search(text)
    path = match["path"] if match else ""
    rule = _PATH.sub("", text).replace("`", "")
    # a file's own fields stand behind its name as those of a node stand behind the node's
    place = f"{where}{path.lstrip('.')}".removesuffix(": ") if where.endswith(": ") else f"{where}{path}"
    # a name that the file made up may be of several lines
    return " ".join(f"{place}: {rule}".split())


def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return `new` merged over `old`, mapping by mapping."""
    result = dict(old)
    for key, value in new.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if both else value
    return result


def require_rest(name: str, value_s: float) -> None:
    """Raise `ValueError` unless a rest is 0 s to an hour: an endless one would fail only once the node runs."""
    if not 0.0 <= value_s <= LONGEST_REST_S:
        raise ValueError(f"{name} must be 0..{LONGEST_REST_S:g} s, got {value_s!r}")


def require_clock_offset(name: str, value_s: float) -> None:
    """Raise `ValueError` unless a clock's offset is one that stamps can take."""
    if not abs(value_s) <= MAX_CLOCK_OFFSET_S:
        raise ValueError(f"{name} must be finite, within {MAX_CLOCK_OFFSET_S:g} s of zero, got {value_s!r}")
