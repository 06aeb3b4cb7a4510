"""The live bus, over real sockets: discovery, late joiners, restarts, losses, garbage. Waits end early."""

from __future__ import annotations

import errno
import os
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import chain, count
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import zmq

from mirrorwave.diagnose.foreign_topic import ForeignBus
from msgs.bus.interface import Received
from msgs.bus.topics import TOPICS
from msgs.bus.zmq import ZmqBus, list_publishers, run_dir, socket_path
from msgs.values.diagnostics import LogRecord, TopicCount
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.vehicle import VehicleState
from tests.builders import example_beam
from tests.msgs.bus.test_local import peaks

#: Ends a test that hangs; every wait below normally ends within some 50 ms.
PATIENCE_S = 60.0


@pytest.fixture
def meeting() -> Iterator[Path]:
    # pytest's own folders are too deep for a socket address
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder) / "domain"


def state(stamp_ns: int) -> VehicleState:
    return VehicleState(stamp_ns=stamp_ns)


def beam(index: int) -> RadarBeam:
    return example_beam(
        stamp_ns=index, beam_index=index, beam_count=1000, samples=np.full((128, 8192, 2), index, np.int16)
    )


def stamps(received: list[Received]) -> list[int]:
    return [message.message.stamp_ns for message in received]  # type: ignore[attr-defined]


def until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def collect(bus: ZmqBus, count: int) -> list[Received]:
    """At least `count` messages of a bus."""
    received: list[Received] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(received) < count:
        assert time.monotonic() < deadline, f"{len(received)} of {count} messages came"
        received += bus.receive(0.2)
    return received


def count_of(bus: ZmqBus, topic: str) -> TopicCount:
    return next(count for count in bus.counts()[0] if count.topic == topic)


def connect(sender: ZmqBus, receiver: ZmqBus, topic: str, make: Callable[[int], object]) -> int:
    """Publish until the last that was sent has come, so that no message is on its way; returns how many were sent.

    On a machine that leaves no time to the threads of libzmq some may be lost meanwhile.
    """
    receiver.subscribe(topic)
    sent, last = 0, -1
    deadline = time.monotonic() + PATIENCE_S
    while sent == 0 or last < sent - 1:
        assert time.monotonic() < deadline, "never connected"
        received = receiver.receive(0.02)
        last = max((message.envelope.sequence for message in received), default=last)
        if not received:
            sender.publish(topic, make(sent))  # type: ignore[arg-type]
            sent += 1
    return sent


def test_messages_arrive_in_order_and_whole(meeting: Path) -> None:
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        sent = connect(sender, receiver, "radar/beam", beam)
        lost = count_of(receiver, "radar/beam").lost
        for index in range(sent, sent + 25):
            sender.publish("radar/beam", beam(index))
        received = collect(receiver, 25)
        assert stamps(received) == list(range(sent, sent + 25))
        for message in received:
            samples = message.message.samples  # type: ignore[attr-defined]
            assert not samples.flags.writeable
            assert (samples == message.message.stamp_ns).all()  # type: ignore[attr-defined]
        count = count_of(receiver, "radar/beam")
        assert (count.lost, count.rejected) == (lost, 0)
        assert sender.counts()[1][0].messages == sent + 25


def test_run_dir_is_private_and_publishers_are_listed(meeting: Path) -> None:
    assert list_publishers(meeting) == []
    with closing(ZmqBus("sender", meeting)) as sender:
        assert stat.S_IMODE(meeting.stat().st_mode) == 0o700
        sender.advertise("vehicle/state")
        sender.advertise("log")
        assert list_publishers(meeting) == [("log", "sender"), ("vehicle/state", "sender")]
    until(lambda: list_publishers(meeting) == [])


def test_latched_topic_serves_late_joiners_while_publisher_only_receives(meeting: Path) -> None:
    with closing(ZmqBus("sender", meeting)) as sender:
        sender.publish("radar/setup", RadarSetup(stamp_ns=4))
        for node in ("first", "second"):
            with closing(ZmqBus(node, meeting)) as receiver:
                receiver.subscribe("radar/setup")
                got: list[Received] = []
                deadline = time.monotonic() + PATIENCE_S
                while not got and time.monotonic() < deadline:
                    sender.receive(0.01)
                    got = receiver.receive(0.01)
                assert stamps(got) == [4]


def test_resent_latched_message_is_not_delivered_twice(meeting: Path) -> None:
    with (
        closing(ZmqBus("sender", meeting)) as sender,
        closing(ZmqBus("early", meeting)) as early,
        closing(ZmqBus("late", meeting)) as late,
    ):
        sender.publish("radar/setup", RadarSetup(stamp_ns=4))
        got: dict[str, list[int]] = {"early": [], "late": []}

        def serve(node: str, bus: ZmqBus) -> bool:
            sender.receive(0.01)
            got[node] += stamps(bus.receive(0.01))
            return bool(got[node])

        early.subscribe("radar/setup")
        until(lambda: serve("early", early))
        late.subscribe("radar/setup")
        until(lambda: serve("late", late))
        serve("early", early)
        assert got == {"early": [4], "late": [4]}
        assert count_of(early, "radar/setup").lost == 0


def test_newest_only_topic_gives_the_newest(meeting: Path) -> None:
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        sent = connect(sender, receiver, "perception/peaks", peaks)
        lost = count_of(receiver, "perception/peaks").lost
        for stamp_ns in range(sent, sent + 4):
            sender.publish("perception/peaks", peaks(stamp_ns))
        got: list[int] = []
        until(lambda: got.extend(stamps(receiver.receive(0.1))) or got[-1:] == [sent + 3])
        assert got == sorted(set(got))
        assert count_of(receiver, "perception/peaks").lost == lost


def test_slow_receiver_loses_counts_and_stays_bounded(meeting: Path) -> None:
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        sent = connect(sender, receiver, "radar/beam", beam)
        lost, one = count_of(receiver, "radar/beam").lost, beam(0)
        for _ in range(150):
            sender.publish("radar/beam", one)
        sequences: list[int] = []

        def is_last_here() -> bool:
            """Whether the last that was sent has come, so that every loss is known; where nothing waits, send it."""
            came = receiver.receive(0.1)
            sequences.extend(message.envelope.sequence for message in came)
            is_here = sequences[-1:] == [sender.counts()[1][0].messages - 1]
            if not came and not is_here:
                sender.publish("radar/beam", one)
            return is_here

        until(is_last_here)
        total = sender.counts()[1][0].messages - sent
        waiting = sum(sequence < sent + 150 for sequence in sequences)
        # twice the history at the sender, once at the receiver, some in the kernel and in hand
        assert 0 < waiting <= 4 * TOPICS["radar/beam"].history_messages
        assert sequences == sorted(set(sequences))
        assert count_of(receiver, "radar/beam").lost - lost == total - len(sequences) >= 150 - waiting


def test_one_call_is_bounded(meeting: Path) -> None:
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        sent = connect(sender, receiver, "vehicle/state", state)
        for stamp_ns in range(sent, sent + 200):
            sender.publish("vehicle/state", state(stamp_ns))
        batches: list[list[int]] = []
        until(lambda: batches.append(stamps(receiver.receive(0.1))) or sum(map(len, batches)) == 200)
        assert list(chain.from_iterable(batches)) == list(range(sent, sent + 200))
        assert max(map(len, batches)) <= 64


CHILD = """
import sys, time
from pathlib import Path
from msgs.values.vehicle import VehicleState
from msgs.bus.zmq import ZmqBus
bus = ZmqBus("driver", Path(sys.argv[1]))
for stamp in range(10_000):
    bus.publish("vehicle/state", VehicleState(stamp_ns=stamp))
    time.sleep(0.005)
"""


def test_killed_publisher_comes_back_without_loss_counted(meeting: Path) -> None:
    with closing(ZmqBus("receiver", meeting)) as receiver:
        receiver.subscribe("vehicle/state")
        for _ in range(2):
            child = subprocess.Popen([sys.executable, "-c", CHILD, str(meeting)])
            try:
                received = collect(receiver, 5)
                assert received[-1].envelope.publisher == "driver"
            finally:
                child.send_signal(signal.SIGKILL)
                child.wait()
            while receiver.receive(0.1):
                pass
            assert socket_path(meeting, "vehicle/state", "driver").exists(), "the killed left its file"
        assert list_publishers(meeting) == []
        assert count_of(receiver, "vehicle/state").lost == 0


def test_name_in_use_is_refused(meeting: Path) -> None:
    with closing(ZmqBus("same", meeting)) as first, closing(ZmqBus("same", meeting)) as second:
        first.publish("log", LogRecord(stamp_ns=0, node="same", level="info", text=""))
        with pytest.raises(ValueError, match="names must differ"):
            second.publish("log", LogRecord(stamp_ns=0, node="same", level="info", text=""))


@contextmanager
def rogue_publisher(meeting: Path, topic: str) -> Iterator[zmq.Socket[bytes]]:
    """A plain socket in the place of a publisher, closed however the test ends: a context waits for open sockets."""
    with zmq.Context() as context, context.socket(zmq.PUB) as rogue:
        rogue.setsockopt(zmq.LINGER, 0)
        rogue.bind(f"ipc://{socket_path(meeting, topic, 'rogue')}")
        yield rogue


def test_garbage_from_a_rogue_publisher_is_counted_and_survived(
    meeting: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # however long it takes: one line an interval
    monkeypatch.setattr("msgs.bus.sequencing._WARNING_INTERVAL_NS", 3600 * 10**9)
    random = np.random.default_rng(1)
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        sent = connect(sender, receiver, "vehicle/state", state)
        with rogue_publisher(meeting, "vehicle/state") as rogue:
            until(lambda: rogue_heard(rogue, receiver))
            for frames in range(1, 6):
                rogue.send_multipart([b"vehicle/state\0", *(random.bytes(40) for _ in range(frames))])
                rogue.send_multipart([random.bytes(30)] * frames)
            # larger than the topic allows: libzmq itself hangs up and connects again
            rogue.send_multipart([b"vehicle/state\0", bytes(TOPICS["vehicle/state"].max_bytes + 1)])
        sender.publish("vehicle/state", state(sent))
        assert stamps(collect(receiver, 1)) == [sent]
        assert count_of(receiver, "vehicle/state").rejected >= 1
        assert len(caplog.records) == 1, "one warning line per topic, not one per message"


def rogue_heard(rogue: zmq.Socket[bytes], receiver: ZmqBus) -> bool:
    rogue.send_multipart([b"vehicle/state\0", b"\xc1"])
    receiver.receive(0.05)
    return count_of(receiver, "vehicle/state").rejected > 0


def test_raw_bytes_into_a_publisher_are_survived(meeting: Path) -> None:
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        sender.publish("radar/setup", RadarSetup())
        sent = connect(sender, receiver, "vehicle/state", state)
        for topic in ("vehicle/state", "radar/setup"):
            # a ZMTP 1.0 greeting, which needs no handshake, then frames of nonsense
            for raw in (b"\x01\x00\x02\x00\x01x", b"\xff" * 64, bytes(range(256)) * 40):
                with socket.socket(socket.AF_UNIX) as client:
                    client.connect(str(socket_path(meeting, topic, "sender")))
                    client.sendall(raw)
                sender.receive(0.01)
        sender.publish("vehicle/state", state(sent))
        assert stamps(collect(receiver, 1)) == [sent]


def test_other_topics_with_the_same_beginning_do_not_come_in(meeting: Path) -> None:
    with closing(ZmqBus("receiver", meeting)) as receiver:
        receiver.subscribe("log")
        with rogue_publisher(meeting, "log") as rogue:
            for _ in range(30):
                rogue.send_multipart([b"logs\0", b"\x80"])
                receiver.receive(0.01)
        assert count_of(receiver, "log").rejected == 0


def test_a_process_without_descriptors_searches_later(meeting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood of connections takes them all for a while: what is known goes on, a new publisher is found after it."""
    with closing(ZmqBus("known", meeting)) as known, closing(ZmqBus("listener", meeting)) as listener:
        sent = connect(known, listener, "vehicle/state", state)

        def refuse(path: object) -> list[str]:
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), str(path))

        with monkeypatch.context() as without:
            without.setattr("msgs.bus.zmq.os.listdir", refuse)
            with closing(ZmqBus("new", meeting)) as new:
                new.publish("vehicle/state", state(0))
            time.sleep(0.15)
            known.publish("vehicle/state", state(sent))
            assert stamps(collect(listener, 1)) == [sent]
        with closing(ZmqBus("new", meeting)) as new:
            until(lambda: bool(new.publish("vehicle/state", state(0)) or stamps(listener.receive(0.05))))


def test_any_other_trouble_of_a_search_is_an_error(meeting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(ZmqBus("listener", meeting)) as listener:
        listener.subscribe("vehicle/state")

        def refuse(path: object) -> list[str]:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

        monkeypatch.setattr("msgs.bus.zmq.os.listdir", refuse)
        time.sleep(0.15)
        with pytest.raises(PermissionError):
            listener.receive(0.05)


def test_strange_files_in_the_run_dir_are_passed_over(meeting: Path) -> None:
    with closing(ZmqBus("receiver", meeting)) as receiver:
        for name in ("vehicle.state@", "vehicle.state@a b", "nothing@x", "vehicle.state", f"vehicle.state@{'n' * 200}"):
            (meeting / name).touch()
        (meeting / "vehicle.state@dead").touch()
        receiver.subscribe("vehicle/state")
        with closing(ZmqBus("sender", meeting)) as sender:
            connect(sender, receiver, "vehicle/state", state)
        assert list_publishers(meeting) == []


def test_stale_file_is_taken_over(meeting: Path) -> None:
    meeting.mkdir()
    socket_path(meeting, "vehicle/state", "sender").touch()
    with closing(ZmqBus("sender", meeting)) as sender, closing(ZmqBus("receiver", meeting)) as receiver:
        connect(sender, receiver, "vehicle/state", state)


def test_a_watched_descriptor_ends_the_wait(meeting: Path) -> None:
    read, write = os.pipe()
    with closing(ZmqBus("node", meeting)) as bus:
        bus.subscribe("vehicle/state")
        bus.watch(read)
        os.write(write, b"x")
        # a bus that takes no notice waits for an hour
        assert bus.receive(3600.0) == []
        bus.unwatch(read)
        assert bus.receive(0.0) == []
    os.close(read)
    os.close(write)


def interrupt_at(line: int, action: Callable[[], None]) -> None:
    """Do something, with Ctrl-C at a line of it, counted through all Python that it runs."""
    left = line

    def trace(frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal left
        left -= event == "line"
        if left == 0:
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    previous = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    finally:
        sys.settrace(previous)


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda folder: ZmqBus("node", folder), ForeignBus], ids=["own", "foreign"])
def test_a_bus_interrupted_at_any_line_of_a_subscription_can_be_closed(
    meeting: Path, make: Callable[[Path], ZmqBus | ForeignBus]
) -> None:
    """A socket that nobody knows keeps libzmq waiting for ever."""
    for line in count(1):
        bus = make(meeting)
        try:
            interrupt_at(line, lambda bus=bus: bus.subscribe("vehicle/state"))  # type: ignore[misc]
        except KeyboardInterrupt:
            # here, where its traceback holds whatever was open
            closing_bus = threading.Thread(target=bus.close, daemon=True)
            closing_bus.start()
            closing_bus.join(PATIENCE_S)
            assert not closing_bus.is_alive(), f"interrupted at line {line}, it is not closed"
        else:
            bus.close()
            break
    assert line > 10


@pytest.mark.parametrize("node", ["", "a/b", "a@b", "a b", "n" * 65, "ü"])
def test_node_names_are_checked(meeting: Path, node: str) -> None:
    with pytest.raises(ValueError, match="node name must be"):
        ZmqBus(node, meeting)


def test_too_long_a_path_is_refused(meeting: Path) -> None:
    with pytest.raises(ValueError, match="at most 107 bytes"):
        ZmqBus("node", meeting / ("d" * 90))


def test_run_dir_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", "/run/here")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert run_dir("car") == Path("/run/here/car")
    monkeypatch.delenv("MIRRORWAVE_RUN_DIR")
    assert run_dir("car") == Path("/run/user/7/mirrorwave/car")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert run_dir("car") == Path(f"/tmp/mirrorwave-{os.getuid()}/car")


@pytest.mark.parametrize("domain", ["", "..", "a/b"])
def test_domain_names_are_checked(domain: str) -> None:
    with pytest.raises(ValueError, match="domain must be"):
        run_dir(domain)
