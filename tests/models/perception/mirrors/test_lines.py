from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.lines import SCATTER_WIDTH_M, LineFit, claimed, fit_line, gains


def line_gain(
    points_m: np.ndarray, covariance_m2: np.ndarray, normals: np.ndarray, offsets_m: np.ndarray
) -> np.ndarray:
    """Return what each point [N] adds to each line's [H] score (`residual_gain`), zero for outliers; float64 [H, N]."""
    points_m, covariance_m2 = np.array(points_m, np.float64), np.array(covariance_m2, np.float64)
    rows = [gains(points_m, covariance_m2, nx, ny, d) for (nx, ny), d in zip(normals, offsets_m, strict=True)]
    return np.array(rows).reshape(len(offsets_m), len(points_m))


def cloud(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points about a line somewhere, and covariances of all shapes."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.0, math.pi)
    along = rng.uniform(-8.0, 8.0, count)[:, None] * [math.cos(turn), math.sin(turn)]
    roots = rng.normal(0.0, 0.3, (count, 2, 2))
    points = rng.uniform(-30.0, 30.0, 2) + along + rng.normal(0.0, 0.3, (count, 2))
    return points, roots @ roots.transpose(0, 2, 1) + 0.01 * np.eye(2)


def by_arrays(points: np.ndarray, covariance: np.ndarray, rounds: int) -> tuple[np.ndarray, float, float, float]:
    """Iterated weighted total least squares as eigenvectors of the weighted scatter."""
    weights = 1.0 / np.trace(covariance, axis1=1, axis2=2)
    for _ in range(rounds):
        centre = np.average(points, axis=0, weights=weights)
        normal = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, points - centre, points - centre))[1][:, 0]
        weights = 1.0 / np.einsum("i,nij,j->n", normal, covariance, normal)
    normal = -normal if -normal @ centre < 0.0 else normal
    residual = (points - centre) @ normal
    along = (points - centre) @ [-normal[1], normal[0]]
    inflate = max(1.0, float(weights @ residual**2) / (len(points) - 2))
    angle_variance = inflate / float(weights @ along**2)
    middle = 0.5 * (along.min() + along.max())
    offset_variance = inflate / weights.sum() + middle**2 * angle_variance
    return normal, float(-normal @ centre), math.sqrt(angle_variance), math.sqrt(offset_variance)


@pytest.mark.parametrize("seed", range(20))
def test_fit_is_weighted_total_least_squares(seed: int) -> None:
    points, covariance = cloud(seed, 3 + 2 * seed)
    normal, *rest = fit_line(points, covariance)
    expected_normal, *expected = by_arrays(points, covariance, 3)
    np.testing.assert_allclose(normal, expected_normal, atol=1e-9)
    np.testing.assert_allclose(rest, expected, rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_gain_is_the_log_likelihood_over_scattered_points(seed: int) -> None:
    points, covariance = cloud(seed, 30)
    turns = np.random.default_rng(seed).uniform(0.0, math.pi, 12)
    normals = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    offsets = -(normals @ points.mean(axis=0))
    variance = np.einsum("hi,nij,hj->hn", normals, covariance, normals)
    residual = normals @ points.T + offsets[:, None]
    density = np.maximum(np.exp(-0.5 * residual**2 / variance), 1e-99) / np.sqrt(2.0 * math.pi * variance)
    expected = np.where(residual**2 <= 9.0 * variance, np.maximum(np.log(SCATTER_WIDTH_M * density), 0.0), 0.0)
    assert 0 < np.count_nonzero(expected) < expected.size
    np.testing.assert_allclose(line_gain(points, covariance, normals, offsets), expected, atol=1e-9)


def test_gain_of_no_line_and_of_no_point() -> None:
    points, covariance = cloud(0, 4)
    assert line_gain(points, covariance, np.zeros((0, 2)), np.zeros(0)).shape == (0, 4)
    assert line_gain(points[:0], covariance[:0], np.eye(2), np.zeros(2)).shape == (2, 0)


def test_fit_takes_arrays_of_any_layout() -> None:
    """Read-only, strided and broadcast: the same answer as for plain copies."""
    points, covariance = cloud(1, 9)
    strided = np.repeat(points, 2, axis=0)[::2]
    strided.flags.writeable = False
    for one, other in zip(fit_line(strided, covariance), fit_line(points, covariance), strict=True):
        np.testing.assert_array_equal(one, other)
    same = np.broadcast_to(np.eye(2), (9, 2, 2))
    np.testing.assert_array_equal(fit_line(points, same)[0], fit_line(points, same.copy())[0])


def test_claimed_points_are_those_of_any_wall() -> None:
    fits = [LineFit(np.array([1.0, 0.0]), 0.0, np.array(on), 0.0, np.zeros((2, 2)), 0.0, 0.0) for on in ([1, 3], [3])]
    assert claimed(5, fits).tolist() == [False, True, False, True, False]
    assert not claimed(3, []).any()
