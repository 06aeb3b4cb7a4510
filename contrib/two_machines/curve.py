"""Shared part of both ends of a link between two hosts: the messages on TCP and the set-up of the sockets.

Downwards go the messages as on every bus (`msgs.bus.codec`), and answers of the exporter's clock. Upwards go
subscriptions and questions: `[2][8 bytes of requester][8 bytes of number]`, answered on the topic `clock\\0` +
requester with the number and the exporter's monotonic clock (int64, big-endian, ns). Newest-only topics go down one
message at a time (`contrib.two_machines.newest`), on the topic `newest\\0` + requester + topic with a number before
the header;
`[3][8 bytes of requester][8 bytes of number]` acknowledges it and all before it. An exporter that offers this
precedes every answer of its clock by `[clock\\0 + requester][newest\\0][last number]`, to be acknowledged likewise; of
another one those topics are subscribed to as all are. Nothing else is accepted upwards: an importer cannot publish.

`contrib.two_machines.exporter` is the end that is bound on one port, `contrib.two_machines.importer` the one that
connects to it.
"""

from __future__ import annotations

import contextlib
import logging
import re
import struct
from collections.abc import Callable, Iterable, Iterator

import zmq
from zmq.utils.monitor import recv_monitor_message

from msgs.bus.codec import topic_frame
from msgs.bus.topics import Topic
from msgs.values.units import NANOSECONDS_PER_SECOND

logger = logging.getLogger(__name__)

Clock = Callable[[], int]

#: Messages that one turn takes from a peer, and a burst that one turn of a bus may pass to an exporter.
MAX_A_TURN = 64
#: Subscriptions and questions are short; a CURVE handshake needs some 300 bytes.
MAX_UPWARD_BYTES = 1024
#: Without a dot: a peer does not pass on what it has itself imported.
ORIGIN = re.compile(r"[A-Za-z0-9_-]{1,64}")

CLOCK = topic_frame("clock")
NEWEST = topic_frame("newest")
PING, TAKEN = b"\x02", b"\x03"
ID_BYTES = 8
STAMP = struct.Struct(">q")

_HANDSHAKE_MS = 2000
#: Time to connect, and for sent data to be acknowledged; a silent connection has as long after `_IDLE_S`.
_CONNECT_MS, _UNHEARD_MS = 2000, 3000
_IDLE_S, _PROBE_S = 2, 1
_LINGER_MS = 100
_LOG_INTERVAL_NS = 5 * NANOSECONDS_PER_SECOND


def queue_messages(facts: Iterable[Topic]) -> int:
    """Return how many messages may wait for a peer: as many as fill the topics' history together, each of the maximum
    size and at its nominal rate; at least as many as one turn of a bus delivers.
    """
    topics = list(facts)
    rate_hz = sum(topic.rate_hz for topic in topics)
    budget_bytes = sum(topic.history_bytes for topic in topics)
    if rate_hz <= 0.0:
        return MAX_A_TURN
    mean_bytes = sum(topic.rate_hz * topic.max_bytes for topic in topics) / rate_hz
    return max(MAX_A_TURN, int(budget_bytes / mean_bytes))


class Complaint:
    """A warning about a count, logged when the count grew and not more often than every 5 s."""

    def __init__(self) -> None:
        self._said = 0
        self._said_ns: int | None = None

    def say(self, count: int, now_ns: int, text: str) -> None:
        """Log `text % count` if it is due."""
        if count > self._said and (self._said_ns is None or now_ns - self._said_ns >= _LOG_INTERVAL_NS):
            self._said, self._said_ns = count, now_ns
            logger.warning(text.replace("%d", str(count), 1))


class Monitor:
    """ZeroMQ's events of a socket's connections."""

    def __init__(self, socket: zmq.Socket[bytes], events: int) -> None:
        self._of = socket
        self.socket: zmq.Socket[bytes] = socket.get_monitor_socket(events)

    def events(self) -> list[tuple[int, int]]:
        """Return the events since the last call and their values, bounded."""
        events = []
        with contextlib.suppress(zmq.Again):
            for _ in range(MAX_A_TURN):
                event = recv_monitor_message(self.socket, zmq.NOBLOCK)
                events.append((int(event["event"]), int(event["value"])))
        return events

    def close(self) -> None:
        """Stop listening."""
        self._of.disable_monitor()
        self.socket.close(linger=0)


def waiting_on(socket: zmq.Socket[bytes]) -> Iterator[list[zmq.Frame]]:
    """Yield messages that wait on a socket, at most `MAX_A_TURN`."""
    with contextlib.suppress(zmq.Again):
        for _ in range(MAX_A_TURN):
            yield socket.recv_multipart(zmq.NOBLOCK, copy=False)


def set_common(socket: zmq.Socket[bytes]) -> None:
    """Set the options of both ends: the time after which a silent peer is given up."""
    socket.set(zmq.LINGER, _LINGER_MS)
    # the kernel detects a dead peer: heartbeats of libzmq abort the process (its issues 3937, 4364, 4767) where a
    # connection ends that has stopped reading
    socket.set(zmq.TCP_MAXRT, _UNHEARD_MS)
    socket.set(zmq.TCP_KEEPALIVE, 1)
    socket.set(zmq.TCP_KEEPALIVE_IDLE, _IDLE_S)
    socket.set(zmq.TCP_KEEPALIVE_INTVL, _PROBE_S)
    socket.set(zmq.TCP_KEEPALIVE_CNT, _UNHEARD_MS // 1000)
    socket.set(zmq.CONNECT_TIMEOUT, _CONNECT_MS)
    socket.set(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
