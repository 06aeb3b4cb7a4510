"""Health of the graph as a table: rates, stage times, losses and state of every node from its heartbeats."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from msgs.bus.topics import ABOUT_NODES, TOPICS
from msgs.values.diagnostics import NodeState, NodeStatus, StageTime
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.wording import counted

#: Window of the rates: two heartbeats a second against 3.3 scans would make shorter ones jump.
WINDOW_NS = 10 * NANOSECONDS_PER_SECOND
#: A node whose last heartbeat is older is shown as silent.
SILENT_NS = 3 * NANOSECONDS_PER_SECOND
#: Nodes that ended, or never existed (any name may appear on the bus), must not fill the page.
MAX_NODES = 64
#: Two a second are twenty in a window; a faster sender adds no information.
MAX_HEARTBEATS = 64
#: Maximum stages, topics and shed work of a node on the page: none has more than a few.
MAX_ENTRIES = 32
_MAX_TEXT = 500


def is_of_peer(name: str) -> bool:
    """Return whether a node is on another host, whose link publishes its heartbeats as those of `<peer>.<node>`."""
    return "." in name


class _Heard(NamedTuple):
    """A heartbeat and its time of arrival."""

    at_ns: int
    status: NodeStatus


class NodeTable:
    """Keeps the heartbeats of the last seconds of each node."""

    def __init__(self) -> None:
        self._heard: dict[str, deque[_Heard]] = {}
        self._stages: dict[str, tuple[StageTime, ...]] = {}

    def add(self, status: NodeStatus, now_ns: int) -> None:
        """Add a heartbeat; a new process under the same name starts afresh."""
        heartbeats = self._heard.setdefault(status.node, deque(maxlen=MAX_HEARTBEATS))
        if heartbeats and heartbeats[-1].status.pid != status.pid:
            heartbeats.clear()
        heartbeats.append(_Heard(now_ns, status))
        while len(heartbeats) > 2 and now_ns - heartbeats[0].at_ns > WINDOW_NS:
            heartbeats.popleft()
        if status.stages:
            self._stages[status.node] = status.stages
        self._forget_oldest()

    def rows(self, now_ns: int) -> list[dict[str, Any]]:
        """Return one row a node, in the order of the stream: sources first, nodes without publications last."""
        names = sorted(self._heard, key=lambda name: (_stream_order(self._heard[name][-1].status), name))
        return [self._row(name, now_ns) for name in names]

    def _row(self, name: str, now_ns: int) -> dict[str, Any]:
        first, last = self._heard[name][0], self._heard[name][-1]
        status = last.status
        age_ns = now_ns - last.at_ns
        is_silent = age_ns > SILENT_NS and status.state is not NodeState.STOPPING
        return {
            "node": name,
            "state": "silent" if is_silent else str(status.state),
            "reason": f"no heartbeat for {s_from_ns(age_ns):.0f} s" if is_silent else status.reason[:_MAX_TEXT],
            "cpu": round(_rate(first.status.cpu_s, status.cpu_s, first, last), 2),
            "memory_mib": round(status.resident_bytes / (1 << 20)),
            "lost": sum(count.lost for count in status.received),
            "rejected": sum(count.rejected for count in status.received),
            "lost_lately": _gone(status) - _gone(first.status),
            "shed": [f"{counted(count.count, count.what)} {count.reason}" for count in status.shed[:MAX_ENTRIES]],
            "stages": [
                {"name": stage.name, "mean_ms": round(stage.mean_ms, 1), "max_ms": round(stage.max_ms, 1)}
                for stage in self._stages.get(name, ())[:MAX_ENTRIES]
            ],
            "rates": _rates(first, last),
        }

    def _forget_oldest(self) -> None:
        while len(self._heard) > MAX_NODES:
            # nodes of this host are not displaced by names that a peer makes up
            oldest = min(self._heard, key=lambda name: (not is_of_peer(name), self._heard[name][-1].at_ns))
            del self._heard[oldest]
            self._stages.pop(oldest, None)


def _stream_order(status: NodeStatus) -> int:
    """Return the index of the first topic that a node publishes in the table of topics."""
    published = {count.topic for count in status.published}
    return next((index for index, topic in enumerate(TOPICS) if topic in published - ABOUT_NODES), len(TOPICS))


def _gone(status: NodeStatus) -> int:
    """Return messages lost or unreadable since the node started."""
    return sum(count.lost + count.rejected for count in status.received)


def _rates(first: _Heard, last: _Heard) -> list[dict[str, Any]]:
    """Return messages a second of each topic that a node publishes."""
    before = {count.topic: count.messages for count in first.status.published}
    return [
        {"topic": count.topic, "hz": round(_rate(before.get(count.topic, 0), count.messages, first, last), 1)}
        for count in last.status.published[:MAX_ENTRIES]
        if count.topic in TOPICS and count.topic not in ABOUT_NODES and TOPICS[count.topic].rate_hz > 0.0
    ]


def _rate(before: float, after: float, first: _Heard, last: _Heard) -> float:
    """Return the increase a second by the node's own clock, on which both were taken; 0 after one heartbeat only."""
    elapsed_s = last.status.uptime_s - first.status.uptime_s
    return (after - before) / elapsed_s if elapsed_s > 0.0 else 0.0
