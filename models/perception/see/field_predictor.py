"""Inference with the field network: how likely each cell holds a wall, a direct and a mirrored return."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from models.perception.cards import card_path, learned_path, read_card
from models.perception.find.encoding import Encoding, encode_map
from models.perception.onnx_session import ArraySession
from models.perception.see.wall_elements import WALL_ANSWERS
from models.perception.trained_radar import TrainedRadar, require_grid
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

#: The network in use where parameters say `default`.
DEFAULT_FIELDS = learned_path("field_unet", ".onnx")
#: Answers of a cell: those of a wall, then the logits of a direct and of a mirrored return.
FIELD_ANSWERS = WALL_ANSWERS + len(PathClass)
#: Answers that change sign when left and right are exchanged.
ODD_ANSWERS = [3]


class FieldCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a field network file: how it was made, its input, its scores; a JSON file beside it."""

    name: str
    sha256: str
    parameters: int
    encoding: Encoding
    grid: RangeAzimuthGrid
    #: Radar of the maps in training.
    radar: TrainedRadar = TrainedRadar()
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    scores: dict[str, float] = {}
    #: Data sets of training and validation.
    data: dict[str, str] = {}
    #: Chosen epoch and the resolved configuration of the run.
    training: dict[str, Any] = {}

    def __post_init__(self) -> None:
        expected = {
            "input": (1, *self.encoding.shape),
            "output": (1, FIELD_ANSWERS, self.encoding.seen_bins, self.grid.azimuth_bins),
        }
        for end, shape in expected.items():
            if getattr(self, f"{end}_shape") != shape:
                raise ValueError(f"card.{end}_shape must be {shape}, got {getattr(self, f'{end}_shape')}")


class FieldPredictor:
    """A field network under ONNX Runtime: where each direction may meet a wall, and how that is turned.

    It looks at a map or its mirror image (`Encoding.is_turned`), with `flip_test` at both. `ValueError` as its card
    says.
    """

    def __init__(self, model_path: Path = DEFAULT_FIELDS, threads: int = 1, flip_test: bool = False) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._path = Path(model_path)
        self.card = read_card(card_path(self._path), FieldCard)
        shapes = self.card.input_shape, self.card.output_shape
        self._flip_test = flip_test
        self._session = ArraySession(self._path, self.card.sha256, threads, *shapes)

    def answer(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        """Return the answer to a map, float32 [`FIELD_ANSWERS`, range, azimuth]."""
        require_grid(self.card.name, self.card.grid, ra_map.grid)
        encoded = encode_map(self.card.encoding, ra_map)
        if self._flip_test:
            return 0.5 * (self._session.answer(encoded) + self._turned_answer(ra_map))
        return self._turned_answer(ra_map) if self.card.encoding.is_turned(encoded) else self._session.answer(encoded)

    def _turned_answer(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        """Return the answer to the mirrored map, mirrored back."""
        mirrored = msgspec.structs.replace(ra_map, values=ra_map.values[:, ::-1])
        answer = self._session.answer(encode_map(self.card.encoding, mirrored))[..., ::-1].copy()
        answer[ODD_ANSWERS] *= -1.0
        return answer
