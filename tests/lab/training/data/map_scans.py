"""Scans of maps made up cell by cell, whose labels say where their points are and nothing else."""

from __future__ import annotations

import numpy as np

from lab.training.data.frames import FrameLabels, Scan
from msgs.values.radar import RangeAzimuthGrid


def map_scan(
    grid: RangeAzimuthGrid, values: np.ndarray, row: np.ndarray, column: np.ndarray, path_class: list[int], index: int
) -> Scan:
    """A map with points in these cells; its noise is that of values of 0.01."""
    unknown = np.full(len(row), np.nan)
    labels = FrameLabels(
        range_m=grid.range_at(row),
        azimuth_rad=grid.azimuth_at(column),
        path_class=np.array(path_class, np.uint8),
        order=unknown,
        hidden_xy_m=np.full((len(row), 2), np.nan),
        power_mw=unknown,
        object_index=unknown,
        object_class=np.full(len(row), ""),
    )
    return Scan(
        index=index,
        profiles=None,
        values=values.astype(np.complex64),
        noise_power_mw=1e-4,
        missing_beams=(),
        labels=labels,
    )
