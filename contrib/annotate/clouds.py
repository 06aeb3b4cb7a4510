"""LiDAR clouds from files, in metres, checked at the door."""

from __future__ import annotations

import io
import math
import re
import warnings
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from msgs.files.array_files import load_array
from msgs.files.text_files import without_mark
from msgs.values.wording import counted

SUFFIXES = (".ply", ".pcd", ".xyz", ".npy")
#: What a directory of clouds may hold.
RECORDED_SUFFIXES = (*SUFFIXES, ".bin")
_COLUMNS = ("x", "y", "z", "intensity")
MAX_POINTS = 20_000_000
#: A file of as many points, each with a hundred bytes of numbers or words.
MAX_CLOUD_BYTES = 1 << 31
#: Longest side of a plausible cloud. The same numbers read in metres and in millimetres rarely both pass.
EXTENT_M = (2.0, 1000.0)
#: A point nearer to its sensor is no return: scanners write a pulse without an echo as zeros.
NO_RETURN_M = 0.01
#: Numbers in PLY, by both of their names, and in PCD.
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
    "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PCD_TYPES = {(kind, size): f"<{kind.lower()}{size}" for kind in "IUF" for size in "1248" if kind != "F" or size in "48"}
#: Name of what fills a point of a PCD up.
_FILLER = "_"
#: Words that lines of a PLY header begin with.
PLY_WORDS = {"ply", "format", "comment", "obj_info", "element", "property", "end_header"}
#: Digits are taken once: a line of them would be tried at each.
_NUMBER = rb"[-+]?(?:(?:\d++\.?\d*+|\.\d+)(?:e[-+]?\d+)?|nan|inf(?:inity)?)"
#: A line of text that is not three numbers and more, nor a remark; and one that is not numbers alone.
_NO_POINT = re.compile(
    rb"^(?![ \t\r]*(?:$|#|//|" + rb"[ \t]+".join([_NUMBER] * 3) + rb"(?:[ \t\r]|$)))[^\n]+",
    re.IGNORECASE | re.MULTILINE,
)
_NO_NUMBERS = re.compile(rb"^(?![ \t\r]*(?:" + _NUMBER + rb"(?:[ \t\r]+|$))*$)[^\n]+", re.IGNORECASE | re.MULTILINE)
#: Largest numbers of a PCD header.
PCD_MAX = {"SIZE": 8, "COUNT": 1024, "POINTS": MAX_POINTS}


# a signalling NaN is left out as the others are
@np.errstate(invalid="ignore")
def read_cloud(path: Path, unit: Literal["m", "mm"] = "m") -> tuple[np.ndarray, int]:
    """Points [N, 3] of a cloud in metres, and how many were left out: not finite, at the sensor (no return), strays.

    Raises ValueError that names file, rule and value: another format, unreadable, empty, more than `MAX_POINTS`,
    an extent that no street has (which is how millimetres read as metres show).
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: format must be one of {', '.join(SUFFIXES)}, got {path.suffix!r}")
    if not path.is_file():
        raise FileNotFoundError(2, "no such cloud", str(path))
    if path.stat().st_size > MAX_CLOUD_BYTES:
        raise ValueError(f"{path}: at most {MAX_CLOUD_BYTES} bytes are read, got {path.stat().st_size}")
    if path.suffix.lower() == ".npy":
        return checked_points(path, _npy_points(path), unit)
    columns = _file_columns(path, exact=True)
    if not columns.keys() >= set("xyz"):
        raise ValueError(f"{path}: points must have x, y and z, got {', '.join(columns)}")
    return checked_points(path, np.stack([columns[name] for name in "xyz"], axis=1), unit)


def checked_points(path: Path, points: np.ndarray, unit: Literal["m", "mm"] = "m") -> tuple[np.ndarray, int]:
    """Return points of a file as `read_cloud` does, with the same rules."""
    if points.ndim != 2 or points.shape[1] < 3 or len(points) == 0 or points.dtype.kind not in "fiu":
        raise ValueError(
            f"{path}: points must be numbers of shape (N, 3) with N > 0, got {points.dtype} {points.shape}"
        )
    if len(points) > MAX_POINTS:
        raise ValueError(f"{path}: points must be at most {MAX_POINTS}, got {len(points)}")
    points_m = points[:, :3].astype(np.float64) * (1e-3 if unit == "mm" else 1.0)
    # of the largest coordinate: the square of a stray one is no double
    reach_m = np.abs(points_m).max(axis=1)
    returned = np.isfinite(reach_m) & (reach_m > NO_RETURN_M)
    if not returned.any():
        raise ValueError(f"{path}: points must be finite and not at the sensor (0, 0, 0), none of {len(points)} is")
    points_m = points_m[returned]
    # a few far strays must not decide
    low, high = np.quantile(points_m, [0.02, 0.98], axis=0)
    extent_m = float((high - low).max())
    if not EXTENT_M[0] <= extent_m <= EXTENT_M[1]:
        raise ValueError(
            f"{path}: extent must be {EXTENT_M[0]:g}..{EXTENT_M[1]:g} m, got {extent_m:.4g} m with unit {unit}: "
            f"is it {'m' if unit == 'mm' else 'mm'}?"
        )
    kept_m = points_m[(np.abs(points_m - np.median(points_m, axis=0)) <= EXTENT_M[1]).all(axis=1)]
    return kept_m, len(points) - len(kept_m)


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Return all fields of a cloud as the file has them, [points] each, x, y, z first.

    NumPy arrays and `.bin` (as KITTI writes them: float32) have x, y, z and, with four columns, intensity. Raises
    ValueError that names file, rule and value for what `read_cloud` refuses of its format.
    """
    suffix = path.suffix.lower()
    if path.stat().st_size > MAX_CLOUD_BYTES:
        raise ValueError(f"{path}: at most {MAX_CLOUD_BYTES} bytes are read, got {path.stat().st_size}")
    if suffix in (".npy", ".bin"):
        table = _npy_points(path) if suffix == ".npy" else _bin_points(path)
        if table.ndim != 2 or not 3 <= table.shape[1] <= len(_COLUMNS) or table.dtype.kind != "f":
            shapes = "(N, 3) or (N, 4)"
            raise ValueError(f"{path}: points must be floats of shape {shapes}, got {table.dtype} {table.shape}")
        return {name: table[:, at] for at, name in enumerate(_COLUMNS[: table.shape[1]])}
    return _file_columns(path, exact=False)


def _file_columns(path: Path, exact: bool) -> dict[str, np.ndarray]:
    """Return the columns of a PLY, PCD or XYZ; numbers of text as doubles (`exact`) or in the type that is declared."""
    with without_mark(path) as plain:
        try:
            return _table_columns(plain, exact)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def _table_columns(path: Path, exact: bool) -> dict[str, np.ndarray]:
    """Return the columns, those of several values a point as NAME_0 and so on; of an XYZ the positions alone."""
    kind, content = path.suffix.lower(), path.read_bytes()
    if kind == ".xyz":
        _require_tractable(content.count(b"\n"))
        _require_numbers(_NO_POINT, content, 0)
        return dict(zip("xyz", _numbers(content, usecols=(0, 1, 2), comments=("#", "//")).T, strict=True))
    rows, start = _header(kind, content)
    layout, count, form = _ply_layout(rows) if kind == ".ply" else _pcd_layout(rows)
    _require_tractable(count)
    if count == 0:
        raise ValueError("must hold a point, holds none")
    if form == "ascii":
        _require_numbers(_NO_NUMBERS, content, start)
        table = _text_table(content[start:], layout, count, exact)
    else:
        table = _binary_table(content[start:], layout, count, form == "binary_compressed")
    columns: dict[str, np.ndarray] = {}
    for name in layout.names or ():
        values = table[name].reshape(count, -1)
        if name.startswith("\0"):
            continue
        width = values.shape[1]
        columns |= {name if width == 1 else f"{name}_{at}": values[:, at] for at in range(width)}
    return columns


def _numbers(text: bytes, **options: Any) -> np.ndarray:
    """Return lines of numbers, float64 [lines, numbers]; ValueError unless all have as many."""
    with warnings.catch_warnings():
        # of no line at all
        warnings.simplefilter("ignore", UserWarning)
        return np.loadtxt(io.BytesIO(text), np.float64, ndmin=2, **options)


def _text_table(text: bytes, layout: np.dtype, count: int, exact: bool) -> np.ndarray:
    """Return points written as lines of numbers, in the layout of a header; `exact`: with doubles in place of its
    types.
    """
    names = layout.names or ()
    widths = [math.prod(layout[name].shape) for name in names]
    try:
        values = _numbers(text, max_rows=count, comments=None)
    except ValueError:
        # lines of several lengths
        values = np.empty((0, 0))
    _require_promised(count, values.shape == (count, sum(widths)))
    if exact:
        layout = np.dtype([(name, "<f8", layout[name].shape) for name in names])
    table = np.empty(count, layout)
    with np.errstate(invalid="ignore", over="ignore"):
        for name, part in zip(names, np.split(values, np.cumsum(widths)[:-1], axis=1), strict=True):
            table[name] = part.reshape(table[name].shape)
    return table


def _ply_layout(rows: list[list[str]]) -> tuple[np.dtype, int, str]:
    """Return the layout of a PLY's vertices, their number, and ascii or binary; they must be its first element."""
    for row in rows:
        is_odd = row[0] == "element" and not (len(row) == 3 and row[2].isascii() and row[2].isdecimal())
        if is_odd or row[0] not in PLY_WORDS:
            raise ValueError(f"no line of a PLY header: {' '.join(row)[:80]!r}")
    form = next((row[1] for row in rows if row[0] == "format" and len(row) > 1), "")
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    elements = [row for row in rows if row[0] == "element"]
    if order is None or not elements or elements[0][1] != "vertex":
        raise ValueError("must be a PLY, ascii or binary, whose first element is vertex")
    fields = []
    for row in rows[rows.index(elements[0]) + 1 :]:
        if row[0] == "element":
            break
        if row[0] == "property" and (len(row) != 3 or row[1] not in PLY_TYPES):
            raise ValueError(f"properties of a vertex must be single numbers, got {' '.join(row)[:80]!r}")
        if row[0] == "property":
            fields.append((row[2], order + PLY_TYPES[row[1]]))
    return np.dtype(fields), int(elements[0][2]), "ascii" if form == "ascii" else "binary"


def _pcd_layout(rows: list[list[str]]) -> tuple[np.dtype, int, str]:
    """Return the layout of a PCD's points, their number, and the form of its data."""
    head = {row[0]: row[1:] for row in rows if len(row) > 1}
    for name in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA"):
        if name not in head:
            raise ValueError(f"{name} must be said before DATA, it is not")
    names, sizes, kinds = (head[name] for name in ("FIELDS", "SIZE", "TYPE"))
    counts = head.setdefault("COUNT", ["1"] * len(names))
    for name, limit in PCD_MAX.items():
        if not all(word.isascii() and word.isdecimal() and int(word) <= limit for word in head[name]):
            raise ValueError(f"{name} must be whole numbers of at most {limit}, got {' '.join(head[name])[:80]}")
    if (form := head["DATA"][0]) not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA must be ascii, binary or binary_compressed, got {form[:80]!r}")
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT must be of one length")
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for at, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if (kind, size) not in PCD_TYPES or int(count) < 1:
            raise ValueError(f"field {name[:80]!r} must be of TYPE I, U or F with its SIZE, got {kind[:8]} {size[:8]}")
        fields.append((f"\0{at}" if name == _FILLER else name, PCD_TYPES[kind, size], (int(count),)))
    return np.dtype(fields), int(head["POINTS"][0]), form


def _bin_points(path: Path) -> np.ndarray:
    content = path.read_bytes()
    if len(content) % 16:
        raise ValueError(f"{path}: points must have 16 bytes each (x, y, z, intensity), got {len(content)} bytes")
    return np.frombuffer(content, "<f4").reshape(-1, 4)


def _require_tractable(count: int) -> None:
    if count > MAX_POINTS:
        raise ValueError(f"points must be at most {MAX_POINTS}, got {count}")


def _require_promised(count: int, is_held: bool) -> None:
    if not is_held:
        raise ValueError(f"header promises {counted(count, 'point')}, the file ends before: it is cut off")


def _npy_points(path: Path) -> np.ndarray:
    try:
        return load_array(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: must be a readable numpy array: {' '.join(str(error).split())}") from None


def _binary_table(content: bytes, layout: np.dtype, count: int, is_packed: bool) -> np.ndarray:
    """Return points written as bytes: one after the other or, packed, field after field."""
    if is_packed:
        size = int.from_bytes(content[:4], "little")
        content = _unpacked(content[8 : 8 + size], count * layout.itemsize)
    _require_promised(count, len(content) >= count * layout.itemsize)
    if not is_packed:
        return np.frombuffer(content, layout, count)
    table, at = np.empty(count, layout), 0
    for name in layout.names or ():
        field = table[name]
        field[...] = np.frombuffer(content, field.dtype, field.size, at).reshape(field.shape)
        at += field.nbytes
    return table


def _unpacked(packed: bytes, needed: int) -> bytes:
    """Undo LZF: literal runs, and runs that repeat what stands so far back. As much as is needed, or as there is."""
    out, values = bytearray(), iter(packed)
    for first in values:
        if first < 32:
            out += bytes(islice(values, first + 1))
        else:
            length = 2 + (first >> 5) + (next(values, 0) if first >> 5 == 7 else 0)
            back = 1 + ((first & 31) << 8) + next(values, 0)
            if back > len(out):
                raise ValueError("packed points must repeat what stands before them, they reach back farther")
            # a run may repeat itself
            out += (out[-back:][:length] * length)[:length]
        if len(out) >= needed:
            break
    return bytes(out)


def _header(kind: str, content: bytes) -> tuple[list[list[str]], int]:
    """Return the words of a header's lines, and where the points begin; ValueError where it has no end."""
    end = b"\nend_header" if kind == ".ply" else b"\nDATA"
    start = content.find(b"\n", content.find(end) + 1) + 1
    if end not in content or not start:
        raise ValueError(f"header must end with {end.decode().strip()}, it does not")
    return [line.split() for line in content[:start].decode("latin-1").splitlines() if line.split()], start


def _require_numbers(odd: re.Pattern[bytes], content: bytes, start: int) -> None:
    """ValueError for the first line from `start` on that is `odd`."""
    if line := odd.search(content, start):
        number = content.count(b"\n", 0, line.start()) + 1
        text = line[0].decode("latin-1").strip()[:80]
        raise ValueError(f"line {number}: must be numbers with blanks between them, got {text!r}")
