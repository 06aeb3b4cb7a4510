from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from lab.measures.point_scores import Counts, chamfer, dense_counts, match_points, recovered_counts
from msgs.values.perception import PathClass

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
