"""The hook by which a host measures the stages; the stages themselves know no clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

#: Measures the body of `with timed(name)`; `contextlib.nullcontext` measures nothing.
Timed = Callable[[str], AbstractContextManager[object]]
