"""Base of dataclasses whose fields are arrays of one length: rows selected, tables joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np


@dataclass(frozen=True)
class ArrayTable:
    """Columns of one length, an array a field."""

    def take(self, selection: np.ndarray) -> Self:
        """Return the rows of an index or mask."""
        return type(self)(**{field.name: getattr(self, field.name)[selection] for field in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of one or more tables, in order."""
        columns = (field.name for field in fields(cls))
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns})
