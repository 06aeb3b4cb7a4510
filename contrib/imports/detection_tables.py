"""Detections as text: one row each, in columns that a mapping names."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np

from contrib.imports.detection_columns import STAMP_UNITS, DetectionMapping, missing_columns
from msgs.files.text_files import AS_CP1252, text_encoding
from msgs.values.arrays import MAX_STAMP_NS
from msgs.values.detections import MAX_DETECTIONS

#: Longest line, and most columns of one.
MAX_LINE, MAX_COLUMNS = 1 << 16, 1 << 10
#: Cells of what was not measured, as tools write them; anything else that is no number is refused.
_NOTHING = frozenset(("", "nan", "-nan", "na", "n/a", "#n/a", "<na>", "null", "none", "-"))
#: Digits are taken once: a line of them would be tried at each.
_NUMBER = re.compile(r"[-+]?(?:(?:[0-9]++\.?[0-9]*+|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|inf(?:inity)?)", re.IGNORECASE)


class ScanRows(NamedTuple):
    """Rows of one scan: float64 [rows] by column, and the time of the first."""

    stamp_ns: int
    columns: dict[str | int, np.ndarray]


class _Row(NamedTuple):
    stamp_ns: int
    scan: str
    values: list[float]


def count_lines(path: Path) -> int:
    """Return the number of lines, for a progress bar."""
    with path.open("rb") as file:
        return sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))


def table_scans(
    path: Path, mapping: DetectionMapping, left_out: Counter[str], advance: Callable[[], None]
) -> Iterator[ScanRows]:
    """Yield the scans of a table in its order, rows that say when they are alone; `advance` is called for each line.

    Rows of another number of columns or without a time are counted in `left_out`. Raises `ValueError` naming file, line
    and rule for a mapping that does not fit, a line that is too long, and a cell that is neither a number nor empty.
    """
    if mapping.stamp is None:
        raise ValueError("stamp must be given: the column with a row's time")
    rows: list[_Row] = []
    for row in _rows(path, mapping, left_out, advance):
        if rows and row.scan != rows[0].scan:
            yield _scan(rows, mapping)
            rows = []
        if len(rows) < MAX_DETECTIONS:
            rows.append(row)
        else:
            left_out[f"more than {MAX_DETECTIONS} in a scan"] += 1
    if rows:
        yield _scan(rows, mapping)


def _scan(rows: list[_Row], mapping: DetectionMapping) -> ScanRows:
    table = np.array([row.values for row in rows], np.float64).reshape(len(rows), -1)
    names = dict.fromkeys(mapping.columns.values())
    return ScanRows(rows[0].stamp_ns, {name: table[:, at] for at, name in enumerate(names)})


def _rows(path: Path, mapping: DetectionMapping, left_out: Counter[str], advance: Callable[[], None]) -> Iterator[_Row]:
    assert mapping.stamp is not None
    with path.open("rb") as file:
        lines = _Lines(file, path, mapping, advance)
        cells = _cells(lines, mapping)
        places = _places(next(cells, []), path, mapping)
        source, factor = mapping.stamp, Decimal(STAMP_UNITS[mapping.stamp.unit or "s"])
        stamp_at = None if source.column is None else places[source.column]
        scan_at = stamp_at if mapping.scan is None else places[mapping.scan.column]
        value_places = {name: places[name] for name in mapping.columns.values()}
        width, decimal = len(set(places.values())), mapping.table.decimal
        for row in cells:
            stamp = repr(source.value) if stamp_at is None else row[stamp_at] if stamp_at < len(row) else ""
            if len(row) != width:
                left_out["row has another number of columns"] += 1
            elif (stamp_ns := _stamp_ns(_plain(stamp, decimal), factor)) is None:
                left_out["stamp is no time"] += 1
            else:
                scan = "" if scan_at is None else row[scan_at]
                try:
                    values = [_number(row[place], name, decimal) for name, place in value_places.items()]
                except ValueError as error:
                    raise ValueError(f"{lines}: {error}") from None
                yield _Row(stamp_ns, scan, values)


def _places(head: list[str], path: Path, mapping: DetectionMapping) -> dict[str | int | None, int]:
    """Return the place of each column by its name and by its number; the head is a row like any other without names."""
    places: dict[str | int | None, int] = {at: at for at in range(len(head))}
    names = [name.strip() for name in head] if mapping.table.header else []
    if len(set(names)) != len(names):
        raise ValueError(f"{path}: columns must have different names, got {', '.join(names)}")
    places |= {name: at for at, name in enumerate(names)}
    if rule := missing_columns(mapping, [*names] if names else [*range(len(head))]):
        by_number = missing_columns(mapping, [name for name in places if name is not None])
        if by_number or not names:
            raise ValueError(f"{path}: {rule}")
    return places


def _cells(lines: _Lines, mapping: DetectionMapping) -> Iterator[list[str]]:
    """Yield the cells of each row; without a head the first row comes twice, once in place of it."""
    reader = csv.reader(lines, delimiter=mapping.table.delimiter, strict=True)
    is_first = True
    try:
        for row in reader:
            if len(row) > MAX_COLUMNS:
                raise ValueError(f"{lines}: at most {MAX_COLUMNS} columns, got {len(row)}")
            if is_first and not mapping.table.header:
                yield row
            is_first = False
            yield row
    except csv.Error as error:
        raise ValueError(f"{lines}: row that ends here: {error}") from None
    if is_first:
        raise ValueError(f"{lines.path}: holds no row")


class _Lines:
    """Lines of a table with anything to read, without the first `skip_lines`; as text, the line that was read last."""

    def __init__(
        self, file: io.BufferedReader, path: Path, mapping: DetectionMapping, advance: Callable[[], None]
    ) -> None:
        self.path, self._table, self._advance = path, mapping.table, advance
        self._text = io.TextIOWrapper(file, text_encoding(file.peek(4)[:4]), AS_CP1252)
        self._number = 0

    def __str__(self) -> str:
        return f"{self.path}: line {self._number}"

    def __iter__(self) -> Iterator[str]:
        while line := self._text.readline(MAX_LINE + 1):
            self._number += 1
            self._advance()
            if len(line) > MAX_LINE:
                raise ValueError(f"{self}: must be at most {MAX_LINE} characters")
            comment = self._table.comment
            is_empty = not line.strip() or (comment and line.lstrip().startswith(comment))
            if self._number > self._table.skip_lines and not is_empty:
                yield line.rstrip("\r\n")


def _stamp_ns(text: str, factor: Decimal) -> int | None:
    """Return nanoseconds, exact for as many digits as are written; None for what is no time."""
    if not _NUMBER.fullmatch(text):
        return None
    stamp = Decimal(text) * factor
    return round(stamp) if stamp.is_finite() and 0 <= stamp <= MAX_STAMP_NS else None


def _plain(text: str, decimal: str) -> str:
    """Return a cell with a point before its decimals; one before thousands, or of another rule, reads as no number."""
    return text.strip() if decimal == "." else text.strip().replace(".", "?").replace(decimal, ".")


def _number(text: str, column: str | int, decimal: str) -> float:
    """Return the number of a cell, NaN where it says that there is none; `ValueError` for one that is neither."""
    plain = _plain(text, decimal)
    if plain.lower() in _NOTHING:
        return math.nan
    if not _NUMBER.fullmatch(plain):
        hint = '; for decimal commas say table: {decimal: ","}' if decimal == "." and "," in plain else ""
        raise ValueError(f"column {column!r} must be a number or empty, got {text[:40]!r}{hint}")
    return float(plain)
