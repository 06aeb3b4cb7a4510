"""Hard cases of the object network: answers without bounds or direction, walls that no ray meets well, odd tables."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.perception.detection.score_calibration import ScoreTable, calibrated, score_of
from models.perception.objects.answers import ANSWERS, CENTRE, HEADING, LOG_STD, OBJECT, _half_angle, detections
from models.perception.objects.encoding import speed_channels
from models.perception.objects.hypotheses import HYPOTHESES, SINGLES
from tests.models.perception.objects.object_scenes import (
    ACROSS,
    ALONG,
    COLUMN,
    GRID,
    ROW,
    SPEEDS,
    cell,
    hypotheses,
    speed_map,
    walls,
)
from tests.stability.catalogue import Errors

ROWS, COLUMNS = len(GRID.range_m), len(GRID.azimuth_rad)


def answer_at(row: int, column: int, **numbers: float) -> np.ndarray:
    """An answer that is sure of one object, by the first hypothesis of one cell."""
    said = np.zeros((HYPOTHESES, ANSWERS, ROWS, COLUMNS), np.float32)
    said[:, OBJECT] = -30.0
    said[0, OBJECT, row, column] = 8.0
    said[0, HEADING.start, row, column] = 1.0
    for name, value in numbers.items():
        said[0, {"log_std": LOG_STD, "heading": HEADING, "centre": CENTRE}[name], row, column] = value
    return said.reshape(-1, ROWS, COLUMNS)


@pytest.mark.hard(
    where="models.perception.objects.answers", naive="exponential of the answer as it stands", bound=8.0, unit="m",
    source="limit of the logarithm: e^2 m = 7.39 m",
)  # fmt: skip
def test_a_network_may_say_any_error(errors: Errors) -> None:
    """A logarithm of 400, as an unusual input may cause: its variance is no double."""
    at = cell(17.0, 2.0)
    (covariance_m2,) = detections(
        answer_at(*at, log_std=400.0), hypotheses(walls(ACROSS)), GRID, walls(ACROSS), 0.5
    ).covariance_m2
    assert np.linalg.eigvalsh(covariance_m2).min() > 0.0
    with np.errstate(over="ignore"):
        naive = float(np.sqrt(np.exp(np.float64(400.0)) ** 2))
    errors(naive=naive, ours=float(np.sqrt(np.linalg.eigvalsh(covariance_m2).max())))


@pytest.mark.hard(
    where="models.perception.objects.answers", naive="arccos of the doubled angle's cosine", bound=1e-15, unit="rad",
    source="rounding of the inverse tangent",
)  # fmt: skip
def test_half_of_a_very_small_angle(errors: Errors) -> None:
    """A box 1e-9 rad off the ray: its cosine is 1, so the inverse cosine sees no angle and no side."""
    half_rad = 1e-9
    doubled = np.array([[math.cos(2.0 * half_rad), math.sin(2.0 * half_rad)]])
    (unit,) = _half_angle(doubled)
    errors(naive=abs(0.5 * math.acos(doubled[0, 0]) - half_rad), ours=abs(math.atan2(unit[1], unit[0]) - half_rad))


@pytest.mark.hard(
    where="models.perception.objects.encoding", naive="square of a speed in its standard deviations", bound=1e-6,
    unit="", source="single precision of the channel",
)  # fmt: skip
def test_a_speed_known_exactly(errors: Errors) -> None:
    """The fastest speed that a map can say in a map without noise: it moves, with 0.2 m/s of sway 1 - 3.4e-6."""
    ra_map = speed_map(327.67)
    silent = msgspec.structs.replace(ra_map, noise_power_mw=0.0)
    speed, moves, known = speed_channels(SPEEDS, silent)[:, ROW, COLUMN]
    assert (speed, known) == (3.0, 1.0)
    wanted = 1.0 / (1.0 + (0.6 / 327.67) ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigmas = (np.float64(327.67) / (3.0 * np.float64(0.0))) ** 2
        naive = float(sigmas / (1.0 + sigmas))
    errors(naive=abs(naive - wanted), ours=abs(float(moves) - wanted))


@pytest.mark.hard(
    where="models.perception.objects.answers", naive="half angle by a normalised bisector", bound=1e-12, unit="",
    source="length of a unit vector",
)  # fmt: skip
def test_a_heading_that_the_network_does_not_know(errors: Errors) -> None:
    """Both numbers of the heading zero: a vector without direction cannot be brought to length 1."""
    with np.errstate(invalid="ignore"):
        naive = np.zeros(2) / np.float64(0.0)
    (ours,) = _half_angle(np.zeros((1, 2)))
    errors(naive=float(np.abs(np.linalg.norm(naive) - 1.0)), ours=float(abs(np.linalg.norm(ours) - 1.0)))


@pytest.mark.parametrize("index", [ACROSS, ALONG])
@pytest.mark.parametrize("length_m", [1e-12, 1e-6, 1.0, 1e4])
def test_walls_of_any_length_leave_numbers(index: int, length_m: float) -> None:
    """A candidate wall of a picometre, and one of kilometres: features are finite, hypotheses are walls of the scan."""
    plain = walls(index)
    along = (plain.b - plain.a) / plain.length_m[:, None]
    middle = 0.5 * (plain.a + plain.b)
    sized = walls(index)
    sized.a[:], sized.b[:] = middle - 0.5 * length_m * along, middle + 0.5 * length_m * along
    made = hypotheses(sized)
    assert np.isfinite(made.features).all()
    assert set(np.unique(made.wall)) <= {-1, 0}


def test_a_wall_along_a_ray_is_no_mirror_for_it() -> None:
    """A wall seen exactly edge-on, 30 deg off: rays to both sides meet it at the same place; features are finite."""
    edge_on = walls(ACROSS)
    ray = np.array([math.cos(math.radians(30.0)), math.sin(math.radians(30.0))])
    edge_on.a[:], edge_on.b[:] = 5.0 * ray, 25.0 * ray
    edge_on.normal[:], edge_on.offset_m[:] = [-ray[1], ray[0]], 0.0
    assert np.isfinite(hypotheses(edge_on).features).all()


def test_candidate_walls_without_end_fill_the_hypotheses_and_no_more() -> None:
    """Forty parallel walls, each behind the one before: a cell has the three likeliest, every index in bounds."""
    many = walls(*[ACROSS] * 40)
    shift_m = np.linspace(0.0, 8.0, 40)
    many.a[:, 0] += shift_m
    many.b[:, 0] += shift_m
    many.offset_m[:] += shift_m
    made = hypotheses(many)
    singles = made.wall[:SINGLES]
    assert singles.max() < 40
    row, column = cell(30.0, 0.0)
    assert len(set(singles[:, row, column].tolist())) == SINGLES
    assert np.isfinite(made.features).all()


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
