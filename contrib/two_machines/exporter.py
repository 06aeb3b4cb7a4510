"""The sending end of a link: local topics for peers, bound on one port and encrypted with CURVE.

The handshake decides who may connect; a connected peer can read and get answers (`contrib.two_machines.curve`), no
more.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping

import zmq
from zmq.auth.thread import ThreadAuthenticator

from contrib.two_machines.curve import (
    CLOCK,
    ID_BYTES,
    MAX_UPWARD_BYTES,
    NEWEST,
    ORIGIN,
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
from contrib.two_machines.newest import NUMBER, NewestOnly
from msgs.bus.codec import Buffer, CodecError, encode, topic_frame
from msgs.bus.interface import Received
from msgs.bus.sequencing import latch
from msgs.bus.topics import Topic, topic_facts
from msgs.files.open_files import raise_open_files
from msgs.values.units import NANOSECONDS_PER_SECOND

logger = logging.getLogger(__name__)

_ZAP_DOMAIN = "mirrorwave"
_PING_BYTES = len(PING) + 2 * ID_BYTES
_TAKEN_BYTES = len(TAKEN) + ID_BYTES + NUMBER.size
#: No handshake takes longer.
_STRANGER_NS = 5 * NANOSECONDS_PER_SECOND // 2
#: Far more than there are peers; each costs libzmq memory until its connection is given up.
_MAX_STRANGERS = 256
_MAX_JOINED = 64
#: Limit of one connection; an importer has one a topic and one for the clock. libzmq keeps each: 50 bytes a character.
_MAX_SUBSCRIPTIONS = 64

#: Not EVENT_HANDSHAKE_FAILED_PROTOCOL: libzmq 4.3.5 reports it also for a message that cannot be decrypted, then
#: forgets that the connection is broken, and stops reading it without closing it.
_REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL


class Exporter:
    """Local topics for peers: bound on one address, encrypted and only for `allowed` where `own` is given.

    `allowed`: public key -> name. Peers that take nothing miss messages; the kernel cuts off absent ones.
    Raises `ValueError` for keys without a list or an unknown topic, `OSError` if the address is not available.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        address: str,
        topics: Iterable[str],
        own: KeyPair | None = None,
        allowed: Mapping[bytes, str] | None = None,
        clock_ns: Clock = time.monotonic_ns,
    ) -> None:
        if (own is None) != (not allowed):
            raise ValueError("an own key and the keys of allowed peers belong together")
        facts = [topic_facts(topic) for topic in topics]
        self._allowed, self._clock_ns = dict(allowed or {}), clock_ns
        self._latched: dict[str, dict[str, list[Buffer]]] = {topic.name: {} for topic in facts if topic.latched}
        #: Peers that ask for our clock, and over how many connections: a new one may come before the old one has gone.
        self._joined: dict[bytes, tuple[str, int]] = {}
        self._newest = NewestOnly(facts, self._send, _MAX_JOINED)
        self._complaint = Complaint()
        #: Failed handshakes, and messages that can go neither up nor down: no question, or too large.
        self.refused = self.rejected = 0
        self._socket = context.socket(zmq.XPUB)
        self._watch = Monitor(self._socket, _REFUSED | zmq.EVENT_ACCEPTED | zmq.EVENT_HANDSHAKE_SUCCEEDED)
        #: Subscriptions of each connection, by its file descriptor.
        self._subscriptions: Counter[int] = Counter()
        #: Key of each connection that has asked for something, by its file descriptor.
        self._keys: dict[int, bytes] = {}
        #: At most half of the descriptors we may open: a process that can open no more ends with its next heartbeat.
        self._max_strangers = min(_MAX_STRANGERS, raise_open_files() // 2)
        #: Arrival times of connections that have not identified themselves yet.
        self._strangers: deque[int] = deque()
        self._authenticator = _authenticator(context, self._allowed)
        try:
            self._prepare(facts, own)
            self._socket.bind(address)
        except zmq.ZMQError as error:
            self.close()
            raise OSError(f"{address}: {error.strerror}") from None
        #: The bound address: a port that was left open is filled in.
        self.address = self._socket.get_string(zmq.LAST_ENDPOINT)

    def _prepare(self, facts: list[Topic], own: KeyPair | None) -> None:
        set_common(self._socket)
        self._socket.set(zmq.SNDHWM, queue_messages(facts))
        self._socket.set(zmq.MAXMSGSIZE, MAX_UPWARD_BYTES)
        # every subscription is reported, and answered with the latched messages
        self._socket.set(zmq.XPUB_VERBOSER, 1)
        # without a domain, a peer that speaks ZMTP 1.0 is admitted whatever the mechanism is
        self._socket.set_string(zmq.ZAP_DOMAIN, _ZAP_DOMAIN)
        if own is not None:
            self._socket.set(zmq.CURVE_SERVER, 1)
            self._socket.set(zmq.CURVE_SECRETKEY, own.secret)

    @property
    def sources(self) -> tuple[zmq.Socket[bytes], ...]:
        """Sockets that end a wait."""
        return self._socket, self._watch.socket

    @property
    def alive(self) -> bool:
        """Return whether handshakes are still judged; otherwise no peer is admitted."""
        return self._authenticator.is_alive()

    def send(self, received: Received) -> None:
        """Send a message of the local bus unchanged; imported messages stay here."""
        if not ORIGIN.fullmatch(received.envelope.publisher):
            return
        try:
            frames = encode(received.envelope, received.message)
        except CodecError:
            # a writer that omits defaults fits a little more into a message than we do
            self.rejected += 1
            return
        if received.topic in self._latched:
            latch(self._latched[received.topic], received.envelope.publisher, frames)
        self._send(frames)
        self._newest.offer(received.envelope, frames)

    def superseded(self) -> dict[str, int]:
        """Return how many messages of each newest-only topic a newer one replaced before they were sent."""
        return dict(self._newest.superseded)

    def allow(self, allowed: Mapping[bytes, str]) -> None:
        """Replace the list of peers that may connect; connections of those that are no longer on it are closed."""
        revoked = self._allowed.keys() - allowed.keys()
        # the thread that judges handshakes reads this very mapping
        self._allowed.update(allowed)
        for key in revoked:
            logger.info("%s is no longer allowed", self._allowed.pop(key))
        for descriptor in [descriptor for descriptor, key in self._keys.items() if key in revoked]:
            del self._keys[descriptor]
            _close_connection(descriptor, self.address)

    def turn(self) -> None:
        """Answer the messages from peers, a bounded number of them."""
        self._judge(self._clock_ns())
        for parts in waiting_on(self._socket):
            self._answer(parts)

    def close(self) -> None:
        """Close the port; messages in transit have a tenth of a second."""
        self._watch.close()
        self._socket.close()
        self._authenticator.stop()

    def _judge(self, now_ns: int) -> None:
        """Count the connections that failed to identify themselves, or used another protocol."""
        for event, descriptor in self._watch.events():
            if event == zmq.EVENT_ACCEPTED:
                self._strangers.append(now_ns)
                del self._subscriptions[descriptor]
                self._keys.pop(descriptor, None)
                if len(self._strangers) > self._max_strangers:
                    _close_connection(descriptor, self.address)
            elif self._strangers:
                self._strangers.popleft()
                self.refused += bool(event & _REFUSED)
        while self._strangers and now_ns - self._strangers[0] > _STRANGER_NS:
            self._strangers.popleft()
            self.refused += 1
        self._complaint.say(self.refused, now_ns, "refused %d connections: wrong key or no peer")

    def _answer(self, parts: list[zmq.Frame]) -> None:
        request = parts[0].bytes
        if len(parts) > 1:
            self.rejected += 1
        elif request[:1] == b"\x01":
            self._subscriptions[descriptor := int(parts[0].get(zmq.SRCFD))] += 1
            self._keys[descriptor] = _key_of(parts[0])
            if self._subscriptions[descriptor] <= _MAX_SUBSCRIPTIONS:
                self._send_latched(request[1:], self._allowed.get(_key_of(parts[0]), "somebody"))
            else:
                self._shut_out(parts[0], descriptor)
        elif request[:1] == b"\x00":
            self._part(request[1:])
        elif request[:1] == PING and len(request) == _PING_BYTES:
            asker, number = request[1 : 1 + ID_BYTES], request[1 + ID_BYTES :]
            self._send([CLOCK + asker, NEWEST, NUMBER.pack(self._newest.last_number)])
            self._send([CLOCK + asker, number, STAMP.pack(self._clock_ns())])
        elif request[:1] == TAKEN and len(request) == _TAKEN_BYTES:
            (taken,) = NUMBER.unpack(request[1 + ID_BYTES :])
            self._newest.acknowledge(request[1 : 1 + ID_BYTES], taken)
        else:
            self.rejected += 1

    def _send_latched(self, prefix: bytes, name: str) -> None:
        for topic, by_publisher in self._latched.items():
            if topic_frame(topic).startswith(prefix):
                for frames in by_publisher.values():
                    self._send(frames)
        if prefix.startswith(NEWEST):
            self._newest.join(prefix)
        if prefix.startswith(CLOCK) and (prefix in self._joined or len(self._joined) < _MAX_JOINED):
            _, connections = self._joined.get(prefix, (name, 0))
            self._joined[prefix] = name, connections + 1
            if not connections:
                logger.info("%s has joined", name)

    def _shut_out(self, frame: zmq.Frame, descriptor: int) -> None:
        """Close the connection of a peer that subscribes without end, and remove its key from the list."""
        self.rejected += 1
        if name := self._allowed.pop(_key_of(frame), ""):
            logger.error("%s subscribes without end: shut out until this node starts again", name)
        _close_connection(descriptor, self.address)

    def _part(self, prefix: bytes) -> None:
        self._newest.part(prefix)
        name, connections = self._joined.get(prefix, ("", 0))
        if connections > 1:
            self._joined[prefix] = name, connections - 1
        elif connections:
            del self._joined[prefix]
            logger.info("%s has gone", name)

    def _send(self, frames: list[Buffer]) -> None:
        self._socket.send_multipart(frames, zmq.NOBLOCK, copy=False)


def _authenticator(context: zmq.Context[zmq.Socket[bytes]], allowed: Mapping[bytes, str]) -> ThreadAuthenticator:
    """Return a thread that admits the listed keys; without keys, any peer with the current protocol."""

    class _List:
        def callback(self, domain: str, key: bytes) -> bool:
            return key in allowed

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve_callback(_ZAP_DOMAIN, _List())
    return authenticator


def _key_of(frame: zmq.Frame) -> bytes:
    """Return the public key of the sender; empty without keys."""
    try:
        return str(frame.get("User-Id")).encode()
    except zmq.ZMQError:
        return b""


def _close_connection(descriptor: int, address: str) -> None:
    """End a connection of our port; a descriptor that has gone meanwhile, or is not of our port, is left alone.

    If libzmq gives the number to another connection at this very moment, that one comes back as after any cut: it is
    a socket of libzmq (files cannot be shut down), and all of those connect again.
    """
    with contextlib.suppress(OSError):
        connection = socket.socket(fileno=descriptor)
        try:
            if connection.family != socket.AF_UNIX and address.endswith(f":{connection.getsockname()[1]}"):
                connection.shutdown(socket.SHUT_RDWR)
        finally:
            # libzmq closes it
            connection.detach()
