"""Training samples of the object network: encoded cells of a scan, and the hypotheses that lead to its hidden objects.

A hypothesis is true where an image that the labels list, folded by walls that the vehicle's own stage has found in the
map, leads to the object: the errors of those walls are part of the sample as they will be part of a drive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from models.perception.detection.detectors import Detector
from models.perception.geometry.mirrors import WallArrays, mirrors_met, wall_arrays
from models.perception.geometry.stage import GeometryParams, WallPrior, direct_structure
from models.perception.objects.answers import CLASSES
from models.perception.objects.encoding import ObjectEncoding, encode_objects
from models.perception.objects.hypotheses import HYPOTHESES, CellGrid, CellHypotheses
from models.perception.tracking.wall_priors import WallPriorStore
from models.physics.mirror import reflect
from models.training.data.frames import FrameLabels
from msgs.values.array_table import ArrayTable
from msgs.values.environment import PriorWall, WallPriors
from msgs.values.frames import Pose2, polar_from_xy, xy_from_polar
from msgs.values.perception import PathClass, TruthObject
from msgs.values.radar import RangeAzimuthMap

#: A labelled image belongs to a hypothesis whose walls fold it to within this of the labelled point's image.
RANGE_GATE_M, AZIMUTH_GATE_RAD = 1.5, math.radians(7.0)
#: Widths of the target around a true cell, in rows and columns, and how far it reaches.
SPREAD_CELLS, REACH_CELLS = (1.2, 0.6), (3, 1)


@dataclass(frozen=True)
class ObjectTargets(ArrayTable):
    """True hypotheses of one scan, N of them."""

    #: Which hypothesis, row, column; int64 [N, 3].
    at: np.ndarray
    #: Number of the object in the scan's truth, and its class.
    number: np.ndarray
    object_class: np.ndarray
    #: float32 [N, 2]: position within the image, along and across the ray of the cell; logarithms of length and width;
    #: cosine and sine of twice the heading against the ray; from that position to the centre of the box.
    place_m: np.ndarray
    log_size: np.ndarray
    heading: np.ndarray
    centre_m: np.ndarray


@dataclass(frozen=True)
class ObjectSample:
    """One scan: float16 input [channels, rows, columns], walls of each hypothesis int16 [K, R, C], true hypotheses."""

    cells: np.ndarray
    wall: np.ndarray
    second: np.ndarray
    targets: ObjectTargets

    def flipped(self, odd_channels: Sequence[int]) -> ObjectSample:
        """Return the same scan with left and right exchanged."""
        cells = self.cells[..., ::-1].copy()
        cells[list(odd_channels)] *= -1
        targets, across = self.targets, np.array([1.0, -1.0], np.float32)
        at = targets.at.copy()
        at[:, 2] = cells.shape[-1] - 1 - at[:, 2]
        place_m, heading, centre_m = targets.place_m * across, targets.heading * across, targets.centre_m * across
        mirrored = ObjectTargets(at, targets.number, targets.object_class, place_m, targets.log_size, heading, centre_m)
        return ObjectSample(cells, self.wall[..., ::-1], self.second[..., ::-1], mirrored)

    def heat(self) -> np.ndarray:
        """Return the target of existence, float32 [K, R, C]: one at true hypotheses, falling off around them over cells
        with the same walls.
        """
        heat = np.zeros(self.wall.shape, np.float32)
        _, rows, columns = self.wall.shape
        for which, row, column in self.targets.at.tolist():
            near = (
                slice(max(row - REACH_CELLS[0], 0), min(row + REACH_CELLS[0] + 1, rows)),
                slice(max(column - REACH_CELLS[1], 0), min(column + REACH_CELLS[1] + 1, columns)),
            )
            off_row = (np.arange(rows)[near[0]] - row) / SPREAD_CELLS[0]
            off_column = (np.arange(columns)[near[1]] - column) / SPREAD_CELLS[1]
            bump = np.exp(-0.5 * (off_row[:, None] ** 2 + off_column**2))
            same = self.wall[which][near] == self.wall[which, row, column]
            same &= self.second[which][near] == self.second[which, row, column]
            heat[which][near] = np.maximum(heat[which][near], np.where(same, np.minimum(bump, 0.99), 0.0))
        heat[tuple(self.targets.at.T)] = 1.0
        return heat


class SampleMaker:
    """Makes samples of maps with their truth by the detector and walls of the vehicle."""

    def __init__(self, encoding: ObjectEncoding, detector: Detector) -> None:
        self.encoding, self._detector, self._geometry = encoding, detector, GeometryParams(walls=encoding.walls)

    def sample(
        self,
        ra_map: RangeAzimuthMap,
        labels: FrameLabels,
        truth: Sequence[TruthObject],
        known_walls: Sequence[PriorWall] = (),
    ) -> tuple[ObjectSample, WallArrays]:
        """Return the sample of one map, in which objects that are not `hidden` are no targets, and its walls: those in
        the map, fused with those known of its place.
        """
        peaks = self._detector.detect(ra_map)
        returns, walls = direct_structure(peaks, self._geometry, _wall_prior(known_walls))
        cells, hypotheses = encode_objects(self.encoding, ra_map, peaks, walls, returns)
        arrays = wall_arrays(walls)
        elapsed_s = 1e-9 * (ra_map.stamps_at(labels.azimuth_rad) - ra_map.stamp_ns)
        targets = true_hypotheses(hypotheses, self.encoding.cells, arrays, labels, truth, elapsed_s)
        return ObjectSample(cells.astype(np.float16), hypotheses.wall, hypotheses.second, targets), arrays


def _wall_prior(walls: Sequence[PriorWall]) -> WallPrior | None:
    """Return the fusion with walls known in the radar's frame, as a view of one scan makes it; None without any."""
    if not walls:
        return None
    store = WallPriorStore()
    store.add(WallPriors(stamp_ns=0, source="map", walls=tuple(walls)))
    return partial(store.fused, store.at(0, lambda stamp_ns: None, Pose2()))


def true_hypotheses(
    hypotheses: CellHypotheses,
    grid: CellGrid,
    walls: WallArrays,
    labels: FrameLabels,
    truth: Sequence[TruthObject],
    elapsed_s: np.ndarray,
) -> ObjectTargets:
    """Return the hypotheses by whose walls a labelled image of a hidden object leads to it; `elapsed_s` [labels] is
    how long after the truth each label was measured.
    """
    rows = []
    for number, true_object in enumerate(truth):
        images = (labels.object_index == number) & (labels.path_class == PathClass.MIRRORED)
        if not true_object.hidden or not images.any() or true_object.object_class not in CLASSES:
            continue
        for which in range(HYPOTHESES):
            for mirrors in _mirrors(hypotheses, which):
                image = _Image.of(true_object, labels, images, mirrors, walls, elapsed_s)
                at = None if image is None else image.cell(grid)
                if image is not None and at is not None and _has(hypotheses, which, at, mirrors):
                    rows.append((which, *at, number, CLASSES.index(true_object.object_class), *image.values(grid, at)))
    table = np.array(rows, np.float64).reshape(-1, 13)
    values = [table[:, first : first + 2].astype(np.float32) for first in (5, 7, 9, 11)]
    return ObjectTargets(
        table[:, :3].astype(np.int64), table[:, 3].astype(np.int64), table[:, 4].astype(np.int64), *values
    )


def _mirrors(hypotheses: CellHypotheses, which: int) -> list[tuple[int, ...]]:
    """Return the walls, first one first, that some cell has for a hypothesis."""
    pairs = np.stack([hypotheses.wall[which], hypotheses.second[which]], axis=-1).reshape(-1, 2)
    return [tuple(int(wall) for wall in pair if wall >= 0) for pair in np.unique(pairs, axis=0) if pair[0] >= 0]


def _has(hypotheses: CellHypotheses, which: int, at: tuple[int, int], mirrors: tuple[int, ...]) -> bool:
    """Return whether a cell has these walls for a hypothesis."""
    row, column = at
    said = hypotheses.wall[which, row, column], hypotheses.second[which, row, column]
    return said == (mirrors[0], mirrors[1] if len(mirrors) > 1 else -1)


@dataclass(frozen=True)
class _Image:
    """Image of what some mirrors show of an object: its position, the centre and heading of its box there."""

    place_m: np.ndarray
    centre_m: np.ndarray
    heading: np.ndarray
    log_size: tuple[float, float]

    @classmethod
    def of(
        cls,
        true_object: TruthObject,
        labels: FrameLabels,
        images: np.ndarray,
        mirrors: tuple[int, ...],
        walls: WallArrays,
        elapsed_s: np.ndarray,
    ) -> _Image | None:
        """Return the mean image of the labelled points that these mirrors explain; None without one."""
        points_m = labels.hidden_xy_m[images].astype(np.float64)
        velocity_mps = np.array([true_object.velocity_x_mps, true_object.velocity_y_mps])
        centre_m = np.array([true_object.x_m, true_object.y_m]) + elapsed_s[images, None] * velocity_mps
        heading = np.tile([math.cos(true_object.yaw_rad), math.sin(true_object.yaw_rad)], (len(points_m), 1))
        seen_m = xy_from_polar(labels.range_m[images].astype(np.float64), labels.azimuth_rad[images].astype(np.float64))
        for wall in reversed(mirrors):
            normal, offset_m = mirrors_met(seen_m, np.full(len(seen_m), wall), walls)
            points_m, centre_m = reflect(points_m, normal, offset_m), reflect(centre_m, normal, offset_m)
            heading = heading - 2.0 * np.sum(heading * normal, axis=1, keepdims=True) * normal
        range_m, azimuth_rad = polar_from_xy(points_m)
        fits = np.abs(range_m - labels.range_m[images]) < RANGE_GATE_M
        fits &= np.abs(azimuth_rad - labels.azimuth_rad[images]) < AZIMUTH_GATE_RAD
        if not fits.any():
            return None
        log_size = math.log(true_object.length_m), math.log(true_object.width_m)
        return cls(points_m[fits].mean(axis=0), centre_m[fits].mean(axis=0), heading[fits].mean(axis=0), log_size)

    def cell(self, grid: CellGrid) -> tuple[int, int] | None:
        """Return the row and column of its position; None outside the grid."""
        range_m, azimuth_rad = math.hypot(*self.place_m), math.atan2(self.place_m[1], self.place_m[0])
        row = round((range_m - grid.range_m[0]) / float(grid.range_m[1] - grid.range_m[0]))
        column = round((azimuth_rad - grid.azimuth_rad[0]) / float(grid.azimuth_rad[1] - grid.azimuth_rad[0]))
        inside = 0 <= row < len(grid.range_m) and 0 <= column < len(grid.azimuth_rad)
        return (row, column) if inside else None

    def values(self, grid: CellGrid, at: tuple[int, int]) -> tuple[float, ...]:
        """Return the eight values that the network is to answer in a cell."""
        range_m, azimuth_rad = math.hypot(*self.place_m), math.atan2(self.place_m[1], self.place_m[0])
        ray = self.place_m / range_m
        axes = np.array([ray, [-ray[1], ray[0]]])
        turn_rad = 2.0 * math.atan2(*(axes @ self.heading)[::-1])
        along_m = range_m - float(grid.range_m[at[0]])
        # as `answers` reads it: the cell's own range turns an angle into metres
        across_m = max(float(grid.range_m[at[0]]), 1.0) * (azimuth_rad - float(grid.azimuth_rad[at[1]]))
        to_centre_m = axes @ (self.centre_m - self.place_m)
        return along_m, across_m, *self.log_size, math.cos(turn_rad), math.sin(turn_rad), *to_centre_m
