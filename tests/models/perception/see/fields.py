"""Answers that a perfect field network would give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.training.data.field_samples import first_walls
from models.perception.see.field_predictor import FIELD_ANSWERS
from models.perception.see.wall_elements import BEYOND_M
from msgs.values.environment import PriorWall
from msgs.values.radar import RangeAzimuthGrid

GRID, BINS = RangeAzimuthGrid(), 320
AZIMUTH_RAD = GRID.azimuth_at(np.arange(GRID.azimuth_bins))

Ends = tuple[tuple[float, float], tuple[float, float]]


def walls_of(*ends_m: Ends) -> list[PriorWall]:
    return [PriorWall(ends_m=ends, offset_std_m=0.01, angle_std_rad=0.001, end_std_m=0.05) for ends in ends_m]


def perfect_answer(walls: Sequence[PriorWall]) -> np.ndarray:
    """Every cell within 0.3 m of the first wall of its direction says so, and how it lies to it."""
    first = first_walls(walls, AZIMUTH_RAD)
    met_m = np.where(np.isfinite(first.range_m), first.range_m, 1e3)
    beyond_m = (GRID.range_at(np.arange(BINS))[:, None] - met_m) * np.cos(first.angle_rad)
    answer = np.full((FIELD_ANSWERS, BINS, GRID.azimuth_bins), -8.0, np.float32)
    answer[0] = np.where(np.abs(beyond_m) <= 0.3, 5.0 - 3.0 * np.abs(beyond_m), -8.0)
    answer[1] = np.clip(beyond_m, -1.0, 1.0) / BEYOND_M
    answer[2], answer[3] = np.cos(first.angle_rad), np.sin(first.angle_rad)
    return answer
