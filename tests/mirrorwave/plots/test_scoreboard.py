"""Views and truths paired in whatever order they come."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mirrorwave.plots.scoreboard import KEPT_SCANS, Scoreboard
from msgs.values.perception import BevFrame, BevGrid, SceneTruth, TruthObject
from tests.builders import example_object, example_truth, example_view

GRID = BevGrid(rows=1, columns=1)


def frame(scan_id: int, *places: tuple[float, float]) -> BevFrame:
    objects = tuple(
        example_object(id=index, x_m=x, y_m=y, length_m=2.0, width_m=1.0, cov_m2=((0.1, 0.0), (0.0, 0.1)))
        for index, (x, y) in enumerate(places)
    )
    return example_view(scan_id=scan_id, objects=objects)


def truth(scan_id: int) -> SceneTruth:
    """One hidden car at (10, 5), 4.5 m by 1.8 m along x."""
    car = TruthObject(id=7, object_class="car", x_m=10.0, y_m=5.0, length_m=4.5, width_m=1.8, yaw_rad=0.0, hidden=True)
    return example_truth(scan_id=scan_id, objects=(car,))


@pytest.mark.parametrize("truth_first", [True, False])
def test_order_does_not_matter(truth_first: bool) -> None:
    board = Scoreboard()
    steps = [lambda: board.add_truth(truth(0)), lambda: board.add_frame(frame(0, (10.3, 5.0), (30.0, 0.0)))]
    for step in steps if truth_first else reversed(steps):
        step()
    score = board.summary()
    assert (score.scans, score.objects, score.matched, score.missed, score.unmatched) == (1, 2, 1, 0, 1)
    assert score.mean_error_m == score.worst_error_m == pytest.approx(0.3)


def test_the_error_of_the_centre_stands_before_that_of_the_nearest_visible_face(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A report 0.25 m before the seen face at x = 7.75 is 2.5 m from the centre at x = 10."""
    seen = np.array([[7.75, 5.0, 0.5]], np.float32)
    with_face = msgspec.structs.replace(
        truth(0), mirrored_points_m=seen, hidden_points_m=seen, hidden_object=np.zeros(1, np.int32)
    )
    board = Scoreboard()
    board.add_truth(with_face)
    board.add_frame(frame(0, (7.5, 5.0)))
    score = board.summary()
    assert (score.mean_error_m, score.mean_centre_error_m) == (pytest.approx(0.25), pytest.approx(2.5))
    board.print_table()
    text = capsys.readouterr().out
    head, row = text.splitlines()[:2]
    assert head.split("  ")[-2:] == ["error: centre [m]", "error: nearest visible face [m]"]
    assert row.split()[-2:] == ["2.5", "0.25"], "the centre first"
    assert "error: from the centre of the report to the centre of the true box" in text


def test_a_row_shows_the_centre_that_its_error_is_of(capsys: pytest.CaptureFixture[str]) -> None:
    """A report whose face is at x = 9.5 and centre at x = 9 is 1 m from the true centre at x = 10."""
    (seen,) = frame(0, (9.5, 5.0)).objects
    board = Scoreboard()
    board.add_truth(truth(0))
    board.add_frame(example_view(scan_id=0, objects=(msgspec.structs.replace(seen, centre_m=(9.0, 5.0)),)))
    board.print_table()
    row = capsys.readouterr().out.splitlines()[1].split()
    assert (row[2:4], row[-2:]) == (["9", "5"], ["1", "0.5"])


def test_without_truth_nothing_is_claimed() -> None:
    board = Scoreboard()
    board.add_frame(frame(0, (1.0, 1.0)))
    score = board.summary()
    assert (score.matched, score.missed, score.unmatched, score.mean_error_m) == (None, None, None, None)


def test_the_table_shows_the_last_scan_that_has_its_truth(capsys: pytest.CaptureFixture[str]) -> None:
    board = Scoreboard()
    board.add_truth(truth(0))
    board.add_frame(frame(0, (10.3, 5.0)))
    board.add_frame(frame(1, (77.0, 5.0)))
    board.print_table()
    text = capsys.readouterr().out
    assert "car" in text
    assert "77" not in text


def test_a_missed_object_and_one_that_is_nothing_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    board = Scoreboard()
    board.add_truth(truth(0))
    board.add_frame(frame(0, (30.0, 0.0)))
    board.print_table()
    text = capsys.readouterr().out
    assert "nothing there" in text
    assert "missed" in text


def test_memory_is_bounded() -> None:
    board = Scoreboard()
    for scan in range(3 * KEPT_SCANS):
        board.add_truth(truth(scan))
    assert board.truth_of(0) is None
    assert board.truth_of(3 * KEPT_SCANS - 1) is not None
