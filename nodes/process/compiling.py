"""A word while kernels are compiled: after an installation or an update they take half a minute, once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

#: Event of numba for a kernel that it has not kept from an earlier run.
_COMPILE = "numba:compile"
NOTICE = "compiling kernels, which are kept: it takes half a minute after an installation or an update"


class _Once(event.Listener):
    """Says at the first kernel that kernels are compiled."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say: Callable[[str], None] | None = say
        self._lock = threading.Lock()

    def on_start(self, event: Any) -> None:
        """A kernel is about to be compiled."""
        with self._lock:
            say, self._say = self._say, None
        if say is not None:
            say(NOTICE)

    def on_end(self, event: Any) -> None:
        """A kernel has been compiled."""


@contextmanager
def compile_notice(say: Callable[[str], None]) -> Iterator[None]:
    """While the body runs, `say` once that kernels are compiled, where the first of them is; kept ones are silent."""
    with event.install_listener(_COMPILE, _Once(say)):
        yield
