"""Messages between nodes of one process: handed over as they are, neither copied nor decoded."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from msgs.bus.interface import Received
from msgs.bus.sequencing import latch
from msgs.bus.topics import topic_facts


class Parcel(NamedTuple):
    """A message, and the bytes that it would take on the wire."""

    received: Received
    size: int


class Mailbox:
    """What waits for one node; a message beyond its topic's history is refused, and the receiver counts it as lost."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Parcel] = deque()
        self._counts: dict[str, int] = {}
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def put(self, parcel: Parcel) -> None:
        """Add a message, from any thread."""
        topic = parcel.received.topic
        with self._lock:
            count = self._counts.get(topic, 0)
            if count < topic_facts(topic).history_messages:
                self._counts[topic] = count + 1
                self._waiting.append(parcel)
                os.eventfd_write(self.descriptor, 1)

    def take(self) -> list[Parcel]:
        """Remove and return all messages, in order of arrival."""
        with self._lock:
            parcels = list(self._waiting)
            self._waiting.clear()
            self._counts.clear()
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self.descriptor)
        return parcels

    def close(self) -> None:
        """Release the descriptor; it is joined to no exchange any more."""
        os.close(self.descriptor)


class Exchange:
    """Connects the buses of the nodes of one process, `nodes`, past their sockets; any thread may call it."""

    def __init__(self, nodes: Iterable[str]) -> None:
        self.nodes = frozenset(nodes)
        self._lock = threading.Lock()
        self._mailboxes: dict[str, list[Mailbox]] = {}
        #: Last message of each latched topic, by the publisher named in its envelope.
        self._latched: dict[str, dict[str, Parcel]] = {}

    def join(self, topic: str, mailbox: Mailbox) -> None:
        """Deliver `topic` to `mailbox` from now on; a latched topic delivers its last messages."""
        with self._lock:
            self._mailboxes.setdefault(topic, []).append(mailbox)
            for parcel in self._latched.get(topic, {}).values():
                mailbox.put(parcel)

    def leave(self, mailbox: Mailbox) -> None:
        """Deliver nothing to `mailbox` any more."""
        with self._lock:
            for mailboxes in self._mailboxes.values():
                while mailbox in mailboxes:
                    mailboxes.remove(mailbox)

    def wants(self, topic: str) -> bool:
        """Return whether `hand_over` would deliver or keep a message of `topic`."""
        return bool(self._mailboxes.get(topic)) or topic_facts(topic).latched

    def hand_over(self, parcel: Parcel) -> None:
        """Deliver a message to all that joined its topic."""
        topic = parcel.received.topic
        with self._lock:
            if topic_facts(topic).latched:
                latch(self._latched.setdefault(topic, {}), parcel.received.envelope.publisher, parcel)
            for mailbox in self._mailboxes.get(topic, ()):
                mailbox.put(parcel)
