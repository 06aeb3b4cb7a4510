"""Returns: errors of the sensor where there are none, heights, cells."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.perception.target_lists.returns import joined_returns, returns_of
from models.perception.target_lists.sensor import DetectionSensor
from tests.models.perception.target_lists.street import SENSOR, detections

UNKNOWN = np.full(3, np.nan)
POINTS = [[10.0, 0.0], [0.0, 20.0], [30.0, 30.0]]


def test_a_detection_without_covariance_has_that_of_the_sensor() -> None:
    """Azimuth errors grow with one over the cosine: at 45 degrees by the root of two."""
    message = detections(POINTS)
    own = np.diag([0.04, 0.01])
    covariance = np.stack([own, np.zeros((2, 2)), np.zeros((2, 2))])
    returns = returns_of(msgspec.structs.replace(message, covariance=covariance), UNKNOWN, SENSOR)
    np.testing.assert_array_equal(returns.covariance[0], own)
    np.testing.assert_allclose(returns.covariance[2, 0, 0], SENSOR.range_std_m**2)
    np.testing.assert_allclose(returns.covariance[2, 1, 1], 2.0 * np.radians(SENSOR.azimuth_std_deg) ** 2, rtol=0.02)


@pytest.mark.parametrize("wrong", [[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 1.0]]])
def test_a_singular_covariance_counts_as_none(wrong: list[list[float]]) -> None:
    message = detections(POINTS, covariance=np.stack([np.array(wrong)] * 3))
    returns = returns_of(message, UNKNOWN, SENSOR)
    assert (returns.covariance[:, 0, 0] == SENSOR.range_std_m**2).all()


def test_an_elevation_gives_height_and_range_in_the_plane() -> None:
    message = detections([[10.0, 0.0]], range_m=np.array([10.0]), elevation_rad=np.array([np.radians(30.0)]))
    returns = returns_of(message, np.array([np.nan]), SENSOR)
    np.testing.assert_allclose([returns.range_m[0], returns.height_m[0]], [np.sqrt(75.0), 5.0])


def test_strengths_come_from_snr_else_rcs_else_the_threshold() -> None:
    """10 dBsm at 50 m, just detected at 100 m: 12 dB more by the fourth power of the range."""
    sensor = DetectionSensor(threshold_db=10.0, reference_range_m=100.0, reference_rcs_dbsm=10.0)
    message = detections([[50.0, 0.0]] * 3, range_m=np.full(3, 50.0))
    message = msgspec.structs.replace(
        message, snr_db=np.array([33.0, np.nan, np.nan]), rcs_dbsm=np.array([0.0, 10.0, np.nan])
    )
    np.testing.assert_allclose(returns_of(message, UNKNOWN, sensor).snr_db, [33.0, 10.0 + 40.0 * np.log10(2.0), 10.0])


def test_detections_of_one_cell_are_one_return_and_the_strongest_come_first() -> None:
    points = np.array([[10.02, 0.01], [10.1, 0.03], [30.0, 5.0]])
    range_m, azimuth_rad = np.hypot(*points.T), np.arctan2(*points.T[::-1])
    message = detections(points, range_m=range_m, azimuth_rad=azimuth_rad, snr_db=np.array([20.0, 20.0, 30.0]))
    joined = joined_returns(returns_of(message, np.zeros(3), SENSOR), SENSOR, 10)
    np.testing.assert_allclose(joined.points_m, [[30.0, 5.0], [10.06, 0.02]], atol=1e-4)
    assert len(joined_returns(returns_of(message, np.zeros(3), SENSOR), SENSOR, 1)) == 1


def test_what_moves_apart_stays_apart() -> None:
    message = detections([[10.0, 0.01]] * 2, range_m=np.full(2, 10.1), azimuth_rad=np.full(2, 0.001))
    assert len(joined_returns(returns_of(message, np.array([0.1, 5.1]), SENSOR), SENSOR, 10)) == 2


def test_sensor_properties_are_checked() -> None:
    with pytest.raises(ValueError, match=r"sensor\.beam_width_deg"):
        DetectionSensor(beam_width_deg=0.0)
    with pytest.raises(ValueError, match=r"sensor\.reference_range_m"):
        DetectionSensor(reference_range_m=-1.0)
