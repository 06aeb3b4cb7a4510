"""Keys that steer a replay while it runs in a terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from enum import Enum
from typing import Any, Self


class Key(Enum):
    """Meaning of a key."""

    PAUSE = "pause"
    STEP = "step"
    BACK = "back"
    FORWARD = "forward"
    FASTER = "faster"
    SLOWER = "slower"
    QUIT = "quit"


#: Sequences that terminals send; both forms of the arrows.
_KEYS = {
    b" ": Key.PAUSE,
    b"s": Key.STEP,
    b"q": Key.QUIT,
    b"\x1b[A": Key.FASTER,
    b"\x1bOA": Key.FASTER,
    b"\x1b[B": Key.SLOWER,
    b"\x1bOB": Key.SLOWER,
    b"\x1b[C": Key.FORWARD,
    b"\x1bOC": Key.FORWARD,
    b"\x1b[D": Key.BACK,
    b"\x1bOD": Key.BACK,
}
HELP = "space pause  s step  left/right 5 s  up/down rate  q quit"


class Keyboard:
    """Keys without Enter from stdin where it is a terminal, none elsewhere; a context manager that restores it."""

    def __init__(self, descriptor: int | None = None) -> None:
        # a daemon may have no stdin at all
        has_terminal = descriptor is None and sys.stdin is not None and sys.stdin.isatty()
        terminal = sys.stdin.fileno() if has_terminal else descriptor
        self._descriptor = (
            terminal if terminal is not None and os.isatty(terminal) and not _in_background(terminal) else None
        )
        self._before: list[Any] = []
        self._typed = b""

    @property
    def is_there(self) -> bool:
        """True if keys can come."""
        return self._descriptor is not None

    def __enter__(self) -> Self:
        if self._descriptor is not None:
            self._before = termios.tcgetattr(self._descriptor)
            # output and Ctrl-C stay as they are
            tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *error: object) -> None:
        if self._descriptor is not None:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def pressed(self) -> list[Key]:
        """Keys since the last call; never waits."""
        if self._descriptor is None:
            return []
        while select.select([self._descriptor], [], [], 0.0)[0]:
            typed = os.read(self._descriptor, 64)
            if not typed:
                self._descriptor = None
                break
            self._typed += typed
        keys, self._typed = keys_of(self._typed)
        return keys


def _in_background(descriptor: int) -> bool:
    """Return whether a shell runs this process in the background: it would be stopped as soon as it touched the
    terminal.
    """
    try:
        return os.tcgetpgrp(descriptor) != os.getpgrp()
    except OSError:
        # not the terminal that controls this process
        return False


def keys_of(typed: bytes) -> tuple[list[Key], bytes]:
    """Keys in what was typed, unknown ones left out, and the beginning of a sequence whose rest is still to come."""
    keys: list[Key] = []
    while typed:
        size = 3 if typed[:2] in (b"\x1b[", b"\x1bO") else 1
        if len(typed) < size or typed == b"\x1b":
            break
        if typed[:size] in _KEYS:
            keys.append(_KEYS[typed[:size]])
        typed = typed[size:]
    return keys, typed
