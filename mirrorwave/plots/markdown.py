"""Markdown as reports and the reference write it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table; None is a dash."""
    lines = (columns, ["---"] * len(columns), *rows)
    return [f"| {' | '.join('-' if cell is None else str(cell) for cell in row)} |" for row in lines]
