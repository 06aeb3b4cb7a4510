"""Recordings as a folder of NumPy archives, one a topic, with an index in JSON.

A row is a message. Numbers and texts of a message are columns of the archive; arrays are members of their own, named
by field and row; lists of structures are tables, whose column `row` names the message. What is left (structures, lists
of numbers or texts) stands in the index.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
import numpy as np

from msgs.bus.topics import TOPICS
from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.wording import as_utf8
from nodes.recording.shapes import Account, counted

INDEX_NAME = "index.json"
INDEX_VERSION = 1


def topics() -> tuple[str, ...]:
    """Return the topics that have a place in this format."""
    return tuple(TOPICS)


def write(
    reader: RecordingReader, out: Path, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> None:
    """Write `out`/TOPIC.npz for each topic, "/" as "_", and `out`/index.json; holds one message at a time."""
    out.mkdir()
    archives = {topic: _Archive(out / f"{topic.replace('/', '_')}.npz", TOPICS[topic].type) for topic in topics}
    try:
        for recorded in counted(reader, topics, account, advance):
            archives[recorded.topic].add(recorded)
        entries = {topic: archive.finish() for topic, archive in archives.items()}
        for archive in archives.values():
            archive.close()
    except BaseException:
        for archive in archives.values():
            archive.abandon()
        raise
    index = {
        "version": INDEX_VERSION,
        "source": as_utf8(reader.path.name),
        "metadata": reader.metadata,
        "topics": entries,
    }
    (out / INDEX_NAME).write_bytes(msgspec.json.format(msgspec.json.encode(index, enc_hook=_inside), indent=1) + b"\n")


def _inside(array: np.ndarray) -> dict[str, Any]:
    """Return an array inside a structure, which has no member of its own."""
    return {"dtype": array.dtype.str, "shape": array.shape, "data": array.tobytes()}


class _Archive:
    """One topic's archive and its part of the index."""

    def __init__(self, path: Path, message_type: Any) -> None:
        self._path = path
        self._zip = zipfile.ZipFile(path, "x", zipfile.ZIP_STORED)
        fields = msgspec.structs.fields(message_type)
        self._fields = [field.name for field in fields]
        self._tables = {name: _Table(kind) for name, kind in _table_types(message_type).items()}
        single = [field.name for field in fields if _is_single(field.type)]
        self._columns: dict[str, list[Any]] = {name: [] for name in ("log_time_ns", "sequence", *single)}
        self._rows: list[dict[str, Any]] = []

    def add(self, recorded: Recorded) -> None:
        """Take in a message: its arrays at once, the rest when the archive is finished."""
        row, arrays, rest = len(self._rows), [], {}
        self._columns["log_time_ns"].append(recorded.log_time_ns)
        self._columns["sequence"].append(recorded.sequence)
        for name in self._fields:
            value = getattr(recorded.message, name)
            if isinstance(value, np.ndarray):
                arrays.append(f"{name}/{row:06d}")
                self._write(arrays[-1], value)
            elif name in self._tables:
                self._tables[name].add(row, value)
            elif name in self._columns:
                self._columns[name].append(_plain(value))
            else:
                rest[name] = value
        columns: dict[str, Any] = {
            key: self._columns[key][row] for key in ("scan_id", "beam_index", "stamp_ns") if key in self._columns
        }
        self._rows.append({"row": row, **columns, "publisher": recorded.publisher, "arrays": arrays, "fields": rest})

    def finish(self) -> dict[str, Any]:
        """Write columns and tables; returns the topic's part of the index."""
        for name, values in self._columns.items():
            self._write(name, np.array(values))
        for table, content in self._tables.items():
            for name, column in content.columns().items():
                self._write(f"{table}.{name}", column)
        return {
            "file": self._path.name,
            "messages": len(self._rows),
            "columns": list(self._columns),
            "tables": {name: list(table.columns()) for name, table in self._tables.items()},
            "rows": self._rows,
        }

    def close(self) -> None:
        """Close the file."""
        self._zip.close()

    def abandon(self) -> None:
        """Let go of a file that cannot be finished; the library would try again, and say so, when it is collected."""
        file, self._zip.fp = self._zip.fp, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()

    def _write(self, name: str, array: np.ndarray) -> None:
        # a fixed date: the same recording gives the same bytes
        with self._zip.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
            np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


class _Table:
    """The structures that stand in one field of all messages, column by column."""

    def __init__(self, kind: Any) -> None:
        fields = msgspec.structs.fields(kind)
        self._shapes = {field.name: _shape(field.type) for field in fields}
        self._values: dict[str, list[Any]] = {field.name: [] for field in fields}
        self._row: list[int] = []

    def add(self, row: int, items: tuple[Any, ...]) -> None:
        """Take in the structures of one message."""
        for item in items:
            self._row.append(row)
            for name, values in self._values.items():
                values.append(getattr(item, name))

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of numbers, texts or number tuples; what has no fixed shape becomes its JSON text."""
        columns = {"row": np.array(self._row, np.int64)}
        return columns | {name: _column(values, self._shapes[name]) for name, values in self._values.items()}


def _column(values: list[Any], shape: tuple[int, ...] | None) -> np.ndarray:
    """[rows, *shape] of values; NaN for what is not known."""
    if shape is None:
        return np.array([msgspec.json.encode(value).decode() for value in values], np.str_)
    if not shape:
        return np.array([_plain(value) for value in values])
    unknown = np.full(shape, np.nan)
    return np.array([unknown if value is None else value for value in values], np.float64).reshape(-1, *shape)


def _shape(kind: Any) -> tuple[int, ...] | None:
    """Shape of a type: () of a number or text, lengths of nested tuples of fixed length, None of anything else."""
    kind = _without_rule(kind)
    options = [option for option in get_args(kind) if option is not type(None)]
    if get_origin(kind) in (Union, UnionType) and len(options) == 1:
        return _shape(options[0])
    if _is_single(kind):
        return ()
    if get_origin(kind) is not tuple or Ellipsis in options:
        return None
    inner = _shape(options[0])
    return None if inner is None else (len(options), *inner)


def _plain(value: Any) -> Any:
    """A value that NumPy takes: NaN for what is not known, the value of an enumeration."""
    if isinstance(value, Enum):
        return value.value
    return float("nan") if value is None else value


def _is_single(kind: Any) -> bool:
    """Return whether a field always holds one number or text."""
    kind = _without_rule(kind)
    return isinstance(kind, type) and issubclass(kind, bool | int | float | str)


def _without_rule(kind: Any) -> Any:
    """Return a type without the limits that an annotation sets it."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _table_types(message_type: Any) -> dict[str, Any]:
    """Fields that are tuples of structures, and the type of these."""
    types = {}
    for field in msgspec.structs.fields(message_type):
        inner = get_args(field.type)[:1] if get_origin(field.type) is tuple else ()
        if inner and isinstance(inner[0], type) and issubclass(inner[0], msgspec.Struct):
            types[field.name] = inner[0]
    return types
