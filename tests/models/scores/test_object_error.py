"""Face and centre errors against values by hand."""

from __future__ import annotations

import numpy as np
import pytest

from models.scores.object_error import object_distances
from models.scores.object_matching import match_objects
from msgs.values.perception import HiddenObject, SceneTruth, TruthObject
from tests.builders import example_object, example_truth

#: A car of 4 m by 2 m along x, its centre at (10, 5), that drives at 2 m/s along y.
CAR = TruthObject(
    id=3, object_class="car", x_m=10.0, y_m=5.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, velocity_y_mps=2.0, hidden=True
)


def face_error_m(report: HiddenObject, truth: TruthObject, seen: SceneTruth) -> float:
    return float(object_distances([report], seen, [truth]).error_m[0, 0])


def centre_error_m(report: HiddenObject, truth: TruthObject, seen: SceneTruth) -> float:
    return float(object_distances([report], seen, [truth]).centre_m[0, 0])


def scene(*points_m: tuple[float, float]) -> SceneTruth:
    """The car with visible scattering centres."""
    points = np.array([(x, y, 0.5) for x, y in points_m], np.float32).reshape(-1, 3)
    seen = {"hidden_object": np.zeros(len(points), np.int32), "objects": (CAR,)}
    return example_truth(stamp_ns=1_000_000_000, mirrored_points_m=points, hidden_points_m=points, **seen)


def found(x_m: float, y_m: float, stamp_ns: int = 0) -> HiddenObject:
    return example_object(id=8, x_m=x_m, y_m=y_m, length_m=2.0, width_m=1.0, stamp_ns=stamp_ns)


@pytest.mark.parametrize(
    ("at", "face_m", "centre_m"),
    [
        # the near side y = 4, x = 8..12, is visible: 0.3 m before it, 1.3 m off the centre
        ((10.0, 3.7), 0.3, 1.3),
        # on that side at its end: the face is met, the centre is sqrt(2^2 + 1^2) off
        ((12.0, 4.0), 0.0, 5.0**0.5),
        # 3 m beyond the end of the side and 4 m before it: a 3-4-5 triangle; 5 and 5 to the centre
        ((15.0, 0.0), 5.0, 50.0**0.5),
        # nearer to the centre than to the side
        ((10.0, 5.2), 0.2, 0.2),
        # at the side that nobody sees: the centre is as near as it gets
        ((10.0, 6.0), 1.0, 1.0),
    ],
)
def test_errors_of_a_car_whose_near_side_is_seen(at: tuple[float, float], face_m: float, centre_m: float) -> None:
    truth = scene((9.0, 4.0), (11.0, 4.0))
    assert face_error_m(found(*at), CAR, truth) == pytest.approx(face_m)
    assert centre_error_m(found(*at), CAR, truth) == pytest.approx(centre_m)


def test_without_a_visible_face_both_are_the_centre_error() -> None:
    assert face_error_m(found(10.0, 3.7), CAR, scene()) == pytest.approx(1.3)


def test_a_visible_point_off_every_side_counts_for_itself() -> None:
    """A roof at (10, 4.5), 0.5 m inside: no side is shown by it; 0.8 m from (10, 3.7)."""
    assert face_error_m(found(10.0, 3.7), CAR, scene((10.0, 4.5))) == pytest.approx(0.8)


def test_the_report_is_taken_back_to_the_truths_time() -> None:
    """Measured 0.25 s after the truth's stamp the car has gone 0.5 m along y."""
    late = found(10.0, 4.2, stamp_ns=1_250_000_000)
    assert face_error_m(late, CAR, scene((9.0, 4.0), (11.0, 4.0))) == pytest.approx(0.3)
    assert centre_error_m(late, CAR, scene((9.0, 4.0), (11.0, 4.0))) == pytest.approx(1.3)


def test_matches_carry_both_errors() -> None:
    match = match_objects([found(10.0, 3.7)], scene((9.0, 4.0), (11.0, 4.0)))
    assert match.matched == ((8, 3, pytest.approx(0.3)),)
    assert match.centre_m == (pytest.approx(1.3),)
