"""Inference with the field network: how likely each cell holds a wall, a direct and a mirrored return."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from models.perception.cards import learned_path
from models.perception.find.encoding import Encoding, encode_map
from models.perception.onnx_session import ArrayCard, ArraySession
from models.perception.see.wall_elements import WALL_ANSWERS
from models.perception.trained_radar import require_grid
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

#: The network in use where parameters say `default`.
DEFAULT_FIELDS = learned_path("field_unet")
#: Answers of a cell: those of a wall, then the logits of a direct and of a mirrored return.
FIELD_ANSWERS = WALL_ANSWERS + len(PathClass)
#: Answers that change sign when left and right are exchanged.
ODD_ANSWERS = [3]


class FieldCard(ArrayCard, frozen=True, kw_only=True):
    """Description of a field network file."""

    encoding: Encoding
    grid: RangeAzimuthGrid

    def __post_init__(self) -> None:
        cells = self.encoding.range_bins, self.grid.azimuth_bins
        self.check_shapes(input=(1, *self.encoding.shape), output=(1, FIELD_ANSWERS, *cells))


class FieldPredictor:
    """A field network under ONNX Runtime: where each direction may meet a wall, and how that is turned.

    It looks at a map or its mirror image (`Encoding.is_turned`), with `flip_test` at both. `ValueError` as its card
    says.
    """

    def __init__(self, model_path: Path = DEFAULT_FIELDS, threads: int = 1, flip_test: bool = False) -> None:
        self._session = ArraySession(Path(model_path), FieldCard, threads)
        self.card = self._session.card
        self._flip_test = flip_test

    def answer(self, ra_map: RangeAzimuthMap) -> np.ndarray:
        """Return the answer to a map, float32 [`FIELD_ANSWERS`, range, azimuth]."""
        encoding = self.card.encoding
        require_grid(self.card.name, self.card.grid, ra_map.grid)
        encoded = encode_map(encoding, ra_map)
        mirrored = msgspec.structs.replace(ra_map, values=ra_map.values[:, ::-1])
        is_turned = encoding.is_turned(encoded)
        return self._session.looked(
            encoded, lambda: encode_map(encoding, mirrored), ODD_ANSWERS, is_turned, self._flip_test
        )
