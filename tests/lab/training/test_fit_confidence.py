"""The fit of the confidence model: its gradient, a planted law, the threshold, and its verdict on itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from lab.training.data.frames import Frame, FrameLabels
from lab.training.fit_confidence import (
    FitConfig,
    ScenePositions,
    _Loss,
    best_threshold,
    confidence_metrics,
    fit_confidence,
    fit_weights,
    scene_positions,
)
from models.perception.mirrors.confidence import FEATURES
from models.perception.mirrors.peaks_to_view import GeometryParams, made_up_peaks
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import RangeAzimuthMap


def drawn(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features, truth and its probability: 0.9 where the first two features have one sign, 0.1 elsewhere."""
    rng = np.random.default_rng(seed)
    features = rng.standard_normal((count, len(FEATURES)))
    probability = np.where(features[:, 0] * features[:, 1] > 0.0, 0.9, 0.1)
    return features, rng.random(count) < probability, probability


def scene(points: list[list[float]], truth: list[list[float]]) -> ScenePositions:
    points_m = np.array(points, np.float64).reshape(-1, 2)
    features = np.random.default_rng(len(points)).standard_normal((len(points), len(FEATURES)))
    return ScenePositions(points_m, features, np.full(len(points), 0.5), np.array(truth, np.float64).reshape(-1, 2))


def test_the_gradient_is_that_of_the_loss() -> None:
    """Against forward differences of 1e-6: 1e-5 of gradients of order 0.1."""
    features, is_true, _ = drawn(40, 1)
    loss = _Loss(features, is_true.astype(float), FitConfig(hidden=3, penalty=0.1))
    at = loss.start() + 0.1
    np.testing.assert_allclose(loss(at)[1], approx_fprime(at, lambda row: loss(row)[0], 1e-6), atol=1e-5)


def test_a_planted_law_no_line_tells_is_found() -> None:
    """6000 places: the fit's probabilities are within 0.2 of the true ones on average (a constant, a line: 0.4)."""
    features, is_true, _ = drawn(6000, 2)
    fitted = fit_weights(features, is_true, FitConfig(hidden=8))
    fresh, _, probability = drawn(2000, 3)
    assert np.abs(fitted.probability(fresh) - probability).mean() < 0.2


def test_the_same_seed_gives_the_same_model_another_another() -> None:
    features, is_true, _ = drawn(300, 4)
    one, again, other = (fit_weights(features, is_true, FitConfig(hidden=4, seed=seed)) for seed in (0, 0, 1))
    assert one == again
    assert one.hidden_weights != other.hidden_weights


def test_a_place_is_true_within_a_metre() -> None:
    assert scene([[0.0, 0.0], [3.0, 0.0]], [[0.99, 0.0], [4.01, 0.0]]).is_true.tolist() == [True, False]
    assert scene([[0.0, 0.0]], []).is_true.tolist() == [False]


class MadeUp:
    """The same peaks in every map."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        return made_up_peaks()


@pytest.mark.parametrize("by_labels", [True, False])
def test_truth_is_the_places_known_in_both_coordinates(by_labels: bool) -> None:
    """Of four places one is known in x alone and one not at all; of labels the one in direct sight does not count."""
    places_m = np.array([[11.0, -9.0], [12.0, np.nan], [np.nan, np.nan], [13.0, -4.0]])
    point = np.zeros(4)
    labels = FrameLabels(
        range_m=point, azimuth_rad=point, path_class=np.array([1, 1, 1, 0]) * PathClass.MIRRORED, order=point,
        hidden_xy_m=places_m, power_mw=point, object_index=point, object_class=point,
    )  # fmt: skip
    frame = Frame(
        index=0, ra_map=None, labels=labels, place="", objects=(), hidden=(), scene_yaml="", sequence="",
        places_m=None if by_labels else places_m,
    )  # type: ignore[arg-type]  # fmt: skip
    found = scene_positions(frame, MadeUp(), GeometryParams())
    assert found.truth_m.tolist() == [[11.0, -9.0]] + ([] if by_labels else [[13.0, -4.0]])
    assert len(found.is_true) == len(found.points_m) > 0


def test_the_threshold_is_that_of_the_best_f1_and_metrics_say_so() -> None:
    """One true place at p = 0.6, false ones at 0.3 and 0.5: all three above 0.5 and below 0.6 are dropped."""
    scenes, probability = [scene([[0, 0], [9, 0], [20, 0]], [[0, 0]])], [np.array([0.6, 0.3, 0.5])]
    threshold = best_threshold(scenes, probability)
    assert threshold == pytest.approx(0.525)
    found = confidence_metrics(scenes, probability, threshold)
    assert (found["f1_1m"], found["precision_1m_without"], found["recall_1m_without"]) == (1.0, 0.3333, 1.0)
    assert found["f1_1m_without"] == 0.5


def test_scenes_without_places_count_their_misses() -> None:
    """All truth of an empty scene is missed: recall 1 of 3."""
    scenes = [scene([[0, 0]], [[0, 0]]), scene([], [[5, 5], [9, 9]])]
    found = confidence_metrics(scenes, [np.array([0.9]), np.zeros(0)], 0.5)
    assert found["recall_1m"] == pytest.approx(1.0 / 3.0, abs=1e-4)


def places_of(likely: tuple[int, int], doubtful: tuple[int, int]) -> ScenePositions:
    """So many true and false places of two kinds, 10 m apart, told apart by the first feature: +1 and -1."""
    is_true = np.repeat([True, False, True, False], [*likely, *doubtful])
    points_m = np.column_stack([10.0 * np.arange(len(is_true)), np.zeros(len(is_true))])
    features = np.zeros((len(is_true), len(FEATURES)))
    features[:, 0] = np.repeat([1.0, -1.0], [sum(likely), sum(doubtful)])
    return ScenePositions(points_m, features, np.full(len(is_true), 0.5), points_m[is_true])


def test_weights_are_those_of_training_scenes_threshold_and_metrics_those_of_validation_scenes() -> None:
    """In training 9 of 10 likely places are true and 6 of 10 doubtful ones: those are the probabilities, within 0.05
    (the penalty draws both to the middle). There all places together give F1 = 2 * 15 / (20 + 15) = 0.857, the likely
    ones alone 2 * 9 / (10 + 15) = 0.72: the lowest threshold, 0.05, would be best. In validation 2 of 2 likely places
    and 0 of 4 doubtful ones are true: together 2 * 2 / (6 + 2) = 0.5, the likely ones alone 1. So the threshold is the
    lowest step of 0.025 above the probability of doubtful places.
    """
    train, validation = [places_of((9, 1), (6, 4))], [places_of((2, 0), (0, 4))]
    fitted = fit_confidence(train, validation, FitConfig(hidden=2))
    likely, doubtful = (fitted.probability(np.eye(1, len(FEATURES)) * sign)[0] for sign in (1.0, -1.0))
    assert (likely, doubtful) == pytest.approx((0.9, 0.6), abs=0.05)
    assert best_threshold(train, [fitted.probability(train[0].features)]) == 0.05
    assert doubtful < fitted.threshold < doubtful + 0.0251
    found = {name: fitted.metrics[name] for name in ("f1_1m", "f1_1m_without", "recall_1m", "precision_1m_without")}
    assert found == {"f1_1m": 1.0, "f1_1m_without": 0.5, "recall_1m": 1.0, "precision_1m_without": 0.3333}
    assert {"f1_2m", "calibration_error", "calibration_error_without"} <= set(fitted.metrics)


def test_places_of_one_kind_and_wrong_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="places to fit must be true and false, got 0 of one kind"):
        fit_confidence([scene([], [])], [], FitConfig())
