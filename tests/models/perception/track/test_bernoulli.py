"""Existence by Bayes' rule in closed form: a hit, a miss, a blind scan, time, birth; and classes."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.track.bernoulli import (
    MAX_EXISTENCE,
    Bernoulli,
    born,
    existence_if_missed,
    log_odds_of_pairs,
    updated,
)
from models.perception.track.estimate import Estimate
from models.perception.track.joint_association import marginal_probabilities
from models.perception.track.measurements import Sighting
from msgs.values.perception import RadialSpeed

HERE = Estimate(0, np.array([3.0, 4.0, 0.0, 0.0]), np.diag([0.5, 0.5, 4.0, 4.0]))
PLAIN = np.eye(2)


def after(existence: float, detection: float, odds: float, measurements: list[Sighting]) -> Bernoulli:
    """An object after a scan in which it has each measurement at the same odds."""
    probability = np.full(len(measurements), odds / (1.0 + len(measurements) * odds))
    return updated(Bernoulli(existence, HERE), detection, probability, measurements, 300_000_000, 2.0)


def test_existence_after_a_measurement_is_bayes_rule():
    """An object with prior r that is reported with p_D at density f, over background of density k: the posterior is
    (r p_D f + k r (1 - p_D)) / (r p_D f + k (1 - r p_D)). With r = 0.4, p_D = 0.8, f = 0.05, k = 0.01:
    (0.016 + 0.0008) / (0.016 + 0.0068) = 0.016800 / 0.022800.
    """
    log_odds = log_odds_of_pairs(np.array([0.4]), np.array([0.8]), np.log([[0.05]]), np.array([0.01]))
    probability = marginal_probabilities(log_odds)[0]
    seen = [Sighting(0, HERE.mean[:2], PLAIN)]
    assert updated(Bernoulli(0.4, HERE), 0.8, probability, seen, 0, 2.0).existence == pytest.approx(168 / 228)


def test_existence_after_a_miss_is_bayes_rule():
    """r (1 - p_D) / (1 - r p_D): 0.5 * 0.2 / 0.6."""
    assert existence_if_missed(0.5, 0.8) == pytest.approx(1 / 6)
    assert after(0.5, 0.8, 0.0, []).existence == pytest.approx(1 / 6)


def test_a_scan_that_cannot_see_it_changes_no_existence():
    """p_D = 0: no odds for any measurement, and a miss says nothing; the position grows vague all the same."""
    log_odds = log_odds_of_pairs(np.array([0.7]), np.array([0.0]), np.log([[0.1]]), np.array([0.01]))
    probability = marginal_probabilities(log_odds)[0]
    assert probability.tolist() == [0.0]
    blind = updated(Bernoulli(0.7, HERE), 0.0, probability, [Sighting(0, HERE.mean[:2], PLAIN)], 300_000_000, 2.0)
    assert blind.existence == pytest.approx(0.7, rel=1e-14)
    np.testing.assert_array_equal(blind.estimate.covariance, HERE.at(300_000_000, 2.0).covariance)


def test_time_alone_lowers_existence_by_the_survival():
    """Half a second at 0.81 a second is 0.9; time that runs backwards is none."""
    assert Bernoulli(0.5, HERE).survived(0.5, 0.81).existence == pytest.approx(0.45)
    assert Bernoulli(0.5, HERE).survived(-1.0, 0.81).existence == 0.5


def test_a_certain_measurement_is_a_kalman_update():
    seen = Sighting(100_000_000, np.array([3.5, 4.5]), PLAIN)
    track = updated(Bernoulli(0.9, HERE), 0.7, np.array([1.0]), [seen], 300_000_000, 2.0)
    expected = HERE.at(100_000_000, 2.0).updated(seen.position_m, PLAIN)
    assert track.estimate.stamp_ns == 100_000_000
    np.testing.assert_array_equal(track.estimate.mean, expected.mean)
    np.testing.assert_array_equal(track.estimate.covariance, expected.covariance)


def test_two_equal_measurements_leave_it_between_them_and_vaguer():
    """2 m apart along x, either as likely: in the middle, along x the spread of the two updated means on top."""
    pair = [Sighting(0, np.array([3.0 + side, 4.0]), PLAIN) for side in (-1.0, 1.0)]
    track = updated(Bernoulli(1.0, HERE), 1.0 - 1e-12, np.array([0.5, 0.5]), pair, 0, 2.0)
    single = HERE.updated(pair[0].position_m, PLAIN)
    np.testing.assert_allclose(track.estimate.mean, HERE.mean, atol=1e-12)
    spread = (single.mean[0] - 3.0) ** 2
    assert track.estimate.covariance[0, 0] == pytest.approx(single.covariance[0, 0] + spread)
    assert track.estimate.covariance[1, 1] == pytest.approx(single.covariance[1, 1])


def test_no_scan_makes_an_object_certain():
    seen = [Sighting(0, HERE.mean[:2], PLAIN)]
    assert updated(Bernoulli(0.99, HERE), 0.9, np.array([1.0]), seen, 0, 2.0).existence == MAX_EXISTENCE


def test_an_object_begins_with_its_score_and_what_is_left_to_explain():
    """Score 0.8, a quarter explained by tracks: 0.6. Its velocity is nothing known."""
    seen = Sighting(5, np.array([1.0, 2.0]), PLAIN, score=0.8, object_class="van")
    track = born(seen, 0.25, 8.0)
    assert track.existence == pytest.approx(0.6)
    assert track.object_class == "van"
    np.testing.assert_array_equal(track.estimate.mean, [1.0, 2.0, 0.0, 0.0])
    np.testing.assert_array_equal(track.estimate.covariance, np.diag([1.0, 1.0, 64.0, 64.0]))
    assert born(seen, 1.0 + 1e-9, 8.0).existence == 0.0


def test_the_class_is_that_of_the_most_weight():
    """car at 0.6, then van twice at 0.5: 1.0 for the van; without any class none."""
    track = born(Sighting(0, HERE.mean[:2], PLAIN, 0.6, "car"), 0.0, 8.0)
    assert track.object_class == "car"
    for _ in range(2):
        van = Sighting(0, HERE.mean[:2], PLAIN, 0.5, "van")
        track = updated(track, 0.7, np.array([1.0]), [van], 0, 2.0)
    assert track.object_class == "van"
    assert Bernoulli(0.5, HERE).object_class == ""


def doppler(speed_mps: float, azimuth_rad: float = 0.0) -> Sighting:
    radial = RadialSpeed(azimuth_rad=azimuth_rad, speed_mps=speed_mps, std_mps=0.5)
    return Sighting(0, HERE.mean[:2], PLAIN, 0.8, radial_speed=radial)


def test_an_object_begins_with_the_speed_that_doppler_shows():
    """Along y, 3 m/s of 8 m/s standard deviation before; a speed that no prior allows (40 m/s) is of something else."""
    begun = born(doppler(3.0, np.pi / 2), 0.0, 8.0).estimate
    np.testing.assert_allclose(begun.mean[2:], [0.0, 3.0 * 64.0 / 64.25], atol=1e-12)
    assert begun.covariance[3, 3] == pytest.approx(64.0 * 0.25 / 64.25)
    assert born(doppler(40.0), 0.0, 8.0).estimate.mean.tolist() == [3.0, 4.0, 0.0, 0.0]


def test_a_measured_speed_moves_a_track_where_it_agrees():
    """HERE knows its velocity to 2 m/s: 2.5 m/s is believed (gain 4 / 4.25), 7 m/s is beyond three deviations."""
    alone = np.array([1.0])
    assert updated(Bernoulli(0.9, HERE), 0.8, alone, [doppler(2.5)], 0, 2.0).estimate.mean[2] == pytest.approx(
        2.5 * 4.0 / 4.25
    )
    assert updated(Bernoulli(0.9, HERE), 0.8, alone, [doppler(7.0)], 0, 2.0).estimate.mean[2] == 0.0


def test_existence_is_a_plain_number():
    """A NumPy scalar would travel as an array does: bytes."""
    assert type(after(0.5, 0.8, 1.0, [Sighting(0, HERE.mean[:2], PLAIN)]).existence) is float
    assert type(after(0.5, 0.8, 0.0, []).existence) is float
