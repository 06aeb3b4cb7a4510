"""The exit codes of verbs that a signal ends, the same while they are loaded, set up, run and stop.

Loaded before all else, so it takes little from the library and nothing from elsewhere.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

#: Exit codes as a shell gives them to a program that the signal ended: 128 and its number.
INTERRUPTED, TERMINATED, HUNG_UP = 128 + signal.SIGINT, 128 + signal.SIGTERM, 128 + signal.SIGHUP
#: Verbs that have no end of their own, and the options that give them one: told to end, they have done what was asked.
_UNTIL_STOPPED: dict[tuple[str, ...], frozenset[str]] = {
    ("launch",): frozenset(),
    ("demo",): frozenset(),
    ("view",): frozenset(),
    ("top",): frozenset({"--once", "--json"}),
    ("bag", "record"): frozenset(),
}
#: What is said of a verb that was not done; nothing where the terminal has gone.
_SAID = {INTERRUPTED: "interrupted", TERMINATED: "terminated"}
#: After so long a lost interrupt is sent again.
_AGAIN_S = 0.05
#: What is said to whoever asks a second time.
PATIENCE = "closing; press Ctrl-C once more to end at once"
#: The last signal to end that interrupted the process.
_heard: signal.Signals | None = None
#: How often the process was asked to end.
_asked = 0


def hear_endings() -> None:
    """Take SIGTERM and SIGHUP, the end of the terminal, for Ctrl-C, so that what a verb holds is closed as well.

    Not where somebody has them ignored, as `nohup` does. None is lost where it comes while a library works that can
    pass on no exception.
    """
    handlers = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    for number, untouched in handlers.items():
        if signal.getsignal(number) is untouched:
            signal.signal(number, _interrupt)
    sys.unraisablehook = _hear_again


def was_interrupted() -> bool:
    """Return whether a signal to end has interrupted the process: a library may have made any error of it."""
    return _heard is not None


def ended_by_signal(arguments: Sequence[str] | None = None) -> int:
    """The exit code of a verb that was interrupted, by its command line; says so in a line where it was not done."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    # an interrupt that passed through code that a library runs from text has marked the process to end by SIGINT,
    # whatever its exit code; the interpreter takes the mark off where it runs such code again, as this does
    namedtuple("Unmarked", ())
    if runs_until_stopped(words):
        return 0
    code = 128 + (_heard or signal.SIGINT)
    if code in _SAID:
        sys.stderr.write(f"mirrorwave: {_SAID[code]}\n")
    return code


def runs_until_stopped(arguments: Sequence[str]) -> bool:
    """Return whether a command line is that of a verb that runs until it is stopped."""
    return any(
        tuple(arguments[: len(verb)]) == verb and not ends & set(arguments) for verb, ends in _UNTIL_STOPPED.items()
    )


def is_asked_again(number: int) -> bool:
    """Note a signal to end; return whether one came before it. The second gets a line, the third ends the process.

    What a verb holds open is closed after the first, which the others must not interrupt.
    """
    global _asked
    if number == signal.SIGHUP and _asked:
        # the terminal is closed: no user is there to request haste
        return True
    _asked += 1
    if _asked == 2:
        # not through `sys.stderr`, in whose code the signal may have come
        with suppress(OSError):
            os.write(2, f"mirrorwave: {PATIENCE}\n".encode())
    elif _asked > 2:
        os._exit(128 + number)
    return _asked > 1


def keep_code() -> None:
    """Take no further notice of signals: what was done is done, and the exit code stands."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def stopped_by_signal(tell: Callable[[], None]) -> Iterator[None]:
    """While the body runs, a signal to end is passed on to `tell`, and interrupts nothing. For the main thread."""

    def pass_on(number: int, frame: object) -> None:
        _hear_once(number)
        tell()

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = [signal.signal(number, pass_on) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _hear_again(lost: sys.UnraisableHookArgs) -> None:
    """Send the signal of an interrupt that could not be raised once more; show all else as it is shown."""
    if lost.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(lost)
        return
    global _asked
    _asked = 0
    number = _heard or signal.SIGINT
    if number == signal.SIGHUP:
        signal.signal(number, _interrupt)
    # from elsewhere and a little later: here it would be lost again
    again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()


def _hear_once(number: int) -> None:
    # shell and kernel both say that the terminal has gone: the second time is no wish for haste
    if number == signal.SIGHUP:
        signal.signal(number, signal.SIG_IGN)


def _interrupt(number: int, frame: object) -> None:
    global _heard
    _hear_once(number)
    if is_asked_again(number):
        return
    _heard = signal.Signals(number)
    raise KeyboardInterrupt
