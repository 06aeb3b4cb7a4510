"""Base of tables whose rows lie together in memory: one array of records, a column a view of it.

Rows selected and tables joined are one copy each, whatever the number of columns, and compiled code takes a table as
one argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np


class Column:
    """A column of a `RowTable`: one value a row, or a vector of `shape`."""

    def __init__(self, kind: str, *shape: int) -> None:
        self.kind, self.shape = kind, shape
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, table: RowTable, owner: type) -> np.ndarray:
        return np.asarray(table.rows[self._name])


class RowTable:
    """Columns of one length in one array of records; the records' type comes from the class's columns."""

    dtype: ClassVar[np.dtype]

    def __init_subclass__(cls) -> None:
        columns = [(name, item.kind, item.shape) for name, item in vars(cls).items() if isinstance(item, Column)]
        cls.dtype = np.dtype(columns, align=True)

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    @classmethod
    def of(cls, count: int, **columns: Any) -> Self:
        """Return a table of `count` rows from all its columns, each an array or one value for all rows."""
        missing = set(cls.dtype.names or ()) ^ set(columns)
        if missing:
            raise ValueError(f"columns must be those of {cls.__name__}, got or missed {', '.join(sorted(missing))}")
        return cls(np.empty(count, cls.dtype)).with_columns(**columns)

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, selection: np.ndarray) -> Self:
        """Return the rows of an index or mask."""
        index = np.flatnonzero(selection) if selection.dtype == np.bool_ else selection
        return type(self)(self.rows.take(index))

    def with_columns(self, **columns: Any) -> Self:
        """Return the same rows with other values in some columns."""
        rows = self.rows.copy()
        for name, values in columns.items():
            rows[name] = values
        return type(self)(rows)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of all tables, in order."""
        filled = [part for part in parts if len(part)]
        if len(filled) <= 1:
            return filled[0] if filled else cls(np.empty(0, cls.dtype))
        # as plain numbers: NumPy copies records field by field
        plain = [np.ascontiguousarray(part.rows).view(np.int64) for part in filled]
        return cls(np.concatenate(plain).view(cls.dtype))
