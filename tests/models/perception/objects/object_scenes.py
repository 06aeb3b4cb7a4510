"""A corner worked out by hand: a wall across the road at x = 12 m, another along it at y = 10 m."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import WallArrays
from models.perception.objects.answers import ANSWERS, CLASS, CLASSES
from models.perception.objects.encoding import BINS, PEAK_CHANNELS, ObjectEncoding
from models.perception.objects.hypotheses import HYPOTHESES, CellHypotheses, cell_hypotheses
from models.perception.objects.predictor import ObjectCard
from models.training.export.onnx import write_card, write_onnx
from models.training.files import file_sha256
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthMap, speed_codes

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


def object_network(path: Path, gain: float = 40.0) -> Path:
    """Write a network that calls every peak of an image an object by its first hypothesis, exactly where the cell's
    centre is, as a car, with a standard deviation of 1 m; with `gain` 0 it sees nothing.
    """
    channels, rows, columns = ENCODING.shape
    layer = torch.nn.Conv2d(channels, HYPOTHESES * ANSWERS, 1)
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        layer.bias[::ANSWERS] = -10.0
        first = BINS * (len(ENCODING.levels.channels) + len(PEAK_CHANNELS) * PathClass.MIRRORED)
        layer.weight[0, first : first + BINS] = gain
        layer.bias[CLASS.start + CLASSES.index("car")] = 1.0
    write_onnx(layer, (torch.zeros(1, channels, rows, columns),), path, input_names=["cells"], output_names=["answer"])
    write_card(object_card(path), path)
    return path


def object_card(path: Path) -> ObjectCard:
    """The card of such a network."""
    _, rows, columns = ENCODING.shape
    return ObjectCard(
        name=path.stem, sha256=file_sha256(path), parameters=0, encoding=ENCODING, input_shape=(1, *ENCODING.shape),
        output_shape=(1, HYPOTHESES * ANSWERS, rows, columns), threshold=0.5, calibration=(), scores={}, data={},
        training={},
    )  # fmt: skip


def empty_map(**values: object) -> RangeAzimuthMap:
    """A map of no echoes, whose columns were measured a millisecond after each other."""
    plain = {
        "stamp_ns": 0, "scan_id": 0, "values": np.full((512, 256), 1e-9, np.complex64), "noise_power_mw": 1e-14,
        "azimuth_stamp_ns": np.arange(256) * 1_000_000, "incoherent": np.zeros(512, bool),
    }  # fmt: skip
    return RangeAzimuthMap(**plain | values)  # type: ignore[arg-type]


SPEEDS = ObjectEncoding(speeds=True)
#: A cell of the map, and the one of the network that holds it: two range bins, eight azimuths.
BIN, AZIMUTH = 101, 130
ROW, COLUMN = 50, 16
NOISE_MW, UNIT_STD_MPS = 1e-12, 8.0


def speed_map(speed_mps: float, snr_db: float = 40.0, ego_compensated: bool = True) -> RangeAzimuthMap:
    """A map with one echo that has a radial speed; around it noise without speeds."""
    values = np.full((512, 256), np.sqrt(NOISE_MW), np.complex64)
    values[BIN, AZIMUTH] = np.sqrt(NOISE_MW * 10.0 ** (snr_db / 10.0))
    speeds = np.full(values.shape, np.nan)
    speeds[BIN, AZIMUTH] = speed_mps
    return empty_map(
        values=values,
        noise_power_mw=NOISE_MW,
        ego_compensated=ego_compensated,
        radial_speed_cmps=speed_codes(speeds),
        radial_speed_unit_std_mps=UNIT_STD_MPS,
    )
