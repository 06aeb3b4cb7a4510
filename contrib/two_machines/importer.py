"""The receiving end of a link: a peer's topics for the local graph, over a connection encrypted with CURVE.

All messages are checked, their stamps are converted to this host's clock, and the peer's name prefixes their origin.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Iterable
from typing import NamedTuple

import zmq

from contrib.two_machines.curve import (
    CLOCK,
    ID_BYTES,
    MAX_A_TURN,
    MAX_UPWARD_BYTES,
    NEWEST,
    PING,
    STAMP,
    TAKEN,
    Clock,
    Complaint,
    Monitor,
    queue_messages,
    set_common,
    waiting_on,
)
from contrib.two_machines.keys import KeyPair
from contrib.two_machines.newest import NUMBER
from contrib.two_machines.peer_clock import ClockSample, PeerClock
from contrib.two_machines.peer_messages import PeerMessages
from msgs.bus.codec import Buffer, topic_frame
from msgs.bus.interface import Forwarded
from msgs.bus.topics import Topic, topic_facts
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns

logger = logging.getLogger(__name__)

#: Bytes that encryption adds to a frame, with a margin.
_ENVELOPE_BYTES = 64
_RECONNECT_MS, _RECONNECT_MAX_MS = 50, 2000

_PING_NS = NANOSECONDS_PER_SECOND // 2
#: Until the peer's clock is known.
_FIRST_PING_NS = NANOSECONDS_PER_SECOND // 20
_ANSWERS_NEEDED = 3
#: Pending questions: answers may take three seconds while they are asked fastest.
_PINGS_KEPT = 64
_SILENCE_NS = 3 * NANOSECONDS_PER_SECOND // 2
#: ZeroMQ gives an address up after a breach of protocol; we try again in any case.
_CONNECT_AGAIN_NS = 5 * NANOSECONDS_PER_SECOND // 2
#: After a cut every origin has sent a message within this time, and the loss is known.
_SETTLED_NS = 2 * NANOSECONDS_PER_SECOND
#: A hundred years of nanoseconds and more: a larger value is no clock.
_MAX_CLOCK_NS = 1 << 62


class Server(NamedTuple):
    """The peer an importer connects to: its name here, its address, its public key (None: no encryption)."""

    name: str
    address: str
    public: bytes | None = None


class Importer:
    """A peer's topics for the local graph, every message checked, its stamps in this host's clock.

    Nothing is imported before the peer's clock is known. Messages keep their numbers and are published as those of
    `<peer>.<origin>`; heartbeats and log records name their node likewise.
    Raises `ValueError` for an invalid address or topic, and for a peer's key without an own one.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        server: Server,
        topics: Iterable[str],
        own: KeyPair | None = None,
        clock_ns: Clock = time.monotonic_ns,
    ) -> None:
        if (own is None) != (server.public is None):
            raise ValueError(f"{server.name}: an own key and the peer's belong together")
        facts = [topic_facts(topic) for topic in topics]
        self.name, self._address, self._clock_ns = server.name, server.address, clock_ns
        self._topics = {topic_frame(topic.name): topic.name for topic in facts}
        self._newest_only = {topic_frame(topic.name) for topic in facts if topic.newest_only}
        self._messages = PeerMessages(server.name, self._topics.values())
        self._complaint = Complaint()
        #: Failed handshakes, and messages that were not asked for.
        self.refused = self._rejected = 0
        self._clock = PeerClock()
        self._id = os.urandom(ID_BYTES)
        self._pings: dict[bytes, int] = {}
        self._answers = 0
        self._subscribed = False
        #: Whether the peer sends newest-only topics one message at a time.
        self._one_at_a_time = False
        self._round_trips_ns: list[int] = []
        now_ns = clock_ns()
        self._next_ping_ns = now_ns
        self._tried_ns = now_ns
        self._heard_ns: int | None = None
        self._outage: _Outage | None = None
        self._socket = context.socket(zmq.XSUB)
        self._watch = Monitor(self._socket, zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED)
        #: Whether the present connection has completed its handshake.
        self._is_in = False
        try:
            self._prepare(facts, own, server.public)
            self._socket.connect(self._address)
        except zmq.ZMQError as error:
            self.close()
            raise ValueError(f"{server.name}: {server.address}: {error.strerror}") from None
        self._socket.send(b"\x01" + CLOCK + self._id)

    def _prepare(self, facts: list[Topic], own: KeyPair | None, public: bytes | None) -> None:
        set_common(self._socket)
        self._socket.set(zmq.RCVHWM, queue_messages(facts))
        largest = max([MAX_UPWARD_BYTES, *(topic.max_bytes for topic in facts)])
        self._socket.set(zmq.MAXMSGSIZE, largest + _ENVELOPE_BYTES)
        self._socket.set(zmq.RECONNECT_IVL, _RECONNECT_MS)
        self._socket.set(zmq.RECONNECT_IVL_MAX, _RECONNECT_MAX_MS)
        # questions asked while no peer is connected are not to be answered later
        self._socket.set(zmq.IMMEDIATE, 1)
        self._socket.set(zmq.SNDHWM, MAX_A_TURN)
        if own is not None and public is not None:
            self._socket.set(zmq.CURVE_PUBLICKEY, own.public)
            self._socket.set(zmq.CURVE_SECRETKEY, own.secret)
            self._socket.set(zmq.CURVE_SERVERKEY, public)

    @property
    def sources(self) -> tuple[zmq.Socket[bytes], ...]:
        """Sockets that end a wait."""
        return self._socket, self._watch.socket

    @property
    def due_ns(self) -> int:
        """Time at which the next turn is due even without input."""
        return self._next_ping_ns

    def trouble(self) -> str:
        """Return a description of what is wrong with the link, empty while it is whole."""
        if self._heard_ns is None:
            silence = "no word yet"
        elif not self._subscribed or self._is_silent(self._clock_ns()):
            silence = f"no word for {s_from_ns(self._clock_ns() - self._heard_ns):.1f} s"
        else:
            return ""
        return f"{self.name}: {silence}" + (f", {self.refused} handshakes failed" if self.refused else "")

    def offset_ns(self) -> int:
        """Return the lead of the peer's clock over ours, as subtracted from its stamps."""
        return self._clock.offset_ns

    def error_ns(self) -> int | None:
        """Return a bound of the error of `offset_ns`; None while it is not known."""
        return self._clock.error_ns(self._clock_ns())

    def round_trips_ns(self) -> list[int]:
        """Return the round trips since the last call."""
        round_trips, self._round_trips_ns = self._round_trips_ns, []
        return round_trips

    def lost(self) -> dict[str, int]:
        """Return the messages lost on the link so far by topic, by gaps in their numbers."""
        return self._messages.lost()

    @property
    def rejected(self) -> int:
        """Refused messages: unreadable, of no topic that was asked for, or in a foreign name."""
        return self._rejected + self._messages.rejected

    def turn(self) -> list[Forwarded]:
        """Return the received messages, a bounded number of them; ask for the peer's clock when that is due."""
        events = [event for event, _ in self._watch.events()]
        for event in events:
            self.refused += event == zmq.EVENT_DISCONNECTED and not self._is_in
            self._is_in = event == zmq.EVENT_HANDSHAKE_SUCCEEDED
        self._complaint.say(self.refused, self._clock_ns(), f"{self.name}: %d handshakes failed: check the keys")
        if zmq.EVENT_DISCONNECTED in events:
            self._end_imports()
        waiting = [self._take([part.buffer for part in parts]) for parts in waiting_on(self._socket)]
        now_ns = self._clock_ns()
        # its answer may still be among the waiting messages
        if len(waiting) < MAX_A_TURN and self._is_silent(now_ns):
            self._note_outage()
        if self._outage and self._outage.back_ns is not None and now_ns - self._outage.back_ns > _SETTLED_NS:
            self._report(self._outage)
        if now_ns >= self._next_ping_ns:
            self._ping(now_ns)
        return [message for message in waiting if message is not None]

    def close(self) -> None:
        """Disconnect from the peer."""
        self._watch.close()
        self._socket.close()

    # the link

    def _is_silent(self, now_ns: int) -> bool:
        """Return whether a question waits too long for its answer; a pause of our own does not count."""
        return now_ns - min(self._pings.values(), default=now_ns) > _SILENCE_NS

    def _end_imports(self) -> None:
        """Import nothing until the clock is known again: another life of the peer, with another one, may come."""
        for subscription in self._subscriptions() if self._subscribed else ():
            self._socket.send(b"\x00" + subscription)
        self._subscribed, self._one_at_a_time, self._answers = False, False, 0
        # messages of the old connection that still wait here may carry another clock
        self._pings.clear()
        self._note_outage()

    def _note_outage(self) -> None:
        if self._heard_ns is not None and (self._outage is None or self._outage.back_ns is not None):
            logger.warning("%s: the link is cut", self.name)
            self._outage = _Outage(self._heard_ns, self._outage.lost if self._outage else self.lost())

    def _report(self, outage: _Outage) -> None:
        """Log how long the peer was away, and what was lost."""
        lost = {topic: total - outage.lost[topic] for topic, total in self.lost().items()}
        losses = ", ".join(f"{count} of {topic}" for topic, count in lost.items() if count) or "nothing"
        assert outage.back_ns is not None
        logger.warning("%s: away for %.1f s, lost %s", self.name, s_from_ns(outage.back_ns - outage.heard_ns), losses)
        self._outage = None

    def _ping(self, now_ns: int) -> None:
        self._next_ping_ns = now_ns + (_PING_NS if self._subscribed else _FIRST_PING_NS)
        if not self._subscribed and now_ns - max(self._tried_ns, self._heard_ns or 0) > _CONNECT_AGAIN_NS:
            self._tried_ns = now_ns
            with contextlib.suppress(zmq.ZMQError):
                self._socket.disconnect(self._address)
            self._socket.connect(self._address)
        number = os.urandom(ID_BYTES)
        self._pings[number] = now_ns
        while len(self._pings) > _PINGS_KEPT:
            self._pings.pop(next(iter(self._pings)))
        self._socket.send(PING + self._id + number)

    def _take(self, frames: list[Buffer]) -> Forwarded | None:
        now_ns = self._clock_ns()
        name = bytes(frames[0][:256])
        if name == CLOCK + self._id:
            self._hear_clock(frames, now_ns)
            return None
        if name.startswith(NEWEST + self._id) and len(frames) > 2:
            self._acknowledge(frames[1])
            name = name.removeprefix(NEWEST + self._id)
            frames = [name, *frames[2:]]
        if name not in self._topics:
            self._rejected += 1
        elif self._subscribed:
            # while the clock is not known a message counts as lost, by its number
            forwarded = self._messages.take(self._topics[name], frames, self._clock, now_ns)
            self._heard_ns = now_ns if forwarded else self._heard_ns
            return forwarded
        return None

    def _acknowledge(self, number: Buffer) -> None:
        """Tell the peer that a newest-only message of this number, and all before it, are no longer on their way."""
        if len(number) == NUMBER.size:
            self._socket.send(TAKEN + self._id + bytes(number))

    # the clock

    def _hear_clock(self, frames: list[Buffer], now_ns: int) -> None:
        if len(frames) == 3 and bytes(frames[1]) == NEWEST:
            self._one_at_a_time = True
            self._acknowledge(frames[2])
        asked_ns = self._pings.get(bytes(frames[1])) if len(frames) == 3 else None
        if asked_ns is None or len(frames[2]) != STAMP.size:
            return
        # it answers all earlier questions, too
        self._pings = {number: later_ns for number, later_ns in self._pings.items() if later_ns > asked_ns}
        (peer_ns,) = STAMP.unpack(frames[2])
        if not 0 <= peer_ns <= _MAX_CLOCK_NS:
            self._rejected += 1
            return
        sample = ClockSample(asked_ns, peer_ns, now_ns)
        self._round_trips_ns.append(sample.round_trip_ns)
        self._heard_ns = now_ns
        if self._clock.add(sample):
            logger.warning("%s: its clock has started anew", self.name)
            self._messages.forget()
        self._answers += 1
        if not self._subscribed and self._answers >= _ANSWERS_NEEDED:
            self._begin(now_ns)
        if self._subscribed and self._outage and self._outage.back_ns is None:
            self._outage = self._outage._replace(back_ns=now_ns)

    def _begin(self, now_ns: int) -> None:
        self._subscribed = True
        for subscription in self._subscriptions():
            self._socket.send(b"\x01" + subscription)
        offset_s, error_ms = s_from_ns(self._clock.offset_ns), 1e-6 * (self._clock.error_ns(now_ns) or 0)
        logger.info("%s: its clock is %+.6f s ahead of ours, to within %.3f ms", self.name, offset_s, error_ms)

    def _subscriptions(self) -> list[bytes]:
        """Return what the peer is asked for, newest-only topics one message at a time if it offers that."""
        taken = self._newest_only if self._one_at_a_time else set()
        return [NEWEST + self._id + name if name in taken else name for name in self._topics]


class _Outage(NamedTuple):
    """Last time a peer was heard before a cut, its losses until then, and the time it came back."""

    heard_ns: int
    lost: dict[str, int]
    back_ns: int | None = None
