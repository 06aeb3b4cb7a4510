"""Age of messages: from acquisition to sending, from sending to arrival, from the last beam to its view.

All clocks are the monotonic clock of one machine. A stamp that this clock cannot have given (a recording that is played
back, another machine) gives no figure and is counted apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msgs.bus.interface import Received
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from nodes.inputs.view_latency import UNHEARD_NS, GraphStart, Setup, latency_ns, on_one_clock

#: What is measured, in the order in which it is shown, and what it says.
SPANS = {
    "acquired to sent": "sent_ns - stamp_ns",
    "sent to received": "arrival - sent_ns",
    "last beam to received": "arrival - end of the scan's last beam",
}


class _Spans:
    """Durations of one topic and publisher."""

    def __init__(self) -> None:
        self.ms: dict[str, list[float]] = {name: [] for name in SPANS}
        self.other_clock = self.ahead = self.before_listening = 0


class DelayWatch:
    """Takes messages as they arrive; `start_ns` is when listening began, on the bus clock."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._graph = GraphStart(start_ns)
        self._setup: Setup | None = None
        self._spans: dict[tuple[str, str], _Spans] = {}

    def set_up(self, setup: Setup) -> None:
        """Beams and their time on air, for the end of a scan."""
        self._setup = setup

    def hear(self, status: NodeStatus, now_ns: int) -> None:
        """Take in a heartbeat: it says since when the graph runs."""
        self._graph.hear(status, now_ns)

    def take(self, received: Received, now_ns: int) -> None:
        """Take in a message that arrived at `now_ns`."""
        envelope = received.envelope
        spans = self._spans.setdefault((received.topic, envelope.publisher), _Spans())
        if envelope.sent_ns < self._start_ns:
            # a latched topic gives its last message: how long it has stood there is no delay
            spans.before_listening += 1
        else:
            spans.ms["sent to received"].append(1e-6 * (now_ns - envelope.sent_ns))
        stamp_ns: int = getattr(received.message, "stamp_ns", envelope.sent_ns)
        if not on_one_clock(stamp_ns, envelope.sent_ns, self._graph.since_ns):
            is_ahead = 0 < stamp_ns - envelope.sent_ns <= UNHEARD_NS
            spans.ahead += is_ahead
            spans.other_clock += not is_ahead
            return
        spans.ms["acquired to sent"].append(1e-6 * (envelope.sent_ns - stamp_ns))
        if isinstance(received.message, BevFrame):
            spans.ms["last beam to received"].append(1e-6 * latency_ns(stamp_ns, now_ns, self._setup))

    def rows(self) -> list[dict[str, Any]]:
        """One row a topic, publisher and span that has figures, or a remark on why it has none."""
        return [
            row for (topic, publisher), spans in sorted(self._spans.items()) for row in _rows(topic, publisher, spans)
        ]


def _rows(topic: str, publisher: str, spans: _Spans) -> list[dict[str, Any]]:
    before = spans.before_listening
    latched = f"{before} sent before listening began (latched)" if before else ""
    remarks = {"acquired to sent": _stamp_remark(spans), "sent to received": latched}
    rows = []
    for span, values_ms in spans.ms.items():
        remark = remarks.get(span, "")
        if values_ms or remark:
            figures = dict(zip(("p50_ms", "p90_ms", "p99_ms", "max_ms"), _quantiles(values_ms), strict=True))
            head = {"topic": topic, "publisher": publisher, "delay": span, "messages": len(values_ms)}
            rows.append({**head, **figures, "remark": remark})
    return rows


def _quantiles(values_ms: list[float]) -> list[float | None]:
    if not values_ms:
        return [None] * 4
    return [float(value) for value in np.percentile(values_ms, [50, 90, 99, 100])]


def _stamp_remark(spans: _Spans) -> str:
    remarks = []
    if spans.other_clock:
        remarks.append(f"{spans.other_clock} stamped by another clock: played back, or from another machine")
    if spans.ahead:
        remarks.append(f"{spans.ahead} stamped later than they were sent: the publisher's stamps run ahead")
    return "; ".join(remarks)
