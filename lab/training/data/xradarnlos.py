"""The published data as a data set of maps: contents of its files, in our units and frames, with their origins.

Axes of the source: x = r sin(-azimuth) to the right, y = r cos(azimuth) ahead; ours are x ahead and y to the left, so
that (x, y) = (y, -x) of the source and azimuths agree in sign. Points are given in the plane; heights are dropped.

- `sim`: a complex map `NAME.npy` [512, 256] and its points `NAME.npz` with L, G and T of shape (3, N) [m]. By the order
  of the release's description L is direct (LOS), G the mirror images and T their true positions. The range axis is
  the supplement's 512 bins of c / 2B, printed as 0..109.4 m: maps stay unchanged on the default grid, which differs by
  a tenth of a bin at its far end.
- `real`: a folder a capture with a Welch power spectrum [512, 256] and points of shape (N, 2). The range axis runs from
  4.521 to 43.994 m; our grids start at 0, so power is interpolated onto 512 bins of 43.994 / 511 m, and cells
  before the start are filled with the map's noise. Power below zero, left over by the background's subtraction,
  counts as zero. Values are square roots of power: no phase.

The source states neither noise nor power in watt: noise is estimated from the quiet fifth of each map's cells, and
powers are relative.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from msgs.files.array_files import is_archive, load_array, load_arrays
from msgs.files.checksums import file_sha256, json_lines
from msgs.files.whole_files import whole, write_whole
from msgs.values.frames import polar_from_xy
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid

Kind = Literal["sim", "real"]
KINDS: tuple[Kind, ...] = ("sim", "real")
SHAPE = (512, 256)
#: First and last range of the two axes, as the release prints them.
SIM_RANGE_M = (0.0, 109.4)
REAL_RANGE_M = (4.521, 43.994)
SPECTRUM = "welch_interpolated_background_subtracted.npz"
SPECTRUM_KEY = "Pxx"
POINTS_FOLDER = "labeled_points"
SCENES_PER_SHARD = 50
#: Meaning of the arrays of a simulated points file.
SIM_KEYS = {"direct": "L", "image": "G", "true_place": "T"}
#: Share of a map's cells that count as quiet: of exponential noise, they lie below -log(1 - share) of its mean.
QUIET_SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class Capture:
    """The files of one frame: its name, the map's file, the files of its points."""

    sequence: str
    map_path: Path
    point_paths: tuple[Path, ...]


@dataclass(frozen=True, kw_only=True)
class ImportedFrame:
    """One frame in our units and frames: values complex64 [range, azimuth], noise, and truth arrays [points]."""

    sequence: str
    values: np.ndarray
    noise_power_mw: float
    range_m: np.ndarray
    azimuth_rad: np.ndarray
    path_class: np.ndarray
    hidden_xy_m: np.ndarray
    #: True positions [M, 2] of all images together, which need not pair with them (a labelled cloud does not).
    places_m: np.ndarray
    #: Source files with their SHA-256, and cells that were below zero.
    source: dict[str, Any]


@dataclass
class ImportSummary:
    """Result of an import; `broken` are the captures left out, each with the reason."""

    frames: int = 0
    los_points: int = 0
    mirrored_points: int = 0
    negative_cells: int = 0
    broken: list[str] = field(default_factory=list)


def grid_of(kind: Kind) -> RangeAzimuthGrid:
    """Return the grid of imported maps of a kind."""
    return RangeAzimuthGrid() if kind == "sim" else RangeAzimuthGrid(range_bin_m=REAL_RANGE_M[1] / (SHAPE[0] - 1))


def find_captures(directory: Path, kind: Kind) -> tuple[list[Capture], list[str]]:
    """Return all captures below a folder, by name, and the faults of files without one; ValueError without captures."""
    captures, faults = _sim_captures(directory) if kind == "sim" else (_real_captures(directory), [])
    if not captures and not faults:
        expected = "NAME.npy with NAME.npz" if kind == "sim" else SPECTRUM
        raise ValueError(f"{directory} must hold captures ({expected}), found none")
    return captures, faults


def _sim_captures(directory: Path) -> tuple[list[Capture], list[str]]:
    """Return points files with the map of the same name: beside them, or the only one of that name anywhere below."""
    maps = [path for path in sorted(directory.rglob("*.npy")) if not _is_label_map(path)]
    captures, faults = [], []
    for points in sorted(directory.rglob("*.npz")):
        beside = points.with_suffix(".npy")
        same = [beside] if beside in maps else [path for path in maps if path.stem == points.stem]
        if len(same) != 1:
            faults.append(f"{points} must have one map of its name (.npy), found {len(same)}")
            continue
        name = _name(points.with_suffix(""), directory)
        captures.append(Capture(sequence=name, map_path=same[0], point_paths=(points,)))
    used = {capture.map_path for capture in captures}
    stems = {points.stem for points in directory.rglob("*.npz")}
    unpaired = [path for path in maps if path not in used and path.stem not in stems]
    return captures, faults + [f"{path} must have points of its name (.npz), found none" for path in unpaired]


def _is_label_map(path: Path) -> bool:
    """Return whether an array is one of the release's label maps (512 x 256 x 5), which the points make redundant."""
    try:
        return load_array(path).ndim == 3
    except (OSError, ValueError):
        return False


def _real_captures(directory: Path) -> list[Capture]:
    names = ("los", "mirrored_nlos", "nlos")
    captures = []
    for spectrum in sorted(directory.rglob(SPECTRUM)):
        points = tuple(spectrum.parent / POINTS_FOLDER / f"{name}.npy" for name in names)
        # frames of one drive lie in folders of one folder; a lone folder is its own
        at = spectrum.parent
        drive = at.parent if at.parent != directory and at != directory else at
        captures.append(Capture(sequence=_name(drive, directory), map_path=spectrum, point_paths=points))
    return captures


def _name(path: Path, directory: Path) -> str:
    """Return the name of a path below the imported folder."""
    return path.relative_to(directory).as_posix() if path != directory else directory.resolve().name


def read_capture(capture: Capture, kind: Kind, directory: Path) -> ImportedFrame:
    """Return one capture in our units and frames.

    Raises `ValueError` that names file, field, value and rule: an array missing, of another shape or type, not finite,
    images without true positions (simulated: without as many), points off the grid.
    """
    if kind == "sim":
        values, negative = _sim_map(capture.map_path), 0
        direct, image, true_place = _sim_points(capture.point_paths[0])
        noise = noise_of(np.square(np.abs(values.astype(np.complex128))))
    else:
        power, negative = _real_map(capture.map_path)
        direct, image, true_place = (_points(path, path.stem, _load(path), 0) for path in capture.point_paths)
        power, noise = resampled(power)
        values = np.sqrt(power).astype(np.complex64)
    where = capture.point_paths[0] if kind == "sim" else capture.point_paths[1]
    if bool(len(image)) != bool(len(true_place)) or (kind == "sim" and len(image) != len(true_place)):
        raise ValueError(f"{where}: images and true places must be as many, got {len(image)} and {len(true_place)}")
    paired = true_place if len(image) == len(true_place) else np.full_like(image, np.nan)
    range_m, azimuth_rad = polar_from_xy(np.concatenate([direct, image]))
    _check_on_grid(capture, range_m, azimuth_rad, grid_of(kind))
    files = (capture.map_path, *capture.point_paths)
    return ImportedFrame(
        sequence=capture.sequence,
        values=values,
        noise_power_mw=noise,
        range_m=range_m.astype(np.float32),
        azimuth_rad=azimuth_rad.astype(np.float32),
        path_class=np.repeat(np.array([PathClass.LOS, PathClass.MIRRORED], np.uint8), [len(direct), len(image)]),
        hidden_xy_m=np.concatenate([direct, paired]).astype(np.float32),
        places_m=true_place.astype(np.float32),
        source={"files": {_name(path, directory): file_sha256(path) for path in files}, "negative_cells": negative},
    )


def _load(path: Path) -> Any:
    """Return an array or an archive; ValueError names a file that cannot be read."""
    try:
        return load_arrays(path) if is_archive(path) else load_array(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ValueError(f"{path}: must be a readable numpy file: {reason}") from None


def _field(path: Path, arrays: Any, key: str) -> np.ndarray:
    if not isinstance(arrays, dict) or key not in arrays:
        names = ", ".join(sorted(arrays)) if isinstance(arrays, dict) else "a single array"
        raise ValueError(f"{path}: must hold {key}, holds {names or 'nothing'}")
    return np.asarray(arrays[key])


def _require(path: Path, name: str, array: np.ndarray, kinds: str, rule: str) -> None:
    """Raise ValueError unless an array's numbers are of the given kinds and finite."""
    if array.dtype.kind not in kinds:
        raise ValueError(f"{path}: {name} must be {rule}, got {array.dtype}")
    if not np.isfinite(array).all():
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{path}: {name} must be finite, got {array[at]} at {at}")


def _require_map(path: Path, name: str, array: np.ndarray, kinds: str, rule: str) -> None:
    if array.shape != SHAPE:
        raise ValueError(f"{path}: {name} must have shape {SHAPE}, got {array.shape}")
    _require(path, name, array, kinds, rule)


def _sim_map(path: Path) -> np.ndarray:
    array = _load(path)
    if isinstance(array, dict):
        raise ValueError(f"{path}: map must be a single array (.npy), got an archive")
    _require_map(path, "map", array, "c", "complex")
    return array.astype(np.complex64)


def _real_map(path: Path) -> tuple[np.ndarray, int]:
    """Return the power of a spectrum, zero where the source is below, and the number of such cells."""
    power = _field(path, _load(path), SPECTRUM_KEY)
    _require_map(path, SPECTRUM_KEY, power, "fiu", "power (real)")
    return np.maximum(power.astype(np.float64), 0.0), int(np.count_nonzero(power < 0.0))


def _sim_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return direct points, images and true positions [N, 2] in the radar's frame."""
    arrays = _load(path)
    direct, image, true_place = (_points(path, key, _field(path, arrays, key), 1) for key in SIM_KEYS.values())
    return direct, image, true_place


def _points(path: Path, name: str, array: Any, axis: int) -> np.ndarray:
    """Return points [N, 2] in the radar's frame of an array (3, N) (`axis` 1) or (N, 2) (`axis` 0) in the source's."""
    if isinstance(array, dict):
        raise ValueError(f"{path}: {name} must be a single array (.npy), got an archive")
    coordinates, expected = (3, "(3, N)") if axis == 1 else (2, "(N, 2)")
    # without points, writers leave an array without its other axis
    points = array.reshape(coordinates, 0) if array.size == 0 else (array if axis == 1 else array.T)
    if points.ndim != 2 or len(points) != coordinates:
        raise ValueError(f"{path}: {name} must have shape {expected}, got {array.shape}")
    _require(path, name, array, "fiu", "real")
    return np.stack([points[1], -points[0]], axis=1).astype(np.float64)


def _check_on_grid(capture: Capture, range_m: np.ndarray, azimuth_rad: np.ndarray, grid: RangeAzimuthGrid) -> None:
    row, column = grid.range_index(range_m), grid.azimuth_index(azimuth_rad)
    inside = (row <= grid.range_bins - 1) & (column >= 0.0) & (column <= grid.azimuth_bins - 1)
    if not inside.all():
        first = int(np.flatnonzero(~inside)[0])
        raise ValueError(
            f"{capture.point_paths[0]}: points must lie on the grid, 0..{grid.range_m[-1]:.1f} m and "
            f"+-{grid.azimuth_limit_deg:g} deg, got {range_m[first]:.2f} m at {np.degrees(azimuth_rad[first]):.1f} deg"
        )


def noise_of(power: np.ndarray) -> float:
    """Return the mean of exponential noise whose quiet fifth is that of a map's cells above zero; 0 if empty."""
    present = power[power > 0.0]
    return float(np.quantile(present, QUIET_SHARE) / -np.log1p(-QUIET_SHARE)) if len(present) else 0.0


def resampled(power: np.ndarray) -> tuple[np.ndarray, float]:
    """Return power [512, 256] on the source's real axis resampled to our grid, which starts at 0; and its noise.

    Linear in range. Cells before the source's start hold the noise: no step for a network to learn.
    """
    grid, noise = grid_of("real"), noise_of(power)
    source_row = (grid.range_m - REAL_RANGE_M[0]) / ((REAL_RANGE_M[1] - REAL_RANGE_M[0]) / (SHAPE[0] - 1))
    row = np.clip(source_row, 0.0, SHAPE[0] - 1.0)
    below = np.minimum(row.astype(int), SHAPE[0] - 2)
    share = (row - below)[:, None]
    onto = (1.0 - share) * power[below] + share * power[below + 1]
    return np.where(source_row[:, None] < 0.0, noise, onto), noise


def import_folder(
    directory: Path,
    out: Path,
    kind: Kind = "sim",
    skip_broken: bool = False,
    on_capture: Callable[[int, int], None] = lambda done, total: None,
) -> ImportSummary:
    """Write all captures below a folder as a data set of maps: shards and `series.json`.

    With `skip_broken` captures that cannot be read are counted, else the first raises `ValueError`. So do a folder
    without captures, one without a readable one, and a target that is not empty. `on_capture` reports progress.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    if out.exists() and any(out.iterdir()):
        raise ValueError(f"{out} must be empty or new, holds {next(out.iterdir()).name}")
    captures, faults = find_captures(directory, kind)
    if faults and not skip_broken:
        raise ValueError(faults[0])
    out.mkdir(parents=True, exist_ok=True)
    summary, sources = ImportSummary(broken=faults), []
    shard: list[ImportedFrame] = []
    for frame in _read_all(captures, kind, directory, skip_broken, summary, on_capture):
        sources.append({"sequence": frame.sequence} | frame.source)
        shard.append(frame)
        if len(shard) == SCENES_PER_SHARD:
            _write_shard(out, summary, shard)
            shard = []
    if shard:
        _write_shard(out, summary, shard)
    if not sources:
        raise ValueError(f"{directory}: captures must be readable, none is: {summary.broken[0]}")
    write_whole(out / "series.json", json_lines(_series(kind, sources, summary)))
    return summary


def _read_all(
    captures: list[Capture],
    kind: Kind,
    directory: Path,
    skip_broken: bool,
    summary: ImportSummary,
    on_capture: Callable[[int, int], None],
) -> Iterator[ImportedFrame]:
    for done, capture in enumerate(captures, start=1):
        try:
            yield read_capture(capture, kind, directory)
        except ValueError as error:
            if not skip_broken:
                raise
            summary.broken.append(str(error))
        on_capture(done, len(captures))


def _series(kind: Kind, sources: list[dict[str, Any]], summary: ImportSummary) -> dict[str, Any]:
    """Return the metadata of the folder."""
    first_m, last_m = SIM_RANGE_M if kind == "sim" else REAL_RANGE_M
    return {
        "format": "maps",
        "grid": msgspec.to_builtins(grid_of(kind)),
        "power_only": kind == "real",
        "source": {
            "layout": "xradarnlos",
            "kind": kind,
            "range_axis_m": [first_m, last_m],
            "resampled": kind == "real",
            "keys": SIM_KEYS if kind == "sim" else None,
            "noise": f"estimated from the quiet {100 * QUIET_SHARE:.0f} % of each map's cells; powers are relative",
            "broken": summary.broken,
            "frames": sources,
        },
    }


def _write_shard(out: Path, summary: ImportSummary, frames: list[ImportedFrame]) -> None:
    """Write one more shard, and count its captures."""
    number = summary.frames // SCENES_PER_SHARD
    path_class = np.concatenate([frame.path_class for frame in frames])
    arrays = {
        "values": np.stack([frame.values for frame in frames]),
        "noise_power_mw": np.array([frame.noise_power_mw for frame in frames]),
        "offset": np.concatenate([[0], np.cumsum([len(frame.range_m) for frame in frames])]).astype(np.int64),
        "range_m": np.concatenate([frame.range_m for frame in frames]),
        "azimuth_rad": np.concatenate([frame.azimuth_rad for frame in frames]),
        "path_class": path_class,
        "hidden_xy_m": np.concatenate([frame.hidden_xy_m for frame in frames]),
        "sequence": np.array([frame.sequence for frame in frames]),
        "place_offset": np.concatenate([[0], np.cumsum([len(frame.places_m) for frame in frames])]).astype(np.int64),
        "places_m": np.concatenate([frame.places_m for frame in frames]),
    }
    with whole(out / f"shard-{number:05d}.npz") as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())
    summary.frames += len(frames)
    summary.los_points += int(np.count_nonzero(path_class == PathClass.LOS))
    summary.mirrored_points += int(np.count_nonzero(path_class == PathClass.MIRRORED))
    summary.negative_cells += sum(frame.source["negative_cells"] for frame in frames)
