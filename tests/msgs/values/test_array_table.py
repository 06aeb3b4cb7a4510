"""Rows of tables of arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from msgs.values.array_table import ArrayTable


@dataclass(frozen=True)
class Points(ArrayTable):
    name: np.ndarray
    at_m: np.ndarray


POINTS = Points(np.array(["a", "b", "c"]), np.arange(6.0).reshape(3, 2))


@pytest.mark.parametrize("selection", [np.array([2, 0]), np.array([True, False, True])])
def test_rows_are_taken_from_every_column(selection: np.ndarray) -> None:
    taken = POINTS.take(selection)
    assert type(taken) is Points
    assert taken.name.tolist() == POINTS.name[selection].tolist()
    assert taken.at_m.tolist() == POINTS.at_m[selection].tolist()


def test_joined_tables_are_the_whole_again() -> None:
    parts = [POINTS.take(np.arange(2)), POINTS.take(np.arange(2, 3)), POINTS.take(np.arange(0))]
    whole = Points.joined(parts)
    assert whole.name.tolist() == ["a", "b", "c"]
    np.testing.assert_array_equal(whole.at_m, POINTS.at_m)
