"""LiDAR clouds from files, in metres, checked at the door."""

from __future__ import annotations

import contextlib
import io
import math
import re
from pathlib import Path
from typing import Literal

import numpy as np

from contrib.annotate.registration import import_open3d
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
PLY_BYTES = {name: np.dtype(kind).itemsize for name, kind in PLY_TYPES.items()}
PCD_TYPES = {(kind, size): f"<{kind.lower()}{size}" for kind in "IUF" for size in "1248" if kind != "F" or size in "48"}
#: Name of what fills a point of a PCD up.
_FILLER = "_"
#: Words that lines of a PLY header begin with.
PLY_WORDS = {"ply", "format", "comment", "obj_info", "element", "property", "end_header"}
#: open3d cuts lines of a PCD here.
LONGEST_LINE = 1000
#: Digits are taken once: a line of them would be tried at each.
_NUMBER = rb"[-+]?(?:(?:\d++\.?\d*+|\.\d+)(?:e[-+]?\d+)?|nan|inf(?:inity)?)"
#: A line of text that is not three numbers and more, nor a remark; and one that is not numbers alone.
_NO_POINT = re.compile(
    rb"^(?![ \t\r]*(?:$|#|//|" + rb"[ \t]+".join([_NUMBER] * 3) + rb"(?:[ \t\r]|$)))[^\n]+",
    re.IGNORECASE | re.MULTILINE,
)
_NO_NUMBERS = re.compile(rb"^(?![ \t\r]*(?:" + _NUMBER + rb"(?:[ \t\r]+|$))*$)[^\n]+", re.IGNORECASE | re.MULTILINE)
_WORD = re.compile(rb"[^ \t\r]+")
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
#: Largest numbers of a PCD header, and how much LZF can pack at most.
PCD_MAX = {"SIZE": 8, "COUNT": 1024, "WIDTH": MAX_POINTS, "HEIGHT": MAX_POINTS, "POINTS": MAX_POINTS}
MAX_LZF_RATIO = 100


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
    with without_mark(path) as plain:
        points = _npy_points(path) if path.suffix.lower() == ".npy" else _open3d_points(plain)
    return checked_points(path, points, unit)


def checked_points(path: Path, points: np.ndarray, unit: Literal["m", "mm"] = "m") -> tuple[np.ndarray, int]:
    """Return points of a file as `read_cloud` does, with the same rules."""
    if points.ndim != 2 or points.shape[1] < 3 or len(points) == 0 or points.dtype.kind not in "fiu":
        raise ValueError(
            f"{path}: points must be numbers of shape (N, 3) with N > 0, got {points.dtype} {points.shape}"
        )
    _require_tractable(path, len(points))
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
    with without_mark(path) as plain:
        try:
            return _table_columns(plain)
        except ValueError as error:
            said = " ".join(str(error).replace(str(plain), str(path)).split())
            raise ValueError(said if str(path) in said else f"{path}: cannot be read: {said}") from None


def _table_columns(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a PLY or PCD, those of several values a point as NAME_0 and so on.

    Of text without names (.xyz) and of compressed PCD only the positions are known.
    """
    _refuse_promises(path)
    if path.suffix.lower() == ".xyz":
        return dict(zip("xyz", _open3d_points(path).T, strict=True))
    content = path.read_bytes()
    rows, start = _header(path, content)
    layout, count, form = _ply_layout(rows) if path.suffix.lower() == ".ply" else _pcd_layout(rows)
    if count == 0:
        raise ValueError(f"{path}: must hold a point, holds none")
    if form == "binary_compressed":
        return dict(zip("xyz", _open3d_points(path).T, strict=True))
    if form == "ascii":
        table = _text_table(content[start:], layout, count)
    else:
        table = np.frombuffer(content, layout, count, start)
    columns: dict[str, np.ndarray] = {}
    for name in layout.names or ():
        values = table[name].reshape(count, -1)
        if name.startswith("\0"):
            continue
        width = values.shape[1]
        columns |= {name if width == 1 else f"{name}_{at}": values[:, at] for at in range(width)}
    return columns


def _text_table(text: bytes, layout: np.dtype, count: int) -> np.ndarray:
    """Return points written as lines of numbers, in the layout of a header."""
    names = layout.names or ()
    widths = [math.prod(layout[name].shape) for name in names]
    values = np.loadtxt(io.BytesIO(text), np.float64, max_rows=count, ndmin=2)
    if values.shape != (count, sum(widths)):
        raise ValueError(f"points must be {count} lines of {sum(widths)} numbers, got {values.shape}")
    table = np.empty(count, layout)
    with np.errstate(invalid="ignore", over="ignore"):
        for name, part in zip(names, np.split(values, np.cumsum(widths)[:-1], axis=1), strict=True):
            table[name] = part.reshape(table[name].shape)
    return table


def _ply_layout(rows: list[list[str]]) -> tuple[np.dtype, int, str]:
    """Return the layout of a PLY's vertices, their number, and ascii or binary; they must be its first element."""
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
    names, sizes, kinds = (head.get(name, []) for name in ("FIELDS", "SIZE", "TYPE"))
    counts = head.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT must be of one length")
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for at, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if (kind, size) not in PCD_TYPES or int(count) < 1:
            raise ValueError(f"field {name[:80]!r} must be of TYPE I, U or F with its SIZE, got {kind[:8]} {size[:8]}")
        fields.append((f"\0{at}" if name == _FILLER else name, PCD_TYPES[kind, size], (int(count),)))
    return np.dtype(fields), int(head["POINTS"][0]), head["DATA"][0]


def _bin_points(path: Path) -> np.ndarray:
    content = path.read_bytes()
    if len(content) % 16:
        raise ValueError(f"{path}: points must have 16 bytes each (x, y, z, intensity), got {len(content)} bytes")
    return np.frombuffer(content, "<f4").reshape(-1, 4)


def _require_tractable(path: Path, count: int) -> None:
    if count > MAX_POINTS:
        raise ValueError(f"{path}: points must be at most {MAX_POINTS}, got {count}")


def _npy_points(path: Path) -> np.ndarray:
    try:
        return load_array(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: must be a readable numpy array: {' '.join(str(error).split())}") from None


def _open3d_points(path: Path) -> np.ndarray:
    """Points as open3d reads them; ValueError where it does not understand the file.

    It makes room for all that a header promises, and what it did not read has the numbers that stood in memory:
    promises that are not kept are refused before. What it fails to read it only prints.
    """
    _refuse_promises(path)
    o3d = import_open3d()
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Warning):
        try:
            cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
        except (MemoryError, RuntimeError) as error:
            raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None
    if said := " ".join(_COLOUR.sub("", printed.getvalue()).split()):
        raise ValueError(f"{path}: cannot be read: {said}")
    return np.asarray(cloud.points)


def _refuse_promises(path: Path) -> None:
    """ValueError for too many points, and for a PLY or PCD that holds fewer bytes or lines than its header promises."""
    kind, content = path.suffix.lower(), path.read_bytes()
    if kind == ".xyz":
        _require_tractable(path, content.count(b"\n"))
        _require_numbers(path, _NO_POINT, content, 0)
        return
    rows, start = _header(path, content)
    if kind == ".ply":
        for row in rows:
            is_odd = row[0] == "element" and not (len(row) == 3 and row[2].isascii() and row[2].isdecimal())
            if is_odd or row[0] not in PLY_WORDS:
                raise ValueError(f"{path}: no line of a PLY header: {' '.join(row)[:80]!r}")
    count, row_bytes, words = _ply_promise(rows) if kind == ".ply" else _pcd_promise(rows)
    _require_tractable(path, count)
    if kind == ".pcd":
        _refuse_large_pcd(path, rows, content[start : start + 8], len(content) - start)
    held = len(content) - start if row_bytes else _lines_of(words, content[start:])
    if held < count * max(row_bytes, 1):
        raise ValueError(f"{path}: header promises {counted(count, 'point')}, the file ends before: it is cut off")
    if kind == ".pcd" and not row_bytes:
        _require_numbers(path, _NO_NUMBERS, content, start)


def _header(path: Path, content: bytes) -> tuple[list[list[str]], int]:
    """Return the words of a header's lines, and where the points begin; ValueError where it has no end."""
    end = b"\nend_header" if path.suffix.lower() == ".ply" else b"\nDATA"
    start = content.find(b"\n", content.find(end) + 1) + 1
    if end not in content or not start:
        raise ValueError(f"{path}: header must end with {end.decode().strip()}, it does not")
    return [line.split() for line in content[:start].decode("latin-1").splitlines() if line.split()], start


def _require_numbers(path: Path, odd: re.Pattern[bytes], content: bytes, start: int) -> None:
    """ValueError for the first line from `start` on that is `odd`: open3d leaves it out, or takes 1,5 for 1."""
    if line := odd.search(content, start):
        number = content.count(b"\n", 0, line.start()) + 1
        text = line[0].decode("latin-1").strip()[:80]
        raise ValueError(f"{path}: line {number}: must be numbers with blanks between them, got {text!r}")


def _lines_of(words: int, text: bytes) -> int:
    """Lines of at least so many words, as open3d finds them; it skips all others."""
    lines = (line for line in text.split(b"\n") if len(line) <= LONGEST_LINE and b"\0" not in line)
    return sum(len(_WORD.findall(line)) >= words for line in lines)


def _refuse_large_pcd(path: Path, rows: list[list[str]], head: bytes, held: int) -> None:
    """ValueError where a PCD asks for memory that its points cannot need: open3d gives it unasked."""
    fields = {row[0]: row[1:] for row in rows if len(row) > 1}
    numbers = {name: [int(word) if word.isdecimal() else -1 for word in fields.get(name, [])] for name in PCD_MAX}
    for name in ("SIZE", "WIDTH", "HEIGHT", "POINTS"):
        # open3d takes by chance what a header does not say
        if not numbers[name]:
            raise ValueError(f"{path}: {name} must be said before DATA, it is not")
    for name, limit in PCD_MAX.items():
        if not all(0 <= value <= limit for value in numbers[name]):
            raise ValueError(f"{path}: {name} must be whole numbers of at most {limit}, got {' '.join(fields[name])}")
    if fields.get("DATA", [""])[0] == "binary_compressed":
        packed, unpacked = (int.from_bytes(head[at : at + 4], "little") for at in (0, 4))
        needed = int(numbers["POINTS"][0]) * sum(_pcd_sizes(fields))
        if packed > held - 8 or not needed <= unpacked <= min(MAX_LZF_RATIO * packed, MAX_CLOUD_BYTES):
            raise ValueError(f"{path}: {packed} bytes that unpack to {unpacked} are promised, the file holds {held}")


def _ply_promise(rows: list[list[str]]) -> tuple[int, int, int]:
    """Points of a PLY header, and the bytes of each (0: a line of text) or its words."""
    count = row_bytes = words = 0
    element = ""
    is_text = any(row[:2] == ["format", "ascii"] for row in rows)
    for row in rows:
        if row[0] == "element":
            element = row[1]
            count = int(row[2]) if element == "vertex" else count
        elif row[0] == "property" and element == "vertex" and len(row) == 3:
            row_bytes += PLY_BYTES.get(row[1], 0)
            words += 1
    return count, 0 if is_text else row_bytes, words


def _pcd_promise(rows: list[list[str]]) -> tuple[int, int, int]:
    """Points of a PCD header, and the bytes of each (0: a line of text) or its words; compressed ones: none."""
    fields = {row[0]: row[1:] for row in rows if len(row) > 1}
    kind = fields.get("DATA", [""])[0]
    count = int(fields["POINTS"][0]) if fields.get("POINTS", [""])[0].isdecimal() else 0
    if kind == "binary_compressed":
        return 0, 0, 0
    words = sum(
        int(number) for number in fields.get("COUNT", ["1"] * len(fields.get("SIZE", []))) if number.isdecimal()
    )
    return count, sum(_pcd_sizes(fields)) if kind == "binary" else 0, words


def _pcd_sizes(fields: dict[str, list[str]]) -> list[int]:
    """Bytes of each field of a PCD point."""
    sizes = [int(size) for size in fields.get("SIZE", []) if size.isdecimal()]
    counts = [int(count) for count in fields.get("COUNT", ["1"] * len(sizes)) if count.isdecimal()]
    return [size * count for size, count in zip(sizes, counts, strict=False)]
