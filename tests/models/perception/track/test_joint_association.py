"""Association probabilities against all joint events written out, and what large clusters make of them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from models.perception.track.estimate import Estimate
from models.perception.track.joint_association import (
    GATE,
    exact,
    is_small,
    log_likelihoods,
    marginal_probabilities,
    propagated,
)
from models.perception.track.measurements import Sighting


def written_out(odds: np.ndarray) -> np.ndarray:
    """Marginals by the list of all joint events: each row takes a column of its own, or none (-1)."""
    rows, columns = odds.shape
    total, weights = 0.0, np.zeros(odds.shape)
    for event in product(range(-1, columns), repeat=rows):
        taken = [column for column in event if column >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = np.prod([odds[row, column] for row, column in enumerate(event) if column >= 0])
        total += weight
        for row, column in enumerate(event):
            if column >= 0:
                weights[row, column] += weight
    return weights / total


def test_one_track_and_one_measurement():
    """Odds of 3 are a probability of 3/4."""
    assert marginal_probabilities(np.log([[3.0]]))[0, 0] == pytest.approx(0.75, rel=1e-14)


def test_one_track_and_two_measurements():
    """Odds 3 and 1 over a miss: 3, 1 and 1 of 5."""
    np.testing.assert_allclose(marginal_probabilities(np.log([[3.0, 1.0]])), [[0.6, 0.2]], rtol=1e-14)


def test_two_tracks_and_one_measurement():
    """Either has it or neither: with odds 2 and 1, shares 2, 1 and 1 of 4."""
    np.testing.assert_allclose(marginal_probabilities(np.log([[2.0], [1.0]])), [[0.5], [0.25]], rtol=1e-14)


@pytest.mark.parametrize("shape", [(1, 4), (2, 2), (3, 2), (2, 4), (4, 4), (5, 3)])
def test_exact_sums_are_those_of_all_joint_events(shape: tuple[int, int]):
    rng = np.random.default_rng([7, *shape])
    for _ in range(20):
        odds = 10.0 ** rng.uniform(-3.0, 4.0, shape) * (rng.random(shape) < 0.7)
        np.testing.assert_allclose(exact(odds), written_out(odds), rtol=1e-11, atol=1e-15)


def test_clusters_do_not_touch_each_other():
    """Two pairs far apart, and a track and a measurement alone: block by block as if the rest were not there."""
    odds = np.zeros((4, 4))
    odds[:2, 1:3] = [[4.0, 1.0], [2.0, 5.0]]
    odds[3, 0] = 3.0
    with np.errstate(divide="ignore"):
        together = marginal_probabilities(np.log(odds))
    np.testing.assert_allclose(together[:2, 1:3], written_out(odds[:2, 1:3]), rtol=1e-12)
    assert together[3, 0] == pytest.approx(0.75)
    assert together[2].sum() == together[:, 3].sum() == 0.0


@pytest.mark.parametrize("shape", [(1, 5), (5, 1)])
def test_propagation_is_exact_on_a_tree(shape: tuple[int, int]):
    odds = 10.0 ** np.random.default_rng([3, *shape]).uniform(-2.0, 3.0, shape)
    np.testing.assert_allclose(propagated(odds), exact(odds), atol=1e-6)


def test_propagation_is_near_the_exact_sums():
    """4 x 4 tables of moderate odds, 200 of them: 0.05 in the mean of the largest difference, 0.2 at worst. Loops make
    it an approximation, without a bound that is known: the limits say what is accepted.
    """
    rng = np.random.default_rng(12)
    tables = [10.0 ** rng.uniform(-2.0, 2.0, (4, 4)) for _ in range(200)]
    worst = [float(np.abs(propagated(odds) - exact(odds)).max()) for odds in tables]
    assert np.mean(worst) < 0.05
    assert max(worst) < 0.2


def test_rows_and_columns_of_a_large_cluster_add_up_to_one_at_most():
    odds = 10.0 ** np.random.default_rng(4).uniform(-2.0, 6.0, (20, 30))
    assert not is_small(odds.shape)
    probability = marginal_probabilities(np.log(odds))
    assert probability.min() >= 0.0
    assert probability.sum(axis=1).max() <= 1.0 + 1e-12
    assert probability.sum(axis=0).max() <= 1.0 + 1e-4


def test_densities_are_those_of_the_predicted_position_at_the_time_of_the_measurement():
    """0.2 s on, with a covariance between position and velocity, against SciPy's density; outside the gate nothing."""
    covariance = np.diag([1.0, 0.5, 4.0, 4.0]) + 0.3 * (np.eye(4, k=2) + np.eye(4, k=-2))
    track = Estimate(10, np.array([1.0, 2.0, 5.0, -5.0]), covariance)
    at = track.at(200_000_010, 2.0)
    noise_m2 = np.array([[0.4, 0.1], [0.1, 0.2]])
    spread = at.covariance[:2, :2] + noise_m2
    inside = Sighting(200_000_010, np.array([2.5, 0.5]), noise_m2)
    far = at.mean[:2] + 1.01 * np.sqrt(GATE * np.linalg.eigvalsh(spread)[1]) * np.array([1.0, 0.0])
    log_density = log_likelihoods([track], [inside, Sighting(200_000_010, far, noise_m2)], 2.0)
    expected = multivariate_normal(at.mean[:2], spread).logpdf(inside.position_m)
    assert log_density[0, 0] == pytest.approx(expected, rel=1e-12)
    assert log_density[0, 1] == -np.inf


@pytest.mark.parametrize(("tracks", "measurements"), [(0, 0), (0, 2), (2, 0)])
def test_nothing_is_associated_with_nothing(tracks: int, measurements: int):
    estimates = [Estimate(0, np.zeros(4), np.eye(4))] * tracks
    seen = [Sighting(0, np.zeros(2), np.eye(2))] * measurements
    odds = log_likelihoods(estimates, seen, 2.0)
    assert marginal_probabilities(odds).shape == (tracks, measurements)
