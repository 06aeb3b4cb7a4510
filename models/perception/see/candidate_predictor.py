"""A second look at the candidates of the evidence network: what it answers of each, and the evidence about its place.

The evidence network learns where objects are, cell by cell; a small network learns which of its candidates are reports
that find one, and corrects their probability. Candidates to the right are seen in a mirror, so that both sides
are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from scipy.special import expit

from models.perception.cards import card_path, read_card
from models.perception.mirrors.mirror_table import WallArrays
from models.perception.onnx_session import open_session
from models.perception.see.detections import ANSWERS, CENTRE, HEADING, OBJECT, PLACE, distinct
from models.perception.see.evidence_answers import Candidates, candidates, detections_of
from models.perception.see.gathering import PLACE_M, RANGE_M, channel_names, odd_channels
from models.perception.see.scan_evidence import EvidenceEncoding
from models.perception.trained_radar import TrainedRadar
from msgs.values.arrays import require_positive, require_within

#: Answers that change sign when left and right are exchanged.
ODD_ANSWERS = [PLACE.stop - 1, HEADING.stop - 1, CENTRE.stop - 1]
#: Facts of a candidate: what is answered of it, range and azimuth of its image, place, direction of the way on, and
#: whether the vehicle moves.
FACTS, AWAY = ANSWERS + 7, slice(ANSWERS + 4, ANSWERS + 6)
_ODD_FACTS = [*ODD_ANSWERS, ANSWERS + 1, ANSWERS + 3, ANSWERS + 5]


class CandidateEncoding(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the candidate network's input; travels in its card."""

    evidence: EvidenceEncoding = EvidenceEncoding()
    #: Least probability that the evidence network gives a candidate, and at most so many of a scan, the likeliest.
    least: float = 0.03
    most: int = 48
    #: Cells of the plane to each side of a place.
    reach: int = 3

    def __post_init__(self) -> None:
        require_within("candidates.least", 0.0, 1.0, self.least)
        for name in ("most", "reach"):
            require_positive(f"candidates.{name}", getattr(self, name))

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each input of one candidate: of `CandidateInputs`."""
        width = 2 * self.reach + 1
        return {"places": (len(channel_names(self.evidence.mirrors)) + 1, width, width), "facts": (FACTS,)}

    def candidates(self, answer: np.ndarray, mirror: np.ndarray, walls: WallArrays) -> Candidates:
        """Return the candidates of an answer [answers, x, y]: different objects, the likeliest first."""
        proposals = candidates(answer, mirror, self.least)
        reports = detections_of(proposals, self.evidence.grid, walls)
        return proposals.take(distinct(reports, np.abs(reports.place_m[:, 1]))[: self.most])


class CandidateInputs(msgspec.Struct, frozen=True):
    """What is seen of N candidates, float32: `CandidateEncoding.shapes` after the first axis; seen in a mirror [N]."""

    places: np.ndarray
    facts: np.ndarray
    mirrored: np.ndarray


class CandidateCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a candidate network file."""

    name: str
    sha256: str
    parameters: int
    encoding: CandidateEncoding
    radar: TrainedRadar = TrainedRadar()
    #: On the data sets of validation.
    scores: dict[str, float] = {}
    #: Data sets of training and validation; the evidence network that it corrects, with its SHA-256.
    data: dict[str, str] = {}
    training: dict[str, object] = {}


def candidate_inputs(
    encoding: CandidateEncoding,
    proposals: Candidates,
    walls: WallArrays,
    channels: np.ndarray,
    answer: np.ndarray,
    moving: bool,
) -> CandidateInputs:
    """Return what is seen of candidates in the evidence `channels` [channels, x, y] and the `answer` to it, where the
    vehicle is `moving` or not.
    """
    grid = encoding.evidence.grid
    reports = detections_of(proposals, grid, walls)
    row, column, inside = _cells_about(proposals, grid.shape, encoding.reach)
    places = np.concatenate([channels[:, row, column], expit(answer[OBJECT, row, column])]) * inside
    places = np.ascontiguousarray(places.swapaxes(0, 1), np.float32)
    facts = np.column_stack(
        [
            proposals.values,
            reports.range_m / RANGE_M,
            reports.azimuth_rad,
            reports.place_m / (PLACE_M, grid.y_limit_m),
            np.cos(reports.away_rad),
            np.sin(reports.away_rad),
            np.full(len(reports), float(moving)),
        ]
    ).astype(np.float32)
    mirrored = grid.y_m[proposals.column] < 0.0
    places[mirrored] = places[mirrored, ..., ::-1]
    places *= signs(places.shape[1], odd_channels(encoding.evidence.mirrors), mirrored)[..., None, None]
    return CandidateInputs(places, facts * signs(FACTS, _ODD_FACTS, mirrored), mirrored)


def signs(count: int, odd: Sequence[int], mirrored: np.ndarray) -> np.ndarray:
    """Return the signs of `count` numbers of candidates, float32 [N, count]: -1 for odd ones of a mirrored one."""
    sign = np.ones((len(mirrored), count), np.float32)
    sign[:, odd] = np.where(mirrored, -1.0, 1.0)[:, None]
    return sign


def _cells_about(
    proposals: Candidates, shape: tuple[int, int], reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows [N, x, 1] and columns [N, 1, y] of the cells about candidates, those beyond the plane moved to its
    edge, and which are of the plane [N, x, y].
    """
    across = np.arange(-reach, reach + 1)
    row, column = proposals.row[:, None, None] + across[:, None], proposals.column[:, None, None] + across
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    return np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1), inside


def corrected(proposals: Candidates, correction: np.ndarray) -> Candidates:
    """Return candidates whose logit of an object a correction [N] is added to."""
    values = proposals.values.copy()
    values[:, OBJECT.start] += correction
    return replace(proposals, values=values)


class CandidatePredictor:
    """A candidate network under ONNX Runtime; `ValueError` when its file, card and shapes do not belong together."""

    def __init__(self, model_path: Path, threads: int = 1) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._path = Path(model_path)
        self.card = read_card(card_path(self._path), CandidateCard)
        self._session = open_session(self._path, self.card.sha256, threads)
        expected = {name: list(shape) for name, shape in self.card.encoding.shapes.items()}
        actual = {tensor.name: list(tensor.shape[1:]) for tensor in self._session.get_inputs()}
        if actual != expected or [list(each.shape[1:]) for each in self._session.get_outputs()] != [[]]:
            raise ValueError(f"{self._path}: inputs of the network must be {expected}, got {actual}")
        # the first scan must not wait
        places, facts = (np.zeros((1, *shape), np.float32) for shape in self.card.encoding.shapes.values())
        self._session.run(None, {"places": places, "facts": facts})

    def correction(self, inputs: CandidateInputs) -> np.ndarray:
        """Return what is added to the logits of candidates, float32 [N]; `ValueError` if not finite."""
        if not len(inputs.facts):
            return np.zeros(0, np.float32)
        values = {name: getattr(inputs, name) for name in self.card.encoding.shapes}
        correction: np.ndarray = self._session.run(None, values)[0]
        if not np.isfinite(correction).all():
            raise ValueError(f"{self._path}: answers must be finite")
        return correction
