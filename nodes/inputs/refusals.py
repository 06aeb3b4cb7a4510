"""Input that a stage cannot take: counted, and logged once a reason."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from msgs.values.diagnostics import NodeState
from msgs.values.wording import counted
from nodes.node import ShedTally

Answer = TypeVar("Answer")
#: Why a stage leaves input out that it cannot take.
REFUSED = "refused"


class Refusals:
    """Refusals of a stage. `unit`: what log lines count, as "beam"; of others they name what was refused."""

    def __init__(self, log: logging.Logger, shed: ShedTally, unit: str | None = None) -> None:
        self._log, self._shed, self._unit = log, shed, unit
        self._count = 0

    @property
    def reason(self) -> str:
        """Why input was refused last; empty once input was accepted again."""
        return self._shed.refusal

    def refuse(self, kind: str, error: ValueError, name: str | None = None) -> None:
        """Count `kind`, in the log called `name`, as refused for an error; log the error unless it is the last one."""
        is_counted = kind == self._unit
        self._count += is_counted
        self._shed.add(kind, REFUSED)
        if str(error) != self.reason:
            so_far = f"{error} ({counted(self._count, kind)} refused so far)"
            self._log.warning("%s", so_far if is_counted else f"{name or kind} refused: {error}")
        self._shed.refusal = str(error)

    def attempt(self, kind: str, work: Callable[[], Answer], name: str | None = None) -> Answer | None:
        """Return what `work` gives, its input accepted; None where it raises `ValueError`, its input refused."""
        try:
            answer = work()
        except ValueError as error:
            self.refuse(kind, error, name)
            return None
        self.accept()
        return answer

    def accept(self) -> None:
        """Note that input is accepted again."""
        self._shed.refusal = ""

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED with the reason while input is refused."""
        return (NodeState.DEGRADED, self.reason) if self.reason else (NodeState.READY, "")
