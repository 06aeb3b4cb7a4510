from __future__ import annotations

import numpy as np
import pytest

from models.perception.find.score_calibration import calibrated, check_table, score_of

TABLE = ((0.0, 0.0), (0.5, 0.2), (1.0, 1.0))


def test_linear_between_knots_and_flat_beyond() -> None:
    table = ((0.2, 0.1), (0.6, 0.5))
    np.testing.assert_allclose(calibrated(table, np.array([0.0, 0.2, 0.4, 0.6, 1.0])), [0.1, 0.1, 0.3, 0.5, 0.5])


def test_no_table_changes_nothing() -> None:
    score = np.array([0.3, 0.9])
    assert calibrated((), score) is score


@pytest.mark.parametrize("probability", [0.0, 0.1, 0.2, 0.7, 1.0])
def test_the_score_of_a_probability_is_the_inverse(probability: float) -> None:
    assert calibrated(TABLE, np.array([score_of(TABLE, probability)]))[0] == pytest.approx(probability, abs=1e-12)
    assert score_of((), probability) == probability


@pytest.mark.parametrize(
    ("table", "rule"),
    [
        (((0.0, 0.0), (0.5, 1.1)), r"card\.calibration must lie in 0\.\.1"),
        (((0.0, 0.0), (0.5, float("nan"))), r"card\.calibration must lie in 0\.\.1"),
        (((0.0, 0.5), (0.5, 0.5)), r"card\.calibration must be empty or rise in score and in probability"),
        (((0.5, 0.1), (0.5, 0.2)), r"card\.calibration must be empty or rise"),
        (((0.5, 0.1),), r"card\.calibration must be empty or rise"),
    ],
)
def test_tables_that_would_change_ranks_are_refused(table: tuple[tuple[float, float], ...], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        check_table("card.calibration", table)
    check_table("card.calibration", TABLE)
    check_table("card.calibration", ())
