"""Radial speeds of detected objects: that of the loudest cell of the image, along the ray as the mirrors turn it."""

from __future__ import annotations

import numpy as np

from models.perception.see.detections import Detections
from msgs.values.perception import RadialSpeed
from msgs.values.radar import RangeAzimuthMap

#: The image's loudest cell lies at most so many range bins and azimuth cells from the place said of it.
REACH_BINS, REACH_CELLS = 3, 2
#: Extended objects turn, step and pedal: no speed of one is surer than this.
LEAST_STD_MPS = 0.2


def radial_speeds(reports: Detections, ra_map: RangeAzimuthMap) -> list[RadialSpeed | None]:
    """Return the radial speed over ground of each detection; None where the map did not measure one."""
    if ra_map.radial_speed_cmps is None or not ra_map.ego_compensated:
        return [None] * len(reports)
    rows = np.rint(ra_map.grid.range_index(reports.range_m)).astype(np.int64)
    columns = np.rint(ra_map.grid.azimuth_index(reports.azimuth_rad)).astype(np.int64)
    return [
        _radial_speed(ra_map, int(row), int(column), float(away_rad))
        for row, column, away_rad in zip(rows, columns, reports.away_rad, strict=True)
    ]


def _radial_speed(ra_map: RangeAzimuthMap, row: int, column: int, away_rad: float) -> RadialSpeed | None:
    """Return the radial speed of the loudest cell about one; None where that is noise or outside the map."""
    first_row, first_column = max(row - REACH_BINS, 0), max(column - REACH_CELLS, 0)
    near = np.s_[first_row : max(row + REACH_BINS + 1, 0), first_column : max(column + REACH_CELLS + 1, 0)]
    speed_mps = ra_map.radial_speed_mps(near)
    level = np.where(np.isfinite(speed_mps), np.abs(ra_map.values[near]), 0.0)
    if not level.size or not level.max() > 0.0:
        return None
    loudest = np.unravel_index(int(level.argmax()), level.shape)
    std_mps = ra_map.radial_speed_unit_std_mps * np.sqrt(ra_map.noise_power_mw) / float(level[loudest])
    return RadialSpeed(
        azimuth_rad=away_rad,
        speed_mps=float(speed_mps[loudest]),
        std_mps=max(float(std_mps), LEAST_STD_MPS),
    )
