"""What the residual network learns from: a facade 12 m ahead, hidden places before it, their images behind it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path

import msgspec
import numpy as np
import pytest

from lab.training.data.frames import Frame, FrameLabels
from lab.training.data.residual_samples import (
    FoldedImages,
    fold_published,
    fold_scenes,
    join,
    load_folded,
    recovered_scores,
    save_folded,
    truth_peaks,
    with_truth,
)
from msgs.values.frames import polar_from_xy
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import RangeAzimuthMap

WALL_X_M = 12.0
#: On the facade, a metre apart, as much left as right.
RETURNS_M = np.stack([np.full(13, WALL_X_M), np.linspace(-6.0, 6.0, 13)], axis=1)
PLACES_M = np.array([[6.0, 3.0], [4.0, -3.0]])


def labels_of(places_m: np.ndarray) -> FrameLabels:
    """The facade's returns, then the images of places [N, 2] in it."""
    images_m = np.stack([2.0 * WALL_X_M - places_m[:, 0], places_m[:, 1]], axis=1)
    range_m, azimuth_rad = polar_from_xy(np.concatenate([RETURNS_M, images_m]))
    count, hidden = len(range_m), len(places_m)
    return FrameLabels(
        range_m=range_m.astype(np.float32),
        azimuth_rad=azimuth_rad.astype(np.float32),
        path_class=np.repeat([PathClass.LOS, PathClass.MIRRORED], [count - hidden, hidden]).astype(np.uint8),
        order=np.zeros(count),
        hidden_xy_m=np.concatenate([RETURNS_M, places_m]).astype(np.float32),
        power_mw=np.ones(count),
        object_index=np.zeros(count, int),
        object_class=np.full(count, "car"),
    )


def moved(peaks: Peaks, range_m: float) -> Peaks:
    """The images of peaks, that much further off than they are."""
    return msgspec.structs.replace(peaks, range_m=peaks.range_m + range_m * (peaks.path_class == PathClass.MIRRORED))


def test_without_error_nothing_is_left_to_correct() -> None:
    """Labels are float32: 1e-4 m."""
    labels = labels_of(PLACES_M)
    folded = with_truth(fold_published(truth_peaks(labels)), labels, 7)
    assert len(folded) == 2
    np.testing.assert_allclose(folded.folded_m, PLACES_M, atol=1e-4)
    np.testing.assert_allclose(folded.target_m, 0.0, atol=1e-4)
    assert folded.state[:, 5].tolist() == [0.0, 0.0]
    assert folded.scene.tolist() == folded.truth_scene.tolist() == [7, 7]
    assert folded.patch_m.shape == (2, 16, 2)


def test_a_range_error_is_what_is_to_be_corrected() -> None:
    """An image seen 0.5 m too far folds 0.5 m too near along its mirrored ray (unit vector of place from the foot)."""
    labels = labels_of(PLACES_M)
    folded = with_truth(fold_published(moved(truth_peaks(labels), 0.5)), labels, 0)
    ray = folded.images_m / np.linalg.norm(folded.images_m, axis=1, keepdims=True)
    np.testing.assert_allclose(folded.target_m, -0.5 * ray * [-1.0, 1.0], atol=1e-4)


def test_an_image_beyond_the_gate_is_none_of_the_truth() -> None:
    labels = labels_of(PLACES_M)
    peaks = moved(truth_peaks(labels), 2.5)
    assert with_truth(fold_published(peaks), labels, 0).within(np.inf).tolist() == [False, False]
    peaks = moved(truth_peaks(labels), 1.5)
    assert with_truth(fold_published(peaks), labels, 0).within(np.inf).tolist() == [True, True]


def test_two_images_of_one_place_are_matched_once() -> None:
    labels = labels_of(PLACES_M)
    peaks = truth_peaks(labels_of(np.concatenate([PLACES_M, PLACES_M[:1] + 0.4])))
    folded = with_truth(fold_published(peaks), labels, 0)
    assert folded.within(np.inf).tolist() == [True, True, False]


def test_labels_without_a_place_count_for_nothing() -> None:
    labels = labels_of(PLACES_M)
    labels.hidden_xy_m[-1] = np.nan
    folded = with_truth(fold_published(truth_peaks(labels)), labels, 0)
    assert folded.truth_m.shape == (1, 2)
    assert folded.within(np.inf).tolist() == [True, False]


def test_a_scene_without_returns_gives_no_images() -> None:
    labels = labels_of(PLACES_M)
    labels = labels.take(labels.path_class == PathClass.MIRRORED)
    folded = with_truth(fold_published(truth_peaks(labels)), labels, 0)
    assert (len(folded), len(folded.truth_m)) == (0, 2)


class FakeData:
    """Scenes with the same places; the map says nothing."""

    def frames(self, indices: Iterable[int]) -> Iterator[Frame]:
        for index in indices:
            yield Frame(
                index=int(index), ra_map=None, labels=labels_of(PLACES_M), place="", objects=(), hidden=(),
                scene_yaml="", sequence="",
            )  # type: ignore[arg-type]  # fmt: skip


class FakeDetector:
    """Finds the same in every map: one of the two images, half a metre off."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        return moved(truth_peaks(labels_of(PLACES_M[:1])), 0.5)


def test_each_detected_image_has_its_true_position() -> None:
    heard: list[None] = []
    folded = fold_scenes(FakeData(), [3, 5], FakeDetector(), lambda: heard.append(None))  # type: ignore[arg-type]
    assert (len(folded), len(heard)) == (2, 2)
    assert set(folded.scene.tolist()) == {3, 5}
    assert np.count_nonzero(np.linalg.norm(folded.target_m, axis=1) > 0.4) == 2


def table(folded_m: list[list[float]], target_m: list[list[float]], truth_m: list[list[float]]) -> FoldedImages:
    """Images of scene 0 with these places; scene 1 holds one truth point nobody saw."""
    count = len(folded_m)
    return FoldedImages(
        images_m=np.zeros((count, 2)), patch_m=np.zeros((count, 16, 2)), state=np.zeros((count, 6)),
        folded_m=np.array(folded_m), target_m=np.array(target_m), scene=np.zeros(count, int),
        truth_m=np.array([*truth_m, [50.0, 0.0]]), truth_scene=np.array([0] * len(truth_m) + [1]),
    )  # fmt: skip


def test_scores_by_hand() -> None:
    """Scene 0: one place 1.5 m off, one found, one false. Scene 1: one missed.

    Mirror law: TP 1, FP 2, FN 2 -> F1 = 2/6; distances 1.5, 0, 10 and 1.5, 0 -> 11.5/3 + 1.5/2 m.
    With the residual of the first: TP 2, FP 1, FN 1 -> F1 = 4/6; l1 of the two known 1.5/2, then 0.
    """
    folded = table(
        [[1.5, 0.0], [5.0, 0.0], [15.0, 0.0]], [[-1.5, 0.0], [0.0, 0.0], [np.nan, np.nan]], [[0.0, 0.0], [5.0, 0.0]]
    )
    without = recovered_scores(folded, np.zeros((3, 2)))
    assert without.l1_m == pytest.approx(0.75)
    assert without.f1 == pytest.approx(1.0 / 3.0)
    assert without.chamfer_m == pytest.approx(11.5 / 3.0 + 0.75)
    offsets_m = np.array([[-1.5, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert recovered_scores(folded, offsets_m).f1 == pytest.approx(2.0 / 3.0)
    assert recovered_scores(folded, offsets_m).l1_m == 0.0
    # within 1 m only the second is held against its place
    assert recovered_scores(folded, np.zeros((3, 2)), reach_m=1.0).l1_m == 0.0


def test_scores_of_nothing() -> None:
    nothing = join([])
    scores = recovered_scores(nothing, np.zeros((0, 2)))
    assert (scores.l1_m, scores.f1, scores.chamfer_m) == (0.0, 1.0, np.inf)


def test_tables_come_back_as_they_were(tmp_path: Path) -> None:
    folded = table([[1.0, 2.0]], [[np.nan, np.nan]], [[3.0, 4.0]])
    save_folded(tmp_path / "samples.npz", folded)
    back = load_folded(tmp_path / "samples.npz")
    for field in fields(FoldedImages):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(folded, field.name))
    assert [path.name for path in tmp_path.iterdir()] == ["samples.npz"]


def test_a_file_that_is_no_table_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(ValueError, match=r"broken\.npz must hold folded images"):
        load_folded(tmp_path / "broken.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(1))
    with pytest.raises(ValueError, match=r"other\.npz must hold folded images"):
        load_folded(tmp_path / "other.npz")
