"""Hard cases of detections: nothing, one, all on a line, all alike, NaN, as many as a message holds."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from models.perception.mirrors.peaks_to_view import recover_bev
from models.perception.target_lists.defaults import DETECTION_GEOMETRY
from models.perception.target_lists.ego_doppler import over_ground
from models.perception.target_lists.list_map import list_map
from models.perception.target_lists.sensor import DetectionSensor
from models.perception.target_lists.targets_to_peaks import DetectionsStage
from msgs.values.detections import MAX_DETECTIONS, RadarDetections
from msgs.values.perception import MAX_PEAKS, BevFrame, Peaks
from tests.models.perception.target_lists.street import SENSOR, detections, standing_speeds, street_points
from tests.stability.catalogue import Errors

RNG = np.random.default_rng(3)
SCATTERED_M = RNG.uniform([0.0, -40.0], [80.0, 40.0], (2048, 2))


def through(message: RadarDetections, sensor: DetectionSensor = SENSOR) -> tuple[Peaks, BevFrame]:
    peaks = DetectionsStage(sensor, DETECTION_GEOMETRY).peaks(message)
    return peaks, recover_bev(peaks, DETECTION_GEOMETRY)


@pytest.mark.parametrize(
    ("points", "peaks"),
    [
        (np.zeros((0, 2)), 0),
        ([[10.0, 0.0]], 1),
        ([[0.0, 0.0]], 1),
        ([[10.0, 3.0]] * 500, None),
        (np.stack([np.linspace(1.0, 90.0, 500), np.zeros(500)], axis=1), None),
        (np.stack([np.full(500, 20.0), np.linspace(-40.0, 40.0, 500)], axis=1), None),
        (SCATTERED_M, None),
    ],
    ids=["none", "one", "at the radar", "all alike", "along a ray", "on one wall", "2048 scattered"],
)
def test_any_set_of_points_passes(points: Any, peaks: int | None) -> None:
    """Finite, bounded, without a hidden object where there is no mirror and something behind it."""
    found, frame = through(detections(points))
    assert peaks is None or len(found) == peaks
    assert len(found) <= min(MAX_PEAKS, len(points))
    assert np.isfinite(frame.los_points_m).all()
    assert frame.objects == ()
    assert np.isfinite(list_map(found).values).all()


def test_as_many_as_a_message_holds_leave_as_many_as_peaks_may_be() -> None:
    points = RNG.uniform([0.0, -60.0], [99.0, 60.0], (MAX_DETECTIONS, 2))
    assert len(through(detections(points))[0]) == MAX_PEAKS
    with pytest.raises(ValueError, match=r"detections\.count"):
        detections(np.full((MAX_DETECTIONS + 1, 2), 9.0))


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_missing_speeds_heights_and_strengths_change_no_wall(share: float) -> None:
    message = detections(street_points())
    nothing = np.where(np.arange(len(message)) < share * len(message), np.nan, 0.0)
    with_gaps = msgspec.structs.replace(
        message, radial_speed_mps=nothing, elevation_rad=nothing, elevation_std_rad=nothing, rcs_dbsm=nothing
    )
    assert len(through(with_gaps)[1].walls) == 2


@pytest.mark.hard("models.perception.target_lists.ego_doppler", "least squares over all detections", 0.05, "m/s",
                  "three standard deviations of the radar's velocity from 150 speeds of 0.1 m/s")  # fmt: skip
def test_a_column_of_cars_does_not_pull_the_velocity(errors: Errors) -> None:
    """A quarter of the detections are of traffic that drives along, and speeds repeat every 10 m/s."""
    velocity = np.array([14.0, 0.0])
    message = detections(street_points(car=False))
    speeds = standing_speeds(message, velocity) + RNG.normal(0.0, 0.1, len(message))
    speeds[::4] += 12.0 * np.cos(message.azimuth_rad[::4])
    folded = speeds - 10.0 * np.round(speeds / 10.0)
    sensor = msgspec.structs.replace(SENSOR, speed_period_mps=10.0)
    result = over_ground(msgspec.structs.replace(message, radial_speed_mps=folded), sensor, None)
    standing = np.arange(len(message)) % 4 != 0
    directions = np.stack([np.cos(message.azimuth_rad), np.sin(message.azimuth_rad)], axis=1)
    plain, *_ = np.linalg.lstsq(directions, -folded, rcond=None)
    residual = (folded + directions @ plain)[standing]
    errors(naive=math.sqrt(float(np.mean(residual)) ** 2), ours=abs(float(result[standing].mean())))
