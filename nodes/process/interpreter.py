"""The interpreter that runs a module as a process of the graph."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

#: Set in a process that was started again: one that cannot keep its kernels must not be started for ever.
COMPILED = "MIRRORWAVE_COMPILED"


def module_command(words: Sequence[str]) -> list[str]:
    """Return the command line that runs a module, the first word, with its arguments."""
    # -P: a file of the working directory must not replace a module
    return [sys.executable, "-P", "-m", *words]


def start_again_if_compiled(words: Sequence[str], close: Callable[[], None]) -> None:
    """Where this process has compiled a kernel, `close` what is open and run a module and its arguments in its place.

    They keep its number, standard input and output, and load kernels from their cache: numba's compiler, half a
    gigabyte, cannot be unloaded.
    """
    compiled = sys.modules.get("models.compiled")
    if compiled is None or not compiled.KernelCache.compiled or COMPILED in os.environ:
        return
    close()
    os.environ[COMPILED] = "1"
    os.execv(sys.executable, module_command(words))
