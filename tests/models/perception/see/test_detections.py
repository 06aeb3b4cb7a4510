"""Objects as a view reports them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from models.perception.see.detections import Detections, distinct, hidden_objects
from msgs.values.perception import RadialSpeed


def two_boxes(apart_m: tuple[float, float], second_m: tuple[float, float], yaw_deg: float) -> Detections:
    """A car of 4 by 2 m along x, and a second box, whose centre lies so far from the car's; its score is the higher."""
    centre_m = np.array([[10.0, 5.0], [10.0 + apart_m[0], 5.0 + apart_m[1]]])
    return Detections(
        score=np.array([0.8, 0.9]),
        place_m=np.array([[8.0, 5.0], [100.0, 5.0]]),
        covariance_m2=np.zeros((2, 2, 2)),
        centre_m=centre_m,
        size_m=np.array([[4.0, 2.0], second_m]),
        yaw_rad=np.array([0.0, math.radians(yaw_deg)]),
        object_class=np.array([2, 2]),
        range_m=np.zeros(2),
        azimuth_rad=np.zeros(2),
        away_rad=np.zeros(2),
    )


@pytest.mark.parametrize(
    ("apart_m", "second_m", "yaw_deg", "kept"),
    [
        # side by side: 0.1 m free; a seventh of the ground shared
        ((0.0, 2.1), (4.0, 2.0), 0.0, [1, 0]),
        ((0.0, 1.7), (4.0, 2.0), 0.0, [1]),
        # across before the car's front, 0.1 m free; pushed into it by 0.6 m
        ((3.1, 0.0), (4.0, 2.0), 90.0, [1, 0]),
        ((2.4, 0.0), (4.0, 2.0), 90.0, [1]),
        # a pedestrian within the car, and beside it; the car within a bus
        ((1.0, 0.5), (0.5, 0.5), 30.0, [1]),
        ((0.0, 1.4), (0.5, 0.5), 0.0, [1, 0]),
        ((3.0, 0.0), (12.0, 2.5), 0.0, [1]),
        # a corner of the one in the corner of the other: a 36th of the ground
        ((3.4, 1.7), (4.0, 2.0), 180.0, [1, 0]),
    ],
)
def test_two_bodies_do_not_share_ground(
    apart_m: tuple[float, float], second_m: tuple[float, float], yaw_deg: float, kept: list[int]
) -> None:
    assert distinct(two_boxes(apart_m, second_m, yaw_deg), np.zeros(2)).tolist() == kept


@pytest.mark.parametrize(("away_m", "kept"), [(0.5, [1]), (0.7, [1, 0])])
def test_two_reports_of_one_place_are_one_object(away_m: float, kept: list[int]) -> None:
    """Boxes of which neither holds the other's ground; without a size as well."""
    boxes = two_boxes((0.0, 2.1), (4.0, 2.0), 0.0)
    for size_m in (boxes.size_m, np.zeros((2, 2))):
        near = dataclasses.replace(boxes, size_m=size_m, place_m=np.array([[8.0, 5.0], [8.0, 5.0 + away_m]]))
        assert distinct(near, np.zeros(2)).tolist() == kept


def test_every_report_has_its_own_stamp_and_values() -> None:
    """Two cars that two beams have measured, 60 ms apart."""
    two = Detections(
        score=np.array([0.9, 0.4]),
        place_m=np.array([[1.0, 2.0], [3.0, 4.0]]),
        covariance_m2=np.array([[[1.0, 0.1], [0.1, 2.0]], [[3.0, 0.2], [0.2, 4.0]]]),
        centre_m=np.array([[1.5, 2.5], [3.5, 4.5]]),
        size_m=np.array([[4.0, 2.0], [6.0, 3.0]]),
        yaw_rad=np.array([0.1, 0.2]),
        object_class=np.array([2, 4]),
        range_m=np.zeros(2),
        azimuth_rad=np.zeros(2),
        away_rad=np.zeros(2),
    )
    speeds = [None, RadialSpeed(azimuth_rad=0.5, speed_mps=1.0, std_mps=0.1)]
    first, second = hidden_objects(two, np.array([100, 160]), speeds)
    assert (first.id, first.x_m, first.y_m, first.length_m, first.width_m) == (0, 1.0, 2.0, 4.0, 2.0)
    assert (second.id, second.x_m, second.y_m, second.length_m, second.width_m) == (1, 3.0, 4.0, 6.0, 3.0)
    assert (first.stamp_ns, first.score, first.yaw_rad, first.object_class) == (100, 0.9, 0.1, "car")
    assert (second.stamp_ns, second.score, second.yaw_rad, second.object_class) == (160, 0.4, 0.2, "truck")
    assert second.cov_m2 == ((3.0, 0.2), (0.2, 4.0))
    assert (first.radial_speed, second.radial_speed) == (None, speeds[1])
