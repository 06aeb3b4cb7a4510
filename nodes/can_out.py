"""The hidden-object list on a CAN bus: sent at the DBC's cycle time, with or without a new view.

One list is a status and the messages of all its slots, spread over the cycle by the delays of the DBC so that no
queue of the interface overflows. It holds the state at the time of its status and carries one counter.
"""

from __future__ import annotations

import logging
from typing import Literal

from models.vehicle.hidden_object_list import HiddenObjectList, ListFrame
from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import shipped_path
from msgs.values.arrays import require_positive
from msgs.values.diagnostics import NodeState
from msgs.values.perception import BevFrame
from msgs.values.units import ns_from_s
from msgs.values.wording import counted
from nodes.can.bus import MAX_RETRY_S, RETRY_S, BusParams, CanLink, bus_frame, load_dbc
from nodes.node import Node

_LOG = logging.getLogger(__name__)


class Params(BusParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """CAN bus of the list, and the maximum age of its view."""

    dbc: str = "launch/can/mirrorwave_out.dbc"
    #: The list is marked invalid when its view is older than this.
    max_age_s: float = 1.0
    #: The age of a view counts from its first beam, or from its arrival if stamps are of another clock (a capture).
    age_from: Literal["acquisition", "arrival"] = "acquisition"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("max_age_s", self.max_age_s)


class Outlet:
    """Sends frames on a bus that may fail: refused frames are counted, never kept for later.

    After bus-off the interface is closed for a delay that grows while it happens again.
    """

    def __init__(self, link: CanLink) -> None:
        self._link = link
        self._hold_s = RETRY_S
        self._resume_ns: int | None = None
        self.sent = self.refused = self.bus_offs = 0

    @property
    def trouble(self) -> str:
        """Fault of the bus; empty while it works."""
        return self._link.trouble

    def send(self, frames: list[ListFrame], now_ns: int) -> None:
        """Send frames, in order."""
        if self._is_held(now_ns):
            self.refused += len(frames)
            return
        for frame in frames:
            if self._link.send(bus_frame(frame.arbitration_id, frame.data, frame.extended, now_ns), now_ns):
                self.sent += 1
            else:
                self.refused += 1

    def note_good_list(self) -> None:
        """Note that a whole list was sent: the next bus-off is the first again."""
        self._hold_s = RETRY_S

    def close(self) -> None:
        """Close the bus."""
        self._link.close()

    def _is_held(self, now_ns: int) -> bool:
        if self._resume_ns is not None:
            if now_ns < self._resume_ns:
                return True
            self._resume_ns = None
            return False
        # the interface reports in its received frames that the controller has left the bus
        self._link.receive(now_ns)
        if not self._link.trouble.endswith(": bus-off"):
            return False
        self.bus_offs += 1
        self._link.close()
        self._resume_ns = now_ns + ns_from_s(self._hold_s)
        self._hold_s = min(MAX_RETRY_S, 2.0 * self._hold_s)
        return True


class CanOut(Node):
    """perception/hidden_objects -> CAN, list after list on a grid of cycles that starts with the first step."""

    inputs = ("perception/hidden_objects",)

    def __init__(self, outlet: Outlet, encoder: HiddenObjectList, max_age_ns: int, by_arrival: bool = False) -> None:
        super().__init__()
        self.outlet = outlet
        self._encoder, self._max_age_ns, self._by_arrival = encoder, max_age_ns, by_arrival
        self._view: BevFrame | None = None
        self._view_ns = 0
        self._cycle_ns: int | None = None
        self._counter = 0
        self._waiting: list[ListFrame] = []
        self._refused_before = 0

    def due_ns(self, now_ns: int) -> int:
        """Return the time of the next frame."""
        if self._cycle_ns is None:
            return now_ns
        return self._cycle_ns + (self._waiting[0].delay_ns if self._waiting else self._encoder.period_ns)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Keep the newest view; send the frames whose time has come."""
        for received in inputs:
            assert isinstance(received.message, BevFrame)
            self._view = received.message
            self._view_ns = now_ns if self._by_arrival else received.message.stamp_ns
        if now_ns >= self.due_ns(now_ns):
            with self.stages("send"):
                self._advance(now_ns)
        return []

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while the bus takes no frames."""
        if self.outlet.trouble:
            return NodeState.DEGRADED, f"{self.outlet.trouble}; {counted(self.outlet.refused, 'frame')} not sent"
        return NodeState.READY, ""

    def close(self) -> None:
        """Close the bus."""
        self.outlet.close()

    def _advance(self, now_ns: int) -> None:
        if self._cycle_ns is None or now_ns >= self._cycle_ns + self._encoder.period_ns:
            self._begin_list(now_ns)
        assert self._cycle_ns is not None
        elapsed_ns = now_ns - self._cycle_ns
        due = [frame for frame in self._waiting if frame.delay_ns <= elapsed_ns]
        self._waiting = self._waiting[len(due) :]
        self.outlet.send(due, now_ns)
        if not self._waiting and self.outlet.refused == self._refused_before:
            self.outlet.note_good_list()

    def _begin_list(self, now_ns: int) -> None:
        """Begin the list of the cycle that runs at `now_ns`; the remainder of the previous one is dropped."""
        period_ns = self._encoder.period_ns
        if self._cycle_ns is None:
            self._cycle_ns = now_ns
        else:
            cycles = (now_ns - self._cycle_ns) // period_ns
            self._cycle_ns += cycles * period_ns
            if self._waiting:
                self.shed.add("frame", "late", len(self._waiting))
            if cycles > 1:
                self.shed.add("list", "late", cycles - 1)
        age_ns = None if self._view is None else now_ns - self._view_ns
        self._waiting = self._encoder.frames(self._view, age_ns, self._max_age_ns, self._counter)
        self._counter += 1
        self._refused_before = self.outlet.refused


def create(params: Params) -> CanOut:
    """Return the node; `ValueError` for a DBC that does not fit. An absent bus may appear later."""
    path = shipped_path(params.dbc)
    database = load_dbc(path)
    try:
        encoder = HiddenObjectList(database)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if 1000.0 * params.max_age_s >= encoder.max_age_ms:
        raise ValueError(f"max_age_s must be below {encoder.max_age_ms} ms, the DBC's AGE, got {params.max_age_s!r}")
    by_arrival = params.age_from == "arrival"
    return CanOut(Outlet(CanLink(params)), encoder, ns_from_s(params.max_age_s), by_arrival)
