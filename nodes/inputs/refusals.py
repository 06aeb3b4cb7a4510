"""Input that a stage cannot take: counted, and logged once a reason."""

from __future__ import annotations

import logging

from msgs.values.diagnostics import NodeState
from msgs.values.wording import counted
from nodes.node import ShedTally


class Refusals:
    """Refusals of a stage. `unit`: what log lines count, as "beam"; None: they name what was refused."""

    def __init__(self, log: logging.Logger, shed: ShedTally, unit: str | None = None) -> None:
        self._log, self._shed, self._unit = log, shed, unit
        self._count = 0

    @property
    def reason(self) -> str:
        """Why input was refused last; empty once input was accepted again."""
        return self._shed.refusal

    def refuse(self, kind: str, error: ValueError, name: str | None = None) -> None:
        """Count `kind`, in the log called `name`, as refused for an error; log the error unless it is the last one."""
        self._count += kind == self._unit
        self._shed.add(kind, "refused")
        if str(error) != self.reason:
            self._log.warning("%s", self._line(name or kind, error))
        self._shed.refusal = str(error)

    def accept(self) -> None:
        """Note that input is accepted again."""
        self._shed.refusal = ""

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED with the reason while input is refused."""
        return (NodeState.DEGRADED, self.reason) if self.reason else (NodeState.READY, "")

    def _line(self, name: str, error: ValueError) -> str:
        return (
            f"{name} refused: {error}"
            if self._unit is None
            else (f"{error} ({counted(self._count, self._unit)} refused so far)")
        )
