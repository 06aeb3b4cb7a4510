"""Base of dataclasses whose fields are arrays of one length: rows selected, tables joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self, TypeVar

import numpy as np

Table = TypeVar("Table", bound="ArrayTable")


@dataclass(frozen=True)
class ArrayTable:
    """Columns of one length, an array a field."""

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def take(self, selection: np.ndarray) -> Self:
        """Return the rows of an index or mask."""
        index = np.flatnonzero(selection) if selection.dtype == np.bool_ else selection
        return type(self)(**{name: getattr(self, name).take(index, axis=0) for name in self.__dataclass_fields__})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of one or more tables, in order."""
        names = list(cls.__dataclass_fields__)
        filled = [part for part in parts if len(part)]
        if len(filled) <= 1:
            return filled[0] if filled else parts[0]
        return cls(**{name: np.concatenate([getattr(part, name) for part in filled]) for name in names})


def stored_columns(name: str, tables: Sequence[ArrayTable]) -> dict[str, np.ndarray]:
    """Return the columns of tables in one row, and where each table ends."""
    joined = type(tables[0]).joined(tables)
    columns = {f"{name}.{field.name}": getattr(joined, field.name) for field in fields(joined)}
    return columns | {f"{name}.end": np.cumsum([len(table) for table in tables])}


def stored_tables(kind: type[Table], name: str, arrays: dict[str, np.ndarray]) -> list[Table]:
    """Return the tables that `stored_columns` joined."""
    joined = kind(**{field.name: arrays[f"{name}.{field.name}"] for field in fields(kind)})
    ends = arrays[f"{name}.end"].tolist()
    return [joined.take(np.arange(first, last)) for first, last in zip([0, *ends[:-1]], ends, strict=True)]
