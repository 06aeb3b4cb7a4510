"""Inference with the learned residual on the vehicle: an ONNX file of ResidualReflectNet, its card, bounded outputs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from models.perception.cards import card_path, read_card
from models.perception.mirrors.recovery import NEIGHBOURS, ReflectionState
from models.perception.onnx_session import open_session

#: Walls that a card names, by back end.
CARD_GEOMETRY = {"ours": "ours", "specification": "published"}
#: Inputs of the file, in order, with their shapes after the batch.
INPUTS = ("images", "patch", "state")
#: Longest correction in use.
MAX_SHIFT_M = 5.0


class ResidualCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a residual network file: how it was made, its input, its scores; a JSON file beside it."""

    name: str
    sha256: str
    parameters: int
    #: Coordinates the network sees: those of each image's own wall.
    frame: Literal["wall"]
    #: Direct returns in a patch.
    neighbours: int
    #: Source of its training points: `truth`, `peaks` or `both`; and the walls that it was trained with.
    source: str
    geometry: str
    seed: int
    command: str
    #: Made from which scenes, with which detector.
    data: dict[str, str | int]
    #: On test scenes that were used neither to train nor to select it; `_without` are those of the mirror law alone.
    metrics: dict[str, float]
    #: Chosen epoch and the resolved configuration of the run.
    training: dict[str, Any]

    def __post_init__(self) -> None:
        if self.neighbours < 1:
            raise ValueError(f"card.neighbours must be at least 1, got {self.neighbours}")


@dataclass(frozen=True)
class ImageFrames:
    """A frame for each image: origins [N, 2] and axes [N, 2, 2], a row each, in the radar's frame."""

    origin_m: np.ndarray
    axes: np.ndarray

    def points(self, points_m: np.ndarray) -> np.ndarray:
        """Return the points [N, ..., 2] of the radar's frame in each image's own."""
        origin_m = self.origin_m.reshape(len(self.origin_m), *[1] * (points_m.ndim - 2), 2)
        return np.einsum("nij,n...j->n...i", self.axes, points_m - origin_m)

    def from_radar(self, offsets_m: np.ndarray) -> np.ndarray:
        """Return the offsets [N, 2] of the radar's frame in each image's own."""
        return np.einsum("nij,nj->ni", self.axes, offsets_m)

    def to_radar(self, offsets_m: np.ndarray) -> np.ndarray:
        """Return the offsets [N, 2] of each image's own frame in the radar's."""
        return np.einsum("nij,ni->nj", self.axes, offsets_m)


def wall_frames(reflection: ReflectionState) -> ImageFrames:
    """Return the relay-wall frames (section 3.2): origin at the radar's foot, tangent to the image's side, normal."""
    normal, offset_m = reflection.state[:, 2:4], reflection.state[:, 4:5]
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    along_m = np.sum(tangent * reflection.images_m, axis=1, keepdims=True)
    tangent = np.where(along_m < 0.0, -tangent, tangent)
    return ImageFrames(-offset_m * normal, np.stack([tangent, normal], axis=1))


def in_frames(reflection: ReflectionState, frames: ImageFrames) -> ReflectionState:
    """Return the same images in their own frames; the offset stays the radar's distance from the wall."""
    images_m = frames.points(reflection.images_m)
    state = reflection.state.copy()
    state[:, :2], state[:, 2:4] = images_m, frames.from_radar(reflection.state[:, 2:4])
    return ReflectionState(images_m, frames.points(reflection.patch_m), state)


def bounded(offsets_m: np.ndarray) -> np.ndarray:
    """Return the offsets [N, 2], those longer than `MAX_SHIFT_M` scaled down to it."""
    length_m = np.linalg.norm(offsets_m, axis=1, keepdims=True)
    return offsets_m * np.minimum(1.0, MAX_SHIFT_M / np.maximum(length_m, 1e-9))


def load_residual_card(model_path: Path) -> ResidualCard:
    """Read the card of a residual network; raises `ValueError` naming the file and the field that is wrong."""
    return read_card(card_path(model_path), ResidualCard)


class LearnedResidual:
    """Corrections of folded places, Eq. (18): callable as `recovery.Residual`; warm.

    Raises `ValueError` when file, card and shapes do not belong together, or a bound is not positive.
    """

    def __init__(self, model_path: Path, threads: int = 1) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._path = Path(model_path)
        self.card = load_residual_card(self._path)
        self._session = open_session(self._path, self.card.sha256, threads)
        self._check_shapes()
        self._infer(ReflectionState(*(np.zeros((1, *shape)) for shape in self._shapes().values())))

    def __call__(self, reflection: ReflectionState) -> np.ndarray:
        """Return the offsets float64 [N, 2] in metres within the bound; `ValueError` for other or no numbers."""
        self._check_inputs(reflection)
        if len(reflection.images_m) == 0:
            return np.zeros((0, 2))
        frames = wall_frames(reflection)
        return bounded(frames.to_radar(self._infer(in_frames(reflection, frames))))

    def require_trained_for(self, back_end: str) -> None:
        """Raise `ValueError` unless the network was trained on the walls, and takes the patches, of a back end."""
        wanted = {"geometry": CARD_GEOMETRY[back_end], "neighbours": NEIGHBOURS}
        for name, value in wanted.items():
            if getattr(self.card, name) != value:
                raise ValueError(
                    f"{card_path(self._path)}: card.{name} must be {value!r} for back_end {back_end}, "
                    f"got {getattr(self.card, name)!r}"
                )

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        return dict(zip(INPUTS, ((2,), (self.card.neighbours, 2), (6,)), strict=True))

    def _infer(self, reflection: ReflectionState) -> np.ndarray:
        arrays = (reflection.images_m, reflection.patch_m, reflection.state)
        inputs = {name: array.astype(np.float32) for name, array in zip(INPUTS, arrays, strict=True)}
        offsets_m = self._session.run(None, inputs)[0].astype(np.float64)
        if not np.isfinite(offsets_m).all():
            raise ValueError(
                f"{self._path}: residuals must be finite, got {np.extract(~np.isfinite(offsets_m), offsets_m)[0]}"
            )
        return offsets_m

    def _check_inputs(self, reflection: ReflectionState) -> None:
        count = len(reflection.images_m)
        arrays = (reflection.images_m, reflection.patch_m, reflection.state)
        for (name, shape), array in zip(self._shapes().items(), arrays, strict=True):
            if array.shape != (count, *shape):
                raise ValueError(f"reflection.{name} must have shape {(count, *shape)}, got {array.shape}")
            if not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0, 0])
                raise ValueError(f"reflection.{name} must be finite, image {row} is not")

    def _check_shapes(self) -> None:
        """Raise `ValueError` unless file and card agree on every name and shape; the batch is free."""
        expected = {**self._shapes(), "residual": (2,)}
        actual = {
            tensor.name: tuple(tensor.shape[1:])
            for tensor in (*self._session.get_inputs(), *self._session.get_outputs())
        }
        if actual != expected:
            raise ValueError(f"{self._path}: inputs and output of the network must be {expected}, got {actual}")
        if any(isinstance(tensor.shape[0], int) for tensor in self._session.get_inputs()):
            raise ValueError(f"{self._path}: the network must take any number of images, takes a fixed one")
