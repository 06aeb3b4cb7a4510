"""A corner worked out by hand: a wall across the road at x = 12 m, another along it at y = 10 m."""

from __future__ import annotations

import numpy as np

from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import WallArrays
from models.perception.objects.encoding import ObjectEncoding
from models.perception.objects.hypotheses import CellHypotheses, cell_hypotheses

ENCODING = ObjectEncoding()
GRID = ENCODING.cells
#: Facing the radar: x = 12 from y = -10 to 10, y = 10 from x = 0 to 12.
ACROSS, ALONG = 0, 1


def walls(*chosen: int) -> WallArrays:
    both = WallArrays(
        normal=np.array([[-1.0, 0.0], [0.0, -1.0]]),
        offset_m=np.array([12.0, 10.0]),
        a=np.array([[12.0, -10.0], [0.0, 10.0]]),
        b=np.array([[12.0, 10.0], [12.0, 10.0]]),
        angle_std_rad=np.zeros(2),
        offset_std_m=np.zeros(2),
        curvature_per_m=np.zeros(2),
    )
    return both.take(np.array(chosen or (ACROSS, ALONG)))


def returns() -> DirectReturns:
    """One return on the wall across, at its foot."""
    return DirectReturns(np.array([[12.0, 0.0]]), np.array([40.0]), np.zeros(1, int), np.zeros(1, int))


def hypotheses(of: WallArrays, level: np.ndarray | None = None, scores: np.ndarray | None = None) -> CellHypotheses:
    shape = len(GRID.range_m), len(GRID.azimuth_rad)
    level = np.zeros(shape) if level is None else level
    return cell_hypotheses(GRID, of, returns(), level, np.zeros((2, *shape)) if scores is None else scores)


def cell(x_m: float, y_m: float) -> tuple[int, int]:
    """Row and column of the cell that holds a position."""
    row = np.abs(GRID.range_m - np.hypot(x_m, y_m)).argmin()
    return int(row), int(np.abs(GRID.azimuth_rad - np.arctan2(y_m, x_m)).argmin())


def centre(row: int, column: int) -> np.ndarray:
    """Position of a cell's centre."""
    azimuth_rad = GRID.azimuth_rad[column]
    return GRID.range_m[row] * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
