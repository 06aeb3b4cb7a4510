"""Peers that leave at once, on every kind of socket that the bus opens: a victim is a process of its own.

A publisher that was told to change an option of a socket while a subscriber hung up died of a segmentation fault in
libzmq, silently. Whatever leaves, whenever it leaves, the process must go on and serve its good peer.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import zmq

from benchmarks.transport.net import COMMAND, Row, frame, frames, frames_v1, greeting, ready
from benchmarks.transport.raw_peers import MESSAGE, TOPIC
from mirrorwave.diagnose.foreign_topic import ForeignBus
from msgs.bus.codec import encode, topic_frame
from msgs.bus.interface import Envelope, Forwarded
from msgs.bus.sequencing import MAX_LATCHED
from msgs.bus.zmq import ZmqBus, socket_path
from msgs.files.shipped import CHECKOUT
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState

ROOT = CHECKOUT
PATIENCE_S = 30.0
#: The victim listens so long for each of its turns.
_TURN_S = 0.002
VICTIM, ROGUE = "player", "rogue"
_LATCHED, _FOREIGN = "radar/setup", "lidar/cloud"
#: Longest life of an ordinary subscriber.
_LIFE_S = 0.05
#: Rogue publishers at a time, and how long each waits to be found.
_ROGUES, _ACCEPT_S = 16, 1.0
#: Ordinary subscribers cost more than raw ones: one in so many.
_SHARE_OF_LIBRARY = 10

_SUBSCRIBE = b"\x01" + topic_frame(TOPIC)
#: What a raw subscriber says before it leaves.
_SUBSCRIBERS = (
    b"",
    b"\xff",
    # the shortest way in: ZMTP 1.0 without an identity, then a subscription to all that begins with x
    frames_v1([b""]) + b"\x02\x00\x01x",
    b"\x01\x00\x02\x00\x01x",
    frames_v1([b""]) + frames_v1([_SUBSCRIBE]),
    greeting("NULL"),
    greeting("NULL") + ready("SUB"),
    greeting("NULL") + ready("SUB") + frame(_SUBSCRIBE),
    greeting("NULL", 1) + ready("XSUB") + frame(b"\x09SUBSCRIBE" + topic_frame(TOPIC), COMMAND),
    greeting("NULL") + ready("SUB") + frame(_SUBSCRIBE) + frame(b"\x00" + topic_frame(TOPIC)),
)
#: What a raw publisher says to who connects to it.
_PUBLISHERS = (
    b"",
    greeting("NULL")[:11],
    frames_v1([b""]) + frames_v1(MESSAGE),
    greeting("NULL") + ready("PUB"),
    greeting("NULL") + ready("XPUB") + frames(MESSAGE)[:-1],
    greeting("NULL") + ready("PUB") + frames(MESSAGE[:1]),
)


class Victim:
    """A process with one bus, and a good peer that hears it."""

    def __init__(self, kind: str) -> None:
        self._kind = kind

    def __enter__(self) -> Victim:
        self._stack = contextlib.ExitStack()
        self.run_dir = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="mw"))) / "graph"
        self._good = ZmqBus("geometry", self.run_dir)
        self._stack.callback(self._good.close)
        self._good.subscribe(TOPIC)
        command = [sys.executable, "-m", "benchmarks.transport.attacks_hangup", self._kind, str(self.run_dir)]
        self._process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
        self._stack.callback(self._process.wait)
        self._stack.callback(self._process.kill)
        if not self.serves():
            raise TimeoutError(f"{self._kind}: the victim did not start")
        return self

    def __exit__(self, *details: object) -> None:
        self._stack.close()

    def ended(self) -> str:
        """How it ended; empty while it runs."""
        code = self._process.poll()
        return "" if code is None else signal.Signals(-code).name if code < 0 else f"exit {code}"

    def serves(self) -> bool:
        """Whether messages that it publishes from now on arrive."""
        start_ns, end_s = time.monotonic_ns(), time.monotonic() + PATIENCE_S
        while not self.ended() and time.monotonic() < end_s:
            envelopes = [received.envelope for received in self._good.receive(0.05)]
            if any(envelope.publisher == VICTIM and envelope.sent_ns > start_ns for envelope in envelopes):
                return True
        return False


def rows(count: int, seed: int) -> Iterator[Row]:
    """Every kind of socket with `count` peers that leave at once; those of libzmq itself are a tenth as many."""
    bound = {
        "PUB of a topic": ("node", TOPIC),
        "XPUB of a latched topic": ("node", _LATCHED),
        "XPUB of a counting publisher": ("counting", TOPIC),
        "XPUB of a publisher that waits": ("paced", TOPIC),
        "XPUB of a node that forwards, latched": ("forwarding", _LATCHED),
    }
    for name, (kind, topic) in bound.items():
        for way, leave, tries in (
            ("raw subscribers", _leave_raw, count),
            ("libzmq subscribers that live 0 to 50 ms", _leave_after, max(1, count // _SHARE_OF_LIBRARY)),
        ):
            with Victim(kind) as victim:
                tried = leave(victim, topic, tries, seed)
                yield _row(name, way, victim, tried)
    for name, kind, topic in (("SUB of a topic", "listening", TOPIC), ("SUB of a foreign topic", "foreign", _FOREIGN)):
        with Victim(kind) as victim:
            yield _row(name, "publishers", victim, _hang_up_on(victim, topic, count))


def _row(name: str, way: str, victim: Victim, tried: int) -> Row:
    serves = victim.serves()
    return Row("bus", f"{name}: {way} that leave at once", tried, 0, victim.ended() or "goes on", serves)


def _leave_raw(victim: Victim, topic: str, count: int, seed: int) -> int:
    """Connect, say something, hang up; ends early where nobody listens any more."""
    path = str(socket_path(victim.run_dir, topic, VICTIM))
    for index in range(count):
        with contextlib.suppress(BrokenPipeError, ConnectionResetError), socket.socket(socket.AF_UNIX) as peer:
            try:
                peer.connect(path)
            except ConnectionRefusedError:
                return index
            peer.sendall(_SUBSCRIBERS[index % len(_SUBSCRIBERS)])
    return count


def _leave_after(victim: Victim, topic: str, count: int, seed: int) -> int:
    """Ordinary subscribers, two at a time."""
    lives_s = np.random.default_rng(seed).uniform(0.0, _LIFE_S, (2, -(-count // 2)))
    address = f"ipc://{socket_path(victim.run_dir, topic, VICTIM)}"
    crowd = [threading.Thread(target=_subscribe_and_leave, args=(address, lives)) for lives in lives_s]
    for thread in crowd:
        thread.start()
    for thread in crowd:
        thread.join()
    return int(lives_s.size)


def _subscribe_and_leave(address: str, lives_s: np.ndarray) -> None:
    with zmq.Context() as context:
        for life_s in lives_s:
            with context.socket(zmq.SUB) as peer:
                peer.set(zmq.LINGER, 0)
                peer.subscribe(b"")
                peer.connect(address)
                time.sleep(life_s)


def _hang_up_on(victim: Victim, topic: str, count: int) -> int:
    """Take the victim's connections as a publisher, say something, hang up.

    Each under a new name: libzmq does not come back to who broke the protocol.
    """
    taken, end_s = 0, time.monotonic() + PATIENCE_S + _LIFE_S * count
    while taken < count and not victim.ended() and time.monotonic() < end_s:
        with contextlib.ExitStack() as stack:
            names = [f"{ROGUE}{taken + index}" for index in range(min(_ROGUES, count - taken))]
            rogues = [stack.enter_context(_listener(socket_path(victim.run_dir, topic, name))) for name in names]
            for rogue in rogues:
                with contextlib.suppress(BrokenPipeError, ConnectionResetError, TimeoutError):
                    connection, _ = rogue.accept()
                    taken += 1
                    with connection:
                        connection.sendall(_PUBLISHERS[taken % len(_PUBLISHERS)])
    return taken


@contextlib.contextmanager
def _listener(path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        listener.settimeout(_ACCEPT_S)
        yield listener
        path.unlink()


def _serve(kind: str, run_dir: Path) -> None:
    """Be the victim: publish, and listen in between."""
    bus = ZmqBus(VICTIM, run_dir, paced=kind == "paced", counted=kind == "counting")
    if kind == "forwarding":
        for index in range(MAX_LATCHED):
            envelope = Envelope(publisher=f"front.radar{index}", topic=_LATCHED, sequence=0, sent_ns=bus.now_ns())
            bus.forward(Forwarded(_LATCHED, envelope, encode(envelope, RadarSetup())))
    else:
        bus.publish(_LATCHED, RadarSetup())
    if kind == "listening":
        bus.subscribe(TOPIC)
    foreign = ForeignBus(run_dir) if kind == "foreign" else None
    if foreign is not None:
        foreign.subscribe(_FOREIGN)
    while True:
        bus.publish(TOPIC, VehicleState(stamp_ns=bus.now_ns()))
        bus.receive(_TURN_S)
        if foreign is not None:
            foreign.receive(_TURN_S)


if __name__ == "__main__":
    _serve(sys.argv[1], Path(sys.argv[2]))
