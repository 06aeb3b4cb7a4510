"""Detections of published data sets, by the ends of their files' names: one table, and what reads each.

Files of arrays hold one scan each: clouds of nuScenes (.pcd), lists of View-of-Delft (.bin), sparse tensors of K-Radar
(.npy). Files of HDF5 hold a drive of several sensors: RadarScenes, the radar ghost set. Formats are named by their
mappings in `launch/detections`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from contrib.imports.detection_columns import STAMP_UNITS, Columns, DetectionMapping
from contrib.imports.detection_mapping import read_mapping
from contrib.imports.detection_tables import ScanRows
from msgs.files.shipped import LAUNCH
from msgs.files.unpacking import Budget
from msgs.values.arrays import MAX_STAMP_NS

#: Columns of a radar list of View-of-Delft, float32; frames of the numbered sets are 0.1 s apart and have no stamps.
DELFT_COLUMNS = ("x", "y", "z", "rcs", "v_r", "v_r_compensated", "time")
_PERIOD_NS = 100_000_000
_MAX_BYTES = 1 << 26
_MAX_DRIVE_BYTES = 1 << 31
_TYPES = {
    ("F", "4"): "<f4",
    ("F", "8"): "<f8",
    **{(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in "1248"},
}
_NEEDED = ("x", "y", "z", "rcs", "vx_comp", "vy_comp", "invalid_state", "ambig_state")


class _ArrayFormat(NamedTuple):
    """Files of one scan each: the shipped mapping, the stamp by the name, and what reads the columns."""

    mapping: str
    stamp_ns: Callable[[Path], int]
    columns: Callable[[Path], Columns]


def array_files(source: Path) -> list[Path]:
    """Return the scans of a data set: one file, or those of a folder; empty where it is something else."""
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    return [file for file in files if file.suffix.lower() in ARRAYS]


def array_scans(files: Iterable[Path], advance: Callable[[], None]) -> Iterator[ScanRows]:
    """Yield a scan a file by their stamps; `ValueError` names the file and the rule that it breaks."""
    order: dict[int, Path] = {}
    for file in files:
        stamp_ns = ARRAYS[file.suffix.lower()].stamp_ns(file)
        if stamp_ns in order:
            raise ValueError(f"{file}: name must be of another frame than that of {order[stamp_ns].name}")
        order[stamp_ns] = file
    for stamp_ns, file in sorted(order.items()):
        if file.stat().st_size > _MAX_BYTES:
            raise ValueError(f"{file}: must be at most {_MAX_BYTES} bytes, got {file.stat().st_size}")
        columns = ARRAYS[file.suffix.lower()].columns(file)
        advance()
        yield ScanRows(stamp_ns, dict(columns))


def _numbered(pattern: str, noun: str) -> Callable[[Path], int]:
    def stamp_ns(path: Path) -> int:
        if (met := re.fullmatch(pattern, path.stem)) is None:
            raise ValueError(f"{path}: name must be the number of a frame of {noun}")
        return _PERIOD_NS * int(met[1])

    return stamp_ns


def _nuscenes_stamp_ns(path: Path) -> int:
    name = re.search("__([0-9]{16})$", path.stem)
    if name is None:
        raise ValueError(f"{path}: name must end in __ and 16 digits, the time in microseconds, as in nuScenes")
    return 1000 * int(name[1])


def _require_finite(path: Path, columns: Columns, names: Iterable[str]) -> None:
    """Refuse a place that is no number: no published file has one."""
    for name in names:
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if len(bad):
            raise ValueError(f"{path}: {name} must be finite, got {columns[name][bad[0]]} in row {bad[0]}")


def _delft(path: Path) -> Columns:
    content, width = path.read_bytes(), 4 * len(DELFT_COLUMNS)
    if len(content) % width:
        raise ValueError(f"{path}: must hold whole rows of {width} bytes ({', '.join(DELFT_COLUMNS)}), ends within one")
    table = np.frombuffer(content, "<f4").reshape(-1, len(DELFT_COLUMNS)).astype(np.float64)
    columns: Columns = {name: table[:, at] for at, name in enumerate(DELFT_COLUMNS)}
    _require_finite(path, columns, "xyz")
    return columns


def _k_radar(path: Path) -> Columns:
    """Read a sparse tensor: x, y, z, power and, where it was added, Doppler; strongest first.

    Level is that over the weakest of the frame: power is scaled.
    """
    try:
        table = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError, SyntaxError) as error:
        raise ValueError(f"{path}: must be an array of NumPy: {' '.join(str(error).split())[:100]}") from None
    is_array = isinstance(table, np.ndarray) and table.dtype.kind == "f" and table.ndim == 2
    if not is_array or table.shape[1] not in (4, 5):
        got = f"{table.dtype} {table.shape}" if isinstance(table, np.ndarray) else "an archive"
        raise ValueError(f"{path}: must hold rows of x, y, z, power (and Doppler), floats, got {got}")
    columns: Columns = dict(zip(("x", "y", "z", "power"), np.array(table[:, :4].T, np.float64), strict=True))
    _require_finite(path, columns, ("x", "y", "z", "power"))
    order = np.argsort(-columns["power"], kind="stable")
    positive = np.maximum(columns["power"], np.finfo(np.float64).tiny)
    level_db = 10.0 * np.log10(positive / positive.min(initial=np.inf))
    return {name: column[order] for name, column in {**columns, "level_db": level_db}.items()}


def _nuscenes(path: Path) -> Columns:
    """Read a cloud; returns that the sensor calls invalid or ambiguous become NaN, as the set's own kit drops them."""
    points = _pcd_points(path)
    if absent := [name for name in _NEEDED if name not in (points.dtype.names or ())]:
        raise ValueError(f"{path}: FIELDS must hold {absent[0]}, as radar clouds of nuScenes do")
    columns: dict[str | int, np.ndarray] = {
        field: points[field].astype(np.float64) for field in points.dtype.names or ()
    }
    _require_finite(path, columns, "xy")
    columns["x"][(points["invalid_state"] != 0) | (points["ambig_state"] != 3)] = np.nan
    with np.errstate(all="ignore"):
        along = columns["x"] * columns["vx_comp"] + columns["y"] * columns["vy_comp"]
        columns["v_r_comp"] = along / np.hypot(columns["x"], columns["y"])
    return columns


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
    if (version := "".join(facts.get("VERSION", ["none"]))) not in ("0.7", ".7"):
        raise ValueError(f"{path}: VERSION must be 0.7, got {version}")
    dtype = np.dtype([(name, str(kind)) for name, kind in zip(names, types, strict=True)])
    if len(data) < int(count) * dtype.itemsize:
        raise ValueError(f"{path}: must hold {count} points of {dtype.itemsize} bytes, got {len(data)} bytes")
    return np.frombuffer(data, dtype, int(count))


#: Sets of a file a scan, by the ends of names.
ARRAYS = {
    ".pcd": _ArrayFormat("nuscenes", _nuscenes_stamp_ns, _nuscenes),
    ".bin": _ArrayFormat("view_of_delft", _numbered("([0-9]{1,9})", "View-of-Delft, such as 00123.bin"), _delft),
    ".npy": _ArrayFormat("k_radar", _numbered(".*_([0-9]{5})", "K-Radar, such as sprdr_00123.npy"), _k_radar),
}
#: Ends of names of HDF5 files, and the mappings whose dataset such a file may hold.
DRIVE_SUFFIXES = (".h5", ".hdf5")
DRIVES = ("radar_scenes", "radar_ghost")


def shipped_mapping(name: str) -> Path:
    """Return the file of a format's mapping."""
    return LAUNCH / "detections" / f"{name}.yaml"


class Drive(NamedTuple):
    """Scans of one sensor of a drive, with the mapping that is the sensor's own."""

    path: Path
    mapping_path: Path
    mapping: DetectionMapping
    stamp_ns: np.ndarray
    columns: dict[str | int, np.ndarray]
    #: First row of each scan.
    starts: np.ndarray

    def scans(self, advance: Callable[[], None]) -> Iterator[ScanRows]:
        """Yield the scans in the file's order."""
        ends = [*self.starts[1:], len(self.stamp_ns)]
        for start, end in zip(self.starts, ends, strict=True):
            advance()
            yield ScanRows(int(self.stamp_ns[start]), {name: rows[start:end] for name, rows in self.columns.items()})


def read_drive(path: Path, given: Path | None, sensor: str | None) -> Drive:
    """Return a sensor's scans of a file of HDF5: of `sensor`, or of the only one.

    The mapping is `given`, or the shipped one whose dataset the file holds. Raises `ImportError` without h5py,
    `ValueError` naming file, field and rule.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError("h5py, which reads HDF5 (pip install mirrorwave[convert])") from error
    if not path.is_file():
        raise FileNotFoundError(2, "No such file or directory", str(path))
    try:
        with h5py.File(path, "r") as file:
            used, mapping = _drive_mapping(path, given, set(file))
            dataset = file[mapping.dataset]
            names = [*dict.fromkeys([*mapping.columns.values(), *_keys(mapping)])]
            _require_table(path, mapping, dataset, names)
            table = {name: dataset.fields(name)[()] for name in names}
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{path}: no HDF5 that can be read: {' '.join(str(error).split())[:150]}") from None
    return _drive(path, used, mapping, table, sensor)


def _keys(mapping: DetectionMapping) -> list[str | int]:
    """Return the columns that tell sensors, scans and stamps."""
    sources = (mapping.stamp, mapping.scan, mapping.sensors)
    return [source.column for source in sources if source is not None and source.column is not None]


def _drive_mapping(path: Path, given: Path | None, held: set[str]) -> tuple[Path, DetectionMapping]:
    candidates = [given] if given else [shipped_mapping(name) for name in DRIVES]
    mappings = {used: read_mapping(used) for used in candidates}
    for used, mapping in mappings.items():
        if mapping.stamp is None or mapping.stamp.column is None or not mapping.dataset:
            raise ValueError(f"{used}: dataset and stamp.column must be given: the table of the file and a row's time")
        if mapping.dataset in held:
            return used, mapping
    listed = " or ".join(mapping.dataset for mapping in mappings.values())
    raise ValueError(f"{path}: must hold the dataset {listed}, got {', '.join(sorted(held)) or 'none'}")


def _require_table(path: Path, mapping: DetectionMapping, dataset: Any, names: list[str | int]) -> None:
    dtype = getattr(dataset, "dtype", np.dtype("f8"))
    if dtype.names is None or dataset.ndim != 1:
        raise ValueError(f"{path}: {mapping.dataset} must be a table with named columns")
    # what was never written reads as zeros
    limit = min(_MAX_DRIVE_BYTES, Budget.FREE_BYTES + Budget.RATIO * path.stat().st_size)
    if (size := dataset.size * dtype.itemsize) > limit:
        raise ValueError(f"{path}: {mapping.dataset} must be at most {limit} bytes in a file of this size, got {size}")
    if absent := [name for name in names if name not in dtype.names]:
        raise ValueError(f"{path}: {mapping.dataset} must hold the column {absent[0]}, got {', '.join(dtype.names)}")


def _drive(
    path: Path, used: Path, mapping: DetectionMapping, table: dict[str | int, np.ndarray], sensor: str | None
) -> Drive:
    if mapping.sensors is not None:
        mapping, rows = _of_sensor(path, mapping, table[mapping.sensors.column], sensor)
        table = {name: column[rows] for name, column in table.items()}
    elif sensor is not None:
        raise ValueError(f"{used}: sensors must be given to name one by --topic, got {sensor!r}")
    stamp_ns = _stamps_ns(path, mapping, table)
    key = stamp_ns if mapping.scan is None else table[mapping.scan.column]  # type: ignore[index]
    starts = np.flatnonzero(np.append(True, key[1:] != key[:-1])) if len(key) else np.zeros(0, np.intp)
    columns: dict[str | int, np.ndarray] = {}
    for name, column in mapping.columns.items():
        if table[column].dtype.kind not in "fiu":
            raise ValueError(f"{path}: {column} must be numbers, got {table[column].dtype}")
        columns[column] = table[column].astype(np.float64)
        if name in ("range", "azimuth", "x", "y", "z"):
            _require_finite(path, columns, [str(column)])
    return Drive(path, used, mapping, stamp_ns, columns, starts)


def _of_sensor(
    path: Path, mapping: DetectionMapping, column: np.ndarray, sensor: str | None
) -> tuple[DetectionMapping, np.ndarray]:
    """Return the mapping of a sensor and its rows."""
    assert mapping.sensors is not None
    names = np.array([value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value) for value in column])
    known = sorted(set(names))
    if sensor is None and len(known) == 1:
        sensor = known[0]
    if sensor is None or sensor not in known:
        got = "none" if sensor is None else repr(sensor)
        raise ValueError(f"{path}: --topic must name one of its sensors: {', '.join(known) or 'none'}; got {got}")
    mounting = mapping.sensors.mountings.get(sensor, mapping.mounting)
    name = "_".join(filter(None, (mapping.sensor, sensor)))
    return msgspec.structs.replace(mapping, sensor=name, mounting=mounting), np.flatnonzero(names == sensor)


def _stamps_ns(path: Path, mapping: DetectionMapping, table: dict[str | int, np.ndarray]) -> np.ndarray:
    assert mapping.stamp is not None
    assert mapping.stamp.column is not None
    name, factor = mapping.stamp.column, STAMP_UNITS[mapping.stamp.unit or "s"]
    raw = table[name]
    if raw.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {name} must be numbers, got {raw.dtype}")
    bad = np.flatnonzero(~((raw >= 0) & (raw <= MAX_STAMP_NS // factor)))
    if len(bad):
        raise ValueError(f"{path}: {name} must be a time, got {raw[bad[0]]} in row {bad[0]} of the sensor")
    stamp_ns = raw.astype(np.int64) * factor if raw.dtype.kind in "iu" else np.rint(raw * factor).astype(np.int64)
    if len(back := np.flatnonzero(np.diff(stamp_ns) < 0)):
        at = int(back[0]) + 1
        raise ValueError(
            f"{path}: {name} must not go back, got {raw[at]} after {raw[at - 1]} in row {at} of the sensor"
        )
    return stamp_ns
