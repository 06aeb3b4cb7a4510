"""Fit of the model of the probability that a folded position is true: penalised maximum likelihood, by L-BFGS.

Weights come from training scenes, the threshold from validation scenes: that of the best recovered F1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from lab.measures.point_scores import Counts, recovered_counts
from lab.training.calibration import calibration_error
from lab.training.data.frames import Frame
from models.perception.find.detectors import Detector
from models.perception.mirrors.confidence import FEATURES, PositionConfidence, position_features, standardised
from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan
from msgs.values.perception import PathClass

#: Maximum distance of a true position from truth; the gate of the recovered F1.
REACH_M = 1.0
THRESHOLDS = tuple(round(0.05 + 0.025 * step, 3) for step in range(25))


class FitConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the fit."""

    hidden: int = 16
    #: Weight of half the sum of squared weights beside the mean log loss.
    penalty: float = 3e-3
    iterations: int = 300
    seed: int = 0


@dataclass(frozen=True)
class ScenePositions:
    """The folded positions of one scene [N, 2], their features [N, F] and peak scores [N], and all true ones [M, 2]."""

    points_m: np.ndarray
    features: np.ndarray
    score: np.ndarray
    truth_m: np.ndarray

    @property
    def is_true(self) -> np.ndarray:
        """Return whether each position lies within reach of a true one; bool [N]."""
        if len(self.points_m) == 0 or len(self.truth_m) == 0:
            return np.zeros(len(self.points_m), bool)
        return np.asarray(cKDTree(self.truth_m).query(self.points_m)[0] < REACH_M)


def scene_positions(frame: Frame, detector: Detector, params: GeometryParams) -> ScenePositions:
    """Return the positions that the geometry stage derives from a detector's peaks in a frame."""
    peaks = detector.detect(frame.ra_map)
    scan = fold_scan(peaks, params)
    features = position_features(scan.recovered, scan.walls, scan.returns, params.recovery)
    return ScenePositions(scan.recovered.points_m, features, scan.recovered.score, _true_places(frame))


def _true_places(frame: Frame) -> np.ndarray:
    labels = frame.labels
    of_images = labels.hidden_xy_m[labels.path_class == PathClass.MIRRORED]
    places_m = np.asarray(of_images if frame.places_m is None else frame.places_m, np.float64)
    return places_m[np.isfinite(places_m).all(axis=1)]


def fit_confidence(
    train: list[ScenePositions], validation: list[ScenePositions], config: FitConfig
) -> PositionConfidence:
    """Return a model with weights from training scenes, threshold and metrics from validation scenes.

    Raises `ValueError` if the training scenes hold no true position or no false one.
    """
    model = fit_weights(*_joined(train), config)
    probability = [model.probability(scene.features) for scene in validation]
    threshold = best_threshold(validation, probability)
    metrics = confidence_metrics(validation, probability, threshold)
    return msgspec.structs.replace(model, threshold=threshold, metrics=metrics)


def _joined(scenes: list[ScenePositions]) -> tuple[np.ndarray, np.ndarray]:
    """Return features and truth of the positions of all scenes."""
    features = np.concatenate([np.zeros((0, len(FEATURES))), *(scene.features for scene in scenes)])
    return features, np.concatenate([np.zeros(0, bool), *(scene.is_true for scene in scenes)])


@dataclass(frozen=True)
class _Loss:
    """Mean log loss with penalty, and its gradient, of the weights in one row: A [H, F], a [H], w [H], b."""

    inputs: np.ndarray
    is_true: np.ndarray
    config: FitConfig

    def parts(self, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Return the row divided into A, a, w, b."""
        hidden = self.config.hidden
        matrix, rest = np.split(row, [hidden * self.inputs.shape[1]])
        return matrix.reshape(hidden, -1), rest[:hidden], rest[hidden:-1], float(rest[-1])

    def start(self) -> np.ndarray:
        """Return initial weights, of the variance that keeps activations of order one."""
        rng, hidden, count = np.random.default_rng(self.config.seed), self.config.hidden, self.inputs.shape[1]
        matrix = rng.standard_normal(hidden * count) / np.sqrt(count)
        return np.concatenate([matrix, np.zeros(hidden), rng.standard_normal(hidden) / np.sqrt(hidden), [0.0]])

    def __call__(self, row: np.ndarray) -> tuple[float, np.ndarray]:
        matrix, shift, weights, bias = self.parts(row)
        active = np.tanh(self.inputs @ matrix.T + shift)
        logit = active @ weights + bias
        penalty = self.config.penalty
        loss = np.mean(np.logaddexp(0.0, logit) - self.is_true * logit)
        loss += 0.5 * penalty * (np.sum(matrix**2) + np.sum(weights**2))
        # 0.5 (1 + tanh(z / 2)) is the sigmoid without overflow
        error = (0.5 * (1.0 + np.tanh(0.5 * logit)) - self.is_true) / len(logit)
        back = error[:, None] * weights * (1.0 - active**2)
        gradient = [(back.T @ self.inputs + penalty * matrix).ravel(), back.sum(axis=0)]
        return float(loss), np.concatenate([*gradient, active.T @ error + penalty * weights, [error.sum()]])


def fit_weights(features: np.ndarray, is_true: np.ndarray, config: FitConfig) -> PositionConfidence:
    """Return a model of features [N, F] and truth [N], threshold 0.5; features that are all equal are ignored."""
    if len(np.unique(is_true)) < 2:
        raise ValueError(f"places to fit must be true and false, got {len(is_true)} of one kind")
    means, spread = features.mean(axis=0), features.std(axis=0)
    scales = np.where(spread > 1e-6, spread, 1.0)
    loss = _Loss(standardised(features, means, scales), is_true.astype(np.float64), config)
    solution = minimize(loss, loss.start(), jac=True, method="L-BFGS-B", options={"maxiter": config.iterations})
    matrix, shift, weights, bias = loss.parts(solution.x)
    return PositionConfidence(
        features=FEATURES,
        means=tuple(means.tolist()),
        scales=tuple(scales.tolist()),
        hidden_weights=tuple(tuple(row) for row in matrix.tolist()),
        hidden_biases=tuple(shift.tolist()),
        weights=tuple(weights.tolist()),
        bias=bias,
        threshold=0.5,
        seed=config.seed,
    )


def best_threshold(scenes: list[ScenePositions], probability: list[np.ndarray]) -> float:
    """Return the threshold of the best recovered F1 within 1 m; the lowest of equals."""
    return max(THRESHOLDS, key=lambda threshold: _counts(scenes, probability, threshold, REACH_M).f1)


def _counts(scenes: list[ScenePositions], probability: list[np.ndarray], threshold: float, tau_m: float) -> Counts:
    pairs = zip(scenes, probability, strict=True)
    return sum((recovered_counts(scene.points_m[p >= threshold], scene.truth_m, tau_m) for scene, p in pairs), Counts())


def confidence_metrics(
    scenes: list[ScenePositions], probability: list[np.ndarray], threshold: float
) -> dict[str, float]:
    """Return recovered scores with and without a threshold, and the errors of probabilities and peak scores."""
    _, is_true = _joined(scenes)
    probabilities = np.concatenate([np.zeros(0), *probability])
    score = np.concatenate([np.zeros(0), *(scene.score for scene in scenes)])
    metrics = {
        "calibration_error": calibration_error(probabilities, is_true),
        "calibration_error_without": calibration_error(score, is_true),
    }
    for tau_m in (REACH_M, 2.0 * REACH_M):
        for name, at in (("", threshold), ("_without", 0.0)):
            counts = _counts(scenes, probability, at, tau_m)
            metrics |= {f"f1_{tau_m:.0f}m{name}": counts.f1, f"precision_{tau_m:.0f}m{name}": counts.precision}
            metrics[f"recall_{tau_m:.0f}m{name}"] = counts.recall
    return {name: round(float(value), 4) for name, value in metrics.items()}


def collected(
    frames: Iterable[Frame],
    detector: Detector,
    params: GeometryParams,
    on_scene: Callable[[], None] = lambda: None,
) -> list[ScenePositions]:
    """Return the positions of many scenes; `on_scene` is called for each."""
    scenes = []
    for frame in frames:
        scenes.append(scene_positions(frame, detector, params))
        on_scene()
    return scenes
