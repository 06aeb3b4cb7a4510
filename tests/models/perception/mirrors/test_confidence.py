"""Features of folded places, the model on them, its file, and what the geometry stage does with its answer."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from models.perception.mirrors.confidence import (
    FEATURES,
    FittedConfidences,
    PositionConfidence,
    load_confidence,
    position_features,
)
from models.perception.mirrors.image_walls import DirectReturns, RecoveryParams
from models.perception.mirrors.mirror_table import NO_WALL
from models.perception.mirrors.peaks_to_view import GeometryParams, recover_bev
from models.perception.mirrors.recovery import Recovered
from msgs.values.perception import Peaks, Wall
from nodes import geometry
from tests.builders import peaks_at

FACADE = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -10.0), (20.0, 10.0)), inliers=9, angle_std_rad=0.01)
SIDE = Wall(normal=(0.0, 1.0), offset_m=12.0, ends_m=((2.0, -12.0), (22.0, -12.0)), inliers=9)


def places(points: list[list[float]], images: list[list[float]], wall: list[int]) -> Recovered:
    """Errors of 0.3 m of each image in both directions, none of the walls'."""
    count = len(points)
    return Recovered(
        points_m=np.array(points, np.float64), images_m=np.array(images, np.float64),
        image_covariance_m2=np.tile(0.045 * np.eye(2), (count, 1, 1)), wall_covariance_m2=np.zeros((count, 2, 2)),
        wall=np.array(wall), second=np.full(count, NO_WALL), score=np.full(count, 0.8), snr_db=np.full(count, 25.0),
        stamp_ns=np.zeros(count, np.int64), radial_speed_mps=np.full(count, np.nan),
    )  # fmt: skip


def returns_at(points: list[list[float]], wall: list[int], snr_db: float = 30.0) -> DirectReturns:
    count = len(points)
    points_m = np.array(points, np.float64).reshape(-1, 2)
    return DirectReturns(points_m, np.full(count, snr_db), np.zeros(count, np.int64), np.array(wall, np.int64))


def model(threshold: float = 0.5, **changes: Any) -> PositionConfidence:
    """p = sigmoid(2 tanh((snr - 20 dB) / 10 dB) - 0.5) unless told otherwise."""
    own = [float(name == "snr_db") for name in FEATURES]
    fields: dict[str, Any] = {
        "features": FEATURES, "means": tuple(20.0 * one for one in own),
        "scales": tuple(1.0 + 9.0 * one for one in own),
        "hidden_weights": (tuple(own),), "hidden_biases": (0.0,), "weights": (2.0,), "bias": -0.5,
        "threshold": threshold,
    }  # fmt: skip
    return PositionConfidence(**{**fields, **changes})


def scan_of(snr_db: list[float]) -> Peaks:
    """A facade x = 20 of 19 returns, and images 8 m behind it at y = 4, 5, ... of these strengths."""
    facade_m = [[20.0, y] for y in np.linspace(-9.0, 9.0, 19)]
    images_m = [[28.0, 4.0 + k] for k in range(len(snr_db))]
    return peaks_at(facade_m, images_m, snr_db=np.array([30.0] * 19 + snr_db), sensitivity_db=109.0)


def test_features_of_a_place_worked_out_by_hand() -> None:
    """Image (28, 8), facade x = 20, place (12, 8): the ray meets the facade at (20, 40/7), nearest return (20, 5),
    and a lone return at (12, 6) is 5 dB stronger; rounding of double precision."""
    returns = returns_at([[20.0, 5.0], [20.0, -5.0], [12.0, 6.7]], [0, 0, NO_WALL])
    (row,) = position_features(places([[12.0, 8.0]], [[28.0, 8.0]], [0]), [FACADE], returns, RecoveryParams())
    found = dict(zip(FEATURES, row, strict=True))
    image_m = math.hypot(28.0, 8.0)
    expected = {
        "score_logit": math.log(4.0), "snr_db": 25.0, "image_range": math.log(image_m),
        "image_azimuth_rad": math.atan2(8.0, 28.0), "image_sigma": math.log(0.3), "sigma": math.log(0.3),
        "missed_m": 0.0, "depth": math.log(8.0), "to_wall": math.log(image_m * 20.0 / 28.0),
        "incidence": 28.0 / image_m, "mirror_gap": math.log(40.0 / 7.0 - 5.0), "twice": 0.0,
        "wall_length": math.log(20.0), "wall_angle_std_rad": 0.01, "wall_curved": 0.0, "wall_returns": math.log(3.0),
        "range": math.log(math.hypot(12.0, 8.0)), "azimuth_rad": math.atan2(8.0, 12.0),
        "nearest_return": math.log(1.3), "nearest_loose_return": math.log(1.3), "return_louder_db": 5.0,
        "nearest_wall": math.log(8.0), "behind_wall": 0.0,
        "support": 0.0, "company": 0.0, "company_score": 0.0, "places": math.log(2.0), "walls": math.log(2.0),
    }  # fmt: skip
    assert found == pytest.approx(expected, abs=1e-12)


def test_places_of_other_walls_support_and_those_of_the_same_keep_company() -> None:
    """Three places: two by the facade 1.5 m apart, one by the side wall on the first of them."""
    three = places(
        [[12.0, 8.0], [12.0, 6.5], [12.0, 8.0]], [[28.0, 8.0], [28.0, 6.5], [12.0, -32.0]], [0, 0, 1]
    )  # fmt: skip
    rows = position_features(three, [FACADE, SIDE], returns_at([], []), RecoveryParams())
    found = {name: rows[:, FEATURES.index(name)] for name in FEATURES}
    far = 0.8 * math.exp(-(1.5**2))
    np.testing.assert_allclose(found["support"], [0.8, far, 0.8], atol=1e-12)
    np.testing.assert_allclose(found["company"], [math.log(2.0), math.log(2.0), 0.0], atol=1e-12)
    np.testing.assert_allclose(found["company_score"], [0.8, 0.8, 0.0], atol=1e-12)


def test_places_that_another_second_wall_folded_support_too() -> None:
    """All three by the facade first; the second and third by the side wall too, 1.5 m apart, the third on the first."""
    three = places([[12.0, 8.0], [12.0, 6.5], [12.0, 8.0]], [[28.0, 8.0], [28.0, 6.5], [28.0, 8.0]], [0, 0, 0])
    three = replace(three, second=np.array([NO_WALL, 1, 1]))
    rows = position_features(three, [FACADE, SIDE], returns_at([], []), RecoveryParams())
    found = {name: rows[:, FEATURES.index(name)] for name in FEATURES}
    far = 0.8 * math.exp(-(1.5**2))
    np.testing.assert_allclose(found["support"], [0.8, far, 0.8], atol=1e-12)
    np.testing.assert_allclose(found["company"], [0.0, math.log(2.0), math.log(2.0)], atol=1e-12)
    np.testing.assert_allclose(found["company_score"], [0.0, 0.8, 0.8], atol=1e-12)
    np.testing.assert_array_equal(found["twice"], [0.0, 1.0, 1.0])


def test_probability_is_the_networks() -> None:
    features = np.zeros((3, len(FEATURES)))
    features[:, FEATURES.index("snr_db")] = [20.0, 30.0, -100.0]
    # 12 spreads off count for four
    expected = [1.0 / (1.0 + math.exp(0.5 - 2.0 * math.tanh(z))) for z in (0.0, 1.0, -4.0)]
    np.testing.assert_allclose(model().probability(features), expected, rtol=1e-12)


def test_improbable_places_are_dropped_and_the_others_carry_their_probability() -> None:
    """Images of 35 dB (p = 0.79) and 5 dB (p = 0.09) against a threshold of 0.5."""
    peaks = scan_of([35.0, 5.0])
    (point,) = recover_bev(peaks, GeometryParams(), confidence=model()).points
    assert point.score == pytest.approx(1.0 / (1.0 + math.exp(0.5 - 2.0 * math.tanh(1.5))))
    assert (point.x_m, point.y_m) == pytest.approx((12.0, 4.0), abs=1e-6)
    assert [point.score for point in recover_bev(peaks, GeometryParams()).points] == [0.9, 0.9]


def test_a_model_fitted_on_another_detectors_peaks_judges_nothing() -> None:
    """Images of 35 dB and 5 dB: both stay with their own scores, as without a model; those of its detector go."""
    fitted = model(threshold=0.9, detector="network")
    of_cfar, of_network = (msgspec.structs.replace(scan_of([35.0, 5.0]), detector=name) for name in ("cfar", "network"))
    for confidence in (fitted, FittedConfidences((fitted,))):
        left = recover_bev(of_cfar, GeometryParams(), confidence=confidence).points
        assert [point.score for point in left] == [0.9, 0.9]
        assert recover_bev(of_network, GeometryParams(), confidence=confidence).points == ()


def test_objects_are_formed_from_probable_places_by_their_probability() -> None:
    """Four images 1 m apart make an object of score 1 - 0.2^4 at p = 0.8, and none where none is probable."""
    peaks = scan_of([35.0] * 4)
    even, never = model(weights=(0.0,), bias=math.log(4.0)), model(threshold=0.9)
    (one,) = recover_bev(peaks, GeometryParams(), confidence=even).objects
    assert one.score == pytest.approx(1.0 - 0.2**4)
    assert recover_bev(peaks, GeometryParams(), confidence=never).objects == ()
    assert len(recover_bev(peaks, GeometryParams()).objects) == 1


def test_a_file_gives_the_same_model_again(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_bytes(msgspec.json.encode(model()))
    assert load_confidence(path) == model()
    node = geometry.create(geometry.Params(confidence=str(path)))
    assert node._stage._confidence == model()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"features": [*FEATURES[1:], FEATURES[0]]}, "confidence.features must be score_logit, snr_db"),
        ({"means": [0.0]}, r"confidence.means must have shape \(28,\), got \(1,\)"),
        ({"scales": [0.0] * len(FEATURES)}, "confidence.scales must be positive, got 0.0"),
        ({"hidden_weights": [[0.0]]}, r"confidence.hidden_weights must have shape \(1, 28\)"),
        ({"weights": [1e30]}, "confidence.weights must be finite and within 1000"),
        ({"bias": None}, "bias"),
        ({"threshold": 1.0}, "confidence.threshold must be between 0 and 1, got 1.0"),
        ({"surprise": 1}, "surprise"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_file_that_does_not_fit_is_refused_by_field(changes: dict[str, Any], says: str, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_bytes(msgspec.json.encode(msgspec.to_builtins(model()) | changes))
    with pytest.raises(ValueError, match=says) as caught:
        load_confidence(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_weights_that_are_no_numbers_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"confidence\.bias must be finite"):
        model(bias=math.nan)
    with pytest.raises(ValueError, match=r"nowhere\.json"):
        load_confidence(tmp_path / "nowhere.json")
    with pytest.raises(ValueError, match=r"nowhere\.json"):
        geometry.create(geometry.Params(confidence=str(tmp_path / "nowhere.json")))
