"""Inference with the evidence network on the vehicle: an ONNX file and the card that describes it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, TypeVar

import msgspec
import numpy as np

from models.perception.cards import learned_path
from models.perception.find.score_calibration import ScoreTable, calibrated, check_table
from models.perception.mirrors.mirror_table import WallArrays
from models.perception.mirrors.observability import visibility_at
from models.perception.mirrors.peaks_to_view import GeometryParams, WithPriors, direct_structure, synthetic_peaks
from models.perception.mirrors.walls import WallParams
from models.perception.onnx_session import ArrayCard, ArraySession
from models.perception.see.candidate_predictor import (
    ODD_ANSWERS,
    CandidatePredictor,
    candidate_inputs,
    corrected,
)
from models.perception.see.detections import ANSWERS, hidden_objects
from models.perception.see.evidence_answers import (
    ROUNDING,
    Candidates,
    candidates,
    evidence_detections,
    least_answer,
    shifted,
)
from models.perception.see.field_predictor import DEFAULT_FIELDS, FieldPredictor
from models.perception.see.radial_speed import radial_speeds
from models.perception.see.scan_evidence import EvidenceEncoding, scan_evidence
from models.perception.see.wall_memory import WallMemory
from models.perception.trained_radar import require_grid
from msgs.values.arrays import require_finite, require_within
from msgs.values.perception import BevGrid, HiddenObject, Wall
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

Answer = TypeVar("Answer")

#: The network in use where parameters say `default`.
DEFAULT_EVIDENCE = learned_path("evidence_unet.int8")


class EvidenceCard(ArrayCard, frozen=True, kw_only=True):
    """Description of an evidence network file."""

    formerly: ClassVar[dict[str, str]] = {
        "encoding.growth": "models.perception.see.wall_elements",
        "encoding.walls": "models.perception.mirrors.walls",
        "encoding.walls.arcs": "models.perception.mirrors.arcs",
    }

    encoding: EvidenceEncoding
    #: Least probability that is reported: that of the least loss on the validation scans.
    threshold: float = 0.3
    #: From answers to the share of such reports that are a hidden object within a metre, of validation scans of a
    #: vehicle at rest, and of one that moves.
    calibration: ScoreTable = ()
    calibration_moving: ScoreTable = ()
    #: Added to the logit of a probability by what the view's mask (`Visibility`) says of the place: unknown, in direct
    #: sight, seen in a mirror. The mask knows fitted walls alone: a second witness beside the network's own.
    visibility_logits: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_table("card.calibration", self.calibration)
        require_finite("card.visibility_logits", *self.visibility_logits)
        check_table("card.calibration_moving", self.calibration_moving)
        require_within("card.threshold", 0.0, 1.0, self.threshold)
        self.check_shapes(input=(1, *self.encoding.shape), output=(1, ANSWERS, *self.encoding.grid.shape))

    def calibration_of(self, moving: bool) -> ScoreTable:
        """Return the table for a vehicle that moves or does not; that at rest where no other could be fitted."""
        return self.calibration_moving if moving and self.calibration_moving else self.calibration


class EvidencePredictor:
    """A field, an evidence and a candidate network under ONNX Runtime: what a scan hides, by its map and walls.

    `threshold`: least probability reported; None: the card's. The first two look at the louder side's way, with
    `flip_test` both. A card that names no candidate network has none. `ValueError` when files, cards and shapes do not
    belong together.
    """

    def __init__(
        self,
        model_path: Path = DEFAULT_EVIDENCE,
        threads: int = 1,
        threshold: float | None = None,
        flip_test: bool = False,
    ) -> None:
        path = Path(model_path)
        self._session = ArraySession(path, EvidenceCard, threads)
        self.card = self._session.card
        self.threshold = self.card.threshold if threshold is None else threshold
        require_within("threshold", 0.0, 1.0, self.threshold)
        #: File of the field network, beside this one.
        self.fields_path = path.with_name(self.card.data.get("fields", DEFAULT_FIELDS.name))
        self._fields = FieldPredictor(self.fields_path, threads, flip_test)
        self._flip_test = flip_test
        self._check("field", self._fields.card.sha256, self.card.data.get("fields_sha256"))
        self._second_look: CandidatePredictor | None = None
        if name := self.card.data.get("candidates"):
            self._second_look = CandidatePredictor(path.with_name(name), threads)
            self._check("candidate", self._second_look.card.sha256, self.card.data.get("candidates_sha256"))
            if self._second_look.card.encoding.evidence != self.card.encoding:
                raise ValueError(f"{path.with_name(name)}: encoding.evidence must be that of {path}")
        #: The newest map that peaks are awaited for, and what waits for its field answer.
        self._expected: tuple[RangeAzimuthMap, Callable[[], np.ndarray]] | None = None
        silent = silent_map(self.grid)
        _, walls = direct_structure(synthetic_peaks(), GeometryParams(walls=self.walls))
        self.judge(silent, walls)()

    def _check(self, kind: str, actual: str, wanted: str | None) -> None:
        """Raise `ValueError` for a network beside this one that has not the checksum of its card, if it says one."""
        if wanted not in (None, actual):
            raise ValueError(
                f"{self.card.name}: {kind} network must have the sha256 {wanted} of its card, got {actual}"
            )

    @property
    def walls(self) -> WallParams:
        """How the walls are fitted that its own walls join."""
        return self.card.encoding.walls

    @property
    def grid(self) -> RangeAzimuthGrid:
        """Cells of the maps that it answers."""
        return self._fields.card.grid

    def suits(self, ra_map: RangeAzimuthMap) -> bool:
        """Return whether the networks were trained on maps of this kind."""
        return ra_map.grid == self.grid and ra_map.mode != "photons"

    def expect(self, ra_map: RangeAzimuthMap) -> None:
        """Let the field network begin with a map while its peaks are found elsewhere; other maps are passed over."""
        if self.suits(ra_map):
            self._expected = ra_map, begun(partial(self._fields.answer, ra_map))

    def judge(
        self,
        ra_map: RangeAzimuthMap,
        walls: list[Wall],
        with_priors: WithPriors | None = None,
        moving: bool = False,
        memory: WallMemory | None = None,
        threshold: float | None = None,
    ) -> Callable[..., tuple[HiddenObject, ...]]:
        """Let the networks begin with a scan; the function returned waits for its hidden objects, likeliest first.

        It takes the view's observability mask and its grid, or neither. Walls of earlier scans count where a memory is
        given, those of a map by `with_priors`. Scores are probabilities of a vehicle that is `moving` or not;
        `threshold`: in place of its own.
        `ValueError` for a map that does not suit, and for answers that are not finite.
        """
        if not self.suits(ra_map):
            require_grid(self.card.name, self.grid, ra_map.grid)
            raise ValueError(f"map.mode must be of a radar for {self.card.name}, got {ra_map.mode}")
        threshold = self.threshold if threshold is None else threshold
        likely = begun(partial(self._objects, ra_map, walls, with_priors, moving, memory, threshold))
        return partial(self._reported, likely, threshold)

    def _reported(
        self,
        likely: Callable[[], tuple[HiddenObject, ...]],
        threshold: float,
        mask: np.ndarray | None = None,
        grid: BevGrid | None = None,
    ) -> tuple[HiddenObject, ...]:
        """Wait for what is likely, and return what still is once the view's mask is known."""
        objects = likely()
        if objects and mask is not None and grid is not None:
            states = visibility_at(mask, grid, np.array([(each.x_m, each.y_m) for each in objects]))
            logits = np.array(self.card.visibility_logits)[states]
            scores = shifted(np.array([each.score for each in objects]), logits).tolist()
            objects = tuple(
                msgspec.structs.replace(each, score=score) for each, score in zip(objects, scores, strict=True)
            )
        reached = [each for each in objects if each.score >= ROUNDING * threshold]
        reached.sort(key=lambda each: -each.score)
        return tuple(msgspec.structs.replace(each, id=index) for index, each in enumerate(reached))

    def _objects(
        self,
        ra_map: RangeAzimuthMap,
        walls: list[Wall],
        with_priors: WithPriors | None,
        moving: bool,
        memory: WallMemory | None,
        threshold: float,
    ) -> tuple[HiddenObject, ...]:
        earlier = memory.earlier() if memory else ()
        expected, fields = self._expected or (None, None)
        field_answer = fields() if fields and expected is ra_map else self._fields.answer(ra_map)
        scan = scan_evidence(self.card.encoding, ra_map, field_answer, walls, earlier, with_priors)
        if memory:
            memory.add(scan.elements)
        table = self.card.calibration_of(moving)
        least = least_answer(table, threshold, self.card.visibility_logits)
        proposals = self.candidates(scan.evidence.channels, scan.evidence.mirror, scan.arrays, least, moving)
        reports = evidence_detections(proposals, self.card.encoding.grid, scan.arrays, least)
        reports = replace(reports, score=calibrated(table, reports.score))
        return hidden_objects(reports, ra_map.stamps_at(reports.azimuth_rad), radial_speeds(reports, ra_map))

    def candidates(
        self, channels: np.ndarray, mirror: np.ndarray, walls: WallArrays, least: float, moving: bool
    ) -> Candidates:
        """Return the places that may hold an object, with what is answered of them after a second look.

        `channels` and `mirror` are those of the evidence by `walls`, of a vehicle that is `moving` or not; `least`:
        least probability by the evidence network where there is no second look, which has its own.
        """
        answer = self.answer(channels)
        if self._second_look is None:
            return candidates(answer, mirror, least)
        encoding = self._second_look.card.encoding
        proposals = encoding.candidates(answer, mirror, walls)
        inputs = candidate_inputs(encoding, proposals, walls, channels, answer, moving)
        return corrected(proposals, self._second_look.correction(inputs))

    def answer(self, channels: np.ndarray) -> np.ndarray:
        """Return the answer [answers, x, y] to evidence [channels, x, y]."""
        level = channels[1].astype(np.float64)
        half = level.shape[1] // 2
        is_turned = bool(level[:, half:].sum() > level[:, :half].sum())
        return self._session.looked(channels, partial(self._turned, channels), ODD_ANSWERS, is_turned, self._flip_test)

    def _turned(self, channels: np.ndarray) -> np.ndarray:
        flipped = channels[..., ::-1].copy()
        flipped[self.card.encoding.odd_channels] *= -1.0
        return flipped


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


def begun(work: Callable[[], Answer]) -> Callable[[], Answer]:
    """Begin `work` in a thread of its own, no pool that a fork would lack; the function returned waits for it."""
    pool = ThreadPoolExecutor(1, "evidence-network")
    future = pool.submit(work)
    pool.shutdown(wait=False)
    return future.result
