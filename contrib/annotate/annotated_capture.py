"""Annotated captures in the published layout, read by `lab.training.data.xradarnlos` like the release's own.

`real`: a folder a frame with a Welch power spectrum on the release's axis, 4.521 to 43.994 m, and points (N, 2).
`sim`: a complex map NAME.npy on our default grid and NAME.npz with L, G and T of shape (3, N). Points are in the
source's axes: x to the right, y ahead. Points outside the map are left out: the import would refuse them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from contrib.annotate.slice_labels import SliceLabels
from lab.training.data.xradarnlos import (
    POINTS_FOLDER,
    REAL_RANGE_M,
    SHAPE,
    SIM_KEYS,
    SPECTRUM,
    SPECTRUM_KEY,
    Kind,
    grid_of,
)
from msgs.values.frames import polar_from_xy
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap


@dataclass(frozen=True, eq=False)
class FramePoints:
    """Points in the radar's frame: direct [N, 2], images and their true positions [M, 2] row by row, walls [W, 2]."""

    los_m: np.ndarray
    image_m: np.ndarray
    place_m: np.ndarray
    wall_m: np.ndarray
    #: Points and images outside the map.
    off_map: int


def frame_points(labels: SliceLabels, kind: Kind) -> FramePoints:
    """Return the labels that the map of a kind can show."""
    los, image, wall = (on_map(points, kind) for points in (labels.los_m, labels.image_m, labels.wall_m))
    return FramePoints(
        labels.los_m[los],
        labels.image_m[image],
        labels.points_m[labels.image_point[image]],
        labels.wall_m[wall],
        int(np.count_nonzero(~los) + np.count_nonzero(~image)),
    )


def on_map(points_m: np.ndarray, kind: Kind) -> np.ndarray:
    """Return whether points [N, 2] lie on the map of a kind; bool [N]."""
    grid = grid_of(kind)
    range_m, azimuth_rad = polar_from_xy(points_m)
    column = grid.azimuth_index(azimuth_rad)
    first_m = REAL_RANGE_M[0] if kind == "real" else 0.0
    inside = (range_m >= first_m) & (grid.range_index(range_m) <= grid.range_bins - 1)
    return np.asarray(inside & (column >= 0.0) & (column <= grid.azimuth_bins - 1))


def mean_map(maps: list[RangeAzimuthMap], kind: Kind) -> np.ndarray:
    """Return scans of a scene at rest as one map [512, 256]: `sim` mean field, `real` mean power on the release's axis.

    Raises ValueError without maps or if their grid is not the default one.
    """
    if not maps:
        raise ValueError("radar must hold at least one complete scan, holds none")
    grid = maps[0].grid
    if any(map_.grid != RangeAzimuthGrid() for map_ in maps):
        raise ValueError(f"radar maps must be on the default grid of {SHAPE} cells, got {grid.shape}")
    if kind == "sim":
        return np.asarray(np.mean([map_.values for map_ in maps], axis=0, dtype=np.complex128), np.complex64)
    power = np.mean([np.abs(map_.values).astype(np.float64) ** 2 for map_ in maps], axis=0)
    row = np.linspace(*REAL_RANGE_M, SHAPE[0]) / grid.range_bin_m
    below = np.floor(row).astype(int)
    share = (row - below)[:, None]
    return np.asarray((1.0 - share) * power[below] + share * power[below + 1])


def write_frame(folder: Path, name: str, kind: Kind, values: np.ndarray, points: FramePoints) -> None:
    """Write one frame below a folder: `real` into folder/name/, `sim` as folder/name.npy and folder/name.npz."""
    if kind == "sim":
        folder.mkdir(parents=True, exist_ok=True)
        columns = zip(SIM_KEYS.values(), (points.los_m, points.image_m, points.place_m), strict=True)
        arrays = {key: _in_source(rows, 3).T for key, rows in columns}
        np.save(folder / f"{name}.npy", values)
        np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
        return
    labelled = folder / name / POINTS_FOLDER
    labelled.mkdir(parents=True, exist_ok=True)
    np.savez(folder / name / SPECTRUM, **{SPECTRUM_KEY: values})  # type: ignore[arg-type]
    rows_of = {"los": points.los_m, "mirrored_nlos": points.image_m, "nlos": points.place_m, "wall": points.wall_m}
    for label, rows in rows_of.items():
        np.save(labelled / f"{label}.npy", _in_source(rows, 2))


def _in_source(points_m: np.ndarray, coordinates: int) -> np.ndarray:
    """Return points [N, 2] of the radar's frame in the source's axes; a third coordinate is the antenna's height."""
    columns = [-points_m[:, 1], points_m[:, 0], np.zeros(len(points_m))]
    return np.stack(columns[:coordinates], axis=1)
