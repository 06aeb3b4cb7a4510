"""Newest-only topics on their way to peers: one message of a publisher at a time, the next when it has arrived.

Whatever waits in a queue of ZeroMQ or of the kernel is sent in order, however old it is, and a slow connection fills
all of them. What waits here is replaced by what is newer.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable

from contrib.two_machines.curve import ID_BYTES, NEWEST
from msgs.bus.codec import Buffer, topic_frame
from msgs.bus.interface import Envelope
from msgs.bus.sequencing import MAX_LATCHED
from msgs.bus.topics import Topic

NUMBER = struct.Struct(">Q")


class _Flow:
    """Messages of one publisher and topic for one peer."""

    def __init__(self, history: int) -> None:
        self.waiting: deque[list[Buffer]] = deque(maxlen=history)
        #: Number of the message that has not been acknowledged.
        self.in_flight: int | None = None


class NewestOnly:
    """What waits for each peer that takes newest-only topics one at a time, and what is in flight to it.

    A peer subscribes to `NEWEST + its id + topic`, gets messages with a number before their header, and acknowledges
    each by its number, with all before it. With every answer of the clock it gets `last_number`, too, so that a message
    that a full queue has dropped holds nothing up. Paced messages replace none: their player waits for all answers.
    """

    def __init__(self, topics: list[Topic], send: Callable[[list[Buffer]], None], max_peers: int) -> None:
        self._topics = {topic_frame(topic.name): topic for topic in topics if topic.newest_only}
        self._send, self._max_subscriptions = send, max_peers * len(self._topics)
        #: Number of the last message to any peer.
        self.last_number = 0
        #: Subscriptions of peers and over how many connections: a new one may come before the old one has gone.
        self._connections: Counter[bytes] = Counter()
        #: Flows of each subscription, by publisher.
        self._flows: dict[bytes, dict[str, _Flow]] = {}
        #: Messages of each topic that a newer one replaced, for all peers together.
        self.superseded: Counter[str] = Counter()

    def join(self, subscription: bytes) -> None:
        """Begin to serve a subscription, or begin again: what was in flight went with an earlier connection."""
        peer_bytes = len(NEWEST) + ID_BYTES
        known = subscription in self._flows
        if subscription[peer_bytes:] in self._topics and (known or len(self._flows) < self._max_subscriptions):
            self._connections[subscription] += 1
            for flow in self._flows.setdefault(subscription, {}).values():
                flow.in_flight = None

    def part(self, subscription: bytes) -> None:
        """End a subscription once its last connection has gone."""
        if self._connections[subscription] > 1:
            self._connections[subscription] -= 1
        else:
            del self._connections[subscription]
            self._flows.pop(subscription, None)

    def offer(self, envelope: Envelope, frames: list[Buffer]) -> None:
        """Keep a message for peers that take its topic, in place of an older one; send it where none is in flight."""
        for subscription, flows in self._flows.items():
            if not subscription.endswith(bytes(frames[0])):
                continue
            flow = flows.pop(envelope.publisher, None) or _Flow(self._topics[bytes(frames[0])].history_messages)
            # of too many publishers those that sent last
            flows[envelope.publisher] = flow
            while len(flows) > MAX_LATCHED:
                del flows[next(iter(flows))]
            before = len(flow.waiting)
            if not envelope.paced:
                flow.waiting.clear()
            flow.waiting.append(frames)
            self.superseded[envelope.topic] += before + 1 - len(flow.waiting)
        self._send_due()

    def acknowledge(self, peer: bytes, number: int) -> None:
        """Note that a message and all before it have reached their peer; send what waits for that."""
        for subscription, flows in self._flows.items():
            if subscription.startswith(NEWEST + peer):
                for flow in flows.values():
                    if flow.in_flight is not None and flow.in_flight <= number:
                        flow.in_flight = None
        self._send_due()

    def _send_due(self) -> None:
        """Send what waits where nothing is in flight."""
        for subscription, flows in self._flows.items():
            for flow in flows.values():
                if flow.waiting and flow.in_flight is None:
                    self.last_number += 1
                    flow.in_flight = self.last_number
                    self._send([subscription, NUMBER.pack(self.last_number), *flow.waiting.popleft()[1:]])
