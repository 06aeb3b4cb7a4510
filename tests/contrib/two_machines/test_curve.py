"""Two ends of a link over loopback TCP with CURVE, each with a clock of its own: what comes, and what must not."""

from __future__ import annotations

import contextlib
import logging
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from contrib.two_machines.curve import CLOCK, MAX_A_TURN, STAMP, Monitor, queue_messages, waiting_on
from contrib.two_machines.exporter import Exporter
from contrib.two_machines.importer import Importer, Server
from contrib.two_machines.keys import KeyPair
from contrib.two_machines.peer_clock import shift_stamps
from msgs.bus.codec import decode, encode, topic_frame
from msgs.bus.interface import Envelope, Forwarded, Received
from msgs.bus.local import LocalNetwork
from msgs.bus.topics import TOPICS, topic_facts
from msgs.values.diagnostics import LogRecord
from msgs.values.vehicle import VehicleState
from tests.msgs.bus.test_codec import CASES, assert_same

#: Ends a test that hangs; every wait below ends as soon as what it waits for is there.
PATIENCE_S = 60.0
#: The peer was started so much before us.
AHEAD_NS = 10**15


def pair() -> KeyPair:
    return KeyPair(*zmq.curve_keypair())


OURS, THEIRS, STRANGER = pair(), pair(), pair()


def peer_ns() -> int:
    return time.monotonic_ns() + AHEAD_NS


class Bench:
    """Ends of links that are turned together."""

    def __init__(self) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        #: An authenticator, and so an exporter, has a context of its own.
        self.contexts = [self.context]
        #: Those that are turned, and all that are open.
        self.ends: list[Exporter | Importer] = []
        self._open: list[Exporter | Importer] = []
        self.came: list[Forwarded] = []

    def exporter(self, *topics: str, address: str = "tcp://127.0.0.1:*", **options: Any) -> Exporter:
        """The peer's end, which lets our key in."""
        options = {"own": THEIRS, "allowed": {OURS.public: "ours"}, "clock_ns": peer_ns, **options}
        self.contexts.append(zmq.Context())
        exporter = Exporter(self.contexts[-1], address, topics, **options)
        self.ends.append(exporter)
        self._open.append(exporter)
        return exporter

    def importer(self, address: str, *topics: str, server: bytes | None = THEIRS.public, **options: Any) -> Importer:
        """Our end."""
        importer = Importer(self.context, Server("sensor", address, server), topics, **{"own": OURS, **options})
        self.ends.append(importer)
        self._open.append(importer)
        return importer

    def until(self, done: Callable[[], object]) -> None:
        """Turn all ends until something holds."""
        deadline_s = time.monotonic() + PATIENCE_S
        poller = zmq.Poller()
        for end in self.ends:
            for source in end.sources:
                poller.register(source, zmq.POLLIN)
        while not done():
            assert time.monotonic() < deadline_s, "waited in vain"
            poller.poll(10)
            for end in self.ends:
                self.came += end.turn() or []

    def linked(self, *topics: str) -> tuple[Exporter, Importer]:
        """Both ends of a link that is up."""
        exporter = self.exporter(*topics)
        importer = self.importer(exporter.address, *topics)
        self.up(importer)
        return exporter, importer

    def up(self, importer: Importer) -> None:
        """Wait until messages flow: subscriptions have reached the other end with what the last turns answered."""
        self.until(lambda: not importer.trouble())
        importer.round_trips_ns()
        self.until(importer.round_trips_ns)

    def close(self, end: Exporter | Importer) -> None:
        self.ends.remove(end)
        self._open.remove(end)
        end.close()

    def end(self) -> None:
        """Close all that a test has left open, wherever it failed: a context waits for ever for an open socket."""
        with contextlib.ExitStack() as stack:
            for context in self.contexts:
                stack.callback(context.destroy, linger=0)
            for end in self._open:
                stack.callback(end.close)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    # what waits for seconds in a car need not do so here
    monkeypatch.setattr("contrib.two_machines.importer._CONNECT_AGAIN_NS", 300_000_000)
    monkeypatch.setattr("contrib.two_machines.importer._SETTLED_NS", 600_000_000)
    monkeypatch.setattr("contrib.two_machines.importer._PING_NS", 20_000_000)
    monkeypatch.setattr("contrib.two_machines.importer._FIRST_PING_NS", 15_000_000)
    monkeypatch.setattr("contrib.two_machines.exporter._STRANGER_NS", 50_000_000)
    bench = Bench()
    try:
        yield bench
    finally:
        bench.end()


def sent(topic: str, message: msgspec.Struct, sequence: int = 0, publisher: str = "node") -> Received:
    envelope = Envelope(publisher=publisher, topic=topic, sequence=sequence, sent_ns=peer_ns())
    return Received(topic, message, envelope)


def speed(sequence: int) -> Received:
    return sent("vehicle/state", VehicleState(stamp_ns=peer_ns(), speed_mps=float(sequence)), sequence)


def renamed(message: msgspec.Struct) -> msgspec.Struct:
    node = getattr(message, "node", None)
    return msgspec.structs.replace(message, node=f"sensor.{node}") if node else message


def test_every_message_of_every_topic_arrives_as_it_was_in_our_clock_and_under_its_peer_s_name(bench: Bench) -> None:
    exporter, importer = bench.linked(*TOPICS)
    originals = [sent(topic, shift_stamps(message, AHEAD_NS), number) for number, (topic, message) in enumerate(CASES)]
    # on a busy machine a later exchange may know the offset better
    offsets_ns = []
    for count, original in enumerate(originals, start=1):
        exporter.send(original)
        bench.until(lambda expected=count: len(bench.came) == expected)
        offsets_ns.append(importer.offset_ns())
    error_ns = importer.error_ns()
    assert error_ns is not None
    assert abs(offsets_ns[-1] - AHEAD_NS) <= error_ns
    for came, original, offset_ns in zip(bench.came, originals, offsets_ns, strict=True):
        got = decode(came.frames)
        assert_same(got.message, renamed(shift_stamps(original.message, -offset_ns)))
        assert got.envelope == came.envelope
        assert came.envelope.publisher == "sensor.node"
        assert came.envelope.sequence == original.envelope.sequence
        assert 0 <= came.envelope.sent_ns <= time.monotonic_ns()
        assert came.envelope.sent_ns <= original.envelope.sent_ns - offset_ns


def test_one_host_s_stamps_are_not_touched(bench: Bench) -> None:
    exporter = bench.exporter("vehicle/state", clock_ns=time.monotonic_ns)
    importer = bench.importer(exporter.address, "vehicle/state")
    bench.up(importer)
    exporter.send(sent("vehicle/state", VehicleState(stamp_ns=123), 4))
    bench.until(lambda: importer.rejected)
    # sent by a clock that is ahead of ours: from the future, where none was measured
    envelope = Envelope(publisher="node", topic="vehicle/state", sequence=5, sent_ns=time.monotonic_ns())
    exporter.send(Received("vehicle/state", VehicleState(stamp_ns=123), envelope))
    bench.until(lambda: bench.came)
    assert importer.offset_ns() == 0
    assert decode(bench.came[0].frames).message == VehicleState(stamp_ns=123)
    assert bench.came[0].envelope.sent_ns == envelope.sent_ns


def test_who_joins_late_gets_what_is_latched_of_every_publisher(bench: Bench) -> None:
    exporter = bench.exporter("radar/setup", "vehicle/state")
    setup = dict(CASES)["radar/setup"]
    for publisher in ("front", "rear"):
        exporter.send(sent("radar/setup", setup, publisher=publisher))
    exporter.send(speed(0))
    for expected in (2, 4):
        bench.importer(exporter.address, "radar/setup", "vehicle/state")
        bench.until(lambda count=expected: len(bench.came) == count)
        assert {one.envelope.publisher for one in bench.came[-2:]} == {"sensor.front", "sensor.rear"}
        assert {one.topic for one in bench.came} == {"radar/setup"}
    # who spoke last comes last: a receiver goes by that set-up
    exporter.send(sent("radar/setup", setup, 1, "front"))
    bench.until(lambda: len(bench.came) == 6)
    bench.importer(exporter.address, "radar/setup")
    bench.until(lambda: len(bench.came) == 8)
    assert [one.envelope.publisher for one in bench.came[-2:]] == ["sensor.rear", "sensor.front"]


@pytest.mark.parametrize(
    ("own", "server"),
    [
        pytest.param(STRANGER, THEIRS.public, id="client not in the list"),
        pytest.param(OURS, STRANGER.public, id="not the server that was meant"),
        pytest.param(KeyPair(OURS.public, STRANGER.secret), THEIRS.public, id="a secret that is not the key's"),
        pytest.param(None, None, id="no key at all"),
    ],
)
def test_wrong_keys_are_refused_and_counted(
    bench: Bench, caplog: pytest.LogCaptureFixture, own: KeyPair | None, server: bytes | None
) -> None:
    exporter = bench.exporter("vehicle/state")
    stranger = bench.importer(exporter.address, "vehicle/state", own=own, server=server)
    bench.until(lambda: exporter.refused)
    assert stranger.trouble().startswith("sensor: no word yet")
    # the right one is let in beside it, and alone gets what is sent
    importer = bench.importer(exporter.address, "vehicle/state")
    bench.up(importer)
    exporter.send(speed(0))
    bench.until(lambda: bench.came)
    assert len(bench.came) == 1
    assert stranger.trouble().startswith("sensor: no word yet")
    assert [record for record in caplog.records if "refused" in record.message]


def test_who_says_nothing_takes_half_of_the_descriptors_at_most(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of six, three connections may wait without a word; a fourth is closed and those before it stay."""
    monkeypatch.setattr("contrib.two_machines.exporter.raise_open_files", lambda: 6)
    monkeypatch.setattr("contrib.two_machines.exporter._STRANGER_NS", 10**12)
    exporter = bench.exporter("vehicle/state")
    host, port = exporter.address.removeprefix("tcp://").split(":")
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(4)]
        for connection in silent:
            connection.setblocking(False)

        def is_closed(connection: socket.socket) -> bool:
            with contextlib.suppress(BlockingIOError):
                while connection.recv(64):
                    pass
                return True
            return False

        bench.until(lambda: is_closed(silent[3]))
        assert [is_closed(connection) for connection in silent] == [False, False, False, True]


def test_zmtp_1_0_injects_nothing_into_an_end_without_keys(bench: Bench) -> None:
    """Without a ZAP domain that protocol, which knows no security, would be spoken to."""
    exporter = bench.exporter("vehicle/state", own=None, allowed=None)
    host, port = exporter.address.removeprefix("tcp://").split(":")
    with contextlib.closing(socket.create_connection((host, int(port)))) as plain:
        # ZMTP 1.0: an empty identity, a subscription to everything, a message
        plain.sendall(b"\x01\x00" + b"\x02\x00\x01" + b"\x09\x00injected")
        bench.until(lambda: exporter.refused)
    assert exporter.rejected == 0
    importer = bench.importer(exporter.address, "vehicle/state", own=None, server=None)
    bench.up(importer)


class Liar:
    """A server with the right keys that says what it likes."""

    def __init__(self, bench: Bench) -> None:
        self.exporter = bench.exporter("vehicle/state", "log")

    def say(self, *frames: bytes) -> None:
        self.exporter._socket.send_multipart(frames)


def test_what_was_not_asked_for_and_what_is_nobody_s_is_rejected(bench: Bench) -> None:
    liar = Liar(bench)
    importer = bench.importer(liar.exporter.address, "log")
    bench.up(importer)
    record = LogRecord(stamp_ns=1, node="a", level="info", text="x")
    # ZeroMQ sends what was subscribed only; the first byte of the name is enough for a prefix
    importer._socket.send(b"\x01")
    bench.up(importer)
    # as large as allowed, and larger once our name for the peer is in it
    largest = msgspec.structs.replace(record, text="")
    room = topic_facts("log").max_bytes - sum(
        len(part) for part in encode(*_packed(sent("log", largest, publisher="c")))
    )
    largest = msgspec.structs.replace(record, text="x" * (room - 2))
    cases: list[list[Any]] = [
        encode(*_packed(speed(0))),
        [b"vehicle/state\0"],
        [topic_frame("log"), b"\xff garbage"],
        [topic_frame("log"), *encode(*_packed(speed(1)))[1:]],
        encode(*_packed(sent("log", record, publisher="far.away"))),
        encode(*_packed(sent("log", record, publisher="a\x1b[2J"))),
        encode(*_packed(sent("log", msgspec.structs.replace(record, node="our.own"), publisher="b"))),
        encode(*_packed(sent("log", largest, publisher="c"))),
    ]
    for number, frames in enumerate(cases, start=1):
        liar.say(*frames)
        bench.until(lambda count=number: importer.rejected == count)
    assert not bench.came
    liar.exporter.send(sent("log", record, publisher="c", sequence=9))
    bench.until(lambda: bench.came)
    assert not importer.trouble()


def _packed(received: Received) -> tuple[Envelope, msgspec.Struct]:
    return received.envelope, received.message


def test_what_is_too_large_ends_the_connection_and_the_link_comes_back(bench: Bench) -> None:
    liar = Liar(bench)
    importer = bench.importer(liar.exporter.address, "log")
    bench.up(importer)
    liar.say(topic_frame("log"), bytes(topic_facts("log").max_bytes + 100))
    bench.until(importer.trouble)
    bench.up(importer)
    liar.exporter.send(sent("log", LogRecord(stamp_ns=1, node="a", level="info", text="x")))
    bench.until(lambda: bench.came)


def test_an_importer_cannot_publish(bench: Bench) -> None:
    exporter, importer = bench.linked("vehicle/state")
    before = exporter.refused
    importer._socket.send_multipart([bytes(part) for part in encode(*_packed(speed(0)))])
    importer._socket.send(b"\x02 no question")
    bench.until(lambda: exporter.rejected >= 2)
    # beyond what a question can have: cut off
    importer._socket.send(bytes([2]) * 5000)
    bench.until(importer.trouble)
    bench.up(importer)
    assert exporter.refused >= before


def test_what_is_lost_while_the_link_is_cut_is_counted_and_said(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    exporter, importer = bench.linked("vehicle/state", "log")
    exporter.send(speed(0))
    bench.until(lambda: len(bench.came) == 1)
    bench.close(exporter)
    bench.until(importer.trouble)
    assert importer.trouble().startswith("sensor: no word for ")
    again = bench.exporter("vehicle/state", "log", address=exporter.address)
    for number in range(1, 8):
        again.send(speed(number))
    bench.up(importer)
    again.send(speed(8))
    bench.until(lambda: len(bench.came) == 2)
    assert bench.came[-1].envelope.sequence == 8
    assert importer.lost() == {"log": 0, "vehicle/state": 7}
    bench.until(lambda: "lost 7 of vehicle/state" in caplog.text)
    # who listens here counts them too: the numbers are those of the origin
    network = LocalNetwork(start_ns=time.monotonic_ns())
    here, listener = network.bus("link"), network.bus("listener")
    listener.subscribe("vehicle/state")
    for message in bench.came:
        here.forward(message)
    listener.receive(0.0)
    assert [count.lost for count in listener.counts()[0]] == [7]
    assert [count.messages for count in here.counts()[1]] == [2]


def test_a_peer_that_starts_again_with_an_earlier_clock_is_heard(bench: Bench) -> None:
    exporter, importer = bench.linked("vehicle/state")
    exporter.send(speed(1000))
    bench.until(lambda: len(bench.came) == 1)
    bench.close(exporter)
    bench.until(importer.trouble)
    again = bench.exporter("vehicle/state", address=exporter.address, clock_ns=time.monotonic_ns)
    bench.up(importer)
    envelope = Envelope(publisher="node", topic="vehicle/state", sequence=0, sent_ns=time.monotonic_ns())
    again.send(Received("vehicle/state", VehicleState(stamp_ns=5), envelope))
    bench.until(lambda: len(bench.came) == 2)
    assert importer.lost() == {"vehicle/state": 0}


def test_answers_that_a_lost_connection_left_behind_say_nothing_of_the_next(bench: Bench) -> None:
    """They may be those of another life of the peer, with another clock."""
    _, importer = bench.linked("vehicle/state")
    importer._pings.clear()
    importer._ping(time.monotonic_ns())
    (number,) = importer._pings
    answer: list[Any] = [CLOCK + importer._id, number, STAMP.pack(peer_ns())]
    importer._end_imports()
    importer._take(answer)
    assert importer._answers == 0
    importer._ping(time.monotonic_ns())
    (number,) = importer._pings
    importer._take([CLOCK + importer._id, number, STAMP.pack(peer_ns())])
    assert importer._answers == 1


def test_what_was_imported_is_not_exported_again(bench: Bench) -> None:
    exporter, _ = bench.linked("vehicle/state")
    exporter.send(sent("vehicle/state", VehicleState(stamp_ns=1), publisher="third.node"))
    exporter.send(speed(0))
    bench.until(lambda: bench.came)
    assert [one.envelope.publisher for one in bench.came] == ["sensor.node"]


def ra_map(sequence: int) -> Received:
    return sent("radar/ra_map", shift_stamps(dict(CASES)["radar/ra_map"], AHEAD_NS), sequence)


def test_a_reader_that_was_slow_gets_the_newest_next_and_the_rest_is_counted_at_both_ends(bench: Bench) -> None:
    exporter, importer = bench.linked("radar/ra_map", "vehicle/state")
    # meanwhile the reader takes nothing; vehicle states are not newest-only and wait in order
    for number in range(20):
        exporter.send(ra_map(number))
        exporter.send(speed(number))
    bench.until(lambda: len(bench.came) == 22)
    sequences = [message.envelope.sequence for message in bench.came if message.topic == "radar/ra_map"]
    assert sequences == [0, 19]
    assert exporter.superseded() == {"radar/ra_map": 18}
    assert importer.lost() == {"radar/ra_map": 18, "vehicle/state": 0}
    exporter.send(ra_map(20))
    bench.until(lambda: len(bench.came) == 23)
    assert importer.lost() == {"radar/ra_map": 18, "vehicle/state": 0}


def test_a_message_that_a_full_queue_dropped_holds_up_none_after_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    exporter, _ = bench.linked("radar/ra_map")
    with monkeypatch.context() as full:
        full.setattr(exporter._newest, "_send", lambda frames: None)
        exporter.send(ra_map(0))
    exporter.send(ra_map(1))
    bench.until(lambda: bench.came)
    assert [message.envelope.sequence for message in bench.came] == [1]


def test_a_peer_that_knows_no_acknowledgements_gets_all_in_order(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two hosts may have different versions."""
    monkeypatch.setattr("contrib.two_machines.importer.NEWEST", topic_frame("unheard"))
    exporter, importer = bench.linked("radar/ra_map")
    for number in range(5):
        exporter.send(ra_map(number))
    bench.until(lambda: len(bench.came) == 5)
    assert exporter.superseded() == {}
    assert importer.rejected == 0


def test_maps_come_again_after_a_cut_with_one_on_its_way(bench: Bench) -> None:
    exporter, importer = bench.linked("radar/ra_map")
    exporter.send(ra_map(0))
    exporter.send(ra_map(1))
    bench.close(exporter)
    bench.until(importer.trouble)
    again = bench.exporter("radar/ra_map", address=exporter.address)
    bench.up(importer)
    bench.came.clear()
    again.send(ra_map(2))
    bench.until(lambda: bench.came)
    assert [message.envelope.sequence for message in bench.came] == [2]


def test_queues_are_bounded_by_the_history_of_their_topics() -> None:
    def facts(*topics: str) -> list[Any]:
        return [topic_facts(topic) for topic in topics]

    # 4 KiB 50 times a second: all of a history of 1 MiB
    assert queue_messages(facts("vehicle/state")) == 256
    # a map is 4 MiB at most, its history four of them: no less than a turn's burst
    assert queue_messages(facts("radar/ra_map")) == 64
    assert queue_messages(facts("log")) == 64
    assert queue_messages(facts("vehicle/state", "radar/ra_map")) == pytest.approx(17 * 2**20 / 0.253 / 2**20, rel=0.02)


def test_a_flood_of_connection_events_is_taken_in_turns(bench: Bench, tmp_path: Path) -> None:
    """One event for each address it is bound to: a turn takes `MAX_A_TURN`, the next ones the rest; none is lost."""
    with bench.context.socket(zmq.PULL) as flooded:
        monitor = Monitor(flooded, zmq.EVENT_LISTENING)
        for number in range(MAX_A_TURN + 6):
            flooded.bind(f"ipc://{tmp_path}/{number}")
        turns: list[int] = []

        def came_all() -> bool:
            turns.append(len(monitor.events()))
            return sum(turns) == MAX_A_TURN + 6

        bench.until(came_all)
        monitor.close()
    assert max(turns) == MAX_A_TURN


def test_wrong_ends_are_refused_by_one_line(bench: Bench) -> None:
    with pytest.raises(ValueError, match="belong together"):
        bench.exporter("log", allowed=None)
    with pytest.raises(ValueError, match="unknown topic 'logg'"):
        bench.exporter("logg")
    with pytest.raises(ValueError, match="belong together"):
        bench.importer("tcp://127.0.0.1:1", "log", server=None)
    with pytest.raises(ValueError, match=r"sensor: tcp://nonsense: "):
        bench.importer("tcp://nonsense", "log")
    taken = bench.exporter("log")
    with pytest.raises(OSError, match=f"{taken.address}: Address already in use"):
        bench.exporter("log", address=taken.address)


def test_arrays_arrive_aligned(bench: Bench) -> None:
    exporter, _ = bench.linked("radar/ra_map")
    exporter.send(sent("radar/ra_map", shift_stamps(dict(CASES)["radar/ra_map"], AHEAD_NS)))
    bench.until(lambda: bench.came)
    values = decode([bytes(frame) for frame in bench.came[0].frames]).message.values  # type: ignore[attr-defined]
    assert isinstance(values, np.ndarray)
    assert values.flags.aligned


def test_a_peer_that_pauses_is_said_to_be_silent_and_nothing_is_lost(
    bench: Bench, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process waits for a core or is busy: the connection stands, and what waits there comes."""
    monkeypatch.setattr("contrib.two_machines.importer._SILENCE_NS", 200_000_000)
    # what comes is all there, whenever the link asks
    monkeypatch.setattr("contrib.two_machines.importer._SETTLED_NS", 50_000_000)
    exporter, importer = bench.linked("vehicle/state")
    exporter.send(speed(0))
    bench.until(lambda: bench.came)
    bench.ends.remove(exporter)
    bench.until(importer.trouble)
    assert importer.trouble().startswith("sensor: no word for ")
    bench.ends.append(exporter)
    for number in range(1, 100):
        exporter.send(speed(number))
    bench.until(lambda: len(bench.came) == 100)
    bench.until(lambda: "lost nothing" in caplog.text)
    # until the next silence of one that gets no core
    bench.until(lambda: not importer.trouble())


def test_a_flood_is_taken_in_turns() -> None:
    """100 messages wait: 64 in one turn, so that other peers and the clock get theirs, the rest in the next."""
    with zmq.Context() as context, context.socket(zmq.PAIR) as flood, context.socket(zmq.PAIR) as taker:
        taker.bind("inproc://flood")
        flood.connect("inproc://flood")
        for number in range(100):
            flood.send(bytes([number]))
        turns = [[parts[0].bytes[0] for parts in waiting_on(taker)] for _ in range(3)]
    assert turns == [list(range(64)), list(range(64, 100)), []]
