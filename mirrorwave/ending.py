"""The exit codes of verbs that a signal ends, the same while they are loaded, set up, run and stop.

Loaded before all else, so it takes little from the library and nothing from elsewhere.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

#: Exit codes as a shell gives them to a program that the signal ended: 128 and its number.
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
#: Verbs that have no end of their own, and the options that give them one: told to end, they have done what was asked.
_UNTIL_TOLD: dict[tuple[str, ...], frozenset[str]] = {
    ("launch",): frozenset(),
    ("demo",): frozenset(),
    ("view",): frozenset(),
    ("top",): frozenset({"--once", "--json"}),
    ("bag", "record"): frozenset(),
}
_ENDING = (signal.SIGINT, signal.SIGTERM)
_terminated = False


def hear_termination() -> None:
    """Take SIGTERM for Ctrl-C, so that what a verb holds is closed as well; not where somebody has it ignored."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def ended_by_signal(arguments: Sequence[str] | None = None) -> int:
    """The exit code of a verb that was interrupted, by its command line; says so in a line where it was not done."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if is_until_told(words):
        return 0
    sys.stderr.write(f"mirrorwave: {'terminated' if _terminated else 'interrupted'}\n")
    return TERMINATED if _terminated else INTERRUPTED


def is_until_told(arguments: Sequence[str]) -> bool:
    """Whether a command line is that of a verb that runs until it is told to end."""
    return any(
        tuple(arguments[: len(verb)]) == verb and not ends & set(arguments) for verb, ends in _UNTIL_TOLD.items()
    )


def keep_code() -> None:
    """Take no further notice of signals: what was done is done, and the exit code stands."""
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def told_by_signal(tell: Callable[[], None]) -> Iterator[None]:
    """While the body runs, a signal to end is passed on to `tell`, and interrupts nothing. For the main thread."""
    before = [signal.signal(number, lambda _number, _frame: tell()) for number in _ENDING]
    try:
        yield
    finally:
        for number, handler in zip(_ENDING, before, strict=True):
            signal.signal(number, handler)


def _terminate(number: int, frame: object) -> None:
    global _terminated
    _terminated = True
    raise KeyboardInterrupt
