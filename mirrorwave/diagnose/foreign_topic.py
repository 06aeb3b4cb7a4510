"""Topics that the table does not have: published beside ours by other programs, in the same frames, of any type.

What comes is trusted as little as on the bus: sizes, names and array layouts are checked, what does not fit is counted.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zmq

from msgs.bus.codec import MAX_HEADER_BYTES, Buffer
from msgs.bus.declared import expect_declared
from msgs.bus.interface import Envelope, Forwarded, Received
from msgs.bus.topics import MIB, TOPICS
from msgs.bus.zmq import InterruptibleContext
from msgs.values.arrays import DTYPES, MAX_NDIM
from msgs.values.diagnostics import TopicCount

#: Largest message of a type that nobody here knows.
_MAX_BYTES = 64 * MIB
_HISTORY_MESSAGES = 64
_MAX_MESSAGES_A_CALL = 64
_SEARCH_S = 0.25
_ARRAY_KEYS = frozenset({"dtype", "shape", "frame"})
_TROUBLE = (msgspec.MsgspecError, ValueError, TypeError, RecursionError)


class ForeignMessage(msgspec.Struct, frozen=True):
    """Any message: its body as plain values and arrays."""

    body: dict[str, Any]


class _Head(msgspec.Struct):
    """Head of a message."""

    envelope: Envelope
    body: dict[str, Any]


class _ArrayHead(msgspec.Struct):
    """Stand-in for an array."""

    dtype: str
    shape: tuple[int, ...]
    frame: int


def foreign_publishers(run_dir: Path) -> dict[str, list[str]]:
    """Nodes by topic, of the socket files whose topic the table does not have; a topic is named as its file is."""
    expect_declared(run_dir)
    ours = {topic.replace("/", ".") for topic in TOPICS}
    publishers: dict[str, list[str]] = {}
    for path in sorted(run_dir.iterdir()) if run_dir.is_dir() else []:
        topic, at, node = path.name.partition("@")
        if topic and at and node and topic not in ours and path.is_socket():
            publishers.setdefault(topic, []).append(node)
    return publishers


class ForeignBus:
    """Listens to foreign topics; what `msgs.bus.interface.Bus` is, as far as listening goes."""

    def __init__(self, run_dir: Path) -> None:
        self._dir = run_dir
        self._context = InterruptibleContext()
        self._poller = zmq.Poller()
        self._sockets: dict[str, zmq.Socket[bytes]] = {}
        self._connected: set[Path] = set()
        self._searched_s = -math.inf
        self._counts: dict[str, dict[str, int]] = {}
        self._last: dict[tuple[str, str], int] = {}

    def publish(self, topic: str, message: msgspec.Struct) -> None:
        """Refused: types that are not known here are not sent."""
        raise TypeError(f"{topic}: a foreign topic is listened to, never published")

    def forward(self, message: Forwarded) -> None:
        """Refused likewise."""
        raise TypeError(f"{message.topic}: a foreign topic is listened to, never published")

    def subscribe(self, topic: str) -> None:
        """Receive a topic from all its publishers, under the name given: `lidar/cloud` and `lidar.cloud` are one."""
        subscriber = self._context.socket(zmq.SUB)
        subscriber.set(zmq.RCVHWM, _HISTORY_MESSAGES)
        subscriber.set(zmq.MAXMSGSIZE, _MAX_BYTES)
        subscriber.set(zmq.LINGER, 0)
        # a socket carries one topic, whose name on the wire is not known
        subscriber.set(zmq.SUBSCRIBE, b"")
        self._sockets[topic] = subscriber
        self._counts[topic] = dict.fromkeys(("messages", "bytes", "lost", "rejected"), 0)
        self._poller.register(subscriber, zmq.POLLIN)

    def receive(self, timeout_s: float) -> list[Received]:
        """Messages that wait, at most 64 a topic; waits up to `timeout_s` for the first."""
        self._search()
        ready = dict(self._poller.poll(int(1e3 * min(timeout_s, _SEARCH_S))))
        return [
            each
            for topic, subscriber in self._sockets.items()
            if subscriber in ready
            for each in self._drain(topic, subscriber)
        ]

    def now_ns(self) -> int:
        """The machine's monotonic clock."""
        return time.monotonic_ns()

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        """Received messages per topic so far; none are published."""
        return tuple(TopicCount(topic=topic, **counts) for topic, counts in self._counts.items()), ()

    def close(self) -> None:
        """Close all sockets."""
        self._context.destroy()

    def _search(self) -> None:
        if time.monotonic() - self._searched_s < _SEARCH_S:
            return
        self._searched_s = time.monotonic()
        publishers = foreign_publishers(self._dir)
        for topic, subscriber in self._sockets.items():
            stem = topic.replace("/", ".")
            for path in (self._dir / f"{stem}@{node}" for node in publishers.get(stem, ())):
                if path not in self._connected:
                    subscriber.connect(f"ipc://{path}")
                    self._connected.add(path)

    def _drain(self, topic: str, subscriber: zmq.Socket[bytes]) -> list[Received]:
        messages = []
        for _ in range(_MAX_MESSAGES_A_CALL):
            try:
                frames = [part.buffer for part in subscriber.recv_multipart(zmq.NOBLOCK, copy=False)]
            except zmq.Again:
                break
            try:
                messages.append(decode_foreign(topic, frames))
            except ValueError:
                self._counts[topic]["rejected"] += 1
                continue
            self._count(topic, messages[-1].envelope, frames)
        return messages

    def _count(self, topic: str, envelope: Envelope, frames: list[memoryview]) -> None:
        counts, key = self._counts[topic], (topic, envelope.publisher)
        counts["messages"] += 1
        counts["bytes"] += sum(map(len, frames))
        counts["lost"] += max(0, envelope.sequence - self._last.get(key, envelope.sequence - 1) - 1)
        self._last[key] = envelope.sequence


def decode_foreign(topic: str, frames: list[memoryview]) -> Received:
    """A message of any type; raises `ValueError`, and nothing else, where the frames are no message."""
    if len(frames) < 2 or len(frames[1]) > MAX_HEADER_BYTES:
        raise ValueError(f"{topic}: a message has a topic and a header of at most {MAX_HEADER_BYTES} bytes")
    try:
        head = msgspec.msgpack.decode(frames[1], type=_Head, ext_hook=lambda code, data: f"extension {code}")
        return Received(topic, ForeignMessage(_with_arrays(head.body, frames[2:])), head.envelope)
    except _TROUBLE as error:
        raise ValueError(f"{topic}: {error}") from error


def _with_arrays(value: Any, frames: list[memoryview]) -> Any:
    if isinstance(value, dict):
        if value.keys() == _ARRAY_KEYS:
            return _array(msgspec.convert(value, _ArrayHead), frames)
        return {str(name): _with_arrays(item, frames) for name, item in value.items()}
    return [_with_arrays(item, frames) for item in value] if isinstance(value, list) else value


def _array(head: _ArrayHead, frames: list[memoryview]) -> np.ndarray:
    if head.dtype not in DTYPES or len(head.shape) > MAX_NDIM or any(length < 0 for length in head.shape):
        raise ValueError(f"no array: {head}")
    if not 0 <= head.frame < len(frames):
        raise ValueError(f"frame must be one of {len(frames)}, got {head.frame}")
    data: Buffer = frames[head.frame]
    if math.prod(head.shape) * np.dtype(head.dtype).itemsize != len(data):
        raise ValueError(f"shape {head.shape} of {head.dtype} does not fit {len(data)} bytes")
    return np.ndarray(head.shape, head.dtype, buffer=data)
