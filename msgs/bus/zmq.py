"""The live bus: ZeroMQ over Unix sockets, no broker.

A publisher binds `<topic with . for />@<node>` in `run_dir`, subscribers look for `<topic>@*` and connect.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import socket
import stat
import time
from collections.abc import Container
from pathlib import Path
from typing import Any

import msgspec
import zmq

from msgs.bus.codec import Buffer, decode, topic_frame
from msgs.bus.declared import expect_declared
from msgs.bus.exchange import Exchange, Mailbox, Parcel
from msgs.bus.interface import Forwarded, Received
from msgs.bus.sequencing import MAX_LATCHED, Tally, latch, total_size
from msgs.bus.topics import MIB, SHIPPED, TOPICS, Topic, topic_facts
from msgs.values.diagnostics import TopicCount
from msgs.values.units import NANOSECONDS_PER_SECOND

logger = logging.getLogger(__name__)

#: Length available for a path in a Unix socket address, without its end mark.
_MAX_PATH_BYTES = 107
_NODE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_MAX_MESSAGES_A_CALL = 64
_LINGER_MS = 500
_RECONNECT_MS = 20
_RECONNECT_MAX_MS = 50
#: Time for which a subscriber of a paced topic that takes nothing may hold up the publisher.
_HELD_UP_NS = 10 * NANOSECONDS_PER_SECOND
_RETRY_S = 0.001
#: Intervals of the search for publishers: while a topic has none yet, and afterwards.
_SEARCH_INTERVAL_NS = 50_000_000
_RESCAN_INTERVAL_NS = 100_000_000


class InterruptibleContext(zmq.Context[zmq.Socket[bytes]]):
    """A context that knows its sockets before they are open, so that `destroy` closes all of them.

    `term` waits for ever for one that is still open, as one would be that a signal interrupts between its opening and
    the line that keeps it: the interrupt's traceback holds it.
    """

    def socket(self, socket_type: int, *_: Any, **__: Any) -> zmq.Socket[bytes]:
        """Open a socket."""
        opened = zmq.Socket.__new__(zmq.Socket)
        self._add_socket(opened)
        opened.__init__(self, socket_type)  # type: ignore[misc]
        return opened


class ZmqBus:
    """One node's connection to the live graph; a `Bus`.

    `paced`: subscribers that are behind hold up `publish` instead of missing messages, and every message says so.
    `counted`: `subscribers` covers every topic, as on a paced bus, and every message is kept, also on topics whose
    receivers want the newest only.
    `exchange`: what connects the nodes of this process, past the sockets.
    Raises `ValueError` for a node name or run directory that cannot be used or is not ours alone, `OSError` where the
    directory cannot be made.
    """

    def __init__(
        self, node: str, run_dir: Path, paced: bool = False, counted: bool = False, exchange: Exchange | None = None
    ) -> None:
        if not _NODE_NAME.fullmatch(node):
            raise ValueError(f"node name must be 1..64 letters, digits, '_', '-' or '.', got {node!r}")
        self._node = node
        self._dir = Path(run_dir)
        for topic in SHIPPED:
            _require_path_fits(socket_path(self._dir, topic, node))
        make_run_dir(self._dir)
        expect_declared(self._dir)
        self._context = InterruptibleContext()
        self._paced, self._counted = paced, paced or counted
        self._tally = Tally(node, paced, keeps_all=counted)
        self._poller = zmq.Poller()
        self._publishers: dict[str, zmq.Socket[bytes]] = {}
        #: Last message of each latched topic, by the publisher named in its envelope.
        self._latched: dict[str, dict[str, list[Buffer]]] = {}
        #: Subscriber counts of the topics that report them: all topics of a counted bus, else the latched ones.
        self._joined: dict[str, int] = {}
        self._subscribers: dict[str, zmq.Socket[bytes]] = {}
        #: Publishers found per topic, and the life of each, as identified by its socket file.
        self._lives: dict[str, dict[str, tuple[int, int]]] = {}
        #: Other sources that may end a wait: sockets and file descriptors that do not belong to the bus.
        self._watched: set[zmq.Socket[bytes] | int] = set()
        self._next_scan_ns = 0
        self._exchange, self._mailbox = exchange, Mailbox() if exchange else None
        if self._mailbox is not None:
            self._poller.register(self._mailbox.descriptor, zmq.POLLIN)

    def advertise(self, topic: str, origins: int = 1) -> None:
        """Open `topic` for subscribers before the first message, for so many `origins` that this node sends for.

        Raises `ValueError` when a running process of the same node name publishes it already.
        """
        if topic not in self._publishers:
            self._publishers[topic] = self._bind(topic_facts(topic), origins)

    def publish(self, topic: str, message: msgspec.Struct) -> None:
        """Send `message` without waiting; subscribers that are behind by the topic's history miss it.

        Arrays are not copied: do not change them afterwards. Raises `CodecError` if it cannot travel; on a paced bus
        `TimeoutError` where a subscriber takes nothing for 10 s.
        """
        self.advertise(topic)
        envelope, frames = self._tally.pack(topic, message, self.now_ns())
        self._hand_out(topic, envelope.publisher, frames)
        if self._exchange is not None:
            self._exchange.hand_over(Parcel(Received(topic, message, envelope), total_size(frames)))

    def forward(self, message: Forwarded) -> None:
        """Send a message of another graph unchanged, without waiting; raises `TimeoutError` as `publish` does."""
        self.advertise(message.topic, MAX_LATCHED)
        self._tally.forward(message)
        self._hand_out(message.topic, message.envelope.publisher, message.frames)
        if self._exchange is not None and self._exchange.wants(message.topic):
            self._exchange.hand_over(Parcel(decode(message.frames), total_size(message.frames)))

    def subscribers(self, topic: str) -> int:
        """Return the number of connections to an advertised topic, latched or counted: they get all later messages."""
        self._serve_newcomers(topic)
        return self._joined[topic]

    def subscribe(self, topic: str) -> None:
        """Receive `topic` from all its publishers, present and to come."""
        if topic in self._subscribers:
            return
        facts = topic_facts(topic)
        subscriber = self._context.socket(zmq.SUB)
        subscriber.set(zmq.RCVHWM, facts.history_messages)
        subscriber.set(zmq.MAXMSGSIZE, facts.max_bytes)
        subscriber.set(zmq.LINGER, 0)
        subscriber.set(zmq.RECONNECT_IVL, _RECONNECT_MS)
        subscriber.set(zmq.RECONNECT_IVL_MAX, _RECONNECT_MAX_MS)
        subscriber.set(zmq.SUBSCRIBE, topic_frame(topic))
        self._subscribers[topic] = subscriber
        self._lives[topic] = {}
        self._poller.register(subscriber, zmq.POLLIN)
        self._tally.expect(topic)
        if self._exchange is not None and self._mailbox is not None:
            self._exchange.join(topic, self._mailbox)
        self._search()

    def want_all(self) -> None:
        """Receive outdated messages, too."""
        self._tally.wants_all = True

    def watch(self, source: zmq.Socket[bytes] | int) -> None:
        """End the wait of `receive` also when `source`, a socket or file descriptor of the owner's, can be read."""
        self._watched.add(source)
        self._poller.register(source, zmq.POLLIN)

    def unwatch(self, source: zmq.Socket[bytes] | int) -> None:
        """Stop watching `source`; to be called before it is closed."""
        self._watched.remove(source)
        self._poller.unregister(source)

    def receive(self, timeout_s: float) -> list[Received]:
        """Return messages waiting, at most 64 a topic; wait for the first, or until a watched source can be read."""
        deadline_ns = self.now_ns() + max(0, int(timeout_s * NANOSECONDS_PER_SECOND))
        while True:
            if self.now_ns() >= self._next_scan_ns:
                self._bind_again()
                self._search()
            wake_ns = min(deadline_ns, self._next_scan_ns) if self._subscribers else deadline_ns
            received, is_watched_ready = self._poll(max(0, wake_ns - self.now_ns()))
            if received or is_watched_ready or self.now_ns() >= deadline_ns:
                return received

    def has_publisher(self, topic: str, publisher: str) -> bool:
        """Return whether a running process of this name publishes `topic`; true where it cannot be asked."""
        if self._exchange is not None and publisher in self._exchange.nodes:
            return True
        try:
            if "." not in publisher:
                return _is_alive(socket_path(self._dir, topic, publisher))
            # a link has the topic open under its own name, under which nothing is sent
            own_names = self._tally.publishers(topic)
            published = [node for _, node in _published_names(self._dir, {topic}) if node not in own_names]
            return any(_is_alive(socket_path(self._dir, topic, node)) for node in published)
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            return True

    def now_ns(self) -> int:
        """Return the machine's monotonic clock, shared by all processes on it."""
        return time.monotonic_ns()

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        """Return received and published messages per topic so far."""
        return self._tally.counts()

    def close(self) -> None:
        """Close all sockets; waits for messages in transit no longer than half a second."""
        if self._exchange is not None and self._mailbox is not None:
            self._exchange.leave(self._mailbox)
            self._mailbox.close()
            self._exchange = self._mailbox = None
        self._context.destroy()
        self._publishers.clear()
        self._subscribers.clear()

    def _hand_out(self, topic: str, publisher: str, frames: list[Buffer]) -> None:
        """Send a message to all subscribers, and keep it for later ones if its topic is latched."""
        if topic in self._latched:
            # a newcomer needs no older message of this publisher
            self._latched[topic].pop(publisher, None)
            self._serve_newcomers(topic)
            latch(self._latched[topic], publisher, frames)
        self._send(topic, frames)

    def _send(self, topic: str, frames: list[Buffer]) -> None:
        """Pass a message to ZeroMQ, which refuses it while a subscriber of a paced topic is behind."""
        end_ns = self.now_ns() + _HELD_UP_NS
        while True:
            try:
                self._publishers[topic].send_multipart(frames, zmq.NOBLOCK, copy=False)
                return
            except zmq.Again:
                if self.now_ns() > end_ns:
                    raise TimeoutError(f"{topic}: a subscriber has taken nothing for 10 s") from None
                time.sleep(_RETRY_S)

    def _bind(self, topic: Topic, origins: int) -> zmq.Socket[bytes]:
        path = socket_path(self._dir, topic.name, self._node)
        _require_path_fits(path)
        if path.exists():
            if _is_alive(path):
                raise ValueError(f"{path}: node {self._node!r} publishes {topic.name} already; names must differ")
            path.unlink(missing_ok=True)
        hears = topic.latched or self._counted
        publisher = self._context.socket(zmq.XPUB if hears else zmq.PUB)
        # all options before the socket is bound: a later change makes libzmq write to connections that another thread
        # may be tearing down, and it dies with a subscriber that leaves at once
        publisher.set(zmq.SNDHWM, _queue_length(topic, origins))
        publisher.set(zmq.LINGER, 0 if _is_bulk(topic) and not self._paced else _LINGER_MS)
        if hears:
            publisher.set(zmq.XPUB_VERBOSER, 1)
            publisher.set(zmq.XPUB_NODROP, int(self._paced))
            self._joined[topic.name] = 0
            if topic.latched:
                self._latched[topic.name] = {}
            self._poller.register(publisher, zmq.POLLIN)
        publisher.bind(f"ipc://{path}")
        return publisher

    def _bind_again(self) -> None:
        """Bind deleted socket files again: a late subscriber would find no publisher."""
        missing = [topic for topic in self._publishers if not socket_path(self._dir, topic, self._node).exists()]
        if not missing:
            return
        # not unbound before: an old listener unlinks its path when it is closed, which may happen after this
        with contextlib.suppress(OSError, ValueError, zmq.ZMQError):
            make_run_dir(self._dir)
            for topic in missing:
                self._publishers[topic].bind(f"ipc://{socket_path(self._dir, topic, self._node)}")
            logger.warning("%s: %d socket files were gone; opened again", self._dir, len(missing))

    def _poll(self, wait_ns: int) -> tuple[list[Received], bool]:
        """Wait once, serve newcomers to latched topics; return messages and whether a watched source is readable."""
        if not self._poller.sockets:
            # a poll of nothing would return at once
            time.sleep(wait_ns / NANOSECONDS_PER_SECOND)
        ready = dict(self._poller.poll(-(-wait_ns // 1_000_000)))
        for topic in self._joined:
            if self._publishers[topic] in ready:
                self._serve_newcomers(topic)
        received: list[Received] = []
        for topic, subscriber in self._subscribers.items():
            if subscriber in ready:
                received += self._drain(topic, subscriber)
        if self._mailbox is not None and self._mailbox.descriptor in ready:
            received += self._take(self._mailbox)
        # one publisher's clock readings never fall: its own order is kept
        received.sort(key=lambda message: message.envelope.sent_ns)
        return self._tally.without_outdated(received), not self._watched.isdisjoint(ready)

    def _drain(self, topic: str, subscriber: zmq.Socket[bytes]) -> list[Received]:
        # restart the count of a restarted publisher: what its new life sent before it was connected is no loss
        for node, previous in self._lives[topic].items():
            life = _life(socket_path(self._dir, topic, node))
            if life != previous:
                self._lives[topic][node] = life
                self._tally.forget(topic, node)
        messages = []
        for _ in range(_MAX_MESSAGES_A_CALL):
            try:
                parts = subscriber.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            message = self._tally.accept(topic, [part.buffer for part in parts], self.now_ns())
            if message is not None:
                messages.append(message)
        return messages

    def _take(self, mailbox: Mailbox) -> list[Received]:
        now_ns = self.now_ns()
        messages = [self._tally.admit(*parcel, now_ns) for parcel in mailbox.take()]
        return [message for message in messages if message is not None]

    def _serve_newcomers(self, topic: str) -> None:
        """Send a latched topic's last messages again if a subscriber joined; all others discard them as duplicates."""
        latched = self._latched.get(topic, {})
        if self._newcomers(topic) and latched:
            for frames in latched.values():
                self._send(topic, frames)

    def _newcomers(self, topic: str) -> bool:
        """Return whether a subscriber joined a topic since the last call; counts the subscribers."""
        joined = False
        while True:
            try:
                event = self._publishers[topic].recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return joined
            is_new = event[0].startswith(b"\x01")
            self._joined[topic] += 1 if is_new else -1
            joined |= is_new

    def _search(self) -> None:
        """Connect to the publishers that appeared since the last search."""
        try:
            published = _published_names(self._dir, self._subscribers)
        except OSError as error:
            # a flood of connections may have taken all descriptors of the process for a while
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            published = []
        within = self._exchange.nodes if self._exchange else frozenset()
        sought = {topic for topic in self._subscribers if not self._lives[topic]}
        for topic, node in published:
            sought.discard(topic)
            if node not in within and node not in self._lives[topic]:
                self._subscribers[topic].connect(f"ipc://{socket_path(self._dir, topic, node)}")
                self._lives[topic][node] = _life(socket_path(self._dir, topic, node))
        interval_ns = _SEARCH_INTERVAL_NS if sought else _RESCAN_INTERVAL_NS
        self._next_scan_ns = self.now_ns() + interval_ns


def run_dir(domain: str) -> Path:
    """Return the default run directory of a graph; graphs of different domains do not see each other."""
    if not _NODE_NAME.fullmatch(domain) or set(domain) == {"."}:
        raise ValueError(f"domain must be 1..64 letters, digits, '_', '-' or '.', got {domain!r}")
    if override := os.environ.get("MIRRORWAVE_RUN_DIR"):
        return Path(override) / domain
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "mirrorwave" / domain
    return Path("/tmp") / f"mirrorwave-{os.getuid()}" / domain


def make_run_dir(run_dir: Path) -> None:
    """Make a run directory that no other user can enter, or accept an existing one; `OSError` if it cannot be made.

    Raises `ValueError` where another user made it or could write into it: that user would control the graph.
    """
    # a parent directory made along with it takes its mode from the umask otherwise
    run_dir.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    run_dir.mkdir(exist_ok=True, mode=0o700)
    for folder in (run_dir, run_dir.parent):
        # for a link its target counts as well: its owner chooses that
        for status in (folder.lstat(), folder.stat()):
            if status.st_uid not in (os.geteuid(), 0):
                raise ValueError(f"{folder}: must belong to who runs the graph or to root, is user {status.st_uid}'s")
    mode = run_dir.parent.stat().st_mode
    if mode & (stat.S_IWGRP | stat.S_IWOTH) and not mode & stat.S_ISVTX:
        raise ValueError(f"{run_dir.parent}: others may rename what is in it; chmod go-w, or +t")
    # not mended silently: files that others may have left in it would stay
    if run_dir.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise ValueError(f"{run_dir}: others may write into it; look what is in it, then chmod 700")
    run_dir.chmod(0o700)


def socket_path(run_dir: Path, topic: str, node: str) -> Path:
    """Return the path where `node` publishes `topic`."""
    return run_dir / f"{topic.replace('/', '.')}@{node}"


def list_publishers(run_dir: Path) -> list[tuple[str, str]]:
    """Return (topic, node) of every running publisher, sorted; empty if the directory is missing."""
    expect_declared(Path(run_dir))
    return [
        (topic, node)
        for topic, node in _published_names(Path(run_dir), TOPICS)
        if _is_alive(socket_path(Path(run_dir), topic, node))
    ]


def _published_names(run_dir: Path, topics: Container[str]) -> list[tuple[str, str]]:
    """Return (topic, node) of every socket file of these topics, sorted; their owners may have ended."""
    names = []
    for entry in sorted(os.listdir(run_dir)) if run_dir.is_dir() else []:
        stem, at, node = entry.partition("@")
        # no topic has a dot
        topic = stem.replace(".", "/")
        path_fits = len(os.fsencode(run_dir / entry)) <= _MAX_PATH_BYTES
        if at and path_fits and _NODE_NAME.fullmatch(node) and topic in topics:
            names.append((topic, node))
    return names


def _life(path: Path) -> tuple[int, int]:
    """Return a value that differs between one binding of a socket file and the next; zeros if there is none."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_ino, status.st_ctime_ns


def _is_alive(path: Path) -> bool:
    """Return whether a process listens on a socket file."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.2)
        try:
            probe.connect(str(path))
        except (ConnectionError, FileNotFoundError):
            return False
        except OSError:
            # a full backlog or a time-out: a process listens, if busy
            return path.is_socket()
    return True


def _queue_length(topic: Topic, origins: int) -> int:
    """Return how many messages may wait for a subscriber; a newcomer to a latched topic gets one per origin at once."""
    # a reader reports its progress in steps of half the mark: only twice the history surely holds it
    return 2 * topic.history_messages * (origins if topic.latched else 1)


def _is_bulk(topic: Topic) -> bool:
    """Return whether shutdown need not wait for messages in transit: raw beams, and messages that are soon outdated."""
    return topic.newest_only or (topic.max_bytes > 4 * MIB and not topic.latched)


def _require_path_fits(path: Path) -> None:
    size = len(os.fsencode(path))
    if size > _MAX_PATH_BYTES:
        raise ValueError(f"socket path must have at most {_MAX_PATH_BYTES} bytes, got {size}: {path}")
