"""Inference with the object network on the vehicle: an ONNX file and the card that describes it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from models.perception.cards import card_path, learned_path, read_card
from models.perception.detection.score_calibration import ScoreTable, calibrated, check_table, score_of
from models.perception.evidence.wall_memory import WallMemory
from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import wall_arrays
from models.perception.geometry.stage import GeometryParams, direct_structure, made_up_peaks
from models.perception.geometry.walls import WallParams
from models.perception.objects.answers import ANSWERS, CENTRE, HEADING, PLACE, detections, hidden_objects
from models.perception.objects.encoding import BINS, ObjectEncoding, encode_objects
from models.perception.objects.hypotheses import HYPOTHESES
from models.perception.objects.radial_speed import radial_speeds
from models.perception.onnx_session import ArraySession
from models.perception.trained_radar import TrainedRadar, require_grid
from msgs.values.arrays import require_within
from msgs.values.perception import HiddenObject, Peaks, Wall
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

Said = TypeVar("Said")

#: The network in use where parameters say `default`.
DEFAULT_OBJECTS = learned_path("object_unet", ".onnx")
#: Answers of a hypothesis that change sign when left and right are exchanged.
_ODD_ANSWERS = [PLACE.stop - 1, HEADING.stop - 1, CENTRE.stop - 1]


class ObjectCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of an object network file: how it was made, its input, its scores; a JSON file beside it."""

    name: str
    sha256: str
    parameters: int
    encoding: ObjectEncoding
    #: Radar of the maps in training.
    radar: TrainedRadar = TrainedRadar()
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    #: Least probability that is reported: that of the least loss on the validation scans.
    threshold: float
    #: From answers to the share of such reports that are a hidden object within a metre, with the flip test: of
    #: validation scans of a vehicle at rest, and of one that moves.
    calibration: ScoreTable
    calibration_moving: ScoreTable = ()
    #: On the validation scans, which chose epoch, threshold and calibration.
    scores: dict[str, float]
    #: Data sets of training and validation, and the detector.
    data: dict[str, str]
    #: Chosen epoch and the resolved configuration of the run.
    training: dict[str, Any]

    def __post_init__(self) -> None:
        check_table("card.calibration", self.calibration)
        check_table("card.calibration_moving", self.calibration_moving)
        require_within("card.threshold", 0.0, 1.0, self.threshold)
        _, rows, columns = self.encoding.shape
        expected = {"input": (1, *self.encoding.shape), "output": (1, HYPOTHESES * ANSWERS, rows, columns)}
        for end, shape in expected.items():
            if getattr(self, f"{end}_shape") != shape:
                raise ValueError(f"card.{end}_shape must be {shape}, got {getattr(self, f'{end}_shape')}")

    def calibration_of(self, moving: bool) -> ScoreTable:
        """Return the table for a vehicle that moves or does not; that at rest where no other could be fitted."""
        return self.calibration_moving if moving and self.calibration_moving else self.calibration


def load_object_card(model_path: Path) -> ObjectCard:
    """Read the card of an object network; raises `ValueError` naming the file and the field that is wrong."""
    return read_card(card_path(model_path), ObjectCard)


class ObjectPredictor:
    """An object network under ONNX Runtime: what a scan hides, by its map, its peaks and the walls in them.

    Session and kernels are warm when the constructor returns. `threshold`: least probability that is reported; None:
    the card's. The network looks at a scan or at its mirror image, by `Encoding.is_turned`, so that a mirrored scan
    gives mirrored objects; `flip_test` takes the mean of both looks.

    Raises `ValueError` when the file, its card and its shapes do not belong together.
    """

    def __init__(
        self,
        model_path: Path = DEFAULT_OBJECTS,
        threads: int = 1,
        threshold: float | None = None,
        flip_test: bool = False,
    ) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._path = Path(model_path)
        self.card = load_object_card(self._path)
        self.threshold = self.card.threshold if threshold is None else threshold
        require_within("threshold", 0.0, 1.0, self.threshold)
        shapes = self.card.input_shape, self.card.output_shape
        self._session = ArraySession(self._path, self.card.sha256, threads, *shapes)
        self._odd_channels, self._flip_test = self.card.encoding.odd_channels, flip_test
        self._warm()

    @property
    def walls(self) -> WallParams:
        """How the walls are fitted that it judges by."""
        return self.card.encoding.walls

    def suits(self, ra_map: RangeAzimuthMap) -> bool:
        """Return whether the network was trained on maps of this kind."""
        return ra_map.grid == self.card.encoding.grid and ra_map.mode != "photons"

    def _warm(self) -> None:
        """Judge a synthetic street in a map without echoes: kernels that a scan compiles would make its node hang."""
        grid = self.card.encoding.grid
        silent = silent_map(grid)
        peaks = made_up_peaks()
        returns, walls = direct_structure(peaks, GeometryParams(walls=self.card.encoding.walls))
        self.judge(silent, peaks, walls, returns)()

    def judge(
        self,
        ra_map: RangeAzimuthMap,
        peaks: Peaks,
        walls: list[Wall],
        returns: DirectReturns,
        moving: bool = False,
        memory: WallMemory | None = None,
    ) -> Callable[[], tuple[HiddenObject, ...]]:
        """Let the network begin with a scan; the function returned waits for its hidden objects, likeliest first.

        Scores are probabilities where the card says how, of a vehicle that is `moving` or not. The network runs in a
        thread of its own, beside what the caller does until it waits.

        Raises `ValueError` for a map that does not suit the network, and for answers that are not finite.
        """
        require_grid(self.card.name, self.card.encoding.grid, ra_map.grid)
        if not self.suits(ra_map):
            raise ValueError(f"map.mode must be of a radar for {self.card.name}, got {ra_map.mode}")
        cells, hypotheses = encode_objects(self.card.encoding, ra_map, peaks, walls, returns)
        answer = begun(partial(self.answer, cells))
        table = self.card.calibration_of(moving)
        least = score_of(table, self.threshold)

        def objects() -> tuple[HiddenObject, ...]:
            reports = detections(answer(), hypotheses, self.card.encoding.cells, wall_arrays(walls), least)
            reports = replace(reports, score=calibrated(table, reports.score))
            return hidden_objects(reports, ra_map.stamps_at(reports.azimuth_rad), radial_speeds(reports, ra_map))

        return objects

    def answer(self, cells: np.ndarray) -> np.ndarray:
        """Return the network's answer to one input [channels, rows, columns]."""
        if self._flip_test:
            return 0.5 * (self.look(cells) + self._mirrored(cells))
        encoding = self.card.encoding
        of_map = cells[: BINS * len(encoding.levels.channels)].reshape(-1, BINS, *cells.shape[1:])
        return self._mirrored(cells) if encoding.levels.is_turned(of_map) else self.look(cells)

    def _mirrored(self, cells: np.ndarray) -> np.ndarray:
        """Return the answer to the mirror image, mirrored back."""
        flipped = cells[..., ::-1].copy()
        flipped[self._odd_channels] *= -1.0
        mirrored = self.look(flipped)[..., ::-1]
        answer = mirrored.reshape(HYPOTHESES, ANSWERS, *mirrored.shape[1:]).copy()
        answer[:, _ODD_ANSWERS] *= -1.0
        return answer.reshape(mirrored.shape)

    def look(self, cells: np.ndarray) -> np.ndarray:
        """Return what the network says of one input as it is; ValueError for what is not finite."""
        return self._session.answer(cells)


def silent_map(grid: RangeAzimuthGrid) -> RangeAzimuthMap:
    """Return a map without echoes."""
    return RangeAzimuthMap(
        stamp_ns=0,
        scan_id=0,
        grid=grid,
        values=np.full(grid.shape, 1e-9, np.complex64),
        azimuth_stamp_ns=np.zeros(grid.azimuth_bins, np.int64),
        noise_power_mw=1e-14,
        incoherent=np.zeros(grid.range_bins, bool),
    )


def begun(work: Callable[[], Said]) -> Callable[[], Said]:
    """Begin `work` in a thread of its own; the function returned waits for its answer, or raises its error.

    A pool is as short-lived as its thread, which a process that is forked later would lack.
    """
    pool = ThreadPoolExecutor(1, "object-network")
    future = pool.submit(work)
    pool.shutdown(wait=False)
    return future.result
