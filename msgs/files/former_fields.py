"""Former fields of types that files describe: constants of the code, left out of old files with a line about each.

A type names in `formerly` the places of its former fields and the module of their constants: `MIN_POINTS` of
`min_points`, or the default of a field of that name.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec

from msgs.values.known_names import alternatives, fields_of


class FormerField(NamedTuple):
    """A former field: its place in the file, the value there, and its constant's name and value (None: it has none)."""

    place: str
    given: Any
    constant: str
    value: Any

    def __str__(self) -> str:
        today = "has left" if self.value is None else f"is a constant: {self.constant}"
        return f"{self.place} {today}; the value here is not used"


def without_former(value: Any, wanted: Any) -> tuple[Any, list[FormerField]]:
    """Return plain data without the former fields of the type `wanted`, and these fields."""
    former: list[FormerField] = []
    places: Mapping[str, str] = getattr(wanted, "formerly", {})
    return (_kept(value, wanted, "", places, former) if places else value), former


def _kept(value: Any, wanted: Any, group: str, places: Mapping[str, str], former: list[FormerField]) -> Any:
    fields = {name: kind for struct in alternatives(wanted) for name, kind in fields_of(struct).items()}
    if not isinstance(value, Mapping) or not fields:
        return value
    kept = {}
    for name, inner in value.items():
        place = f"{group}.{name}" if group else str(name)
        if name in fields:
            kept[name] = _kept(inner, fields[name], place, places, former)
        elif place in places:
            former += _lost(inner, place, places, places[place])
        elif group in places and (field := _field(place, inner, places[group])).constant != places[group]:
            former.append(field)
        else:
            kept[name] = inner
    return kept


def _lost(value: Any, place: str, places: Mapping[str, str], module_name: str) -> Iterator[FormerField]:
    """Yield all fields of a group that the type has lost, or the field itself."""
    if not (isinstance(value, Mapping) and value):
        yield _field(place, value, places.get(place, module_name))
        return
    for name, inner in value.items():
        yield from _lost(inner, f"{place}.{name}", places, places.get(place, module_name))


def _field(place: str, given: Any, module_name: str) -> FormerField:
    name = place.rpartition(".")[2]
    module = importlib.import_module(module_name)
    if hasattr(module, name.upper()):
        return FormerField(place, given, f"{module_name}.{name.upper()}", getattr(module, name.upper()))
    for kind in vars(module).values():
        default = {field.name: field.default for field in msgspec.structs.fields(kind)} if fields_of(kind) else {}
        if name in default and kind.__module__ == module_name:
            return FormerField(place, given, f"{module_name}.{kind.__name__}.{name}", default[name])
    return FormerField(place, given, module_name, None)
