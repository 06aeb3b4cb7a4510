from __future__ import annotations

import numpy as np
import pytest

from models.scores.object_matching import match_objects
from msgs.values.perception import HiddenObject, SceneTruth, TruthObject
from tests.builders import example_object, example_truth


def found(number: int, x: float, y: float, stamp_ns: int = 0) -> HiddenObject:
    return example_object(id=number, x_m=x, y_m=y, length_m=2.0, width_m=1.0, stamp_ns=stamp_ns)


def scene() -> SceneTruth:
    """A hidden car at (12, 8) that drives along -y, whose face at x = 13 is seen; a visible car at (10, -3)."""
    points = np.array([[13.0, 7.0, 1.0], [13.0, 9.0, 1.0]], np.float32)
    return example_truth(
        stamp_ns=1_000_000_000, mirrored_points_m=points, hidden_points_m=points,
        hidden_object=np.array([1, 1], np.int32),
        objects=(
            TruthObject(id=7, object_class="car", x_m=10.0, y_m=-3.0, length_m=4.4, width_m=1.8, yaw_rad=0.0),
            TruthObject(
                id=9, object_class="car", x_m=12.0, y_m=8.0, length_m=4.4, width_m=1.8, yaw_rad=1.57,
                velocity_y_mps=-10.0, hidden=True,
            ),
        ),
    )  # fmt: skip


def test_objects_match_by_centre_or_visible_face():
    match = match_objects([found(0, 12.2, 8.0), found(1, 13.9, 7.0)], scene())
    assert match.matched == ((0, 9, pytest.approx(0.2)),)
    assert match.unmatched_objects == (1,), "one to one: the second on the same car is nothing"
    assert match_objects([found(1, 13.9, 7.0)], scene()).matched == ((1, 9, pytest.approx(0.9)),)


def test_truth_is_moved_to_the_objects_own_time():
    late = found(0, 12.0, 5.0, stamp_ns=1_300_000_000)
    assert match_objects([late], scene()).matched == ((0, 9, pytest.approx(0.0, abs=1e-9)),)
    # at the scene's own time the near end of the visible face, (12.9, 5.8), is 1.2 m away
    assert match_objects([found(0, 12.0, 5.0, stamp_ns=1_000_000_000)], scene()).missed_truths == (9,)


def test_visible_objects_are_not_asked_for_and_do_not_excuse():
    match = match_objects([found(3, 10.0, -3.0)], scene())
    assert (match.matched, match.unmatched_objects, match.missed_truths) == ((), (3,), (9,))


def test_no_objects_misses_all():
    assert match_objects([], scene()).missed_truths == (9,)
