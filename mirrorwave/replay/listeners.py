"""State of the graph that a replay plays into: who listens, which scans are answered, what was left out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import msgspec

from msgs.bus.interface import Received
from msgs.bus.topics import plain_topic
from msgs.bus.zmq import ZmqBus, list_publishers
from msgs.recording.mcap import Recorded
from msgs.values.diagnostics import NodeState, NodeStatus, TopicCount

#: Topics of one scan, each made of those before.
CHAIN = (
    "radar/beam",
    "lidar/histograms",
    "radar/detections",
    "radar/ra_map",
    "perception/peaks",
    "perception/hidden_objects",
)
HEARTBEAT = "diagnostics/node"
#: Scans on their way at once: the former folds one while the other is looked at. What is in between waits in the nodes'
#: queues, which hold more than that.
SCANS_AT_ONCE = 2
#: A scan that is not answered for this long is given up; a network that is loaded anew may take seconds.
ANSWER_S = 10.0
#: The same where the graph is not waited for.
LATE_ANSWER_S = 2.0
#: Nodes and their subscriptions are waited for so long.
READY_S = 30.0
#: A subscriber that takes nothing more for this long has missed what it has not taken.
CONFIRM_S = 5.0
_TURN_S = 0.02

Stopped = Callable[[], bool]


class NodeLoss(msgspec.Struct, frozen=True, kw_only=True):
    """Messages or work that a node reports as missed."""

    node: str
    #: A topic, or the kind of work that was left out.
    what: str
    reason: str
    count: int


def await_nodes(bus: ZmqBus, run_dir: Path, stopped: Stopped) -> None:
    """Wait until no living node is still starting: it has not said yet what it publishes and takes.

    Raises `TimeoutError` where one does not get ready.
    """
    ready: set[str] = set()
    bus.subscribe(HEARTBEAT)
    end_s = time.monotonic() + READY_S
    # a supervisor is ready when it has started all its nodes: they are looked for anew then
    while (missing := _heard_nodes(run_dir) - ready) and not stopped():
        for received in bus.receive(0.1):
            if isinstance(received.message, NodeStatus) and received.message.state is not NodeState.STARTING:
                ready.add(received.message.node)
        if time.monotonic() > end_s:
            raise TimeoutError(f"not ready after {READY_S:g} s: {', '.join(sorted(missing))}; see mirrorwave doctor")


def _heard_nodes(run_dir: Path) -> set[str]:
    return {node for topic, node in list_publishers(run_dir) if topic == HEARTBEAT}


class ReplayedGraph:
    """The living nodes of a domain while `topics` are played into it over `bus`; nobody may be there too."""

    def __init__(self, bus: ZmqBus, run_dir: Path, topics: tuple[str, ...], stopped: Stopped) -> None:
        publishers = list_publishers(run_dir)
        living = {topic for topic, _ in publishers}
        self._bus, self._topics, self._stopped = bus, topics, stopped
        self._nodes = _heard_nodes(run_dir)
        #: The played topic that scans are counted on, and the last one that the graph makes of it.
        self.head = next((topic for plain in CHAIN for topic in topics if plain_topic(topic) == plain), None)
        after = CHAIN[CHAIN.index(plain_topic(self.head)) + 1 :] if self.head else ()
        self.answer = next((topic for topic in reversed(after) if topic in living and topic not in topics), None)
        self._before: dict[str, NodeStatus] = {}
        self._now: dict[str, NodeStatus] = {}
        self._sent: Counter[str] = Counter()
        self._sent_ns = 0
        self._scan: int | None = None
        self._in_flight: list[int] = []
        #: The same, with those that are waited for no longer.
        self._open: set[int] = set()
        self._passed_over = 0
        self._silent = False
        self.scans = 0
        self._answered_s = time.monotonic()
        for topic in filter(None, (HEARTBEAT, self.answer)):
            bus.subscribe(topic)

    @property
    def unanswered(self) -> int:
        """Scans that were sent and not answered so far."""
        return len(self._open) + self._passed_over

    @property
    def nodes(self) -> tuple[str, ...]:
        """Nodes that say how they are."""
        return tuple(sorted(self._nodes))

    def await_subscribers(self, settle_s: float) -> None:
        """Wait until all nodes have been heard and are connected to what they take: the first message gets there.

        Who says nothing of itself, a plain subscriber, gets `settle_s`. Raises `TimeoutError` where a node is missing.
        """
        self._until(lambda: False, settle_s)
        self._until(lambda: self._nodes <= self._now.keys() and not self._unconnected(), READY_S)
        silent = sorted(self._nodes - self._now.keys())
        if not self._stopped() and (silent or self._unconnected()):
            missing = f"{', '.join(silent)} says nothing" if silent else f"not connected: {self._unconnected()}"
            raise TimeoutError(f"the graph is not ready after {READY_S:g} s: {missing}; see mirrorwave doctor")
        self._before = dict(self._now)

    def begins_scan(self, recorded: Recorded) -> bool:
        """Return whether a message is the first of a scan; every message is where no scans are played."""
        return self.head is None or (recorded.topic == self.head and _scan_id(recorded) != self._scan)

    def restart(self) -> None:
        """Begin a new scan with the next message."""
        self._scan = None

    def note_sent(self, recorded: Recorded) -> None:
        """Take down that a message is on its way."""
        self._sent[recorded.topic] += 1
        self._sent_ns = self._bus.now_ns()
        if recorded.topic == self.head and self.begins_scan(recorded):
            self._scan = _scan_id(recorded)
            self._in_flight.append(self._scan)
            self._passed_over += self._scan in self._open
            self._open.add(self._scan)
            self.scans += 1

    def await_room(self, max_in_flight: int = SCANS_AT_ONCE - 1, patience_s: float = ANSWER_S) -> None:
        """Wait until at most so many scans are unanswered; no longer for a graph that fell silent."""
        if self.answer is None or self._silent:
            self.serve(0.0)
            return
        self._answered_s = time.monotonic()
        while len(self._in_flight) > max_in_flight and not self._stopped():
            self.serve(_TURN_S)
            if time.monotonic() - self._answered_s > patience_s:
                self._silent = True
                self._in_flight.clear()

    def confirm(self, patience_s: float) -> None:
        """Wait until every node has told that it took all that was sent, or takes nothing more for `patience_s`."""
        least, moved_s = self._missing(), time.monotonic()

        def all_heard() -> bool:
            return all(self._now[node].stamp_ns >= self._sent_ns for node in self._before)

        while not (self._stopped() or (all_heard() and self._missing() == 0)):
            self.serve(_TURN_S)
            if self._missing() < least:
                least, moved_s = self._missing(), time.monotonic()
            if time.monotonic() - moved_s > patience_s:
                return

    def losses(self) -> tuple[NodeLoss, ...]:
        """Return what the nodes report as missed or left out since `await_subscribers`."""
        losses = [loss for node in self._before for loss in self._losses_of(node)]
        return tuple(loss for loss in losses if loss.count > 0)

    def serve(self, timeout_s: float) -> None:
        """Take in what the graph says."""
        for received in self._bus.receive(timeout_s):
            self._hear(received)

    def _hear(self, received: Received) -> None:
        if isinstance(received.message, NodeStatus):
            self._now[received.message.node] = received.message
        elif received.topic == self.answer:
            # answers come in order: older scans than the answered one will not be answered any more
            self._silent = False
            self._answered_s = time.monotonic()
            scan: int = received.message.scan_id  # type: ignore[attr-defined]
            self._open.discard(scan)
            if scan in self._in_flight:
                del self._in_flight[: self._in_flight.index(scan) + 1]

    def _until(self, done: Callable[[], bool], timeout_s: float) -> None:
        end_s = time.monotonic() + timeout_s
        while not done() and not self._stopped() and time.monotonic() < end_s:
            self.serve(_TURN_S)

    def _unconnected(self) -> str:
        """Topics with fewer subscribers than nodes that take them."""
        wanted = Counter(count.topic for status in self._now.values() for count in status.received)
        return ", ".join(topic for topic in self._topics if self._bus.subscribers(topic) < wanted[topic])

    def _missing(self) -> int:
        """Messages of the played topics that nodes have not taken."""
        return sum(loss.count for node in self._before for loss in self._untaken(node) if loss.count > 0)

    def _losses_of(self, node: str) -> list[NodeLoss]:
        before, now = self._before[node], self._now[node]
        if before.pid != now.pid:
            return [NodeLoss(node=node, what="node", reason="started anew", count=1)]
        shed = {(count.what, count.reason): count.count for count in before.shed}
        losses = self._untaken(node)
        # of what nodes make of the played topics, between them
        old = {count.topic: count for count in before.received}
        for count in now.received:
            if count.topic in CHAIN and count.topic not in self._topics and count.topic in old:
                lost = _trouble(count) - _trouble(old[count.topic])
                losses.append(NodeLoss(node=node, what=count.topic, reason="lost or outdated", count=lost))
        for work in now.shed:
            left_out = work.count - shed.get((work.what, work.reason), 0)
            losses.append(NodeLoss(node=node, what=work.what, reason=work.reason, count=left_out))
        return losses

    def _untaken(self, node: str) -> list[NodeLoss]:
        before = {count.topic: count.messages for count in self._before[node].received}
        losses = []
        for count in self._now[node].received:
            if count.topic in self._topics and count.topic in before:
                untaken = self._sent[count.topic] - (count.messages - before[count.topic])
                losses.append(NodeLoss(node=node, what=count.topic, reason="not received", count=untaken))
        return losses


def _trouble(count: TopicCount) -> int:
    return count.lost + count.rejected + count.outdated


def _scan_id(recorded: Recorded) -> int:
    scan_id: int = recorded.message.scan_id  # type: ignore[attr-defined]
    return scan_id
