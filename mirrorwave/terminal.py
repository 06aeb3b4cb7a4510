"""The process and its streams: some that came closed, a reader that has seen enough.

Loaded before all else, so it takes little from the library and nothing from elsewhere.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import stat
import sys
import threading
from collections.abc import Iterator

#: Exit code of a program that writes to a reader who has left, as a shell gives it: 128 and SIGPIPE.
READER_LEFT = 128 + signal.SIGPIPE


def open_closed_streams() -> None:
    """Have stdin, stdout and stderr that came closed read and write nothing, in processes started from here too.

    The next file to be opened would get their numbers, and whatever is printed.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # the lowest number that is free is the missing one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


class _ReaderLeftError(BaseException):
    """The reader of stdout has left; a library that handles every `Exception` must not take it for one of its own."""


@contextlib.contextmanager
def ends_with_reader() -> Iterator[None]:
    """End the body with `BrokenPipeError` as soon as the reader of stdout has left, wherever the body is.

    Without it a listening verb would notice with its next line, which may never come. For the main thread.
    """
    descriptor = _pipe_of_stdout()
    if descriptor is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    main = threading.main_thread().ident
    assert main is not None
    wake, end = os.pipe()

    def watch() -> None:
        if _await_reader_left(descriptor, wake):
            signal.pthread_kill(main, signal.SIGPIPE)

    thread = threading.Thread(target=watch, name="reader", daemon=True)
    before = signal.signal(signal.SIGPIPE, _say_reader_left)
    # who had left before is noticed as soon as the thread runs
    try:
        thread.start()
        try:
            yield
        finally:
            os.close(end)
            thread.join()
            os.close(wake)
    except _ReaderLeftError:
        raise BrokenPipeError from None
    finally:
        signal.signal(signal.SIGPIPE, before)


def _pipe_of_stdout() -> int | None:
    """Descriptor of stdout where it leads to another program, else None."""
    try:
        descriptor = sys.stdout.fileno()
        mode = os.fstat(descriptor).st_mode
    except (OSError, ValueError, AttributeError):
        return None
    return descriptor if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) else None


def _await_reader_left(descriptor: int, wake: int) -> bool:
    """Wait until the reader has left, True, or until the other end of `wake` is closed."""
    poll = select.poll()
    # asked for nothing, a poll tells errors
    poll.register(descriptor, 0)
    poll.register(wake, select.POLLIN)
    return any(ready == descriptor for ready, _ in poll.poll())


def _has_left(descriptor: int) -> bool:
    poll = select.poll()
    poll.register(descriptor, 0)
    return bool(poll.poll(0))


def _say_reader_left(number: int, frame: object) -> None:
    # a socket that somebody closed sends the same signal; who writes to it hears of it anyway
    descriptor = _pipe_of_stdout()
    if descriptor is not None and _has_left(descriptor):
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        raise _ReaderLeftError
