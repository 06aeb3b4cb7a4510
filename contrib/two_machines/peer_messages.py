"""Messages of another host as local ones: checked, in our clock, under the peer's name, losses counted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from contrib.two_machines.curve import ORIGIN, Complaint
from contrib.two_machines.peer_clock import PeerClock, shift_stamps
from msgs.bus.codec import Buffer, CodecError, encode
from msgs.bus.interface import Envelope, Forwarded, Received
from msgs.bus.sequencing import Tally
from msgs.values.diagnostics import LogRecord, NodeStatus
from msgs.values.node_params import NodeParams, ParamRequest

#: Publishers of one peer and topic, a fraction of those that a bus distinguishes (`msgs.bus.sequencing`).
MAX_ORIGINS = 32
#: Maximum length of a node name.
_MAX_NAME = 64
#: Messages that name a node: a peer's, so that no request of its changes a node here.
_OF_A_NODE = (NodeStatus, LogRecord, NodeParams, ParamRequest)


class PeerMessages:
    """Messages of one peer on `topics`, as those of `<peer>.<origin>`; heartbeats and log records name that node too.

    Numbers stay those of the origin: a gap is a loss in transit.
    """

    def __init__(self, peer: str, topics: Iterable[str]) -> None:
        self._peer = peer
        self._tally = Tally(peer, max_publishers=MAX_ORIGINS)
        for topic in topics:
            self._tally.expect(topic)
        #: In a foreign name, or with stamps that cannot be converted to our clock.
        self._refused = 0
        self._complaint = Complaint()

    def lost(self) -> dict[str, int]:
        """Return messages lost so far by topic, by gaps in their numbers."""
        return {count.topic: count.lost for count in self._tally.counts()[0]}

    @property
    def rejected(self) -> int:
        """Messages that were unreadable, or in a foreign name."""
        return self._refused + sum(count.rejected for count in self._tally.counts()[0])

    def forget(self) -> None:
        """Forget the sequence: the peer's clock restarted, and its messages would seem older than earlier ones."""
        self._tally.forget_all()

    def take(self, topic: str, frames: Sequence[Buffer], clock: PeerClock, now_ns: int) -> Forwarded | None:
        """Return the message of `frames` as one of this host; None if it is old or not permitted."""
        latest_ns = now_ns + clock.offset_ns + (clock.error_ns(now_ns) or 0)
        received = self._tally.accept(topic, frames, latest_ns)
        if received is None:
            return None
        try:
            return self._at_home(received, clock.offset_ns, now_ns)
        except (ValueError, ArithmeticError) as error:
            # a stamp that cannot be converted to our clock, too
            self._refused += 1
            self._complaint.say(self._refused, now_ns, f"{self._peer}: rejected %d: {error}")
            self._tally.forget(topic, received.envelope.publisher)
            return None

    def _at_home(self, received: Received, offset_ns: int, now_ns: int) -> Forwarded:
        origin = received.envelope
        # local receivers refuse what was sent in the future, or before the clock began
        sent_ns = min(now_ns, max(0, origin.sent_ns - offset_ns))
        envelope: Envelope = msgspec.structs.replace(
            origin, publisher=self._checked_name(received.topic, origin.publisher), sent_ns=sent_ns
        )
        message = received.message
        if isinstance(message, _OF_A_NODE):
            message = msgspec.structs.replace(message, node=self._checked_name(received.topic, message.node))
        return Forwarded(received.topic, envelope, encode(envelope, shift_stamps(message, -offset_ns)))

    def _checked_name(self, topic: str, node: str) -> str:
        """Return the name of a peer's node here; raises `CodecError` if none of its own can have it."""
        name = f"{self._peer}.{node}"
        if not ORIGIN.fullmatch(node) or len(name) > _MAX_NAME:
            raise CodecError(f"{topic}: node {node[:_MAX_NAME]!r}")
        return name
