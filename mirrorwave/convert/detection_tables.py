"""Detections as text: one row each, in columns that a mapping names."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from models.sensors.detection_columns import STAMP_UNITS, DetectionMapping, missing_columns
from msgs.values.arrays import MAX_STAMP_NS
from msgs.values.detections import MAX_DETECTIONS

#: Longest line, and most columns of one.
MAX_LINE, MAX_COLUMNS = 1 << 16, 1 << 10


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

    Rows that cannot be read are counted in `left_out`. Raises `ValueError` naming file, line and rule for a mapping
    that does not fit, a line that is too long and text that is not UTF-8.
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
        cells = _cells(_lines(file, path, mapping, advance), path, mapping)
        places = _places(next(cells, []), path, mapping)
        source, factor = mapping.stamp, Decimal(STAMP_UNITS[mapping.stamp.unit or "s"])
        stamp_at = None if source.column is None else places[source.column]
        scan_at = stamp_at if mapping.scan is None else places[mapping.scan.column]
        value_places = [places[name] for name in dict.fromkeys(mapping.columns.values())]
        width = len(set(places.values()))
        for row in cells:
            if len(row) != width:
                left_out["row has another number of columns"] += 1
            elif (stamp_ns := _stamp_ns(repr(source.value) if stamp_at is None else row[stamp_at], factor)) is None:
                left_out["stamp is no time"] += 1
            else:
                scan = "" if scan_at is None else row[scan_at]
                yield _Row(stamp_ns, scan, [_number(row[place]) for place in value_places])


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


def _cells(lines: Iterator[str], path: Path, mapping: DetectionMapping) -> Iterator[list[str]]:
    """Yield the cells of each row; without a head the first row comes twice, once in place of it."""
    reader = csv.reader(lines, delimiter=mapping.table.delimiter, strict=True)
    is_first = True
    try:
        for row in reader:
            if len(row) > MAX_COLUMNS:
                raise ValueError(f"{path}: line {reader.line_num}: at most {MAX_COLUMNS} columns, got {len(row)}")
            if is_first and not mapping.table.header:
                yield row
            is_first = False
            yield row
    except csv.Error as error:
        raise ValueError(f"{path}: row at line {reader.line_num}: {error}") from None
    if is_first:
        raise ValueError(f"{path}: holds no row")


def _lines(
    file: io.BufferedReader, path: Path, mapping: DetectionMapping, advance: Callable[[], None]
) -> Iterator[str]:
    """Yield lines with anything to read, without the first `skip_lines`."""
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        advance()
        if len(line) > MAX_LINE:
            raise ValueError(f"{path}: line {number}: must be at most {MAX_LINE} bytes")
        if number <= mapping.table.skip_lines:
            continue
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8").rstrip("\r\n")
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: line {number}: must be UTF-8 text, got byte {line[error.start]:#04x}") from None
        if text.strip() and not (mapping.table.comment and text.lstrip().startswith(mapping.table.comment)):
            yield text


def _stamp_ns(text: str, factor: Decimal) -> int | None:
    """Return nanoseconds, exact for as many digits as are written; None for what is no time."""
    try:
        stamp = Decimal(text.strip()) * factor
    except (InvalidOperation, ValueError):
        return None
    return round(stamp) if stamp.is_finite() and 0 <= stamp <= MAX_STAMP_NS else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
