"""Tables of records: columns, rows selected and joined as with one array a column."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.trace.row_table import Column, RowTable


class Marks(RowTable):
    """A small table."""

    number = Column("i4")
    flag = Column("?")
    field = Column("c16")
    point = Column("f8", 3)


def marks(count: int, start: int = 0) -> Marks:
    number = start + np.arange(count)
    return Marks.of(count, number=number, flag=number % 2 == 0, field=1j * number, point=np.outer(number, [1, 2, 3]))


def test_rows_are_selected_by_index_and_mask() -> None:
    table = marks(6)
    for rows in (table.take(np.array([4, 0, 2])), table.take(table.flag)):
        assert sorted(rows.number.tolist()) == [0, 2, 4]
        np.testing.assert_array_equal(rows.field, 1j * rows.number)
        np.testing.assert_array_equal(rows.point[:, 2], 3.0 * rows.number)


def test_tables_are_joined_in_order() -> None:
    table = Marks.joined([marks(3), marks(0), marks(2, start=7)])
    assert table.number.tolist() == [0, 1, 2, 7, 8]
    assert table.flag.tolist() == [True, False, True, False, True]
    assert Marks.joined([marks(0), marks(2, start=5), marks(0)]).number.tolist() == [5, 6]
    assert len(Marks.joined([marks(0), marks(0)])) == 0


def test_other_values_leave_the_table_as_it_was() -> None:
    table = marks(3)
    changed = table.with_columns(number=9, point=np.ones((3, 3)))
    assert changed.number.tolist() == [9, 9, 9]
    assert table.number.tolist() == [0, 1, 2]
    assert changed.flag.tolist() == table.flag.tolist()


def test_all_columns_must_be_given() -> None:
    with pytest.raises(ValueError, match="columns must be those of Marks, got or missed flag, point"):
        Marks.of(2, number=1, field=0.0)
