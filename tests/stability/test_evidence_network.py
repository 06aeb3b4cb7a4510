"""Hard cases of the evidence network: answers without bounds or direction, odd tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import expit, logit

from models.perception.find.score_calibration import ScoreTable, calibrated, score_of
from models.perception.mirrors.mirror_table import wall_arrays
from models.perception.see.candidate_predictor import corrected
from models.perception.see.detections import ANSWERS, HEADING, LOG_STD, OBJECT
from models.perception.see.evidence_answers import Candidates, candidates, evidence_detections
from models.perception.see.gathering import BirdsEyeGrid
from msgs.values.perception import Wall
from tests.stability.catalogue import Errors

PLANE = BirdsEyeGrid()
WALLS = wall_arrays([Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -8.0), (20.0, 9.0)), inliers=9)])


def report_of(log_std: float = 0.0, heading: tuple[float, float] = (1.0, 0.0)) -> tuple[np.ndarray, float]:
    """Covariance and axis of the one object that an answer is sure of."""
    answer = np.zeros((ANSWERS, *PLANE.shape), np.float32)
    answer[OBJECT] = -30.0
    answer[OBJECT, 24, 50], answer[LOG_STD, 24, 50] = 8.0, log_std
    answer[HEADING, 24, 50] = heading
    found = candidates(answer, np.zeros(PLANE.shape, np.int16), 0.5)
    report = evidence_detections(found, PLANE, WALLS, 0.5)
    return report.covariance_m2[0], float(report.yaw_rad[0])


@pytest.mark.hard("models.perception.see.evidence_answers", "exponential of the answer as it stands", 8.0, "m",
                  "limit of the logarithm: e^2 m = 7.39 m")  # fmt: skip
def test_a_network_may_say_any_error(errors: Errors) -> None:
    """A logarithm of 400, as an unusual input may cause: its variance is no double."""
    covariance_m2, _ = report_of(log_std=400.0)
    assert np.linalg.eigvalsh(covariance_m2).min() > 0.0
    with np.errstate(over="ignore"):
        naive = float(np.sqrt(np.exp(np.float64(400.0)) ** 2))
    errors(naive=naive, ours=float(np.sqrt(np.linalg.eigvalsh(covariance_m2).max())))


@pytest.mark.hard("models.perception.see.evidence_answers", "arccos of the doubled angle's cosine", 1e-15, "rad",
                  "rounding of the inverse tangent, of single precision in the answer")  # fmt: skip
def test_half_of_a_very_small_angle(errors: Errors) -> None:
    """A box 1e-9 rad off its axis: its cosine is 1, so the inverse cosine sees no angle and no side."""
    half_rad = 1e-9
    sine = np.float32(math.sin(2.0 * half_rad))
    _, yaw_rad = report_of(heading=(math.cos(2.0 * half_rad), float(sine)))
    wanted_rad = 0.5 * float(sine)
    errors(naive=abs(0.5 * math.acos(math.cos(2.0 * half_rad)) - wanted_rad), ours=abs(yaw_rad - wanted_rad))


@pytest.mark.hard("models.perception.see.evidence_answers", "half angle by a normalised bisector", 1e-12, "rad",
                  "any axis is as good")  # fmt: skip
def test_a_heading_that_the_network_does_not_know(errors: Errors) -> None:
    """Both numbers of the heading zero: a vector without direction cannot be brought to length 1."""
    with np.errstate(invalid="ignore"):
        naive = np.zeros(2) / np.float64(0.0)
    _, yaw_rad = report_of(heading=(0.0, 0.0))
    errors(naive=float(np.abs(naive[0])), ours=abs(yaw_rad))


STEEP: ScoreTable = ((0.4, 0.1), (0.4 + 1e-12, 0.9))


@pytest.mark.parametrize("table", [(), STEEP, ((0.0, 0.0), (1.0, 1.0)), ((0.2, 0.3), (0.9, 0.7))])
def test_a_probability_asks_for_the_score_that_has_it(table: ScoreTable) -> None:
    """There and back within the table; beyond its ends a threshold is the end: nothing is asked of scores beyond it."""
    low, high = (table[0][1], table[-1][1]) if table else (0.0, 1.0)
    for probability in np.linspace(0.0, 1.0, 21):
        score = score_of(table, float(probability))
        back = float(calibrated(table, np.array([score]))[0])
        assert 0.0 <= score <= 1.0
        # on a step a thousand times narrower than a score's last shown digit the inverse loses four digits
        assert back == pytest.approx(min(max(float(probability), low), high), abs=1e-3)


@pytest.mark.hard("models.perception.see.candidate_predictor", "corrected as a probability of single precision", 1e-12,
                  "probability", "rounding of a logit of 60 in double precision")  # fmt: skip
def test_the_second_look_at_a_candidate_that_is_all_but_certain(errors: Errors) -> None:
    """A logit of 60 and a correction of -60: the probability is 1 in single precision, and its logit infinite."""
    none = np.zeros(1, np.int64)
    proposals = Candidates(none, none, np.full((1, ANSWERS), 60.0), none)
    with np.errstate(divide="ignore"):
        naive = expit(logit(expit(np.float32(60.0))) + np.float32(-60.0))
    ours = expit(corrected(proposals, np.array([-60.0], np.float32)).values[0, OBJECT.start])
    errors(naive=abs(float(naive) - 0.5), ours=abs(float(ours) - 0.5))
