"""A hypothesised object of a tracker: the probability that it exists, and where it then is.

Existence follows Bayes' rule (D. Musicki, R. Evans, "Joint integrated probabilistic data association", IEEE TAES 2004);
the density is the Gaussian of the mean and covariance of what its possible measurements say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from models.perception.track.estimate import Estimate, mixture
from models.perception.track.measurements import Sighting

#: Nothing is certain: a track that should be seen and is not must be able to end.
MAX_EXISTENCE = 0.999
#: Measurements less probable than this share of the track's likeliest do not move it; nor do any but the first few.
NEGLIGIBLE_SHARE, MAX_MIXED = 1e-4, 24
#: Objects are one where they are nearer than this, and the squared Mahalanobis distance of their states is smaller.
SAME_M, SAME_DISTANCE2 = 1.0, 1.0
#: Square of the Mahalanobis distance of a radial speed that is believed.
SPEED_GATE = 9.0


@dataclass(frozen=True)
class Bernoulli:
    """An object that exists with a probability; weights of the classes that its measurements were judged as."""

    existence: float
    estimate: Estimate
    class_weights: Mapping[str, float] = field(default_factory=dict)

    def survived(self, elapsed_s: float, survival_per_s: float) -> Bernoulli:
        """Return the object after a time in which it may have gone."""
        return replace(self, existence=self.existence * survival_per_s ** max(elapsed_s, 0.0))

    @property
    def object_class(self) -> str:
        """The class of the largest weight, the first by name of equal ones; empty where nothing judged it."""
        return min(self.class_weights, key=lambda name: (-self.class_weights[name], name), default="")


def log_odds_of_pairs(
    existence: np.ndarray,
    detection_probability: np.ndarray,
    log_likelihood: np.ndarray,
    background_density_per_m2: np.ndarray,
) -> np.ndarray:
    """Return the log odds [T, M] that a track gave a measurement, over it missed and the measurement of another.

    `existence`, `detection_probability` [T]; `log_likelihood` [T, M] in 1/m^2; the background [M] likewise.
    """
    reported = existence * detection_probability
    with np.errstate(divide="ignore"):
        ratio = np.log(reported) - np.log1p(-reported)
    return np.asarray(ratio[:, None] + log_likelihood - np.log(background_density_per_m2))


def existence_if_missed(existence: float, detection_probability: float) -> float:
    """Return the probability that an object exists of which a scan holds no measurement."""
    return existence * (1.0 - detection_probability) / (1.0 - existence * detection_probability)


def updated(
    track: Bernoulli,
    detection_probability: float,
    probability: np.ndarray,
    measurements: Sequence[Sighting],
    stamp_ns: int,
    density_m2ps3: float,
) -> Bernoulli:
    """Return an object after a scan, of whose measurements each is its own with a `probability` [M]."""
    missed = (1.0 - min(probability.sum(), 1.0)) * existence_if_missed(track.existence, detection_probability)
    existence = missed + min(float(probability.sum()), 1.0)
    if existence <= 0.0:
        return replace(track, existence=0.0)
    kept = _considerable(probability)
    likeliest = kept[0] if len(kept) and probability[kept[0]] >= missed else None
    now_ns = max(stamp_ns, track.estimate.stamp_ns) if likeliest is None else measurements[likeliest].stamp_ns
    weights = np.append(probability[kept], missed)
    estimates = [
        _measured(track.estimate, measurements[index], density_m2ps3).at(now_ns, density_m2ps3) for index in kept
    ]
    estimates.append(track.estimate.at(now_ns, density_m2ps3))
    used = weights > NEGLIGIBLE_SHARE * weights.max()
    share = weights[used] / weights[used].sum()
    return Bernoulli(
        existence=min(float(existence), MAX_EXISTENCE),
        estimate=mixture(share, [estimate for estimate, is_used in zip(estimates, used, strict=True) if is_used]),
        class_weights=_with_classes(track.class_weights, probability, kept, measurements),
    )


def _measured(estimate: Estimate, sighting: Sighting, density_m2ps3: float) -> Estimate:
    """Return an estimate after a measurement of position and, where it agrees with it, of radial speed."""
    after = estimate.at(sighting.stamp_ns, density_m2ps3).updated(sighting.position_m, sighting.covariance_m2)
    return along(after, sighting)


def along(estimate: Estimate, sighting: Sighting) -> Estimate:
    """Return an estimate after a measured radial speed; one that lies far off is of something else in the cell."""
    radial, direction = sighting.radial_speed, sighting.direction
    if radial is None:
        return estimate
    variance = direction @ estimate.covariance[2:, 2:] @ direction + radial.std_mps**2
    if (radial.speed_mps - direction @ estimate.mean[2:]) ** 2 > SPEED_GATE * variance:
        return estimate
    return estimate.updated_along(direction, radial.speed_mps, radial.std_mps)


def _considerable(probability: np.ndarray) -> list[int]:
    """Return the measurements that move a track, likeliest first."""
    order = np.argsort(-probability, kind="stable")[:MAX_MIXED]
    return [int(index) for index in order if probability[index] > 0.0]


def _with_classes(
    weights: Mapping[str, float], probability: np.ndarray, kept: Sequence[int], measurements: Sequence[Sighting]
) -> dict[str, float]:
    """Return the weights of classes with those of the measurements added, each by its probability and score."""
    total = dict(weights)
    for index in kept:
        name = measurements[index].object_class
        if name:
            total[name] = total.get(name, 0.0) + float(probability[index]) * measurements[index].score
    return total


def born(sighting: Sighting, explained: float, first_speed_std_mps: float) -> Bernoulli:
    """Return the object that a measurement begins, of which tracks explain a share; only a radial speed is known."""
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = sighting.covariance_m2
    covariance[2:, 2:] = first_speed_std_mps**2 * np.eye(2)
    return Bernoulli(
        existence=sighting.score * (1.0 - min(max(explained, 0.0), 1.0)),
        estimate=along(Estimate(sighting.stamp_ns, np.append(sighting.position_m, np.zeros(2)), covariance), sighting),
        class_weights={sighting.object_class: sighting.score} if sighting.object_class else {},
    )


def is_same(first: Estimate, second: Estimate, density_m2ps3: float) -> bool:
    """Return whether two estimates say the same of position and velocity, as far as they know either."""
    stamp_ns = max(first.stamp_ns, second.stamp_ns)
    first, second = first.at(stamp_ns, density_m2ps3), second.at(stamp_ns, density_m2ps3)
    offset = first.mean - second.mean
    if float(np.hypot(offset[0], offset[1])) > SAME_M:
        return False
    # both may be known exactly in some direction
    information = np.linalg.pinv(first.covariance + second.covariance, hermitian=True)
    return float(offset @ information @ offset) <= SAME_DISTANCE2
