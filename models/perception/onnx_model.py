"""The dense network as the vehicle runs it: an ONNX file, and the card that says what it is."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnxruntime

from models.perception.encoding import CHANNELS, Encoding, encode_map
from msgs.radar import RangeAzimuthGrid, RangeAzimuthMap

#: The network in use unless another is named.
DEFAULT_MODEL = Path(__file__).parents[1] / "weights" / "compact_unet.onnx"


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


class ModelCard(msgspec.Struct, frozen=True, kw_only=True):
    """What a network file is: how it was made, what it takes, how good it is; a JSON file beside the ONNX file."""

    name: str
    sha256: str
    parameters: int
    channels: tuple[str, ...] = CHANNELS
    encoding: Encoding
    grid: RangeAzimuthGrid
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    #: Threshold to pick peaks at; `scores` holds its line.
    threshold: float
    #: On test scenes that neither trained nor chose the network.
    scores: tuple[ScoresAt, ...]
    #: How training and test scenes were made, and how many.
    data: dict[str, str | int]
    #: Training command, chosen epoch, and the resolved configuration of data, schedule and network.
    training: dict[str, Any]

    def __post_init__(self) -> None:
        if self.channels != CHANNELS:
            raise ValueError(f"card.channels must be {CHANNELS}, got {self.channels}")
        self.encoding.check_grid(self.grid)


def card_path(model_path: Path) -> Path:
    """Where the card of a network file lies."""
    return model_path.with_suffix(".json")


def load_card(model_path: Path) -> ModelCard:
    """Read the card of a network file; raises `ValueError` naming the file and the field that is wrong."""
    path = card_path(model_path)
    try:
        return msgspec.json.decode(path.read_bytes(), type=ModelCard)
    except (msgspec.DecodeError, OSError) as error:
        raise ValueError(f"{path}: {error}") from None


class DensePredictor:
    """Confidence of LOS and mirrored returns in every cell of a map.

    The session is warm when the constructor returns. Raises `ValueError` when the file, its card and its shapes do not
    belong together.
    """

    def __init__(self, model_path: Path = DEFAULT_MODEL, threads: int = 1) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        model_path = Path(model_path)
        self.card = load_card(model_path)
        self._session = _open_session(model_path, self.card.sha256, threads)
        _check_shapes(model_path, self.card, self._session)
        self._infer(np.zeros(self.card.input_shape, np.float32))

    def predict(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        """Probabilities, float32 [2, range, azimuth] in the order of `PathClass`; 0 beyond the range the network sees.

        Raises `ValueError` when the map's grid is not the card's.
        """
        if ra_map.grid != self.card.grid:
            raise ValueError(f"map.grid must be the {self.card.name} card's, {self.card.grid}, got {ra_map.grid}")
        seen = self._infer(encode_map(self.card.encoding, ra_map)[None])[0]
        confidence = np.zeros((len(seen), *ra_map.grid.shape), np.float32)
        confidence[:, : seen.shape[1]] = seen
        return confidence

    def _infer(self, encoded: np.ndarray) -> np.ndarray:
        return self._session.run(None, {self._session.get_inputs()[0].name: encoded})[0]


def _open_session(model_path: Path, sha256: str, threads: int) -> onnxruntime.InferenceSession:
    try:
        model = model_path.read_bytes()
    except OSError as error:
        raise ValueError(f"{model_path}: {error}") from None
    found = hashlib.sha256(model).hexdigest()
    if found != sha256:
        raise ValueError(f"{model_path}: sha256 must be {sha256} as its card says, got {found}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # a spinning worker would take its core from the other nodes between two maps
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _check_shapes(model_path: Path, card: ModelCard, session: onnxruntime.InferenceSession) -> None:
    """Raise `ValueError` unless file, card and encoding agree on every shape."""
    seen_cells = (card.encoding.range_bins, card.grid.azimuth_bins)
    checks = (
        ("input of the network", tuple(session.get_inputs()[0].shape), card.input_shape),
        ("output of the network", tuple(session.get_outputs()[0].shape), card.output_shape),
        ("card.input_shape", card.input_shape, (1, *card.encoding.shape)),
        ("card.output_shape", card.output_shape, (1, 2, *seen_cells)),
    )
    for what, found, wanted in checks:
        if found != wanted:
            raise ValueError(f"{model_path}: {what} must be {wanted}, got {found}")
