"""Notice that kernels are being compiled; a line every ten seconds says how many are done."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

#: numba's event for a kernel that is not in its cache.
_COMPILE = "numba:compile"
NOTICE = "compiling kernels, once after an installation or an update: half a minute, on a slow machine minutes"


#: Least time between two lines.
BEAT_S = 10.0


class _Counter(event.Listener):
    """Reports the first kernel that is compiled, then from time to time how many have been."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._done = 0
        self._start_s: float | None = None
        self._said_s = 0.0

    def on_start(self, event: Any) -> None:
        """Note that the compilation of a kernel begins."""
        now_s = time.monotonic()
        with self._lock:
            if self._start_s is None:
                self._start_s, self._said_s, text = now_s, now_s, NOTICE
            elif now_s - self._said_s >= BEAT_S:
                self._said_s, text = now_s, f"compiling kernels: {self._done} done, {now_s - self._start_s:.0f} s"
            else:
                return
        self._say(text)

    def on_end(self, event: Any) -> None:
        """Note that a kernel has been compiled."""
        with self._lock:
            self._done += 1


@contextmanager
def compile_notice(say: Callable[[str], None]) -> Iterator[None]:
    """While the body runs, call `say` at the first kernel that is compiled, then at most every `BEAT_S`.

    Cached ones are silent.
    """
    with event.install_listener(_COMPILE, _Counter(say)):
        yield
