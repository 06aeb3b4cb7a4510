"""One publisher for each input that is one stream: its messages are taken, those of others are dropped and named.

The first publisher is kept until it has been away for a while; a restarted one has its name still. A node comes
before a program that only publishes, as `topic pub`. A set-up is that of the publisher whose measurements the node
takes, where it takes any, else that of the first publisher until its topic is closed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from msgs.bus.interface import GraphBus, Received
from msgs.bus.sequencing import latch
from msgs.bus.topics import SENSOR_TOPICS, plain_topic, sensor_of, sensor_topic, topic_facts
from msgs.values.diagnostics import NodeState
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.wording import counted

_LOG = logging.getLogger(__name__)

#: A publisher may be away for this long, or for some of its own intervals: a restarted node is back earlier. One that
#: has its topic open may be silent for longer: it may be late, and a supervisor ends what hangs.
AWAY_NS, SILENT_NS = 3 * NANOSECONDS_PER_SECOND // 2, 5 * NANOSECONDS_PER_SECOND
_INTERVALS, _LONGEST_SILENCE_NS = 3, 30 * NANOSECONDS_PER_SECOND
#: Another publisher is named for this long after its last message.
NAMED_NS = 10 * NANOSECONDS_PER_SECOND
#: How often the bus is asked who is there.
_LOOK_NS = NANOSECONDS_PER_SECOND // 2
_MAX_NAMES = 32

_MEASUREMENTS_OF = dict(SENSOR_TOPICS)


class BoundInputs:
    """The inputs of one node, each bound to one publisher; belongs to the loop that drives the node.

    `dropped` is called with the topic of each message of another publisher.
    """

    def __init__(self, bus: GraphBus, topics: Iterable[str], dropped: Callable[[str], None]) -> None:
        self._bus, self._dropped = bus, dropped
        self._streams = {topic: _Stream(topic) for topic in topics if not topic_facts(topic).shared}
        #: Whether a name is that of a node, and when the bus was asked.
        self._nodes: dict[str, tuple[bool, int]] = {}

    def take(self, received: list[Received], now_ns: int) -> list[Received]:
        """Return the messages of bound publishers, in order; a set-up of another publisher once that one is bound."""
        # before the others: while this node was busy its publishers only seemed silent
        for item in received:
            stream = self._streams.get(item.topic)
            if stream is not None and stream.publisher == item.envelope.publisher:
                stream.hear(now_ns)
        bound = {id(item) for item in received if self._is_bound(item, now_ns)}
        begun: list[Received] = []
        for stream in self._streams.values():
            if stream.kept and self._bind_latched(stream, now_ns):
                begun.append(stream.kept[stream.publisher])
        replaced = {item.topic for item in begun}
        return begun + [
            item
            for item in received
            if id(item) in bound and item.topic not in replaced and not self._is_of_another(item, now_ns)
        ]

    def health(self, state: NodeState, reason: str, now_ns: int) -> tuple[NodeState, str]:
        """Return the health of a node, DEGRADED with their names while topics have further publishers."""
        troubles = [text for stream in self._streams.values() if (text := stream.trouble(now_ns))]
        if not troubles or state not in (NodeState.READY, NodeState.DEGRADED):
            return state, reason
        return NodeState.DEGRADED, "; ".join([*filter(None, [reason]), *troubles])

    def _is_bound(self, item: Received, now_ns: int) -> bool:
        """Return whether a message is its bound publisher's; a latched topic is decided once all have been seen."""
        stream, publisher = self._streams.get(item.topic), item.envelope.publisher
        if stream is None or publisher == stream.publisher:
            if stream is not None and stream.latched:
                latch(stream.kept, publisher, item)
            return True
        if stream.latched:
            latch(stream.kept, publisher, item)
            return True
        if self._is_over(stream, now_ns) or self._precedes(publisher, stream.publisher, now_ns):
            stream.assign(publisher, now_ns)
            return True
        self._drop(stream, publisher, now_ns)
        return False

    def _is_over(self, stream: _Stream, now_ns: int) -> bool:
        """Return whether another publisher may take the place of the bound one."""
        if not stream.publisher or stream.is_silent(now_ns, SILENT_NS):
            return True
        return stream.is_silent(now_ns, AWAY_NS) and not self._is_there(stream, now_ns)

    def _is_there(self, stream: _Stream, now_ns: int) -> bool:
        """Return whether the bound publisher had its topic open lately."""
        if now_ns - stream.looked_ns >= _LOOK_NS:
            stream.looked_ns = now_ns
            stream.is_there = self._bus.has_publisher(stream.topic, stream.publisher)
        return stream.is_there

    def _is_of_another(self, item: Received, now_ns: int) -> bool:
        """Return whether a message of a latched topic is not its publisher's, and count it."""
        stream = self._streams.get(item.topic)
        if stream is None or not stream.latched or item.envelope.publisher == stream.publisher:
            return False
        self._drop(stream, item.envelope.publisher, now_ns)
        return True

    def _drop(self, stream: _Stream, publisher: str, now_ns: int) -> None:
        stream.note_other(publisher, now_ns)
        self._dropped(stream.topic)

    def _bind_latched(self, stream: _Stream, now_ns: int) -> bool:
        """Bind a latched topic; return whether to another publisher than before."""
        if stream.publisher and self._is_there(stream, now_ns):
            stream.hear(now_ns)
        publisher = self._latched_publisher(stream, now_ns)
        if publisher == stream.publisher:
            return False
        stream.assign(publisher, now_ns)
        return True

    def _latched_publisher(self, stream: _Stream, now_ns: int) -> str:
        own, newest = stream.publisher, next(reversed(stream.kept))
        raw = _MEASUREMENTS_OF.get(plain_topic(stream.topic), "")
        measurements = self._streams.get(sensor_topic(raw, sensor_of(stream.topic)))
        if measurements is not None and measurements.publisher in stream.kept:
            return measurements.publisher
        if not own:
            return max(stream.kept, key=lambda name: self._is_node(name, now_ns))
        rivals = [name for name in stream.kept if name != own]
        if preceding := [name for name in rivals if self._precedes(name, own, now_ns)]:
            return preceding[0]
        if _peer(own) and _peer(newest) == _peer(own):
            # whether a publisher behind a link is there is not known here
            return newest
        if rivals and stream.is_silent(now_ns, AWAY_NS):
            present = [name for name in rivals if self._bus.has_publisher(stream.topic, name)]
            return present[-1] if present else own
        return own

    def _precedes(self, other: str, own: str, now_ns: int) -> bool:
        return self._is_node(other, now_ns) and not self._is_node(own, now_ns)

    def _is_node(self, name: str, now_ns: int) -> bool:
        """Return whether a publisher has given heartbeats; those behind a link are taken for nodes."""
        known, asked_ns = self._nodes.get(name, (False, now_ns - _LOOK_NS))
        if not known and now_ns - asked_ns >= _LOOK_NS:
            known = bool(_peer(name)) or self._bus.has_publisher("diagnostics/node", name)
            self._nodes[name] = known, now_ns
            while len(self._nodes) > _MAX_NAMES:
                del self._nodes[next(iter(self._nodes))]
        return known


class _Stream:
    """A topic and the publisher that is bound to it."""

    def __init__(self, topic: str) -> None:
        self.topic, self.latched = topic, topic_facts(topic).latched
        self.publisher = ""
        #: Last message of each publisher of a latched topic.
        self.kept: dict[str, Received] = {}
        #: Whether the publisher had its topic open when the bus was asked.
        self.is_there, self.looked_ns = False, -_LOOK_NS
        #: When the publisher was heard last, or had its topic open, and its last interval.
        self._heard_ns = self._interval_ns = 0
        #: Messages of other publishers since they came, and when the last one did.
        self._others: dict[str, int] = {}
        self._other_ns = 0

    def hear(self, now_ns: int) -> None:
        """Note that the bound publisher is there."""
        # what comes at one time is a batch; a set-up comes once
        self._interval_ns = 0 if self.latched else now_ns - self._heard_ns or self._interval_ns
        self._heard_ns = now_ns

    def is_silent(self, now_ns: int, patience_ns: int) -> bool:
        """Return whether the bound publisher has been silent for longer than a time and some of its intervals."""
        limit_ns = min(max(patience_ns, _INTERVALS * self._interval_ns), _LONGEST_SILENCE_NS)
        return now_ns - self._heard_ns > limit_ns

    def assign(self, publisher: str, now_ns: int) -> None:
        """Bind the topic to a publisher."""
        if self.publisher:
            silent_s = s_from_ns(now_ns - self._heard_ns)
            text = "%s: %s takes the place of %s, not heard for %.1f s"
            _LOG.warning(text, self.topic, publisher, self.publisher, silent_s)
        self.publisher, self._heard_ns, self._interval_ns = publisher, now_ns, 0
        self.looked_ns = now_ns - _LOOK_NS
        self._others.clear()

    def note_other(self, publisher: str, now_ns: int) -> None:
        """Note a message of another publisher, and name that one once in the log."""
        if now_ns - self._other_ns > NAMED_NS:
            self._others.clear()
        self._other_ns = now_ns
        if publisher not in self._others:
            if len(self._others) == _MAX_NAMES:
                return
            text = "%s: %s publishes it too: its messages are dropped, those of %s taken"
            _LOG.warning(text, self.topic, publisher, self.publisher)
        self._others[publisher] = self._others.get(publisher, 0) + 1

    def trouble(self, now_ns: int) -> str:
        """Return a description of the other publishers while there are any."""
        if not self._others or now_ns - self._other_ns > NAMED_NS:
            return ""
        dropped = ", ".join(f"{counted(count, 'message')} of {name}" for name, count in self._others.items())
        return f"{self.topic} has {1 + len(self._others)} publishers: {self.publisher} is taken, {dropped} dropped"


def _peer(publisher: str) -> str:
    """Return the peer whose link a publisher is behind; empty for one of this host."""
    peer, dot, _ = publisher.partition(".")
    return peer if dot else ""
