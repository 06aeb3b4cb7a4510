"""Attacks on a link between two hosts: its exporting side, its importing side, and the wire between them.

Both sides are real processes; the good peer, importing from the exporting side through a proxy, must be served after
every attack. What an attack is worth is shown by controls first: the same tools on sockets without keys.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import zmq
from zmq.utils.monitor import recv_monitor_message

from benchmarks.transport.link_stand import SECRET_TOPIC, Keys, Stand
from benchmarks.transport.net import HOST, Row, Script, Talk, answer, call, command, frames_v1, greeting, ready
from benchmarks.transport.raw_peers import MESSAGE, TOPIC, drip, injected, scripts, v1
from msgs.bus.codec import topic_frame
from msgs.bus.topics import MIB, TOPICS

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
_REFUSED = zmq.Event.HANDSHAKE_FAILED_PROTOCOL


def rows(tries: int, seed: int, flood: int, subscriptions: int, hangups: int) -> Iterator[Row]:
    """The controls, then all attacks on one link."""
    yield from _controls(tries)
    with Stand() as stand:
        yield from _on_exporter(stand, tries, seed)
        yield from _on_importer(stand, tries, seed)
        yield from _leaving(stand, hangups, seed)
        yield from _on_the_wire(stand, tries, seed)
        yield from _by_allowed_importer(stand, tries, seed, subscriptions)
        yield from _by_allowed_exporter(stand, tries)
        yield _row(stand, "export", f"{flood} connections that say nothing", lambda: half_open(stand, flood))


def _row(stand: Stand, victim: str, attack: str, act: Callable[[], Outcome]) -> Row:
    stand.note()
    tried, accepted, did = act()
    serves = stand.serves()
    return Row(victim, attack, tried, accepted, "; ".join(filter(None, [did, stand.said(victim)])), serves)


# ----------------------------------------------------------------------------------------------------------- controls


def _controls(tries: int) -> Iterator[Row]:
    """What the tools do to sockets that have no keys, or no list of who may come in."""
    name = "ZMTP 1.0, frames without handshake"
    yield Row("control", f"{name}: into a SUB without keys", tries, injected_by_v1(tries), "", True, True)
    yield Row("control", f"{name}: out of a PUB without keys", tries, heard_by_v1(tries), "", True, True)
    name = "a key that nobody knows: out of a CURVE server without a list"
    yield Row("control", name, tries, _heard_without_list(tries), "", True, True)


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


def _heard_without_list(tries: int) -> int:
    keys = Keys.fresh()
    with _open_socket(zmq.XPUB, keys.serve) as (victim, port):
        came = 0
        for _ in range(tries):
            with _client(zmq.SUB, port, lambda peer: keys.connect(peer, Keys.fresh())) as peer:
                peer.subscribe(b"")
                while victim.poll(5000) and victim.recv() != b"\x01":
                    # one that was there before has gone
                    continue
                victim.send_multipart(MESSAGE)
                came += bool(peer.poll(5000))
        return came


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


def _on_exporter(stand: Stand, tries: int, seed: int) -> Iterator[Row]:
    for name, attempts in scripts(tries, seed, as_publisher=False):
        yield _row(stand, "export", name, lambda attempts=attempts: call_all(stand, attempts))
    yield _row(stand, "export", "greeting of one byte a second", lambda: _drips(stand))
    kinds: dict[str, Connected] = {
        "libzmq, NULL": lambda peer: None,
        "libzmq, PLAIN": _plain,
        "libzmq, CURVE, wrong server key": lambda peer: Keys.fresh().connect(peer, stand.good),
        "libzmq, CURVE, right server key, unlisted own key": lambda peer: stand.server.connect(peer, Keys.fresh()),
    }
    for name, prepare in kinds.items():
        yield _row(stand, "export", name, lambda prepare=prepare: strangers(stand, prepare, tries))


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


def _drips(stand: Stand) -> Outcome:
    with call(stand.port) as talk:
        lasted_s = drip(talk, patience_s=2 * HANDSHAKE_LIMIT_S)
        return 1, int(lasted_s > HANDSHAKE_LIMIT_S), f"closed after {lasted_s:.1f} s"


def _plain(peer: zmq.Socket[bytes]) -> None:
    peer.plain_username, peer.plain_password = b"root", b"root"


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


# --------------------------------------------------------------------------------------------------- on the importer


def _on_importer(stand: Stand, tries: int, seed: int) -> Iterator[Row]:
    """Somebody else answers where peers are expected; one node imports from all of them and from the good one."""
    _, to_client = _record(stand)
    plain_ones = dict(scripts(tries, seed + 1, as_publisher=True)) | {
        "replay of a good server's bytes": [_replayed(to_client)] * tries
    }
    sockets: dict[str, Connected] = {
        "libzmq, NULL": lambda victim: None,
        "libzmq, PLAIN": lambda victim: victim.set(zmq.PLAIN_SERVER, 1),
        "libzmq, CURVE, a key of its own": lambda victim: Keys.fresh().serve(victim),
    }
    with contextlib.ExitStack() as stack:
        crowd = {name: stack.enter_context(_scripted(attempts)) for name, attempts in plain_ones.items()}
        crowd |= {name: stack.enter_context(_served(prepare)) for name, prepare in sockets.items()}
        peers = {f"i{index}": (name, impostor) for index, (name, impostor) in enumerate(crowd.items())}
        ports = {peer: impostor.port for peer, (_, impostor) in peers.items()}
        beset = stack.enter_context(stand.importer(ports))
        goal = {name: min(tries, len(plain_ones.get(name, ())) or tries) for name in crowd}
        stand.wait(
            lambda: all(impostor.tried() >= goal[name] for name, impostor in crowd.items()),
            "the importer has not come back often enough",
        )
        stand.turn(1.0)
        served = beset.serves(stand)
        for peer, (name, impostor) in peers.items():
            said = beset.of_peer(peer)
            yield Row(
                "import", f"impostor: {name}", impostor.tried(), beset.came[peer], said, served and stand.serves()
            )


class _Impostor(NamedTuple):
    """Where it listens, and how many connections it has answered to the end."""

    port: int
    tried: Callable[[], int]


def _replayed(data: bytes) -> Script:
    def script(talk: Talk) -> None:
        talk.say(data)
        talk.listen(0.2)

    return script


@contextlib.contextmanager
def _scripted(attempts: Sequence[Script]) -> Iterator[_Impostor]:
    """A plain impostor, one script a connection."""
    left, done = list(attempts), []

    def script(talk: Talk) -> None:
        if left:
            left.pop()(talk)
            done.append(talk)

    with answer(script) as port:
        yield _Impostor(port, lambda: len(done))


@contextlib.contextmanager
def _served(prepare: Connected) -> Iterator[_Impostor]:
    """An impostor of libzmq that sends to whoever it let in, from a thread of its own."""
    seen: list[zmq.Event] = []
    stop = threading.Event()
    with _open_socket(zmq.XPUB, prepare) as (impostor, port):

        def serve() -> None:
            monitor = impostor.get_monitor_socket()
            while not stop.wait(0.02):
                impostor.send_multipart(injected(sent_ns=time.monotonic_ns(), stamp_ns=time.monotonic_ns()))
                seen.extend(_events(monitor))
            impostor.disable_monitor()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield _Impostor(port, lambda: seen.count(zmq.Event.DISCONNECTED) + seen.count(_REFUSED))
        finally:
            stop.set()
            thread.join()


# ------------------------------------------------------------------------------------------------ leaving at once


def _leaving(stand: Stand, count: int, seed: int) -> Iterator[Row]:
    few = max(1, count // 50)
    yield _row(stand, "export", "peers that leave at once: raw", lambda: leave_raw(stand, count))
    yield _row(
        stand, "export", "peers that leave at once: on the list, after 0 to 50 ms", lambda: leave(stand, few, seed)
    )
    yield _row(stand, "import", "the exporter's connection cut after 0 to 50 ms", lambda: cut_early(stand, few, seed))


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
        known = len(stand.proxy.passages)
        stand.proxy.cut()
        stand.wait(lambda known=known: len(stand.proxy.passages) > known, "the importer did not come back")
        stand.turn(life_s)
    return count, 0, ""


# -------------------------------------------------------------------------------------------------------- on the wire


def _on_the_wire(stand: Stand, tries: int, seed: int) -> Iterator[Row]:
    yield _row(stand, "export", "replay of a good client's bytes", lambda: _replay_to_exporter(stand, tries))
    yield _row(stand, "import", "one bit in 4 KiB flipped in flight", lambda: flip(stand, tries, seed, True))
    yield _row(stand, "export", "one bit of the importer's bytes flipped", lambda: flip(stand, tries, seed, False))
    yield _row(stand, "import", "plaintext on the wire (eavesdropper)", lambda: _eavesdrop(stand))


def _record(stand: Stand) -> tuple[bytes, bytes]:
    """All bytes of a good session of more than a second, to the server and to the client."""
    count = len(stand.proxy.passages)
    stand.proxy.is_recording = True
    stand.proxy.cut()
    stand.wait(lambda: len(stand.proxy.passages) > count, "the importer did not come back")
    assert stand.serves()
    stand.turn(1.0)
    stand.proxy.is_recording = False
    passage = max(stand.proxy.passages[count:], key=lambda passage: len(passage.to_client))
    return bytes(passage.to_server), bytes(passage.to_client)


def _replay_to_exporter(stand: Stand, tries: int) -> Outcome:
    to_server, _ = _record(stand)
    got_in = closed = 0
    for _ in range(tries):
        with call(stand.port) as talk:
            talk.say(to_server)
            talk.listen(0.5)
            # greeting and WELCOME (64 + 2 + 168 bytes) answer a HELLO; READY and messages answer who was let in
            got_in += len(talk.heard) > 64 + 2 + 168
            closed += talk.is_closed
    return tries, got_in, f"{len(to_server)} bytes, closed {closed}"


def flip(stand: Stand, tries: int, seed: int, of_server: bool) -> Outcome:
    rng, flipped = np.random.default_rng(seed), 0

    def alter(data: bytes, from_server: bool, before: int) -> bytes:
        nonlocal flipped
        # the handshake passes, so that it is messages that are hit
        if from_server != of_server or before < 1024:
            return data
        changed = bytearray(data)
        for at in range(int(rng.integers(0, 4096 if of_server else 64)), len(data), 4096):
            changed[at] ^= 1 << int(rng.integers(0, 8))
            flipped += 1
        return bytes(changed)

    before, passages = stand.altered, len(stand.proxy.passages)
    stand.proxy.alter = alter
    if not of_server:
        stand.proxy.cut()
    stand.wait(lambda: flipped >= tries, "nothing was flipped")
    stand.turn(0.3)
    stand.proxy.alter = lambda data, from_server, before: data
    stand.proxy.cut()
    return flipped, stand.altered - before, f"{len(stand.proxy.passages) - passages} new connections"


def _eavesdrop(stand: Stand) -> Outcome:
    _, to_client = _record(stand)
    words = [TOPIC.encode(), b"speed_mps", b"player"]
    return len(words), sum(word in to_client for word in words), f"{len(to_client)} bytes looked through"


# ------------------------------------------------------------------------------------------- by those who are let in


def _by_allowed_importer(stand: Stand, tries: int, seed: int, subscriptions: int) -> Iterator[Row]:
    """A peer on the list that wants more than is exported, or sends what it should not."""
    rng = np.random.default_rng(seed)
    wanted = [name.encode() for name in TOPICS]
    noise = [bytes([2]) + rng.bytes(int(rng.integers(0, 60))) for _ in range(100 * tries)]
    many = (b"\x01" + rng.bytes(50) for _ in range(subscriptions))
    # much longer ones end the process of the attacker: libzmq walks its own list of them by recursion
    longest = (b"\x01" + rng.bytes(5000) for _ in range(20))
    yield _row(stand, "export", "allowed peer: asks for what is not exported", lambda: ask(stand, wanted))
    yield _row(stand, "export", "allowed peer: garbage upwards", lambda: upward(stand, noise))
    big = [b"\x02" + bytes(size) for size in (1 << 16, 1 << 20, 1 << 24)]
    yield _row(stand, "export", "allowed peer: oversize upwards", lambda: upward(stand, big))
    flood = (b"\x02ping" for _ in range(subscriptions))
    yield _row(stand, "export", f"allowed peer: {subscriptions} messages upwards", lambda: upward(stand, flood))
    yield _row(stand, "export", "allowed peer: subscriptions of 5 kB", lambda: upward(stand, longest))
    yield _row(
        stand, "export", f"allowed peer: {subscriptions} subscriptions", lambda: upward(stand, many, stand.greedy)
    )


def ask(stand: Stand, wanted: Sequence[bytes]) -> Outcome:
    """Accepted is what comes and is not exported; that the exported comes shows that the peer was let in."""
    heard: list[bytes] = []
    with _client(zmq.XSUB, stand.port, lambda peer: stand.server.connect(peer, stand.evil)) as peer:
        for prefix in [b"", *wanted]:
            peer.send(b"\x01" + prefix)

        def exported_came() -> bool:
            while peer.poll(0):
                heard.append(b"".join(peer.recv_multipart()))
            return any(TOPIC.encode() in message for message in heard)

        stand.wait(exported_came, "the allowed peer got nothing")
        stand.turn(1.0)
        exported_came()
    leaked = sum(SECRET_TOPIC.encode() in message for message in heard)
    return len(wanted), leaked, f"{len(heard)} messages of what is exported"


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


def _by_allowed_exporter(stand: Stand, tries: int) -> Iterator[Row]:
    """Whoever holds the exporter's secret key speaks to the importer: within its own names it may say anything."""
    for name, messages in stand.lies(tries).items():
        yield _row(stand, "import", f"true key: {name}", lambda messages=messages: lie(stand, messages))
    backwards = itertools.count(10**18, -36 * 10**11)
    clocks: dict[str, Callable[[], int]] = {
        "a clock of 2^62 ns": lambda: 1 << 62,
        "a clock that runs back by an hour an answer": lambda: next(backwards),
        "a negative clock": lambda: -1,
    }
    true = [injected("intruder", sequence, 1, 1) for sequence in range(tries)]
    for name, clock in clocks.items():
        yield _row(stand, "import", f"true key: {name}", lambda clock=clock: lie(stand, true, clock, 0))
    own = [injected("other", sequence, sent_ns=1 + sequence) for sequence in range(tries)]
    row = _row(stand, "import", "true key: well-made messages of its own (border of trust)", lambda: lie(stand, own))
    yield row._replace(by_design=True)


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
