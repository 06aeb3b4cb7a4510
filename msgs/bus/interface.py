"""What every bus offers, whatever carries it: publish, subscribe, receive, counts."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import msgspec

from msgs.values.diagnostics import TopicCount


class Envelope(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Head of every message on the wire, beside the body of its topic's type."""

    protocol: int = 1
    publisher: str
    topic: str
    #: Counts up by one per publisher and topic from 0; a gap is a loss.
    sequence: int
    #: The bus clock when it was published.
    sent_ns: int
    #: It comes of a player that waits for the graph: nobody needs to leave it out so as not to fall behind.
    paced: bool = False


class Received(NamedTuple):
    """A message that came in, with its envelope."""

    topic: str
    message: msgspec.Struct
    envelope: Envelope


class Outgoing(NamedTuple):
    """A message that a node wants published."""

    topic: str
    message: msgspec.Struct


class Forwarded(NamedTuple):
    """A message of another graph, checked and encoded, that goes on under the envelope it has."""

    topic: str
    envelope: Envelope
    frames: list[bytes | memoryview]


class Bus(Protocol):
    """One node's connection to the graph. Not thread-safe: one owner, one thread."""

    def publish(self, topic: str, message: msgspec.Struct) -> None:
        """Send `message`; its type must be the topic's. Arrays are sent as they are: do not change them afterwards."""

    def forward(self, message: Forwarded) -> None:
        """Send a message on as it is: its number stays, so that receivers here count what was lost before."""

    def subscribe(self, topic: str) -> None:
        """Receive `topic` from all its publishers from now on; a latched topic delivers its last message."""

    def receive(self, timeout_s: float) -> list[Received]:
        """All messages waiting, in order of arrival; waits up to `timeout_s` for the first, empty after that."""

    def now_ns(self) -> int:
        """The bus clock: monotonic on a live bus, virtual on an in-process one."""

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        """Received and published messages per topic so far, losses and rejections included."""

    def close(self) -> None:
        """Let go of all resources; waits no longer than the bus's linger."""


class WaitingBus(Bus, Protocol):
    """A bus that waits in `receive`, and can be told what else ends a wait."""

    def watch(self, source: Any) -> None:
        """End waits also when `source`, a socket or file descriptor of the owner's, can be read."""
