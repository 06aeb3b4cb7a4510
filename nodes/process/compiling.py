"""Notice that kernels are being compiled: after an installation or an update this takes half a minute, once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

#: numba's event for a kernel that is not in its cache.
_COMPILE = "numba:compile"
NOTICE = "compiling kernels, which are kept: it takes half a minute after an installation or an update"


class _Once(event.Listener):
    """Reports the first kernel that is compiled."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say: Callable[[str], None] | None = say
        self._lock = threading.Lock()

    def on_start(self, event: Any) -> None:
        """Note that the compilation of a kernel begins."""
        with self._lock:
            say, self._say = self._say, None
        if say is not None:
            say(NOTICE)

    def on_end(self, event: Any) -> None:
        """Note that a kernel has been compiled."""


@contextmanager
def compile_notice(say: Callable[[str], None]) -> Iterator[None]:
    """While the body runs, call `say` once at the first kernel that is compiled; cached ones are silent."""
    with event.install_listener(_COMPILE, _Once(say)):
        yield
