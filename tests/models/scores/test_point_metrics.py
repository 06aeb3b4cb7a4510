from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from models.scores.point_metrics import Counts, chamfer, dense_counts, match_objects, match_points, recovered_counts
from msgs.values.perception import HiddenObject, PathClass, SceneTruth, TruthObject

NONE = np.zeros((0, 2))


def test_matching_prefers_many_pairs_to_near_ones():
    """Greedy takes the 0.1 m pair and leaves two alone; one-to-one matching finds both."""
    predicted, truth = np.array([[0.0, 0.0], [1.9, 0.0]]), np.array([[1.8, 0.0], [3.7, 0.0]])
    assert match_points(predicted, truth, 2.0).tolist() == [[0, 0], [1, 1]]


@pytest.mark.parametrize("seed", range(10))
def test_matching_equals_trying_everything(seed):
    rng = np.random.default_rng(seed)
    predicted, truth = rng.uniform(0, 5, (4, 2)), rng.uniform(0, 5, (4, 2))
    distance = np.linalg.norm(predicted[:, None] - truth, axis=-1)
    best = max(
        (
            sum(distance[i, j] <= 2.0 for i, j in enumerate(order)),
            -sum(
                min(distance[i, j], 1e3 * (distance[i, j] > 2.0) + distance[i, j])
                for i, j in enumerate(order)
                if distance[i, j] <= 2.0
            ),
        )
        for order in itertools.permutations(range(4))
    )
    pairs = match_points(predicted, truth, 2.0)
    assert len(pairs) == best[0]
    assert -distance[pairs[:, 0], pairs[:, 1]].sum() == pytest.approx(best[1])


def test_dense_counts_keep_classes_apart():
    predicted = np.array([[10.0, 0.0], [10.5, 0.0], [20.0, 0.0]])
    truth = np.array([[10.0, 0.5], [20.0, 0.5]])
    counts = dense_counts(predicted, np.array([0, 0, 0]), truth, np.array([0, 1]))
    assert counts == {PathClass.LOS: Counts(1, 2, 0), PathClass.MIRRORED: Counts(0, 0, 1)}


def test_an_empty_prediction_counts_its_misses():
    counts = dense_counts(NONE, np.zeros(0, int), np.array([[1.0, 0.0]]), np.array([1]))
    assert counts[PathClass.MIRRORED] == Counts(0, 0, 1)
    assert recovered_counts(NONE, np.array([[1.0, 0.0]])) == Counts(0, 0, 1)


def test_recovered_counts_are_not_one_to_one():
    """Two predictions at one truth are both not false; a truth exactly tau away is not found."""
    predicted, truth = np.array([[0.0, 0.0], [0.5, 0.0], [9.0, 0.0]]), np.array([[0.2, 0.0], [10.0, 0.0]])
    assert recovered_counts(predicted, truth, 1.0) == Counts(1, 1, 1)


def test_chamfer_in_both_units():
    predicted, truth = np.array([[0.0, 0.0]]), np.array([[3.0, 4.0], [0.0, 1.0]])
    distance = chamfer(predicted, truth)
    assert distance.metres == pytest.approx(1.0 + (5.0 + 1.0) / 2.0)
    assert distance.square_metres == pytest.approx(1.0 + (25.0 + 1.0) / 2.0)
    assert chamfer(NONE, truth).metres == math.inf
    assert chamfer(NONE, NONE).metres == 0.0


def test_scores_of_nothing():
    assert Counts().f1 == 1.0
    assert (Counts(0, 1, 0).f1, Counts(0, 1, 0).recall, Counts(0, 0, 1).precision) == (0.0, 0.0, 0.0)


def found(number: int, x: float, y: float, stamp_ns: int = 0) -> HiddenObject:
    return HiddenObject(
        id=number, x_m=x, y_m=y, length_m=2.0, width_m=1.0, yaw_rad=0.0, score=0.9,
        cov_m2=((1.0, 0.0), (0.0, 1.0)), stamp_ns=stamp_ns,
    )  # fmt: skip


def scene() -> SceneTruth:
    """A hidden car at (12, 8) that drives along -y, whose face at x = 13 is seen; a visible car at (10, -3)."""
    points = np.array([[13.0, 7.0, 1.0], [13.0, 9.0, 1.0]], np.float32)
    return SceneTruth(
        stamp_ns=1_000_000_000, scan_id=0, los_points_m=np.zeros((0, 3), np.float32), mirrored_points_m=points,
        hidden_points_m=points, hidden_object=np.array([1, 1], np.int32),
        objects=(
            TruthObject(id=7, object_class="car", x_m=10.0, y_m=-3.0, length_m=4.4, width_m=1.8, yaw_rad=0.0),
            TruthObject(
                id=9, object_class="car", x_m=12.0, y_m=8.0, length_m=4.4, width_m=1.8, yaw_rad=1.57,
                velocity_y_mps=-10.0, hidden=True,
            ),
        ),
    )  # fmt: skip


def test_objects_match_by_centre_or_visible_face():
    match = match_objects([found(0, 12.2, 8.0), found(1, 13.9, 7.0)], scene())
    assert match.matched == ((0, 9, pytest.approx(0.2)),)
    assert match.unmatched_objects == (1,), "one to one: the second on the same car is nothing"
    assert match_objects([found(1, 13.9, 7.0)], scene()).matched == ((1, 9, pytest.approx(0.9)),)


def test_truth_is_moved_to_the_objects_own_time():
    late = found(0, 12.0, 5.0, stamp_ns=1_300_000_000)
    assert match_objects([late], scene()).matched == ((0, 9, pytest.approx(0.0, abs=1e-9)),)
    # at the scene's own time the near end of the visible face, (12.9, 5.8), is 1.2 m away
    assert match_objects([found(0, 12.0, 5.0, stamp_ns=1_000_000_000)], scene()).missed_truths == (9,)


def test_visible_objects_are_not_asked_for_and_do_not_excuse():
    match = match_objects([found(3, 10.0, -3.0)], scene())
    assert (match.matched, match.unmatched_objects, match.missed_truths) == ((), (3,), (9,))


def test_no_objects_misses_all():
    assert match_objects([], scene()).missed_truths == (9,)
