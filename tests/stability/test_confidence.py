"""Hard cases of the confidence model: nothing, one thing, absurd numbers, data that fit too well."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from lab.training.fit_confidence import FitConfig, fit_weights
from models.perception.mirrors.confidence import CLIP, FEATURES, LARGEST, PositionConfidence, position_features
from models.perception.mirrors.image_walls import DirectReturns, RecoveryParams
from models.perception.mirrors.mirror_table import NO_WALL
from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan, recover_bev
from models.perception.mirrors.recovery import Recovered
from msgs.values.perception import Peaks, Wall
from tests.builders import peaks_at

FACADE = [[12.0, y] for y in np.linspace(-6.0, 6.0, 13)]


def fitted(features: np.ndarray, is_true: np.ndarray) -> PositionConfidence:
    return fit_weights(features, is_true, FitConfig(hidden=4))


@pytest.fixture(scope="module")
def model() -> PositionConfidence:
    features = np.random.default_rng(0).standard_normal((200, len(FEATURES)))
    return fitted(features, features[:, 1] > 0.0)


def peaks_of(returns: list[list[float]], images: list[list[float]], std_rad: float = 1e-2) -> Peaks:
    return peaks_at(returns, images, (0.1, std_rad))


@pytest.mark.parametrize("association", ["crossing", "buddy"])
@pytest.mark.parametrize(
    ("returns", "images"),
    [
        ([], []),
        (FACADE, []),
        ([], [[20.0, 3.0]]),
        (FACADE, [[20.0, 3.0]]),
        ([[12.0, 0.0]], [[20.0, 3.0]]),
        ([[0.0, 0.0]], [[20.0, 3.0]]),
        (FACADE, [[1e5, 3.0]]),
        (FACADE, [[20.0, 3.0]] * 50),
    ],
    ids=["nothing", "no images", "no returns", "one place", "one return", "at the radar", "far off", "all on one spot"],
)
def test_scans_without_much_in_them_pass(
    model: PositionConfidence, association: str, returns: list[list[float]], images: list[list[float]]
) -> None:
    """Every place has a probability, whatever is missing around it."""
    peaks, plain = peaks_of(returns, images), GeometryParams()
    recovery = msgspec.structs.replace(plain.recovery, association=association)
    params = msgspec.structs.replace(plain, recovery=recovery)
    everything = msgspec.structs.replace(model, threshold=1e-9)
    recovered = fold_scan(peaks, params, confidence=everything).recovered
    np.testing.assert_array_equal(recovered.points_m, fold_scan(peaks, params).recovered.points_m)
    assert ((recovered.score > 0.0) & (recovered.score < 1.0)).all()
    assert len(recover_bev(peaks, params, confidence=model).points) <= len(recovered)


def test_features_of_absurd_scans_stay_finite_and_bounded() -> None:
    """Scores of 0 and 1, powers and errors beyond all measure, rays along the wall: all within the model's range."""
    wall = Wall(normal=(-1.0, 0.0), offset_m=12.0, ends_m=((12.0, -6.0), (12.0, 6.0)), inliers=9, angle_std_rad=1e3)
    bent = msgspec.structs.replace(wall, curvature_per_m=0.05)
    images_m = np.array([[20.0, 3.0], [0.0, 20.0], [0.0, 0.0], [1e9, -1e9], [12.0, 30.0]])
    count = len(images_m)
    one = Recovered(
        points_m=images_m[::-1], images_m=images_m, image_covariance_m2=np.tile(1e12 * np.eye(2), (count, 1, 1)),
        wall_covariance_m2=np.zeros((count, 2, 2)), wall=np.array([0, 1, 0, 1, NO_WALL]),
        second=np.full(count, NO_WALL),
        score=np.array([0.0, 1.0, 0.5, 1.0, 0.0]), snr_db=np.array([-300.0, 300.0, 0.0, 1e6, -1e6]),
        stamp_ns=np.zeros(count, np.int64), radial_speed_mps=np.full(count, np.nan),
    )  # fmt: skip
    returns = DirectReturns(np.array(FACADE), np.full(13, 1e6), np.zeros(13, np.int64), np.zeros(13, np.int64))
    for places in (one, replace(one, image_covariance_m2=np.zeros((count, 2, 2)))):
        features = position_features(places, [wall, bent], returns, RecoveryParams())
        assert (np.abs(features) <= 70.0).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, 2.0 * LARGEST])
def test_numbers_beyond_reason_are_refused_not_answered(model: PositionConfidence, value: float) -> None:
    features = np.zeros((3, len(FEATURES)))
    features[1, 2] = value
    with pytest.raises(ValueError, match=f"features must be within 1000, {FEATURES[2]} is"):
        model.probability(features)


def test_features_of_another_shape_are_refused(model: PositionConfidence) -> None:
    with pytest.raises(ValueError, match=r"features must have shape \[N, 28\], got \(2, 3\)"):
        model.probability(np.zeros((2, 3)))
    assert model.probability(np.zeros((0, len(FEATURES)))).shape == (0,)


def test_beyond_what_was_fitted_the_answer_stays_that_of_the_edge(model: PositionConfidence) -> None:
    edge = np.array(model.means) + CLIP * np.array(model.scales)
    near, far = model.probability(np.stack([edge, edge + 100.0]))
    assert near == pytest.approx(far, rel=1e-9)


def test_features_that_are_all_equal_tell_the_share_of_the_true() -> None:
    """300 of 400 places true and nothing to tell them by: 0.75; the penalty leaves the bias free."""
    is_true = np.arange(400) % 4 > 0
    flat = fitted(np.full((400, len(FEATURES)), 7.0), is_true)
    np.testing.assert_allclose(flat.probability(np.full((2, len(FEATURES)), 7.0)), 0.75, atol=1e-3)


def test_separable_data_do_not_blow_up_the_weights() -> None:
    """One feature tells all: the penalty keeps weights of order one and leaves every answer in doubt."""
    features = np.random.default_rng(1).standard_normal((400, len(FEATURES)))
    sure = fitted(features, features[:, 3] > 0.0)
    assert max(np.abs(sure.weights).max(), np.abs(sure.hidden_weights).max()) < 10.0
    answers = sure.probability(features)
    assert ((answers > 1e-4) & (answers < 1.0 - 1e-4)).all()
    assert ((answers > 0.5) == (features[:, 3] > 0.0)).mean() > 0.97


def test_one_true_place_among_many_does_not_break_the_fit() -> None:
    features = np.random.default_rng(2).standard_normal((300, len(FEATURES)))
    rare = fitted(features, np.arange(300) == 5)
    assert rare.probability(features).mean() == pytest.approx(1.0 / 300.0, abs=2e-3)
