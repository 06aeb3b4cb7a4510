"""Training samples of the residual network: images folded back by the mirror law, and their true positions.

They are the real input of the back end of the specification, by its own code: the peaks a network detects, behind the
walls found from them. Behind our walls the network corrects nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path

import msgspec
import numpy as np

from lab.measures.point_scores import Counts, chamfer, match_points, recovered_counts
from lab.training.data.frames import DataSet, FrameLabels
from models.perception.find.detectors import Detector
from models.perception.mirrors.published import BUDDY, published_structure
from models.perception.mirrors.recovery import NEIGHBOURS, Recovered, ReflectionState, recover, reflection_state
from msgs.files.array_files import load_arrays
from msgs.files.whole_files import whole
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks

#: A detected image is assigned to the nearest truth image within this (one to one).
GATE_M = 2.0


@dataclass(frozen=True, kw_only=True)
class FoldedImages:
    """Images of many scenes, folded back: the network's input [N], its target, and all truth [M].

    `scene` [N] and `truth_scene` [M] give the scene of each; the order is that of the scenes.
    """

    images_m: np.ndarray
    patch_m: np.ndarray
    state: np.ndarray
    #: Positions by the mirror law alone, Eq. (19) [N, 2].
    folded_m: np.ndarray
    #: Eq. (24), [N, 2]; NaN if the image has no true counterpart.
    target_m: np.ndarray
    scene: np.ndarray
    truth_m: np.ndarray
    truth_scene: np.ndarray

    def __len__(self) -> int:
        return len(self.images_m)

    @property
    def reflection(self) -> ReflectionState:
        """Input of the network."""
        return ReflectionState(self.images_m, self.patch_m, self.state)

    def within(self, reach_m: float) -> np.ndarray:
        """Return images whose true position is known and within `reach_m` of that of the mirror law; bool [N]."""
        # false for NaN
        return np.linalg.norm(self.target_m, axis=1) <= reach_m

    def select(self, keep: np.ndarray) -> FoldedImages:
        """Return the images of a mask or an index, with all truth."""
        names = [field.name for field in fields(self) if not field.name.startswith("truth")]
        selected = {name: getattr(self, name)[keep] for name in names}
        return FoldedImages(**selected, truth_m=self.truth_m, truth_scene=self.truth_scene)


def join(parts: Iterable[FoldedImages]) -> FoldedImages:
    """Return several concatenated."""
    parts = [_none(), *parts]
    return FoldedImages(
        **{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(FoldedImages)}
    )


def _none() -> FoldedImages:
    points, scenes = np.zeros((0, 2)), np.zeros(0, np.int64)
    return FoldedImages(
        images_m=points,
        patch_m=np.zeros((0, NEIGHBOURS, 2)),
        state=np.zeros((0, 6)),
        folded_m=points,
        target_m=points,
        scene=scenes,
        truth_m=points,
        truth_scene=scenes,
    )


#: Images folded back, and the network's input for them.
Folded = tuple[Recovered, ReflectionState]


def fold_published(peaks: Peaks) -> Folded:
    """Return the images of a scene as folded by the published back end."""
    returns, walls = published_structure(peaks)
    recovered = recover(peaks, walls, returns, BUDDY)
    return recovered, reflection_state(recovered, walls, returns)


def true_images(labels: FrameLabels) -> tuple[FrameLabels, np.ndarray]:
    """Return the labels of mirror images whose true position is known, and where they appear [N, 2]."""
    truth = labels.take((labels.path_class == PathClass.MIRRORED) & np.isfinite(labels.hidden_xy_m).all(axis=1))
    return truth, xy_from_polar(truth.range_m.astype(np.float64), truth.azimuth_rad.astype(np.float64))


def with_truth(folded: Folded, labels: FrameLabels, scene: int) -> FoldedImages:
    """Return the folded images of one scene, each with the nearest truth image.

    Labels without a true position are ignored.
    """
    recovered, reflection = folded
    truth, truth_images_m = true_images(labels)
    truth_m = truth.hidden_xy_m.astype(np.float64)
    target_m = np.full((len(recovered), 2), np.nan)
    pairs = match_points(recovered.images_m, truth_images_m, GATE_M)
    target_m[pairs[:, 0]] = truth_m[pairs[:, 1]] - recovered.points_m[pairs[:, 0]]
    return FoldedImages(
        images_m=reflection.images_m,
        patch_m=reflection.patch_m,
        state=reflection.state,
        folded_m=recovered.points_m,
        target_m=target_m,
        scene=np.full(len(recovered), scene),
        truth_m=truth_m,
        truth_scene=np.full(len(truth_m), scene),
    )


def truth_peaks(labels: FrameLabels) -> Peaks:
    """Return the labels of a scene as if they had been detected without error; snr and score are without meaning."""
    count = len(labels)
    return Peaks(
        stamp_ns=0,
        scan_id=0,
        range_m=labels.range_m.astype(np.float64),
        azimuth_rad=labels.azimuth_rad.astype(np.float64),
        score=np.ones(count),
        path_class=labels.path_class.astype(np.uint8),
        covariance=np.tile(np.diag([1e-4, 1e-6]), (count, 1, 1)),
        peak_stamp_ns=np.zeros(count, np.int64),
        snr_db=np.full(count, 30.0),
    )


def fold_scenes(
    data: DataSet, indices: Iterable[int], detector: Detector, on_scene: Callable[[], None] = lambda: None
) -> FoldedImages:
    """Return the images of many scenes; `on_scene` is called for each."""
    parts: list[FoldedImages] = []
    for frame in data.frames(indices):
        parts.append(with_truth(fold_published(detector.detect(frame.ra_map)), frame.labels, frame.index))
        on_scene()
    return join(parts)


def save_folded(path: Path, folded: FoldedImages) -> None:
    """Write the images whole or not at all."""
    with whole(path) as part, part.open("wb") as file:
        np.savez(file, **{field.name: getattr(folded, field.name) for field in fields(FoldedImages)})


def load_folded(path: Path) -> FoldedImages:
    """Read the file of `save_folded`; raises `ValueError` naming the file and the missing array."""
    names = [field.name for field in fields(FoldedImages)]
    try:
        arrays = load_arrays(path)
        return FoldedImages(**{name: arrays[name] for name in names})
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} must hold folded images ({', '.join(names)}): {error}") from None


class RecoveredScores(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of recovered positions against the truth."""

    #: Mean of |error x| + |error y|, Eq. (25), over the images within reach of their true position.
    l1_m: float
    #: All images against all truth within 1 m, micro over scenes, none skipped.
    f1: float
    #: Mean over the scenes that have both images and truth.
    chamfer_m: float


def recovered_scores(folded: FoldedImages, offsets_m: np.ndarray, reach_m: float = math.inf) -> RecoveredScores:
    """Return scores of folded positions moved by offsets [N, 2] (zero: the mirror law alone)."""
    within = folded.within(reach_m)
    errors_m = np.abs(offsets_m - folded.target_m)[within].sum(axis=1)
    places_m = folded.folded_m + offsets_m
    total, distances_m = Counts(), []
    for scene in np.union1d(folded.scene, folded.truth_scene):
        here_m, truth_m = places_m[folded.scene == scene], folded.truth_m[folded.truth_scene == scene]
        total += recovered_counts(here_m, truth_m)
        distances_m.append(chamfer(here_m, truth_m).metres)
    finite = [distance_m for distance_m in distances_m if math.isfinite(distance_m)]
    return RecoveredScores(
        l1_m=float(errors_m.mean()) if len(errors_m) else 0.0,
        f1=total.f1,
        chamfer_m=float(np.mean(finite)) if finite else math.inf,
    )
