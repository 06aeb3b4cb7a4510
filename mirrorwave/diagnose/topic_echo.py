"""Output of `topic echo`: the part of a message asked for, tests on a field, tables, arrays as files."""

from __future__ import annotations

import csv
import io
import json
import operator
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from msgs.values.wording import counted

_OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_CONDITION = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(==|!=|<=|>=|<|>)\s*(.+?)\s*")
#: Longer lists are cut on the terminal; --json keeps them whole.
_SHOWN_ITEMS = 8


class Condition(NamedTuple):
    """A test on one field of a message."""

    field: str
    operator: str
    value: Any

    def holds(self, body: dict[str, Any]) -> bool:
        """Return whether a message passes; one whose field is null, or of another kind than the value, does not."""
        value = field_of(body, self.field)
        try:
            return value is not None and bool(_OPERATORS[self.operator](value, self.value))
        except TypeError:
            return False


def parse_condition(text: str) -> Condition:
    """`speed_mps>5`, `valid==false`, `class==car`: field, operator, and a value as JSON or as a bare word."""
    match = _CONDITION.fullmatch(text)
    if match is None:
        raise ValueError(f"--where {text}: expected FIELD OPERATOR VALUE, operators are {' '.join(_OPERATORS)}")
    field, sign, value = match.groups()
    try:
        return Condition(field, sign, json.loads(value))
    except (ValueError, RecursionError):
        return Condition(field, sign, value)


def field_of(value: Any, path: str) -> Any:
    """The part of a message that a dotted path names; numbers count items, from 0.

    None where a list is shorter or a part is absent. Raises `ValueError` naming the fields where a name is unknown.
    """
    for at, name in enumerate(path.split(".")):
        if value is None:
            return None
        if isinstance(value, list | tuple):
            if not name.isdecimal():
                raise ValueError(f"{path}: {name!r} must be the number of an item, from 0")
            value = value[int(name)] if int(name) < len(value) else None
        elif isinstance(value, dict):
            if name not in value:
                where = ".".join(path.split(".")[:at]) or "the message"
                raise ValueError(f"{path}: {where} has no field {name!r}; its fields are {', '.join(value)}")
            value = value[name]
        else:
            raise ValueError(f"{path}: {'.'.join(path.split('.')[:at])} is a plain value, it has no field {name!r}")
    return value


class CsvLines:
    """Messages as lines of a table, the header before the first; its columns are those of the first message."""

    def __init__(self) -> None:
        self._columns: list[str] | None = None

    def lines(self, head: dict[str, Any], body: Any) -> Iterator[str]:
        """The lines that a message adds."""
        row = {**head, **dict(_leaves(body, ""))}
        if self._columns is None:
            self._columns = list(row)
            yield _csv_line(self._columns)
        yield _csv_line([row.get(name, "") for name in self._columns])


def text_lines(value: Any, indent: str = "") -> Iterator[str]:
    """A message, or a part of it, for people."""
    if not isinstance(value, dict) or "dtype" in value:
        yield f"{indent}{_short(value)}"
        return
    for name, item in value.items():
        if isinstance(item, dict) and "dtype" not in item:
            yield f"{indent}{name}:"
            yield from text_lines(item, indent + "  ")
        elif isinstance(item, list | tuple) and item and isinstance(item[0], dict):
            yield f"{indent}{name}: {counted(len(item), 'item')}"
            for entry in item[:_SHOWN_ITEMS]:
                yield from text_lines(entry, indent + "  - ")
        else:
            yield f"{indent}{name}: {_short(item)}"


def save_arrays(message: msgspec.Struct, folder: Path, stem: str) -> list[Path]:
    """Write each array of a message as `STEM-FIELD.npy` into `folder`; raises `FileExistsError` rather than replace."""
    written = []
    fields = {name: getattr(message, name) for name in message.__struct_fields__}
    for name, value in (fields["body"] if isinstance(fields.get("body"), dict) else fields).items():
        if isinstance(value, np.ndarray):
            # publisher and field are named by the message: they must not lead out of the folder
            path = folder / re.sub(r"[^A-Za-z0-9_.-]", "_", f"{stem}-{name}.npy")
            with path.open("xb") as file:
                np.save(file, value, allow_pickle=False)
            written.append(path)
    return written


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and "dtype" not in value:
        for name, item in value.items():
            yield from _leaves(item, f"{path}.{name}" if path else name)
    else:
        yield path or "value", json.dumps(value) if isinstance(value, dict | list | tuple) else value


def _csv_line(cells: list[Any]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow(["" if cell is None else cell for cell in cells])
    return out.getvalue()


def _short(item: Any) -> str:
    if isinstance(item, dict):
        return ", ".join(f"{name} {value}" for name, value in item.items())
    if isinstance(item, list | tuple) and len(item) > _SHOWN_ITEMS:
        return f"[{', '.join(map(str, item[:_SHOWN_ITEMS]))}, ... {len(item)} in all]"
    return str(item)
