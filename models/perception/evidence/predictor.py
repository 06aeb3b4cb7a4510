"""Inference with the evidence network on the vehicle: an ONNX file and the card that describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from models.perception.cards import card_path, learned_path, read_card
from models.perception.detection.score_calibration import ScoreTable, check_table
from models.perception.evidence.scan_evidence import EvidenceEncoding
from models.perception.objects.answers import ANSWERS, CENTRE, HEADING, PLACE
from models.perception.onnx_session import open_session
from models.perception.trained_radar import TrainedRadar
from msgs.values.arrays import require_within

#: The network in use where parameters say `default`.
DEFAULT_EVIDENCE = learned_path("evidence_unet", ".onnx")
#: Answers that change sign when left and right are exchanged.
ODD_ANSWERS = [PLACE.stop - 1, HEADING.stop - 1, CENTRE.stop - 1]


class EvidenceCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of an evidence network file: how it was made, its input, its scores; a JSON file beside it."""

    name: str
    sha256: str
    parameters: int
    encoding: EvidenceEncoding
    #: Radar of the maps in training.
    radar: TrainedRadar = TrainedRadar()
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    #: Least probability that is reported: that of the least loss on the validation scans.
    threshold: float = 0.3
    #: From answers to the share of such reports that are a hidden object within a metre, of validation scans of a
    #: vehicle at rest, and of one that moves.
    calibration: ScoreTable = ()
    calibration_moving: ScoreTable = ()
    #: On the validation scans, which chose epoch, threshold and calibration.
    scores: dict[str, float] = {}
    #: Data sets of training and validation; detector and wall network with their SHA-256.
    data: dict[str, str] = {}
    #: Chosen epoch and the resolved configuration of the run.
    training: dict[str, Any] = {}

    def __post_init__(self) -> None:
        check_table("card.calibration", self.calibration)
        check_table("card.calibration_moving", self.calibration_moving)
        require_within("card.threshold", 0.0, 1.0, self.threshold)
        expected = {"input": (1, *self.encoding.shape), "output": (1, ANSWERS, *self.encoding.grid.shape)}
        for end, shape in expected.items():
            if getattr(self, f"{end}_shape") != shape:
                raise ValueError(f"card.{end}_shape must be {shape}, got {getattr(self, f'{end}_shape')}")

    def calibration_of(self, moving: bool) -> ScoreTable:
        """Return the table for a vehicle that moves or does not; that at rest where no other could be fitted."""
        return self.calibration_moving if moving and self.calibration_moving else self.calibration


class EvidencePredictor:
    """An evidence network under ONNX Runtime.

    It looks at the plane or at its mirror image, whichever is louder on the right, so that a mirrored scan gives
    mirrored answers. Raises `ValueError` when the file, its card and its shapes do not belong together.
    """

    def __init__(self, model_path: Path = DEFAULT_EVIDENCE, threads: int = 1) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._path = Path(model_path)
        self.card = read_card(card_path(self._path), EvidenceCard)
        self._session = open_session(self._path, self.card.sha256, threads)
        self._odd_channels = self.card.encoding.odd_channels
        expected = [self.card.input_shape, self.card.output_shape]
        actual = [tuple(tensor.shape) for tensor in (*self._session.get_inputs(), *self._session.get_outputs())]
        if actual != expected:
            raise ValueError(f"{self._path}: input and output of the network must be {expected}, got {actual}")

    def answer(self, channels: np.ndarray, turned: bool = False) -> np.ndarray:
        """Return the answer [answers, x, y] to evidence [channels, x, y]; `turned`: by its mirror image."""
        if not turned:
            return self._look(channels)
        flipped = channels[..., ::-1].copy()
        flipped[self._odd_channels] *= -1.0
        answer = self._look(flipped)[..., ::-1].copy()
        answer[ODD_ANSWERS] *= -1.0
        return answer

    def _look(self, channels: np.ndarray) -> np.ndarray:
        answer: np.ndarray = self._session.run(None, {self._session.get_inputs()[0].name: channels[None]})[0][0]
        if not np.isfinite(answer).all():
            raise ValueError(f"{self._path}: answers must be finite, got {np.extract(~np.isfinite(answer), answer)[0]}")
        return answer
