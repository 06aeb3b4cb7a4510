"""Objects that an answer says: what a perfect network would say leads back to the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.special import expit, logit

from models.perception.objects.answers import (
    ANSWERS,
    CENTRE,
    CLASS,
    HEADING,
    LOG_SIZE,
    LOG_STD,
    OBJECT,
    PLACE,
    Detections,
    detections,
    hidden_objects,
)
from models.perception.objects.hypotheses import HYPOTHESES, SINGLES
from models.training.data.frames import FrameLabels
from models.training.data.object_samples import ObjectTargets, true_hypotheses
from msgs.values.perception import PathClass, RadialSpeed, TruthObject
from tests.models.perception.objects.object_scenes import ACROSS, GRID, cell, hypotheses, walls


def labels(
    object_index: list[int], true_m: list[tuple[float, float]], image_m: list[tuple[float, float]]
) -> FrameLabels:
    x, y = np.array(image_m).T
    count = len(object_index)
    return FrameLabels(
        range_m=np.hypot(x, y),
        azimuth_rad=np.arctan2(y, x),
        path_class=np.full(count, PathClass.MIRRORED, np.uint8),
        order=np.ones(count, int),
        hidden_xy_m=np.array(true_m),
        power_mw=np.ones(count),
        object_index=np.array(object_index),
        object_class=np.full(count, "car"),
    )


CAR = TruthObject(id=0, object_class="car", x_m=4.2, y_m=-2.3, length_m=4.4, width_m=1.8, yaw_rad=0.3, hidden=True)
#: Labels that were measured with the truth.
AT_ONCE = np.zeros(1)
#: A point of the car, its image by x = 12, and by y = 10 and x = 12.
POINT, ONCE, TWICE = (5.0, -2.0), (19.0, -2.0), (19.0, 22.0)


def said(targets: ObjectTargets, probability: float) -> np.ndarray:
    """The answer of a network that knows the truth."""
    answer = np.zeros((HYPOTHESES, ANSWERS, len(GRID.range_m), len(GRID.azimuth_rad)))
    answer[:, OBJECT] = -20.0
    for index, (which, row, column) in enumerate(targets.at):
        values = np.zeros(ANSWERS)
        values[OBJECT], values[CLASS] = logit(probability), np.eye(6)[targets.object_class[index]]
        values[PLACE], values[LOG_SIZE] = targets.place_m[index], targets.log_size[index]
        values[HEADING], values[CENTRE] = targets.heading[index], targets.centre_m[index]
        values[LOG_STD] = np.log([0.1, 0.4])
        answer[which, :, row, column] = values
    return answer.reshape(-1, *answer.shape[2:])


@pytest.mark.parametrize(("image_m", "which"), [(ONCE, 0), (TWICE, SINGLES)])
def test_what_is_true_leads_back_to_the_object(image_m: tuple[float, float], which: int) -> None:
    """Position to the millimetre that float32 leaves of the offsets; across the ray by a chord for an arc: 20 mm."""
    found = hypotheses(walls())
    targets = true_hypotheses(found, GRID, walls(), labels([0], [POINT], [image_m]), [CAR], AT_ONCE)
    assert targets.at.tolist() == [[which, *cell(*image_m)]]
    got = detections(said(targets, 0.8), found, GRID, walls(), 0.5)
    assert len(got) == 1
    assert got.score == pytest.approx(0.8)
    np.testing.assert_allclose(got.place_m[0], POINT, atol=0.02)
    np.testing.assert_allclose(got.centre_m[0], [CAR.x_m, CAR.y_m], atol=0.05)
    np.testing.assert_allclose(got.size_m[0], [CAR.length_m, CAR.width_m], rtol=1e-5)
    assert math.remainder(got.yaw_rad[0] - CAR.yaw_rad, math.pi) == pytest.approx(0.0, abs=0.03)
    assert got.object_class.tolist() == [2]


def test_a_moving_object_is_where_it_was_when_its_beam_looked() -> None:
    """At 5 m/s along x, 0.2 s after the truth: its box 1 m further on, the labelled point as it was measured."""
    values = {name: getattr(CAR, name) for name in CAR.__struct_fields__}
    moving = TruthObject(**values | {"velocity_x_mps": 5.0})
    cells = hypotheses(walls(ACROSS))
    targets = true_hypotheses(cells, GRID, walls(ACROSS), labels([0], [POINT], [ONCE]), [moving], np.array([0.2]))
    got = detections(said(targets, 0.8), cells, GRID, walls(ACROSS), 0.5)
    np.testing.assert_allclose(got.place_m[0], POINT, atol=1e-3)
    np.testing.assert_allclose(got.centre_m[0], [CAR.x_m + 1.0, CAR.y_m], atol=1e-3)


def test_errors_turn_with_the_mirror() -> None:
    """0.1 m along the ray and 0.4 m across it, in the wall x = 12: the ray (19, -2) comes back as (-19, -2)."""
    found = hypotheses(walls(ACROSS))
    targets = true_hypotheses(found, GRID, walls(ACROSS), labels([0], [POINT], [ONCE]), [CAR], AT_ONCE)
    got = detections(said(targets, 0.8), found, GRID, walls(ACROSS), 0.5)
    ray = np.array([-19.0, -2.0]) / math.hypot(19.0, 2.0)
    across = np.array([-ray[1], ray[0]])
    assert ray @ got.covariance_m2[0] @ ray == pytest.approx(0.01, rel=1e-3)
    assert across @ got.covariance_m2[0] @ across == pytest.approx(0.16, rel=1e-3)
    assert ray @ got.covariance_m2[0] @ across == pytest.approx(0.0, abs=1e-3)


def test_two_images_of_one_object_are_one_report_and_the_better_one_speaks() -> None:
    found = hypotheses(walls())
    true = labels([0, 0], [POINT, POINT], [ONCE, TWICE])
    targets = true_hypotheses(found, GRID, walls(), true, [CAR], np.zeros(2))
    assert len(targets.at) == 2
    answer = said(targets, 0.8).reshape(HYPOTHESES, ANSWERS, *found.wall.shape[1:])
    answer[SINGLES, OBJECT] = np.where(answer[SINGLES, OBJECT] > 0.0, logit(0.9), -20.0)
    got = detections(answer.reshape(-1, *found.wall.shape[1:]), found, GRID, walls(), 0.5)
    assert got.score.tolist() == pytest.approx([0.9])


def test_what_stands_in_plain_sight_or_has_no_hypothesis_is_no_target() -> None:
    found = hypotheses(walls(ACROSS))
    seen = TruthObject(**{name: getattr(CAR, name) for name in CAR.__struct_fields__} | {"hidden": False})  # type: ignore[arg-type]
    assert not len(true_hypotheses(found, GRID, walls(ACROSS), labels([0], [POINT], [ONCE]), [seen], AT_ONCE).at)
    # an image 3 m from where the wall would show it: another wall's
    elsewhere = labels([0], [POINT], [(22.0, -2.0)])
    assert not len(true_hypotheses(found, GRID, walls(ACROSS), elsewhere, [CAR], AT_ONCE).at)


def test_an_answer_of_nothing_is_nothing() -> None:
    found = hypotheses(walls())
    answer = np.full((HYPOTHESES * ANSWERS, *found.wall.shape[1:]), -20.0)
    assert len(detections(answer, found, GRID, walls(), 0.05)) == 0
    # cells without a hypothesis say nothing, whatever the network answers there
    loud = np.full_like(answer, 20.0)
    none = hypotheses(walls().take(np.zeros(0, int)))
    assert len(detections(loud, none, GRID, walls().take(np.zeros(0, int)), 0.05)) == 0


@pytest.mark.parametrize("threshold", [0.05, 0.3, 1.0])
def test_reports_are_the_likeliest_among_their_neighbours(threshold: float) -> None:
    """The plain form takes the probabilities of all cells; equal ones and certain ones count alike."""
    found = hypotheses(walls())
    shape = found.wall.shape
    answer = np.zeros((HYPOTHESES, ANSWERS, *shape[1:]), np.float32)
    answer[:, 0] = np.round(np.random.default_rng(0).normal(-4.0, 20.0, shape))
    got = detections(answer.reshape(-1, *shape[1:]), found, GRID, walls(), threshold)
    probability = np.where(found.wall >= 0, expit(answer[:, 0].astype(np.float64)), 0.0)
    highest = maximum_filter(probability, (1, 3, 3), mode="constant")
    wanted = probability[(probability >= threshold) & (probability == highest)]
    assert len(got) > 1
    assert set(got.score) <= set(wanted)
    assert got.score[0] == wanted.max()


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
