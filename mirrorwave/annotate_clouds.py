"""LiDAR clouds from files, in metres, checked at the door."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from models.perception.registration import import_open3d
from msgs.array_files import load_array

SUFFIXES = (".ply", ".pcd", ".xyz", ".npy")
MOST_POINTS = 20_000_000
#: A file of as many points, each with a hundred bytes of numbers or words.
MOST_BYTES = 1 << 31
#: Longest side of a plausible cloud. The same numbers read in metres and in millimetres rarely both pass.
EXTENT_M = (2.0, 1000.0)
#: Bytes of a number in PLY, by both of its names.
PLY_BYTES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip
#: Largest numbers of a PCD header, and how much LZF can pack at most.
PCD_MOST = {"SIZE": 8, "COUNT": 1024, "WIDTH": MOST_POINTS, "HEIGHT": MOST_POINTS, "POINTS": MOST_POINTS}
MOST_LZF = 100


def read_cloud(path: Path, unit: Literal["m", "mm"] = "m") -> tuple[np.ndarray, int]:
    """Points [N, 3] of a cloud in metres, and how many were left out because they are not finite.

    Raises ValueError that names file, rule and value: another format, unreadable, empty, more than `MOST_POINTS`,
    an extent that no street has (which is how millimetres read as metres show).
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: format must be one of {', '.join(SUFFIXES)}, got {path.suffix!r}")
    if not path.is_file():
        raise FileNotFoundError(2, "no such cloud", str(path))
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path}: at most {MOST_BYTES} bytes are read, got {path.stat().st_size}")
    points = _npy_points(path) if path.suffix.lower() == ".npy" else _open3d_points(path)
    if points.ndim != 2 or points.shape[1] < 3 or len(points) == 0 or points.dtype.kind not in "fiu":
        raise ValueError(
            f"{path}: points must be numbers of shape (N, 3) with N > 0, got {points.dtype} {points.shape}"
        )
    _require_bearable(path, len(points))
    points_m = points[:, :3].astype(np.float64) * (1e-3 if unit == "mm" else 1.0)
    finite = np.isfinite(points_m).all(axis=1)
    if not finite.any():
        raise ValueError(f"{path}: points must be finite, none of {len(points)} is")
    points_m = points_m[finite]
    # a few far strays must not decide
    low, high = np.quantile(points_m, [0.02, 0.98], axis=0)
    extent_m = float((high - low).max())
    if not EXTENT_M[0] <= extent_m <= EXTENT_M[1]:
        raise ValueError(
            f"{path}: extent must be {EXTENT_M[0]:g}..{EXTENT_M[1]:g} m, got {extent_m:.4g} m with unit {unit}: "
            f"is it {'m' if unit == 'mm' else 'mm'}?"
        )
    return points_m, int(np.count_nonzero(~finite))


def _require_bearable(path: Path, count: int) -> None:
    if count > MOST_POINTS:
        raise ValueError(f"{path}: points must be at most {MOST_POINTS}, got {count}")


def _npy_points(path: Path) -> np.ndarray:
    try:
        return load_array(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: must be a readable numpy array: {' '.join(str(error).split())}") from None


def _open3d_points(path: Path) -> np.ndarray:
    """Points as open3d reads them; what it does not understand comes back empty.

    Of a file that ends early it gives chance numbers, and it makes room for all that is promised: such a file is
    refused before.
    """
    _refuse_promises(path)
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
        except (MemoryError, RuntimeError) as error:
            raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None
    return np.asarray(cloud.points)


def _refuse_promises(path: Path) -> None:
    """ValueError for too many points, and for a PLY or PCD that holds fewer bytes or lines than its header promises."""
    end = {".ply": b"end_header", ".pcd": b"\nDATA"}.get(path.suffix.lower())
    content = path.read_bytes()
    if end is None:
        _require_bearable(path, content.count(b"\n"))
    if end is None or (at := content.find(end)) < 0:
        return
    start = content.find(b"\n", at + 1) + 1
    rows = [line.split() for line in content[: start or None].decode("latin-1").splitlines() if line.split()]
    count, row_bytes = _ply_promise(rows) if path.suffix.lower() == ".ply" else _pcd_promise(rows)
    _require_bearable(path, count)
    if path.suffix.lower() == ".pcd":
        _refuse_large_pcd(path, rows, content[start : start + 8], len(content) - start)
    held = len(content) - start if row_bytes else content.count(b"\n", start) + (not content.endswith(b"\n"))
    if not start or held < count * max(row_bytes, 1):
        raise ValueError(f"{path}: header promises {count} points, the file ends before: it is cut off")


def _refuse_large_pcd(path: Path, rows: list[list[str]], head: bytes, held: int) -> None:
    """ValueError where a PCD asks for memory that its points cannot need: open3d gives it unasked."""
    fields = {row[0]: row[1:] for row in rows if len(row) > 1}
    numbers = {name: [int(word) if word.isdecimal() else -1 for word in fields.get(name, [])] for name in PCD_MOST}
    for name in ("SIZE", "WIDTH", "HEIGHT", "POINTS"):
        # open3d takes by chance what a header does not say
        if not numbers[name]:
            raise ValueError(f"{path}: {name} must be said before DATA, it is not")
    for name, most in PCD_MOST.items():
        if not all(0 <= one <= most for one in numbers[name]):
            raise ValueError(f"{path}: {name} must be whole numbers of at most {most}, got {' '.join(fields[name])}")
    if fields.get("DATA", [""])[0] == "binary_compressed":
        packed, unpacked = (int.from_bytes(head[at : at + 4], "little") for at in (0, 4))
        if packed > held - 8 or unpacked > min(MOST_LZF * packed, MOST_BYTES):
            raise ValueError(f"{path}: {packed} bytes that unpack to {unpacked} are promised, the file holds {held}")


def _ply_promise(rows: list[list[str]]) -> tuple[int, int]:
    """Points of a PLY header and the bytes of each (0: a line of text)."""
    count = row_bytes = 0
    element = ""
    is_text = any(row[:2] == ["format", "ascii"] for row in rows)
    for row in rows:
        if row[0] == "element" and len(row) == 3:
            element = row[1]
            count = int(row[2]) if element == "vertex" and row[2].isdecimal() else count
        elif row[0] == "property" and element == "vertex" and len(row) == 3:
            row_bytes += PLY_BYTES.get(row[1], 0)
    return count, 0 if is_text else row_bytes


def _pcd_promise(rows: list[list[str]]) -> tuple[int, int]:
    """Points of a PCD header and the bytes of each (0: a line of text); compressed points are not counted."""
    fields = {row[0]: row[1:] for row in rows if len(row) > 1}
    kind = fields.get("DATA", [""])[0]
    count = int(fields["POINTS"][0]) if fields.get("POINTS", [""])[0].isdecimal() else 0
    sizes = [int(size) for size in fields.get("SIZE", []) if size.isdecimal()]
    counts = [int(one) for one in fields.get("COUNT", ["1"] * len(sizes)) if one.isdecimal()]
    if kind == "binary_compressed":
        return 0, 0
    return count, sum(size * one for size, one in zip(sizes, counts, strict=False)) if kind == "binary" else 0
