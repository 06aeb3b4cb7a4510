"""A scan's evidence: its walls by the wall network, and what the map shows of each place by them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.special import expit

from models.perception.mirrors.mirror_table import WallArrays, nearest_walls, wall_arrays
from models.perception.mirrors.peaks_to_view import WithPriors
from models.perception.mirrors.walls import WallParams
from models.perception.see.gathering import BirdsEyeGrid, Evidence, channel_names, gathered, loudest_near, odd_channels
from models.perception.see.wall_elements import (
    WALL_ANSWERS,
    WallElements,
    further_walls,
    grown_walls,
    wall_elements,
    weighed_together,
)
from msgs.values.perception import Wall
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

#: Walls that may have mirrored: weaker ones than clusters of positions can be trusted to, since the network weighs each
#: by all that it would show.
CANDIDATE_WALLS = WallParams(
    min_inliers=3,
    min_length_m=1.5,
    max_gap_m=10.0,
    max_angle_std_rad=math.radians(10.0),
    min_score=6.0,
    behind_walls=True,
)
#: Points of a wall at which its certainty is read.
CERTAINTY_POINTS = 16


class EvidenceEncoding(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the evidence network's input; travels in its card."""

    grid: BirdsEyeGrid = BirdsEyeGrid()
    #: Walls that are fitted to the direct returns beside them.
    walls: WallParams = CANDIDATE_WALLS
    #: Mirrors of a place that stand side by side.
    mirrors: int = 3
    max_walls: int = 24

    @property
    def shape(self) -> tuple[int, int, int]:
        """(channels, x, y) of one input."""
        return len(channel_names(self.mirrors)), *self.grid.shape

    @property
    def odd_channels(self) -> list[int]:
        """Channels that change sign when left and right are exchanged."""
        return odd_channels(self.mirrors)


@dataclass(frozen=True)
class ScanEvidence:
    """Walls of a scan as messages and arrays, how certain each is [walls], the elements seen, and the evidence."""

    walls: list[Wall]
    arrays: WallArrays
    certainty: np.ndarray
    elements: WallElements
    evidence: Evidence


def scan_evidence(
    encoding: EvidenceEncoding,
    ra_map: RangeAzimuthMap,
    answer: np.ndarray,
    fitted: Sequence[Wall] = (),
    earlier: Sequence[WallElements] = (),
    with_priors: WithPriors | None = None,
) -> ScanEvidence:
    """Return the evidence of a map by the field network's answer [answers, range, azimuth].

    `fitted`: walls known otherwise, which join its own; `earlier`: elements of earlier scans, each weighs the same;
    `with_priors`: corrects and extends them all by those of a map or another sensor.
    """
    elements = wall_elements(answer, ra_map.grid)
    every = weighed_together([elements, *earlier]) if earlier else elements
    grown, _ = grown_walls(every)
    walls = [*grown, *further_walls(fitted, grown)]
    walls = (with_priors(walls) if with_priors else walls)[: encoding.max_walls]
    arrays = wall_arrays(walls)
    certainty = certainties(arrays, answer, ra_map.grid)
    support = nearest_walls(every.place_m, arrays)
    heat = expit(answer[WALL_ANSWERS:])
    evidence = gathered(encoding.grid, ra_map, heat, arrays, certainty, every.place_m, support, encoding.mirrors)
    return ScanEvidence(walls, arrays, certainty, elements, evidence)


def certainties(walls: WallArrays, answer: np.ndarray, grid: RangeAzimuthGrid) -> np.ndarray:
    """Return the mean probability that an answer [`WALL_ANSWERS`, range, azimuth] gives to the line of each wall."""
    likeliest = loudest_near(answer[0], (5, 3))
    share = (np.arange(CERTAINTY_POINTS) + 0.5) / CERTAINTY_POINTS
    points_m = walls.a[:, None] + share[:, None] * (walls.b - walls.a)[:, None]
    row = np.rint(grid.range_index(np.hypot(points_m[..., 0], points_m[..., 1]))).astype(int)
    column = np.rint(grid.azimuth_index(np.arctan2(points_m[..., 1], points_m[..., 0]))).astype(int)
    inside = (row >= 0) & (row < answer.shape[1]) & (column >= 0) & (column < answer.shape[2])
    said = expit(likeliest[np.where(inside, row, 0), np.where(inside, column, 0)].astype(np.float64))
    return np.where(inside, said, 0.0).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
