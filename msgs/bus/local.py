"""An in-process bus: the codec of the wire, a virtual clock, a fixed order, and faults on demand."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from msgs.bus.codec import Buffer
from msgs.bus.interface import Envelope, Forwarded, Received
from msgs.bus.sequencing import Tally
from msgs.bus.topics import Topic, topic_facts
from msgs.values.arrays import require_finite
from msgs.values.diagnostics import TopicCount


class Faults(msgspec.Struct, frozen=True, kw_only=True):
    """Faults of a topic; probabilities are per message and receiver."""

    drop: float = 0.0
    delay_ns: int = 0
    #: Added to the delay, uniform from 0 to this.
    jitter_ns: int = 0
    duplicate: float = 0.0
    #: Bytes of the header are flipped, so that no receiver can decode it.
    corrupt: float = 0.0

    def __post_init__(self) -> None:
        for name in ("drop", "duplicate", "corrupt"):
            require_finite(f"faults.{name}", getattr(self, name))
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"faults.{name} must be 0..1, got {getattr(self, name)!r}")
        for name in ("delay_ns", "jitter_ns"):
            if getattr(self, name) < 0:
                raise ValueError(f"faults.{name} must not be negative, got {getattr(self, name)!r}")


class _Parcel(NamedTuple):
    """A message in transit; parcels compare in the order of delivery."""

    due_ns: int
    publisher: str
    sequence: int
    #: Distinguishes duplicates and successive lives of a publisher, so that frames are never compared.
    serial: int
    frames: list[Buffer]

    @property
    def size(self) -> int:
        return sum(len(frame) for frame in self.frames)


class _Queue:
    """Messages that wait for one receiver on one topic; the oldest is dropped beyond the topic's history."""

    def __init__(self, history_bytes: float) -> None:
        self._history_bytes = history_bytes
        self._parcels: list[_Parcel] = []
        self._bytes = 0

    def put(self, parcel: _Parcel) -> None:
        heapq.heappush(self._parcels, parcel)
        self._bytes += parcel.size
        while self._bytes > self._history_bytes:
            self._pop()

    def due(self, now_ns: int) -> list[_Parcel]:
        """Remove and return every parcel whose time has come, in order."""
        parcels = []
        while self._parcels and self._parcels[0].due_ns <= now_ns:
            parcels.append(self._pop())
        return parcels

    def _pop(self) -> _Parcel:
        parcel = heapq.heappop(self._parcels)
        self._bytes -= parcel.size
        return parcel


class LocalNetwork:
    """Connects the buses of one process; time moves only by `advance`.

    Messages arrive in the order (delivery time, publisher, sequence); faults are drawn from `seed`: the same calls give
    the same messages. `lossless`: messages of any size, and all of them, also where receivers want the newest.
    """

    def __init__(self, start_ns: int = 0, seed: int = 0, lossless: bool = False) -> None:
        self._now_ns, self.lossless = start_ns, lossless
        self._random = np.random.default_rng(seed)
        self._faults: dict[str, Faults] = {}
        self._queues: dict[str, list[_Queue]] = {}
        self._latched: dict[tuple[str, str], _Parcel] = {}
        #: Topic and node of every open publisher.
        self._publishers: set[tuple[str, str]] = set()
        self._serial = 0

    @property
    def now_ns(self) -> int:
        """The virtual clock."""
        return self._now_ns

    def advance(self, duration_ns: int) -> None:
        """Advance the clock; it never runs back."""
        if duration_ns < 0:
            raise ValueError(f"duration_ns must not be negative, got {duration_ns!r}")
        self._now_ns += duration_ns

    def bus(self, node: str) -> LocalBus:
        """Return a new connection for a node."""
        return LocalBus(self, node)

    def inject(self, topic: str, faults: Faults) -> None:
        """Apply these faults to `topic` from now on; `Faults()` ends them."""
        self._faults[topic_facts(topic).name] = faults

    def _join(self, topic: Topic) -> _Queue:
        queue = _Queue(math.inf if self.lossless else topic.history_bytes)
        self._queues.setdefault(topic.name, []).append(queue)
        for key in sorted(self._latched):
            if key[0] == topic.name:
                self._deliver(queue, self._latched[key], self._faults.get(topic.name, Faults()))
        return queue

    def _send(self, topic: Topic, envelope: Envelope, frames: list[Buffer]) -> None:
        parcel = _Parcel(self._now_ns, envelope.publisher, envelope.sequence, 0, frames)
        if topic.latched:
            self._latched[topic.name, envelope.publisher] = parcel
        faults = self._faults.get(topic.name, Faults())
        for queue in self._queues.get(topic.name, []):
            self._deliver(queue, parcel, faults)

    def _deliver(self, queue: _Queue, parcel: _Parcel, faults: Faults) -> None:
        # four draws a message, whatever the rates: a change of one fault leaves the pattern of the others unchanged
        drop, duplicate, corrupt, jitter = self._random.random(4)
        if drop < faults.drop:
            return
        due_ns = self._now_ns + faults.delay_ns + int(jitter * faults.jitter_ns)
        frames = self._corrupted(parcel.frames) if corrupt < faults.corrupt else parcel.frames
        for _ in range(2 if duplicate < faults.duplicate else 1):
            self._serial += 1
            queue.put(parcel._replace(due_ns=due_ns, serial=self._serial, frames=frames))

    def _corrupted(self, frames: Sequence[Buffer]) -> list[Buffer]:
        header = bytearray(frames[1])
        # the first byte says "map of two": without it the header is certainly none
        for at in (0, *self._random.integers(1, len(header), size=3)):
            header[at] ^= 0xFF
        return [frames[0], bytes(header), *frames[2:]]


class LocalBus:
    """One node's connection to a `LocalNetwork`; a `Bus`."""

    def __init__(self, network: LocalNetwork, node: str) -> None:
        self._network = network
        self._node = node
        self._tally = Tally(node, keeps_all=network.lossless, any_size=network.lossless)
        self._queues: dict[str, _Queue] = {}

    def publish(self, topic: str, message: msgspec.Struct) -> None:
        """Send `message` to all subscribers; raises `CodecError` if it cannot be encoded."""
        facts = topic_facts(topic)
        self._network._publishers.add((topic, self._node))
        envelope, frames = self._tally.pack(topic, message, self._network.now_ns)
        self._network._send(facts, envelope, frames)

    def forward(self, message: Forwarded) -> None:
        """Send a message of another graph unchanged."""
        self._tally.forward(message)
        self._network._send(topic_facts(message.topic), message.envelope, message.frames)

    def subscribe(self, topic: str) -> None:
        """Receive `topic` from now on, and the last message of each publisher if it is latched."""
        if topic not in self._queues:
            facts = topic_facts(topic)
            self._tally.expect(topic)
            self._queues[topic] = self._network._join(facts)

    def receive(self, timeout_s: float) -> list[Received]:
        """Return all messages that are due, at once: nothing but `LocalNetwork.advance` moves the clock."""
        now_ns = self._network.now_ns
        due = [(parcel, topic) for topic, queue in self._queues.items() for parcel in queue.due(now_ns)]
        due.sort(key=lambda item: item[0][:4])
        accepted = (self._tally.accept(topic, parcel.frames, now_ns) for parcel, topic in due)
        return self._tally.without_outdated([message for message in accepted if message is not None])

    def has_publisher(self, topic: str, publisher: str) -> bool:
        """Return whether a node of this name has published `topic` and is still there."""
        return (topic, publisher) in self._network._publishers

    def now_ns(self) -> int:
        """Return the network's virtual clock."""
        return self._network.now_ns

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        """Return received and published messages per topic so far."""
        return self._tally.counts()

    def close(self) -> None:
        """Leave the network; waiting messages are discarded."""
        for topic, queue in self._queues.items():
            self._network._queues[topic].remove(queue)
        self._network._publishers = {key for key in self._network._publishers if key[1] != self._node}
        self._queues.clear()
