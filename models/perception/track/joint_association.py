"""Joint probabilistic association of the objects of a scan with tracks: each of either has at most one of the other.

Gates part clusters. Small ones are exact, by dynamic programming over sets of taken partners; larger ones come from
loopy belief propagation (J. L. Williams, R. A. Lau, "Approximate evaluation of marginal association probabilities with
belief propagation", IEEE TAES 2014).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from models.perception.track.estimate import Estimate
from models.perception.track.measurements import Sighting
from msgs.values.units import s_from_ns

#: Square of the Mahalanobis distance: 99.97 % of true pairs in two dimensions.
GATE = 16.0
#: A cluster is summed exactly where the rarer kind has so few members and the other so few.
EXACT_FEW, EXACT_MANY = 6, 64
#: Propagation ends after so many rounds, or when no message changes by more.
MAX_ROUNDS, TOLERANCE = 100, 1e-7
#: Largest logarithm of the odds of a pair against a miss: products of `EXACT_FEW` stay finite.
MAX_LOG_ODDS = 80.0
#: Relative to the other, the least variance of an innovation: what rounding leaves of it.
_LEAST_VARIANCE = 1e-12


def log_likelihoods(tracks: Sequence[Estimate], measurements: Sequence[Sighting], density_m2ps3: float) -> np.ndarray:
    """Return the log density [1/m^2] of each measurement by each track at its time [T, M]; -inf outside the gate."""
    if not tracks or not measurements:
        return np.full((len(tracks), len(measurements)), -np.inf)
    mean = np.array([track.mean for track in tracks])[:, None]
    covariance = np.array([track.covariance for track in tracks])[:, None]
    stamps_ns = [measurement.stamp_ns for measurement in measurements]
    # differences of integers: stamps are too large for floating point
    elapsed_s = np.array([[s_from_ns(stamp_ns - track.stamp_ns) for stamp_ns in stamps_ns] for track in tracks])
    at = elapsed_s[..., None, None]
    cross = covariance[..., :2, 2:]
    spread = covariance[..., :2, :2] + at * (cross + cross.swapaxes(-1, -2)) + at**2 * covariance[..., 2:, 2:]
    spread = spread + (density_m2ps3 / 3.0) * np.abs(at) ** 3 * np.eye(2)
    spread = spread + np.array([measurement.covariance_m2 for measurement in measurements])
    position_m = np.array([measurement.position_m for measurement in measurements])
    offset = position_m - mean[..., :2] - elapsed_s[..., None] * mean[..., 2:]
    return _log_density(offset, spread)


def _log_density(offset: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the logarithm of Gaussian densities at offsets [..., 2] with covariances [..., 2, 2]."""
    xx, xy, yy = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
    # along the axes of the ellipse, so that a thin one is no difference of large numbers
    half_turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    middle, radius = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    major = middle + radius
    minor = np.maximum(middle - radius, _LEAST_VARIANCE * major)
    c, s = np.cos(half_turn), np.sin(half_turn)
    along, across = c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]
    distance2 = along**2 / major + across**2 / minor
    log_density = -0.5 * (distance2 + np.log(major) + np.log(minor)) - np.log(2.0 * np.pi)
    return np.where(distance2 <= GATE, log_density, -np.inf)


def marginal_probabilities(log_odds: np.ndarray) -> np.ndarray:
    """Return the probability [T, M] that a measurement is that of a track; rows and columns add up to at most 1.

    `log_odds` [T, M] over a track missed and a measurement of no track; minus infinity for what cannot be.
    """
    probability = np.zeros(log_odds.shape)
    odds = np.exp(np.minimum(log_odds, MAX_LOG_ODDS))
    for rows, columns in _clusters(odds > 0.0):
        part = odds[np.ix_(rows, columns)]
        probability[np.ix_(rows, columns)] = exact(part) if is_small(part.shape) else propagated(part)
    return probability


def _clusters(possible: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rows and columns of each connected part of possible pairs [T, M]; what stands alone is left out."""
    if not possible.any():
        return []
    tracks, measurements = np.nonzero(possible)
    count = sum(possible.shape)
    graph = coo_array((np.ones(len(tracks)), (tracks, len(possible) + measurements)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    first, second = label[: len(possible)], label[len(possible) :]
    return [(np.flatnonzero(first == part), np.flatnonzero(second == part)) for part in np.unique(first[tracks])]


def is_small(shape: tuple[int, ...]) -> bool:
    """Return whether a cluster of so many tracks and measurements is summed exactly."""
    return min(shape) <= EXACT_FEW and max(shape) <= EXACT_MANY


def exact(odds: np.ndarray) -> np.ndarray:
    """Return the marginals of a cluster [T, M] of pairs with odds over all joint events, rows from either end."""
    if odds.shape[0] < odds.shape[1]:
        return exact(odds.T).T
    rows, columns = odds.shape
    taken = np.arange(1 << columns)
    free = [taken[taken & (1 << column) == 0] for column in range(columns)]
    before = np.zeros((rows + 1, len(taken)))
    after = np.ones((rows + 1, len(taken)))
    before[0, 0] = 1.0
    for row in range(rows):
        before[row + 1] = before[row]
        for column, sets in enumerate(free):
            before[row + 1, sets | (1 << column)] += odds[row, column] * before[row, sets]
    for row in reversed(range(rows)):
        after[row] = after[row + 1]
        for column, sets in enumerate(free):
            after[row, sets] += odds[row, column] * after[row + 1, sets | (1 << column)]
    weights = np.empty(odds.shape)
    for column, sets in enumerate(free):
        weights[:, column] = odds[:, column] * np.sum(before[:-1, sets] * after[1:, sets | (1 << column)], axis=1)
    return weights / after[0, 0]


def propagated(odds: np.ndarray) -> np.ndarray:
    """Return approximate marginal probabilities of a cluster [T, M] by loopy belief propagation."""
    free = np.ones(odds.shape)
    for _ in range(MAX_ROUNDS):
        claims = odds / (1.0 + _sum_of_rest(odds * free, axis=1))
        before, free = free, 1.0 / (1.0 + _sum_of_rest(claims, axis=0))
        if np.abs(free - before).max() <= TOLERANCE:
            break
    weights = odds * free
    return np.asarray(weights / (1.0 + weights.sum(axis=1, keepdims=True)))


def _sum_of_rest(values: np.ndarray, axis: int) -> np.ndarray:
    """Return for each value [T, M] the sum of all others along an axis; no difference, which large ones would spoil."""
    values = np.moveaxis(values, axis, 0)
    rest = np.zeros_like(values)
    rest[1:] += np.cumsum(values[:-1], axis=0)
    rest[:-1] += np.cumsum(values[:0:-1], axis=0)[::-1]
    return np.moveaxis(rest, 0, axis)
