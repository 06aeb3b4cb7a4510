"""Input of the object network: a map, its peaks, and what each cell would be if a wall had mirrored it."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from models.perception.detection.encoding import Encoding, encode_map
from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import wall_arrays
from models.perception.geometry.walls import WallParams
from models.perception.objects.hypotheses import (
    FEATURES,
    HYPOTHESES,
    Y_FEATURE,
    CellGrid,
    CellHypotheses,
    cell_hypotheses,
)
from msgs.values.perception import PathClass, Peaks, Wall
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

#: Channels of the peaks of one class in each cell: score of the strongest, its place along and across, in cells.
PEAK_CHANNELS = ("score", "along", "across")
#: Channels of the radial speed of a cell's loudest echo, last of all: over ground, along the ray; how surely it moves;
#: how exactly the speed is known. Zero where it is not: in noise, or where the vehicle's own motion is.
SPEED_CHANNELS = ("speed", "moves", "known")
#: Unit of speeds and their bound in it; what stands may seem to move by this, rms (odometry, sway); a speed of so many
#: standard deviations is as likely motion as not.
SPEED_MPS, SPEED_LIMIT, SWAY_MPS, MOVES_SIGMAS = 5.0, 3.0, 0.2, 3.0
#: Range bins of the map in one row of cells.
BINS = 2
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


class ObjectEncoding(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the network's input; travels in the model card."""

    #: Channels of the map itself, its range bins and columns.
    levels: Encoding = Encoding()
    grid: RangeAzimuthGrid = RangeAzimuthGrid()
    #: Which walls are fitted.
    walls: WallParams = CANDIDATE_WALLS
    #: Radial speeds are shown.
    speeds: bool = False

    def __post_init__(self) -> None:
        self.levels.check_grid(self.grid)
        if self.levels.range_bins % BINS or self.levels.pad_columns or self.levels.crop_bins is not None:
            raise ValueError(
                f"objects.levels must have a multiple of {BINS} range bins, no padding and no crop, "
                f"got {self.levels.range_bins}, {self.levels.pad_columns} and {self.levels.crop_bins}"
            )

    @property
    def map_channels(self) -> int:
        """Channels of the map and its peaks, of each range bin."""
        return len(self.levels.channels) + len(PathClass) * len(PEAK_CHANNELS)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(channels, rows, columns) of one input."""
        channels = BINS * self.map_channels + HYPOTHESES * len(FEATURES) + self.speeds * len(SPEED_CHANNELS)
        return channels, self.levels.range_bins // BINS, self.levels.columns

    @property
    def cells(self) -> CellGrid:
        """Centres of the cells: a row is two range bins, a column the middle of its azimuths."""
        rows, width = self.shape[1], self.grid.azimuth_bins // self.levels.columns
        range_m = self.grid.range_at(BINS * np.arange(rows) + 0.5 * (BINS - 1))
        azimuth_rad = self.grid.azimuth_at(width * np.arange(self.levels.columns) + 0.5 * (width - 1))
        return CellGrid(range_m, azimuth_rad)

    @property
    def odd_channels(self) -> list[int]:
        """Channels that change sign when left and right are exchanged."""
        count = len(self.levels.channels)
        across = PEAK_CHANNELS.index("across")
        of_map = [count + len(PEAK_CHANNELS) * k + across for k in range(len(PathClass))]
        of_map += [index for index, name in enumerate(self.levels.channels) if name == "azimuth"]
        first = BINS * self.map_channels + Y_FEATURE
        of_hypotheses = [first + len(FEATURES) * k for k in range(HYPOTHESES)]
        return sorted(BINS * index + half for index in of_map for half in range(BINS)) + of_hypotheses


def encode_objects(
    encoding: ObjectEncoding, ra_map: RangeAzimuthMap, peaks: Peaks, walls: list[Wall], returns: DirectReturns
) -> tuple[np.ndarray, CellHypotheses]:
    """Return the network's input, float32 [channels, rows, columns], and the hypotheses of its cells."""
    levels = encode_map(encoding.levels, ra_map)
    drawn = drawn_peaks(encoding, peaks)
    scores = _strongest_of_row(drawn[:: len(PEAK_CHANNELS)])
    channels, rows, columns = encoding.shape
    # written where they are read: arrays of this size cost more to come by than to fill
    cells = np.empty((channels, rows, columns), np.float32)
    of_map = cells[: BINS * encoding.map_channels].reshape(-1, BINS, rows, columns)
    for part, source in ((of_map[: len(levels)], levels), (of_map[len(levels) :], drawn)):
        part[:] = source.reshape(-1, rows, BINS, columns).transpose(0, 2, 1, 3)
    if encoding.speeds:
        cells[-len(SPEED_CHANNELS) :] = speed_channels(encoding, ra_map)
    features = cells[BINS * encoding.map_channels :][: HYPOTHESES * len(FEATURES)]
    features = features.reshape(HYPOTHESES, len(FEATURES), rows, columns)
    level = _strongest_of_row(levels[0])
    return cells, cell_hypotheses(encoding.cells, wall_arrays(walls), returns, level, scores, features)


def drawn_peaks(encoding: ObjectEncoding, peaks: Peaks) -> np.ndarray:
    """Return the peaks as channels on range bins and columns, float32 [classes * 3, range, columns]; those of a cell
    with a stronger one are not drawn.
    """
    bins, columns = encoding.levels.range_bins, encoding.levels.columns
    channels = np.zeros((len(PathClass), len(PEAK_CHANNELS), bins, columns), np.float32)
    step_rad = float(np.diff(encoding.cells.azimuth_rad[:2])[0])
    order = np.argsort(peaks.score, kind="stable")
    row = encoding.grid.range_index(peaks.range_m[order])
    column = (peaks.azimuth_rad[order] - encoding.cells.azimuth_rad[0]) / step_rad
    at_row, at_column = np.rint(row).astype(int), np.clip(np.rint(column), 0, columns - 1).astype(int)
    inside = np.flatnonzero(at_row < bins)
    at = peaks.path_class[order][inside], slice(None), at_row[inside], at_column[inside]
    drawn = np.stack([peaks.score[order], row - at_row, column - at_column], axis=1)
    # in order of their scores: the last one written to a cell is the strongest
    channels[at] = drawn[inside]
    return channels.reshape(-1, bins, columns)


def speed_channels(encoding: ObjectEncoding, ra_map: RangeAzimuthMap) -> np.ndarray:
    """Return the radial speeds of a map's cells, float32 [`SPEED_CHANNELS`, rows, columns]."""
    _, rows, columns = encoding.shape
    channels = np.zeros((len(SPEED_CHANNELS), rows, columns), np.float32)
    if ra_map.radial_speed_cmps is None or not ra_map.ego_compensated:
        return channels
    bins = encoding.levels.range_bins
    speed_mps = _in_cells(ra_map.radial_speed_mps((slice(bins),)), rows, columns)
    values = _in_cells(ra_map.values[:bins], rows, columns)
    heard_mw = np.where(np.isfinite(speed_mps), values.real**2 + values.imag**2, 0.0)
    loudest = heard_mw.argmax(axis=-1)[..., None]
    power_mw, speed_mps = (
        np.take_along_axis(of_cells, loudest, axis=-1)[..., 0].astype(np.float64) for of_cells in (heard_mw, speed_mps)
    )
    known = power_mw > 0.0
    speed_mps, power_mw = speed_mps[known], power_mw[known]
    std_mps = np.hypot(ra_map.radial_speed_unit_std_mps * np.sqrt(ra_map.noise_power_mw / power_mw), SWAY_MPS)
    # of the variance that motion and errors together have, the share of motion
    moves = 1.0 / (1.0 + (MOVES_SIGMAS * std_mps) ** 2 / np.maximum(speed_mps**2, 1e-6))
    channels[:, known] = np.clip(speed_mps / SPEED_MPS, -SPEED_LIMIT, SPEED_LIMIT), moves, SWAY_MPS / std_mps
    return channels


def _in_cells(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return the bins and azimuths [range, azimuth] of each cell [rows, columns, of a cell]."""
    cells = values.reshape(rows, BINS, columns, -1).transpose(0, 2, 1, 3)
    return cells.reshape(rows, columns, -1)


def _strongest_of_row(values: np.ndarray) -> np.ndarray:
    """Return the larger of the two range bins of each row [..., rows, columns]."""
    return values.reshape(*values.shape[:-2], -1, BINS, values.shape[-1]).max(axis=-2)
