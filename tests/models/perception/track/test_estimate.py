"""The Kalman estimate: closed forms of its noise and of mixtures, and honest covariances in simulated motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from models.perception.track.estimate import Estimate, mixture, motion_noise


@pytest.mark.parametrize(("elapsed_s", "cross"), [(0.3, 0.09), (-0.3, -0.09)])
def test_motion_noise_forth_and_back_in_time(elapsed_s: float, cross: float):
    """White acceleration a of density q = 2 m2/s3 over 0.3 s: forth v errs by the integral of a and x by that of
    (0.3 - s) a, so xx = q t^3 / 3 = 0.018, vv = q t = 0.6, xv = q t^2 / 2 = 0.09. Back in time v errs by minus the
    integral and x by plus that of s a, s from the earlier time on: the same variances, xv = -0.09.
    """
    expected = np.kron([[0.018, cross], [cross, 0.6]], np.eye(2))
    np.testing.assert_allclose(motion_noise(elapsed_s, 2.0), expected, rtol=1e-12)
    known = Estimate(0, np.array([1.0, 2.0, 3.0, 4.0]), np.zeros((4, 4)))
    then = known.at(round(elapsed_s * 1e9), 2.0)
    np.testing.assert_allclose(then.covariance, expected, rtol=1e-12)
    np.testing.assert_allclose(then.mean, [1.0 + 3.0 * elapsed_s, 2.0 + 4.0 * elapsed_s, 3.0, 4.0])


def test_a_mixture_has_the_mean_and_the_covariance_of_its_parts():
    """A quarter at x = 4 and three quarters at x = 0, variance 1 each: mean 1, variance 1 + 0.25 * 9 + 0.75 * 1 = 4."""
    near, far = (Estimate(5, np.array([x, 0.0, 0.0, 0.0]), np.eye(4)) for x in (0.0, 4.0))
    both = mixture([0.75, 0.25], [near, far])
    assert both.stamp_ns == 5
    np.testing.assert_allclose(both.mean, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(both.covariance, np.diag([4.0, 1.0, 1.0, 1.0]), rtol=1e-14)


def test_a_mixture_of_different_times_is_refused():
    parts = [Estimate(stamp_ns, np.zeros(4), np.eye(4)) for stamp_ns in (1, 2)]
    with pytest.raises(ValueError, match="must be of one time, got 2"):
        mixture([0.5, 0.5], parts)


def test_covariances_hold_in_simulated_motion():
    """200 runs of 20 scans, white acceleration of the filter's own density, noise of 0.5 m: the normalised squared
    error of the state has 4 degrees of freedom, so its sum over the runs is chi-squared with 800. Bounds: 99.9 %, after
    the 5th, 10th and 20th scan.
    """
    rng, density, noise_m2 = np.random.default_rng(61), 2.0, 0.25 * np.eye(2)
    low, high = chi2.interval(0.999, 4 * 200)
    square_root = np.linalg.cholesky(motion_noise(0.3, density))
    squares = np.zeros((200, 20))
    for run in range(200):
        state = np.concatenate([rng.uniform(-20.0, 20.0, 2), 8.0 * rng.standard_normal(2)])
        covariance = np.diag([0.25, 0.25, 64.0, 64.0])
        measured = state[:2] + 0.5 * rng.standard_normal(2)
        estimate = Estimate(0, np.append(measured, np.zeros(2)), covariance)
        for scan in range(1, 21):
            state = (np.eye(4) + 0.3 * np.eye(4, k=2)) @ state + square_root @ rng.standard_normal(4)
            measured = state[:2] + 0.5 * rng.standard_normal(2)
            estimate = estimate.at(scan * 300_000_000, density).updated(measured, noise_m2)
            error = estimate.mean - state
            squares[run, scan - 1] = error @ np.linalg.solve(estimate.covariance, error)
    for scan in (5, 10, 20):
        assert low < squares[:, scan - 1].sum() < high


def test_a_radial_speed_corrects_velocity_along_its_direction_alone():
    """Velocity unknown by 8 m/s, 3 m/s +- 0.5 measured along 30 deg: gain 64 / 64.25 along it; across, nothing."""
    direction = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    across = np.array([-direction[1], direction[0]])
    after = Estimate(0, np.array([5.0, 1.0, 0.0, 0.0]), np.diag([1.0, 1.0, 64.0, 64.0])).updated_along(
        direction, 3.0, 0.5
    )
    assert direction @ after.mean[2:] == pytest.approx(3.0 * 64.0 / 64.25)
    assert across @ after.mean[2:] == pytest.approx(0.0, abs=1e-12)
    velocity = after.covariance[2:, 2:]
    assert direction @ velocity @ direction == pytest.approx(64.0 * 0.25 / 64.25)
    assert across @ velocity @ across == pytest.approx(64.0)
    np.testing.assert_array_equal(after.mean[:2], [5.0, 1.0])
