"""Detections of published data sets in files of arrays, one scan a file: nuScenes (.pcd), View-of-Delft (.bin)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from contrib.imports.detection_columns import Columns

#: Columns of a radar list of View-of-Delft, float32; its frames are 0.1 s apart and have no stamps.
DELFT_COLUMNS = ("x", "y", "z", "rcs", "v_r", "v_r_compensated", "time")
_DELFT_PERIOD_NS = 100_000_000
_MAX_BYTES = 1 << 24
_TYPES = {
    ("F", "4"): "<f4",
    ("F", "8"): "<f8",
    **{(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in "1248"},
}
_NEEDED = ("x", "y", "z", "rcs", "vx_comp", "vy_comp", "invalid_state", "ambig_state")


def array_scan(path: Path) -> tuple[int, Columns]:
    """Return stamp [ns] and columns float64 [N] of a file; `ValueError` names it and the rule that it breaks."""
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path}: must be at most {_MAX_BYTES} bytes, got {path.stat().st_size}")
    return _nuscenes(path) if path.suffix.lower() == ".pcd" else _delft(path)


def _delft(path: Path) -> tuple[int, Columns]:
    if not (re.fullmatch("[0-9]{1,9}", path.stem)):
        raise ValueError(f"{path}: name must be the number of a frame of View-of-Delft, such as 00123.bin")
    content, width = path.read_bytes(), 4 * len(DELFT_COLUMNS)
    if len(content) % width:
        raise ValueError(f"{path}: must hold whole rows of {width} bytes ({', '.join(DELFT_COLUMNS)}), ends within one")
    table = np.frombuffer(content, "<f4").reshape(-1, len(DELFT_COLUMNS)).astype(np.float64)
    return _DELFT_PERIOD_NS * int(path.stem), {name: table[:, at] for at, name in enumerate(DELFT_COLUMNS)}


def _nuscenes(path: Path) -> tuple[int, Columns]:
    """Read a cloud; returns that the sensor calls invalid or ambiguous become NaN, as the set's own kit drops them."""
    name = re.search("__([0-9]{16})$", path.stem)
    if name is None:
        raise ValueError(f"{path}: name must end in __ and 16 digits, the time in microseconds, as in nuScenes")
    points = _pcd_points(path)
    if absent := [name for name in _NEEDED if name not in (points.dtype.names or ())]:
        raise ValueError(f"{path}: FIELDS must hold {absent[0]}, as radar clouds of nuScenes do")
    columns: dict[str | int, np.ndarray] = {
        field: points[field].astype(np.float64) for field in points.dtype.names or ()
    }
    columns["x"][(points["invalid_state"] != 0) | (points["ambig_state"] != 3)] = np.nan
    with np.errstate(all="ignore"):
        along = columns["x"] * columns["vx_comp"] + columns["y"] * columns["vy_comp"]
        columns["v_r_comp"] = along / np.hypot(columns["x"], columns["y"])
    return 1000 * int(name[1]), columns


def _pcd_points(path: Path) -> np.ndarray:
    content = path.read_bytes()
    head, mark, data = content.partition(b"DATA binary\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines() if not line.startswith("#")]
    facts = {line[0]: line[1:] for line in lines if line}
    names, sizes, kinds = (facts.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    count = "".join(facts.get("POINTS", []))
    types = [_TYPES.get(pair) for pair in zip(kinds, sizes, strict=False)]
    is_whole = len(names) == len(sizes) == len(kinds) == len(set(names)) > 0 and None not in types
    if not (mark and is_whole and re.fullmatch("[0-9]{1,7}", count) and set(facts.get("COUNT", ["1"])) == {"1"}):
        raise ValueError(f"{path}: head must be that of a PCD in binary: FIELDS, SIZE, TYPE, COUNT 1, POINTS, DATA")
    dtype = np.dtype([(name, str(kind)) for name, kind in zip(names, types, strict=True)])
    if len(data) < int(count) * dtype.itemsize:
        raise ValueError(f"{path}: must hold {count} points of {dtype.itemsize} bytes, got {len(data)} bytes")
    return np.frombuffer(data, dtype, int(count))
