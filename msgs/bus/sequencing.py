"""Frame handling of every bus: at most once, in order per publisher, every gap counted."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TypeVar

import msgspec

from msgs.bus.codec import Buffer, CodecError, decode, encode
from msgs.bus.interface import Envelope, Forwarded, Received
from msgs.bus.topics import topic_facts
from msgs.values.diagnostics import TopicCount
from msgs.values.units import NANOSECONDS_PER_SECOND

logger = logging.getLogger(__name__)

T = TypeVar("T")

_WARNING_INTERVAL_NS = 5 * NANOSECONDS_PER_SECOND
#: A player gives up a scan that has no answer for this long (`mirrorwave.replay.listeners`).
_PACED_NS = 10 * NANOSECONDS_PER_SECOND
#: Publishers of a topic that are distinguished. Any name may appear on the bus; a further one is refused while all of
#: these have sent a message lately.
MAX_PUBLISHERS = 256
_LATELY_NS = 10 * NANOSECONDS_PER_SECOND
#: Maximum length of a node name.
_MAX_NAME = 64
#: Limit of the loss counts: every program can hold it, and no sum of several of them exceeds an int64.
_MAX_LOST = 1 << 53
#: Publishers of a latched topic whose last message is kept for late subscribers.
MAX_LATCHED = 32


class _Count:
    """Running counts of one topic."""

    def __init__(self) -> None:
        self.messages = self.bytes = self.lost = self.rejected = self.outdated = 0

    def add(self, size: int) -> None:
        self.messages += 1
        self.bytes += size

    def frozen(self, topic: str) -> TopicCount:
        return TopicCount(
            topic=topic,
            messages=self.messages,
            bytes=self.bytes,
            lost=self.lost,
            rejected=self.rejected,
            outdated=self.outdated,
        )


class Tally:
    """Sequence numbers and counts of one node's connection."""

    def __init__(
        self, node: str, paced: bool = False, keeps_all: bool = False, max_publishers: int = MAX_PUBLISHERS,
        any_size: bool = False,
    ) -> None:  # fmt: skip
        self._node, self._max_publishers = node, max_publishers
        self._paced, self._keeps_all, self._any_size = paced, keeps_all, any_size
        #: Outdated messages are delivered too.
        self.wants_all = False
        #: Topics whose last message was paced, and its time of arrival: messages derived from them are paced too.
        self._paced_ns: dict[str, int] = {}
        #: Numbers used per topic; forwarded messages have their own.
        self._sequences: dict[str, int] = {}
        self._published: dict[str, _Count] = {}
        self._received: dict[str, _Count] = {}
        #: Last envelope of each publisher of a topic; the one silent longest comes first.
        self._last: dict[str, dict[str, Envelope]] = {}
        self._warned_ns: dict[str, int] = {}

    def pack(self, topic: str, message: msgspec.Struct, now_ns: int) -> tuple[Envelope, list[Buffer]]:
        """Return envelope and frames of the next message; raises `CodecError`, and uses no number, if it is unfit."""
        sequence = self._sequences.get(topic, 0)
        # limited in time: its player may have ended without notice, and an unpaced radar may follow
        paced = self._paced or any(now_ns - came_ns <= _PACED_NS for came_ns in self._paced_ns.values())
        envelope = Envelope(publisher=self._node, topic=topic, sequence=sequence, sent_ns=now_ns, paced=paced)
        frames = encode(envelope, message, self._any_size)
        self._sequences[topic] = sequence + 1
        self._published.setdefault(topic, _Count()).add(total_size(frames))
        return envelope, frames

    def forward(self, message: Forwarded) -> None:
        """Count a forwarded message; it uses no number."""
        self._published.setdefault(message.topic, _Count()).add(total_size(message.frames))

    def expect(self, topic: str) -> None:
        """Count `topic` from now on, so that silence shows as zero."""
        self._received.setdefault(topic, _Count())

    def accept(self, topic: str, frames: Sequence[Buffer], now_ns: int) -> Received | None:
        """Return the message of `frames`; None if it is unreadable (counted, logged) or older than an earlier one."""
        try:
            received = decode(frames, self._any_size)
            if received.topic != topic:
                raise CodecError(f"{topic}: message of {received.topic} on its connection")
            if len(received.envelope.publisher) > _MAX_NAME:
                raise CodecError(f"{topic}: publisher must have at most {_MAX_NAME} characters")
            if received.envelope.sent_ns > now_ns:
                raise CodecError(
                    f"{topic}: sent_ns must not lie in the future, got {received.envelope.sent_ns} at {now_ns}"
                )
        except CodecError as error:
            self._reject(topic, error)
            return None
        return self.admit(received, total_size(frames), now_ns)

    def admit(self, received: Received, size: int, now_ns: int) -> Received | None:
        """Return a message of `size` bytes as `accept` does, one that needs no decoding."""
        topic, envelope = received.topic, received.envelope
        try:
            self._make_room(envelope, now_ns)
        except CodecError as error:
            self._reject(topic, error)
            return None
        count, envelopes = self._received[topic], self._last[topic]
        last = envelopes.get(envelope.publisher)
        if last is not None:
            if envelope.sent_ns <= last.sent_ns and envelope.sequence <= last.sequence:
                return None
            # a publisher that restarts counts from 0: what it sent in between was never numbered
            count.lost = min(_MAX_LOST, count.lost + max(0, envelope.sequence - last.sequence - 1))
        envelopes.pop(envelope.publisher, None)
        envelopes[envelope.publisher] = envelope
        count.add(size)
        if envelope.paced:
            self._paced_ns[topic] = now_ns
        else:
            self._paced_ns.pop(topic, None)
        return received

    def publishers(self, topic: str) -> frozenset[str]:
        """Return the names under which messages of a topic came lately."""
        return frozenset(self._last.get(topic, ()))

    def forget(self, topic: str, publisher: str) -> None:
        """Treat the next message of `publisher` as its first: no gap before it."""
        self._last.get(topic, {}).pop(publisher, None)

    def forget_all(self) -> None:
        """Treat the next message of every publisher as its first."""
        self._last.clear()

    def without_outdated(self, messages: list[Received]) -> list[Received]:
        """Return `messages`, unpaced ones of newest-only topics but the last of each publisher counted and left out."""
        if self._keeps_all:
            return messages
        newest = {(message.topic, message.envelope.publisher): message for message in messages}
        kept = []
        for message in messages:
            is_newest = newest[message.topic, message.envelope.publisher] is message
            if topic_facts(message.topic).newest_only and not (is_newest or message.envelope.paced or self.wants_all):
                self._received[message.topic].outdated += 1
            else:
                kept.append(message)
        return kept

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        """Return the received and published counts, topics in order of name."""
        received = tuple(self._received[topic].frozen(topic) for topic in sorted(self._received))
        published = tuple(self._published[topic].frozen(topic) for topic in sorted(self._published))
        return received, published

    def _make_room(self, envelope: Envelope, now_ns: int) -> None:
        """Forget the publisher silent longest to admit one more; raise `CodecError` if all sent a message lately."""
        envelopes = self._last.setdefault(envelope.topic, {})
        if envelope.publisher in envelopes or len(envelopes) < self._max_publishers:
            return
        silent = next(iter(envelopes))
        if now_ns - envelopes[silent].sent_ns <= _LATELY_NS:
            raise CodecError(
                f"{envelope.topic}: more than {self._max_publishers} publishers, {envelope.publisher!r} among them"
            )
        del envelopes[silent]

    def _reject(self, topic: str, error: CodecError) -> None:
        self._received[topic].rejected += 1
        now_ns = time.monotonic_ns()
        if now_ns - self._warned_ns.get(topic, -_WARNING_INTERVAL_NS) >= _WARNING_INTERVAL_NS:
            self._warned_ns[topic] = now_ns
            logger.warning("rejected: %s (%d so far)", error, self._received[topic].rejected)


def total_size(frames: Sequence[Buffer]) -> int:
    """Return the bytes of a message on the wire."""
    return sum(len(frame) for frame in frames)


def latch(kept: dict[str, T], publisher: str, message: T) -> None:
    """Keep the last message of a publisher of a latched topic; of too many, those that sent most recently."""
    kept.pop(publisher, None)
    kept[publisher] = message
    while len(kept) > MAX_LATCHED:
        del kept[next(iter(kept))]
