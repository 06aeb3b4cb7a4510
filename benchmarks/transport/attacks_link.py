"""Attacks on a link between two hosts: its exporting side, its importing side, and the wire between them.

Both sides are real processes; the good peer, importing from the exporting side through a proxy, must be served after
every attack. What an attack is worth is shown by controls first: the same tools on sockets without keys.
"""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import zmq
from zmq.utils.monitor import recv_monitor_message

from benchmarks.transport.link_stand import Keys, Stand
from benchmarks.transport.net import HOST, Script, Talk, call, command, frames_v1, greeting, ready
from benchmarks.transport.raw_peers import MESSAGE, TOPIC, v1
from msgs.bus.codec import topic_frame
from msgs.bus.topics import MIB

#: A libzmq peer that is going to get in has done so in this.
PATIENCE_S = 0.6
#: What an allowed peer may cost in memory, whatever it sends.
GROWTH_LIMIT_BYTES = 64 * MIB
#: A handshake that has not ended by then is the end of its connection (libzmq's own default is 30 s).
HANDSHAKE_LIMIT_S = 10.0
#: Longest life of a peer that leaves at once.
LIFE_S = 0.05
_BEGINNINGS = (
    b"",
    b"\xff",
    frames_v1([b""]) + frames_v1([b"\x01"]),
    greeting("NULL") + ready("SUB"),
    greeting("CURVE")[:40],
    greeting("CURVE"),
    greeting("CURVE") + command("HELLO", bytes(194)),
)
Connected = Callable[[zmq.Socket[bytes]], None]
Outcome = tuple[int, int, str]


# ----------------------------------------------------------------------------------------------------------- controls


def injected_by_v1(tries: int) -> int:
    with _open_socket(zmq.SUB, lambda victim: victim.subscribe(b"")) as (victim, port):
        came = 0
        for _ in range(tries):
            with call(port) as talk:
                v1(talk)
            got = []
            while victim.poll(100):
                got.append(victim.recv_multipart())
            came += MESSAGE in got
        return came


def heard_by_v1(tries: int) -> int:
    with _open_socket(zmq.XPUB) as (victim, port):
        return sum(_hears(victim, port) for _ in range(tries))


def _hears(victim: zmq.Socket[bytes], port: int) -> bool:
    with call(port) as talk:
        talk.say(frames_v1([b""]) + frames_v1([b"\x01"]))
        while victim.poll(500) and victim.recv() != b"\x01":
            # one that was there before has gone
            continue
        victim.send_multipart(MESSAGE)
        end_s, message = time.monotonic() + 2.0, frames_v1(MESSAGE)
        while message not in talk.listen(0.02) and time.monotonic() < end_s:
            # it comes in pieces
            continue
        return message in talk.heard


@contextlib.contextmanager
def _open_socket(kind: int, prepare: Connected = lambda victim: None) -> Iterator[tuple[zmq.Socket[bytes], int]]:
    """A bound socket, and its port."""
    context = zmq.Context()
    victim = context.socket(kind)
    prepare(victim)
    port = victim.bind_to_random_port(f"tcp://{HOST}")
    try:
        yield victim, port
    finally:
        context.destroy(linger=0)


@contextlib.contextmanager
def _client(kind: int, port: int, prepare: Connected) -> Iterator[zmq.Socket[bytes]]:
    """A connected socket of libzmq."""
    context = zmq.Context()
    peer = context.socket(kind)
    peer.set(zmq.RECONNECT_IVL, 20)
    prepare(peer)
    peer.connect(f"tcp://{HOST}:{port}")
    try:
        yield peer
    finally:
        context.destroy(linger=0)


# --------------------------------------------------------------------------------------------------- on the exporter


def call_all(stand: Stand, attempts: Sequence[Script]) -> Outcome:
    got_in = closed = 0
    for script in attempts:
        with call(stand.port) as talk:
            script(talk)
            got_in += _is_in(talk)
            closed += talk.is_closed
    return len(attempts), got_in, f"closed {closed}"


def _is_in(talk: Talk) -> bool:
    """Whether a plain peer was talked to as one that has come in."""
    return any(word in talk.heard for word in (b"READY", TOPIC.encode()))


def strangers(stand: Stand, prepare: Connected, tries: int) -> Outcome:
    """Subscribe to all and send upwards, as libzmq does it."""
    got_in, events = 0, set()
    for _ in range(tries):
        with _client(zmq.XSUB, stand.port, prepare) as peer:
            monitor = peer.get_monitor_socket()
            peer.send(b"\x01")
            peer.send_multipart(MESSAGE)
            stand.turn(PATIENCE_S)
            seen = _events(monitor)
            got_in += bool(peer.poll(0)) or zmq.Event.HANDSHAKE_SUCCEEDED in seen
            events |= set(seen)
            peer.disable_monitor()
    return tries, got_in, _handshake_text(events)


def _events(monitor: zmq.Socket[bytes]) -> list[zmq.Event]:
    seen = []
    while monitor.poll(0):
        seen.append(zmq.Event(recv_monitor_message(monitor)["event"]))
    return seen


def _handshake_text(events: set[zmq.Event]) -> str:
    named = {
        zmq.Event.HANDSHAKE_FAILED_AUTH: "refused by the list",
        zmq.Event.HANDSHAKE_FAILED_PROTOCOL: "handshake refused",
        zmq.Event.HANDSHAKE_FAILED_NO_DETAIL: "closed in the handshake",
    }
    return ", ".join(text for event, text in named.items() if event in events) or "no handshake"


# ------------------------------------------------------------------------------------------------ leaving at once


def leave_raw(stand: Stand, count: int) -> Outcome:
    """Say a beginning and reset the connection, which the exporter then finds in the middle of a handshake."""
    heard = 0
    for index in range(count):
        with call(stand.port) as talk:
            talk.say(_BEGINNINGS[index % len(_BEGINNINGS)])
            talk.reset()
            heard += _is_in(talk)
        # who is not served all the while would not be noticed afterwards
        stand.turn(0.0)
    return count, heard, ""


def leave(stand: Stand, count: int, seed: int) -> Outcome:
    """Subscribe with a good key and go."""
    for life_s in np.random.default_rng(seed).uniform(0.0, LIFE_S, count):
        with _client(zmq.SUB, stand.port, lambda peer: stand.server.connect(peer, stand.greedy)) as peer:
            peer.subscribe(b"")
            stand.turn(life_s)
    return count, 0, ""


def cut_early(stand: Stand, count: int, seed: int) -> Outcome:
    """Cut the importer's connection as soon as it has come back, or a little later."""
    for life_s in np.random.default_rng(seed).uniform(0.0, LIFE_S, count):
        known = stand.proxy.passages
        stand.proxy.cut()
        stand.wait(lambda known=known: stand.proxy.passages > known, "the importer did not come back")
        stand.turn(life_s)
    return count, 0, ""


# -------------------------------------------------------------------------------------------------------- on the wire


def flip(stand: Stand, tries: int, seed: int) -> Outcome:
    """Change a bit in 4 KiB of what the exporter sends."""
    rng, flipped = np.random.default_rng(seed), 0

    def alter(data: bytes, from_server: bool, before: int) -> bytes:
        nonlocal flipped
        # the handshake passes, so that it is messages that are hit
        if not from_server or before < 1024:
            return data
        changed = bytearray(data)
        for at in range(int(rng.integers(0, 4096)), len(data), 4096):
            changed[at] ^= 1 << int(rng.integers(0, 8))
            flipped += 1
        return bytes(changed)

    before, passages = stand.altered, stand.proxy.passages
    stand.proxy.alter = alter
    stand.wait(lambda: flipped >= tries, "nothing was flipped")
    stand.turn(0.3)
    stand.proxy.alter = lambda data, from_server, before: data
    stand.proxy.cut()
    return flipped, stand.altered - before, f"{stand.proxy.passages - passages} new connections"


# ------------------------------------------------------------------------------------------- by those who are let in


def upward(stand: Stand, messages: Iterable[bytes], key: Keys | None = None) -> Outcome:
    """Accepted is what makes the exporter grow beyond its limit."""

    def prepare(peer: zmq.Socket[bytes]) -> None:
        stand.server.connect(peer, key or stand.evil)
        peer.set(zmq.SNDTIMEO, 2000)
        peer.set(zmq.SNDHWM, 1000)

    before, sent = stand.resident("export"), 0
    with _client(zmq.XSUB, stand.port, prepare) as peer:
        largest = before
        for message in messages:
            with contextlib.suppress(zmq.Again):
                peer.send(message)
            sent += 1
            if sent % 500 == 0:
                stand.turn(0.0)
                largest = max(largest, stand.resident("export"))
        stand.turn(0.5)
        grown = max(largest, stand.resident("export")) - before
    return sent, int(grown > GROWTH_LIMIT_BYTES), f"grew by {grown / MIB:.1f} MiB"


def lie(
    stand: Stand, messages: Sequence[Sequence[bytes]], clock_ns: Callable[[], int] = time.monotonic_ns, weight: int = 1
) -> Outcome:
    """Accepted are messages that reach the local graph, counted `weight` times."""
    before = stand.injected
    with _open_socket(zmq.XPUB, stand.server.serve) as (liar, port):
        stand.proxy.redirect(port)
        asked = 0

        def answer_up() -> bool:
            """Answer questions for the clock; whether the importer has subscribed."""
            nonlocal asked
            subscribed = False
            while liar.poll(0):
                said = liar.recv()
                subscribed |= said == b"\x01" + topic_frame(TOPIC)
                if said[:1] == b"\x02":
                    asked += 1
                    answer = struct.pack(">q", clock_ns())
                    liar.send_multipart([topic_frame("clock") + said[1:9], said[9:17], answer])
            return subscribed

        # it does not subscribe to whose clock it does not believe
        stand.wait(lambda: answer_up() or asked > 60, "the importer did not come back")
        for message in messages:
            liar.send_multipart(message)
            stand.turn(0.02)
            answer_up()
        stand.turn(0.3)
    stand.proxy.redirect(stand.port)
    return len(messages), weight * (stand.injected - before), ""


# -------------------------------------------------------------------------------------------------------------- flood


def half_open(stand: Stand, count: int) -> Outcome:
    """Connections that never end their handshake; the good peer, cut off meanwhile, has to come back among them."""
    before = at_most = stand.descriptors("export")
    with contextlib.ExitStack() as talks:
        for index in range(count):
            talk = talks.enter_context(call(stand.port))
            if index % 2:
                talk.say(greeting("CURVE"))
            if index % 50 == 0:
                stand.turn(0.0)
                at_most = max(at_most, stand.descriptors("export"))
        at_most = max(at_most, stand.descriptors("export"))
        stand.proxy.cut()
        served = stand.serves()
        start_s = time.monotonic()
        while stand.descriptors("export") > before + 10 and time.monotonic() - start_s < 2 * HANDSHAKE_LIMIT_S:
            stand.turn(0.2)
        emptied_s = time.monotonic() - start_s
    stayed = stand.descriptors("export") - before
    back = "came back meanwhile" if served else "DID NOT COME BACK meanwhile"
    text = f"{before} descriptors before, at most {at_most}, back after {emptied_s:.1f} s; good peer {back}"
    return count, max(0, stayed - 10) + (not served), text
