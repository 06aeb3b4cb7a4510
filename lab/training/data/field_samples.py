"""Training samples of the field network: encoded maps, the wall that each direction meets first, and all returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.training.data.frames import Frame
from models.perception.find.encoding import Encoding, encode_map
from models.perception.see.wall_elements import MAX_INCIDENCE_RAD
from models.physics.mirror import crossing_parameters
from msgs.values.array_table import ArrayTable
from msgs.values.environment import PriorWall

#: Shorter walls stand for no mirror.
LEAST_LENGTH_M = 0.4


@dataclass(frozen=True)
class FirstWalls(ArrayTable):
    """Where each azimuth first meets a wall, [N]: range (infinite: nowhere), angle from the ray to the wall's foot."""

    range_m: np.ndarray
    angle_rad: np.ndarray


def first_walls(walls: Sequence[PriorWall], azimuth_rad: np.ndarray) -> FirstWalls:
    """Return the walls, in the radar's frame, that rays of some azimuths [N] meet first."""
    range_m, angle_rad = np.full(len(azimuth_rad), np.inf), np.zeros(len(azimuth_rad))
    if not walls:
        return FirstWalls(range_m.astype(np.float32), angle_rad.astype(np.float32))
    ends_m = np.array([wall.ends_m for wall in walls], np.float64)
    a, along = ends_m[:, 0], ends_m[:, 1] - ends_m[:, 0]
    ray = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    # of rays a metre long, so that their shares are metres
    away_m, share = crossing_parameters(np.zeros(2), ray, a, ends_m[:, 1])
    long_enough = np.hypot(*along.T) > LEAST_LENGTH_M
    met = (away_m > 0.2) & (share >= 0.0) & (share <= 1.0) & long_enough
    away_m = np.where(met, away_m, np.inf)
    first = away_m.argmin(axis=1)
    range_m = away_m[np.arange(len(first)), first]
    normal = np.stack([along[first, 1], -along[first, 0]], axis=1) / np.hypot(*along[first].T)[:, None]
    normal *= np.where(np.sum(normal * ray, axis=1) < 0.0, -1.0, 1.0)[:, None]
    angle_rad = np.arctan2(ray[:, 0] * normal[:, 1] - ray[:, 1] * normal[:, 0], np.sum(ray * normal, axis=1))
    angle_rad = np.clip(angle_rad, -MAX_INCIDENCE_RAD, MAX_INCIDENCE_RAD)
    return FirstWalls(range_m.astype(np.float32), angle_rad.astype(np.float32))


@dataclass(frozen=True)
class Returns(ArrayTable):
    """Returns of a map, N of them: row, column, and `PathClass`; int64 [N]."""

    row: np.ndarray
    column: np.ndarray
    path_class: np.ndarray


def field_sample(frame: Frame, encoding: Encoding) -> tuple[np.ndarray, FirstWalls, Returns]:
    """Return the network's input, float16 [channels, range, columns], the first wall of each azimuth of the map, and
    the returns in it.
    """
    grid, labels = frame.ra_map.grid, frame.labels
    cells = encode_map(encoding, frame.ra_map).astype(np.float16)
    row = np.rint(grid.range_index(labels.range_m)).astype(np.int64)
    column = np.rint(grid.azimuth_index(labels.azimuth_rad)).astype(np.int64)
    inside = np.flatnonzero((row >= 0) & (row < encoding.range_bins) & (column >= 0) & (column < grid.azimuth_bins))
    returns = Returns(row[inside], column[inside], labels.path_class[inside].astype(np.int64))
    return cells, first_walls(frame.walls, grid.azimuth_at(np.arange(grid.azimuth_bins))), returns
