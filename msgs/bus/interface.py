"""Interface of every bus, whatever the transport: publish, subscribe, receive, counts."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import msgspec

from msgs.values.diagnostics import TopicCount


class Envelope(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Head of every message on the wire, beside the body of its topic's type."""

    protocol: int = 1
    publisher: str
    topic: str
    #: Counts up by one per publisher and topic from 0; a gap is a lost message.
    sequence: int
    #: Bus clock at the time of publication.
    sent_ns: int
    #: Its player waits for the graph, so no receiver needs to drop the message to keep up.
    paced: bool = False


class Received(NamedTuple):
    """A received message with its envelope."""

    topic: str
    message: msgspec.Struct
    envelope: Envelope


class Outgoing(NamedTuple):
    """A message that a node asks to have published."""

    topic: str
    message: msgspec.Struct


class Forwarded(NamedTuple):
    """A message of another graph, checked and encoded, that is forwarded under its own envelope."""

    topic: str
    envelope: Envelope
    frames: list[bytes | memoryview]


class Bus(Protocol):
    """One node's connection to the graph. Not thread-safe: one owner, one thread."""

    def publish(self, topic: str, message: msgspec.Struct) -> None:
        """Send `message`; its type must be the topic's. Arrays are sent as they are: do not change them afterwards."""

    def forward(self, message: Forwarded) -> None:
        """Send a message unchanged: its number stays, so that receivers here count what was lost before."""

    def subscribe(self, topic: str) -> None:
        """Receive `topic` from all its publishers from now on; a latched topic delivers its last message."""

    def receive(self, timeout_s: float) -> list[Received]:
        """Return all messages waiting, in order of arrival; wait up to `timeout_s` for the first, then return none."""

    def now_ns(self) -> int:
        """Return the bus clock: monotonic on a live bus, virtual on an in-process one."""

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        """Return the received and published messages per topic so far, losses and rejections included."""

    def close(self) -> None:
        """Release all resources; waits no longer than the bus's linger."""


class GraphBus(Bus, Protocol):
    """A bus that knows who else is on it."""

    def has_publisher(self, topic: str, publisher: str) -> bool:
        """Return whether a publisher of this name has `topic` open; of one behind a link, whether a link has."""


class WaitingBus(GraphBus, Protocol):
    """A bus that waits in `receive` and can watch further sources that end a wait."""

    def watch(self, source: Any) -> None:
        """End waits also when `source`, a socket or file descriptor of the owner's, can be read."""
