"""Figures in sentences."""

from __future__ import annotations


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """A count with its noun as English has it: "1 scan", "2 scans", "0 scans"; `plural` where an s does not do."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"
