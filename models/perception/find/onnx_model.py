"""Inference with a dense network on the vehicle: an ONNX file and the card that describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import onnxruntime

from models.perception.cards import card_path, learned_path, read_card, read_learned
from models.perception.find.anchors import CHANNELS as ANCHOR_CHANNELS
from models.perception.find.anchors import anchor_points
from models.perception.find.encoding import Encoding, encode_map
from models.perception.find.peaks import Points, heatmap_points
from models.perception.onnx_session import MAX_MODEL_BYTES, session_of, wrong_checksum
from models.perception.trained_radar import TrainedRadar, require_grid
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

#: Hint on how to make a network with its card.
GUIDE = (
    "`mirrorwave export` writes a network with its card: docs/guides/train-on-my-captures.md; "
    "the card of one from elsewhere: docs/guides/own-parts.md"
)
#: The network in use unless another is named.
DEFAULT_MODEL = learned_path("compact_unet")


class ClassScores(msgspec.Struct, frozen=True, kw_only=True):
    """Detection scores of one path class (one-to-one matching, 2 m gate, counts over all frames)."""

    precision: float
    recall: float
    f1: float


class ScoresAt(msgspec.Struct, frozen=True, kw_only=True):
    """Detection scores at one confidence threshold."""

    threshold: float
    macro_f1: float
    los: ClassScores
    mirrored: ClassScores


class Fidelity(msgspec.Struct, frozen=True, kw_only=True):
    """Difference between a file and the torch network it was exported from."""

    #: Largest difference of a probability on encoded maps of the training split.
    largest_difference: float
    #: Macro-F1 at the card's threshold that the fp32 export has on the same frames.
    macro_f1_fp32: float
    #: Loss of this file against it, in points (hundredths).
    lost_points: float
    #: Encoded maps of the training split that set the ranges of an int8 file.
    calibration_maps: int = 0


class ModelCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a network file, in JSON beside it: how it was made, input, scores; unknown fields are ignored."""

    name: str
    sha256: str
    #: Number of weights; 0: not counted.
    parameters: int = 0
    #: Family of the network.
    network: str = "compact_unet"
    #: Of weights and arithmetic; input and output are float32 always.
    precision: Literal["fp32", "fp16", "int8"] = "fp32"
    #: A heatmap gives probabilities on the map's own cells; anchors give logits and offsets (see `anchors`).
    head: Literal["heatmap", "anchors"] = "heatmap"
    #: Cells from anchor to anchor.
    anchor_stride: int = 1
    encoding: Encoding
    grid: RangeAzimuthGrid
    #: Radar of the maps in training.
    radar: TrainedRadar = TrainedRadar()
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    #: Threshold to pick peaks at; `scores` holds its line.
    threshold: float
    #: That of peaks by pursuit, the best on the validation scenes; None: the same.
    pursuit_threshold: float | None = None
    #: On test scenes that were used neither to train nor to select the network; empty: none were made.
    scores: tuple[ScoresAt, ...] = ()
    fidelity: Fidelity | None = None
    #: How training and test scenes were made, and how many.
    data: dict[str, str | int] = {}
    #: Training command, chosen epoch, and the resolved configuration of data, schedule and network.
    training: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if self.anchor_stride < 1:
            raise ValueError(f"card.anchor_stride must be at least 1, got {self.anchor_stride}")
        self.encoding.check_grid(self.grid)

    def threshold_for(self, placement: str) -> float:
        """Return the threshold for a placement of peaks (`models.perception.find.detectors.Refine`)."""
        return self.pursuit_threshold or self.threshold if placement == "pursuit" else self.threshold

    @property
    def answer_shape(self) -> tuple[int, int, int, int]:
        """Output shape for one map: all cells that the network sees, or its anchors."""
        cells = self.encoding.range_bins, self.grid.azimuth_bins
        if self.head == "heatmap":
            return 1, len(PathClass), *cells
        return 1, ANCHOR_CHANNELS, cells[0] // self.anchor_stride, cells[1] // self.anchor_stride


def load_card(model_path: Path) -> ModelCard:
    """Read the card of a network file; raises `ValueError` naming the file and the field that is wrong."""
    return read_card(card_path(model_path), ModelCard)


class DensePredictor:
    """An exported network: confidence of LOS and mirrored returns in every cell of a map, or at anchors; warm.

    It looks at a map or its mirror image (`Encoding.is_turned`), with `flip_test` at both. `ValueError` naming file and
    field where file, card and shapes do not belong together, or `flip_test` meets anchors.
    """

    def __init__(self, model_path: Path = DEFAULT_MODEL, threads: int = 1, flip_test: bool = False) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        model_path = Path(model_path)
        self.card, self._session = _open_with_card(model_path, threads)
        self._flip_test = flip_test
        if flip_test and self.card.head != "heatmap":
            raise ValueError(f"{model_path}: flip_test must go with a heatmap, the network answers at {self.card.head}")
        self._input = self._session.get_inputs()[0].name

    def predict(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        """Return the probabilities, float32 [2, range, azimuth] by `PathClass`; 0 beyond the network's range.

        Raises `ValueError` when the map's grid is not the card's, or the network answers at anchors.
        """
        if self.card.head != "heatmap":
            raise ValueError(f"{self.card.name}: card.head must be heatmap for a heatmap, got {self.card.head}")
        visible = self.answer(ra_map)
        confidence = np.zeros((len(visible), *ra_map.grid.shape), np.float32)
        confidence[:, : visible.shape[1]] = visible
        return confidence

    def points(self, ra_map: RangeAzimuthMap, threshold: float, min_distance: int) -> Points:
        """Return the points of the output: maxima (section 3.1.1), or anchors moved; `ValueError` for another grid."""
        return answered_points(self.card, self.answer(ra_map), threshold, min_distance)

    def answer(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        """Return the network's answer to a map, float32 [channels, rows, columns], as `answered_points` takes it."""
        require_grid(self.card.name, self.card.grid, ra_map.grid)
        mirrored = msgspec.structs.replace(ra_map, values=ra_map.values[:, ::-1])
        encoded = encode_map(self.card.encoding, ra_map)
        if self._flip_test:
            return 0.5 * (self.infer(encoded) + self._look(mirrored)[..., ::-1])
        if self.card.head == "heatmap" and self.card.encoding.is_turned(encoded):
            return self._look(mirrored)[..., ::-1]
        return self.infer(encoded)

    def _look(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        return self.infer(encode_map(self.card.encoding, ra_map))

    def infer(self, encoded: np.ndarray) -> np.ndarray:
        """Return the network's answer to an encoded map [channels, range, columns]."""
        return self._session.run(None, {self._input: encoded[None]})[0][0]


def answered_points(card: ModelCard, answer: np.ndarray, threshold: float, min_distance: int) -> Points:
    """Return the points of one answer [channels, rows, columns] with at least a score of `threshold`."""
    if card.head == "anchors":
        return anchor_points(answer, card.anchor_stride, threshold, min_distance)
    return heatmap_points(answer, threshold, min_distance)


def _open_with_card(model_path: Path, threads: int) -> tuple[ModelCard, onnxruntime.InferenceSession]:
    """Return a network and its card; raises one `ValueError` with all that is wrong with either, and the guide."""
    card: ModelCard | None = None
    session: onnxruntime.InferenceSession | None = None
    wrong: list[str] = []
    try:
        card = load_card(model_path)
    except ValueError as error:
        wrong.append(str(error))
    try:
        model = read_learned(model_path, MAX_MODEL_BYTES)
        wrong += wrong_checksum(model_path, model, card.sha256) if card else []
        session = session_of(model_path, model, threads)
    except ValueError as error:
        wrong.append(str(error))
    if card is not None:
        wrong += _wrong_card(model_path, card)
    if session is not None:
        wrong += _wrong_session(model_path, card, session)
    if wrong or card is None or session is None:
        raise ValueError(f"{'; '.join(wrong)} ({GUIDE})")
    return card, session


def _wrong_card(model_path: Path, card: ModelCard) -> list[str]:
    """Return the shapes of a card that its own encoding and grid do not give."""
    expected = {"input": (1, *card.encoding.shape), "output": card.answer_shape}
    shapes = {"input": card.input_shape, "output": card.output_shape}
    return [
        f"{card_path(model_path)}: card.{end}_shape must be {shape}, got {shapes[end]}"
        for end, shape in expected.items()
        if shapes[end] != shape
    ]


def _wrong_session(model_path: Path, card: ModelCard | None, session: onnxruntime.InferenceSession) -> list[str]:
    """Return the types of a network that are not ours, and shapes that are not its card's."""
    wrong = []
    entries = {"input": session.get_inputs(), "output": session.get_outputs()}
    for end, arrays in entries.items():
        if len(arrays) != 1 or arrays[0].type != "tensor(float)":
            wrong.append(f"{model_path}: {end} must be one float32 array, got {[array.type for array in arrays]}")
            continue
        shape = tuple(arrays[0].shape)
        expected = None if card is None else (card.input_shape if end == "input" else card.output_shape)
        if expected is not None and shape != expected:
            wrong.append(f"{model_path}: {end} must be {expected} as its card says, got {shape}")
        elif card is None:
            wrong.append(f"{model_path}: its {end} is {shape}")
    return wrong
