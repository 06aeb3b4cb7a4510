"""Counts with their nouns."""

from __future__ import annotations

import pytest

from msgs.values.wording import counted


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((0, "scan"), "0 scans"),
        ((1, "scan"), "1 scan"),
        ((2, "scan"), "2 scans"),
        ((1, "frequency", "frequencies"), "1 frequency"),
        ((3, "frequency", "frequencies"), "3 frequencies"),
    ],
)
def test_one_is_singular(words: tuple[int, str], text: str) -> None:
    assert counted(*words) == text
