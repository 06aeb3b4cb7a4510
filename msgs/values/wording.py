"""Numbers in sentences."""

from __future__ import annotations


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun in English: "1 scan", "2 scans", "0 scans"; `plural` if an s does not do."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"
