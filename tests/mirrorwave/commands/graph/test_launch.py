"""The terminal of a launched graph: never in its way."""

from __future__ import annotations

import threading
import time
from typing import Any

from mirrorwave.commands.graph.launch import LogPrinter


def entry(number: int) -> dict[str, Any]:
    return {"node": "a", "level": "info", "text": f"line {number}"}


def test_a_held_terminal_holds_nothing_up_and_says_what_it_missed() -> None:
    """The first line is under way, two wait, seven are left out."""
    shown: list[str] = []
    held, under_way = threading.Event(), threading.Event()

    def show(entry: dict[str, Any]) -> None:
        under_way.set()
        held.wait()
        shown.append(entry["text"])

    with LogPrinter(show, max_lines=2) as printer:
        printer(entry(0))
        under_way.wait()
        for number in range(1, 10):
            printer(entry(number))
        held.set()
        while len(shown) < 3:
            time.sleep(0.001)
        printer(entry(10))
    assert shown == ["line 0", "line 1", "line 2", "7 lines left out: the terminal did not take them", "line 10"]


def test_a_terminal_that_has_gone_is_not_asked_again() -> None:
    asked: list[str] = []

    def show(entry: dict[str, Any]) -> None:
        asked.append(entry["text"])
        raise BrokenPipeError

    with LogPrinter(show) as printer:
        for number in range(3):
            printer(entry(number))
    assert asked == ["line 0"]
