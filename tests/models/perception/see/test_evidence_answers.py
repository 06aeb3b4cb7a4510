"""Objects read off what the evidence network says of each place."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.mirror_table import wall_arrays
from models.perception.see.detections import ANSWERS, CENTRE, CLASS, CLASSES, HEADING, LOG_SIZE, LOG_STD, OBJECT, PLACE
from models.perception.see.evidence_answers import _image, candidates, evidence_detections
from models.perception.see.gathering import BirdsEyeGrid
from msgs.values.perception import Wall

PLANE = BirdsEyeGrid()
WALLS = wall_arrays([Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -8.0), (20.0, 9.0)), inliers=9)])


def silence() -> tuple[np.ndarray, np.ndarray]:
    answer = np.zeros((ANSWERS, *PLANE.shape), np.float32)
    answer[OBJECT] = -9.0
    return answer, np.zeros(PLANE.shape, np.int16)


def says(answer: np.ndarray, x_m: float, y_m: float, logit: float, length_m: float = 4.0) -> None:
    row, column = np.abs(PLANE.x_m - x_m).argmin(), np.abs(PLANE.y_m - y_m).argmin()
    answer[OBJECT, row, column] = logit
    answer[CLASS, row, column] = np.eye(len(CLASSES))[2]
    answer[PLACE, row, column] = x_m - PLANE.x_m[row], y_m - PLANE.y_m[column]
    answer[LOG_STD, row, column] = math.log(0.2), math.log(0.6)
    answer[LOG_SIZE, row, column] = math.log(length_m), math.log(1.8)
    answer[HEADING, row, column] = math.cos(0.8), math.sin(0.8)
    answer[CENTRE, row, column] = 1.0, -0.5


def test_an_object_is_where_it_is_said_with_its_box_and_errors_along_its_way() -> None:
    """The way on from the mirror in x = 20 to (14, -3) runs along (6, 1.25): by the image at (26, -3)."""
    answer, mirror = silence()
    says(answer, 14.1, -3.1, 2.0)
    (report,) = np.atleast_1d(evidence_detections(candidates(answer, mirror, 0.5), PLANE, WALLS, 0.5))
    np.testing.assert_allclose(report.place_m, [[14.1, -3.1]], atol=1e-6)
    np.testing.assert_allclose(report.centre_m, [[15.1, -3.6]], atol=1e-6)
    np.testing.assert_allclose(report.size_m, [[4.0, 1.8]], rtol=1e-6)
    assert report.yaw_rad[0] == pytest.approx(0.4)
    assert CLASSES[report.object_class[0]] == "car"
    image_m = np.array([25.9, -3.1])
    assert (report.range_m[0], report.azimuth_rad[0]) == pytest.approx((np.hypot(*image_m), np.arctan2(-3.1, 25.9)))
    away = np.array([14.1, -3.1]) - 20.0 / 25.9 * image_m
    assert report.away_rad[0] == pytest.approx(np.arctan2(away[1], away[0]))
    along = away / np.hypot(*away)
    assert along @ report.covariance_m2[0] @ along == pytest.approx(0.04)


def test_the_image_in_an_arc_does_not_depend_on_other_walls() -> None:
    straight = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -10.0), (20.0, 10.0)), inliers=9)
    arc = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -8.0), (20.0, 9.0)), inliers=9, curvature_per_m=0.04)
    walls, places_m = wall_arrays([straight, arc]), np.full((2, 2), (13.0, -3.0))
    (flat_m, bent_m), _ = _image(places_m, np.array([0, 1]), walls)
    np.testing.assert_allclose(flat_m, [27.0, -3.0])
    np.testing.assert_allclose(bent_m, _image(places_m[1:], np.array([1]), walls)[0][0])
    assert abs(bent_m - flat_m).max() > 0.1


def test_one_object_is_one_report_and_two_are_two() -> None:
    answer, mirror = silence()
    for x_m, y_m, logit in ((14.1, -3.1, 2.0), (15.3, -3.1, 1.0), (14.1, 2.2, 1.5)):
        says(answer, x_m, y_m, logit)
    reports = evidence_detections(candidates(answer, mirror, 0.5), PLANE, WALLS, 0.5)
    assert len(reports) == 2
    assert reports.score[0] > reports.score[1]


def test_places_that_no_mirror_shows_hold_no_object() -> None:
    answer, mirror = silence()
    says(answer, 14.1, -3.1, 2.0)
    assert len(evidence_detections(candidates(answer, np.full_like(mirror, -1), 0.5), PLANE, WALLS, 0.5)) == 0
    assert len(evidence_detections(candidates(answer, mirror, 0.95), PLANE, WALLS, 0.95)) == 0
