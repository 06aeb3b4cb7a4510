"""Nodes of one process: the same objects, once, in order, with every gap counted, and nothing kept from outside."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from msgs.bus.codec import decode
from msgs.bus.exchange import Exchange
from msgs.bus.interface import Forwarded, Received
from msgs.bus.sequencing import Tally
from msgs.bus.topics import TOPICS
from msgs.bus.zmq import ZmqBus
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from tests.fuzz.cases import ra_map

STATE, SETUP, MAP = "vehicle/state", "radar/setup", "radar/ra_map"


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder)


@pytest.fixture
def pair(run_dir: Path) -> Iterator[tuple[ZmqBus, ZmqBus]]:
    exchange = Exchange(["head", "tail"])
    buses = ZmqBus("head", run_dir, exchange=exchange), ZmqBus("tail", run_dir, exchange=exchange)
    yield buses
    for bus in buses:
        bus.close()


def state(speed_mps: float) -> VehicleState:
    return VehicleState(stamp_ns=1, speed_mps=speed_mps)


def until(bus: ZmqBus, count: int, patience_s: float = 20.0) -> list[Received]:
    received: list[Received] = []
    end_s = time.monotonic() + patience_s
    while len(received) < count and time.monotonic() < end_s:
        received += bus.receive(0.1)
    return received


def test_a_message_within_is_the_object_itself_and_comes_once(pair: tuple[ZmqBus, ZmqBus], run_dir: Path) -> None:
    head, tail = pair
    outside = ZmqBus("outside", run_dir)
    for bus in (tail, outside):
        bus.subscribe(MAP)
    head.advertise(MAP)
    # found by the one that needs its socket, and not by the one that does not
    until(outside, 1, 0.3)
    message = ra_map(3, 10)
    head.publish(MAP, message)
    inside = until(tail, 1) + tail.receive(0.3)
    assert [received.message is message for received in inside] == [True]
    (beyond,) = until(outside, 1)
    assert beyond.message is not message
    assert beyond.envelope == inside[0].envelope
    assert tail.counts()[0][0].bytes == outside.counts()[0][0].bytes == head.counts()[1][0].bytes > 0
    outside.close()


def test_a_latched_topic_reaches_who_joins_late(pair: tuple[ZmqBus, ZmqBus]) -> None:
    head, tail = pair
    for _ in range(2):
        head.publish(SETUP, RadarSetup())
    tail.subscribe(SETUP)
    assert [received.envelope.sequence for received in until(tail, 1)] == [1]


def test_what_exceeds_the_history_is_refused_and_counted(pair: tuple[ZmqBus, ZmqBus]) -> None:
    head, tail = pair
    tail.subscribe(STATE)
    limit = TOPICS[STATE].history_messages
    for index in range(limit + 5):
        head.publish(STATE, state(float(index)))
    assert [received.message.speed_mps for received in tail.receive(0.0)] == [float(index) for index in range(limit)]
    head.publish(STATE, state(-1.0))
    assert [received.message.speed_mps for received in tail.receive(0.0)] == [-1.0]
    assert tail.counts()[0][0].lost == 5


def test_a_message_ends_a_wait_in_another_thread(pair: tuple[ZmqBus, ZmqBus]) -> None:
    head, tail = pair
    tail.subscribe(STATE)
    received: list[Received] = []
    thread = threading.Thread(target=lambda: received.extend(tail.receive(60.0)))
    thread.start()
    head.publish(STATE, state(1.0))
    thread.join(30.0)
    assert len(received) == 1


def test_two_that_send_at_once_lose_nothing(pair: tuple[ZmqBus, ZmqBus]) -> None:
    head, tail = pair
    count = TOPICS[STATE].history_messages // 2
    head.subscribe(STATE)
    tail.subscribe(STATE)
    threads = [threading.Thread(target=_send, args=(bus, count)) for bus in pair]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for bus in pair:
        by_publisher: dict[str, list[int]] = {}
        for received in bus.receive(0.0):
            by_publisher.setdefault(received.envelope.publisher, []).append(received.envelope.sequence)
        # both hear themselves too, as on a socket
        assert by_publisher == {"head": list(range(count)), "tail": list(range(count))}


def _send(bus: ZmqBus, count: int) -> None:
    for index in range(count):
        bus.publish(STATE, state(float(index)))


def test_a_forwarded_message_is_decoded_for_those_within(pair: tuple[ZmqBus, ZmqBus]) -> None:
    head, tail = pair
    tail.subscribe(STATE)
    envelope, frames = Tally("far").pack(STATE, state(4.0), time.monotonic_ns())
    head.forward(Forwarded(STATE, envelope, frames))
    # a second time it comes to nothing
    head.forward(Forwarded(STATE, envelope, frames))
    assert until(tail, 1) == [decode(frames)]
    # one of a latched topic waits for who joins later
    envelope, frames = Tally("far").pack(SETUP, RadarSetup(), time.monotonic_ns())
    head.forward(Forwarded(SETUP, envelope, frames))
    tail.subscribe(SETUP)
    assert [received.envelope for received in until(tail, 1)] == [envelope]


def test_a_closed_bus_gets_nothing_and_leaves_no_descriptor(run_dir: Path) -> None:
    exchange = Exchange(["head", "tail"])
    before = len(os.listdir("/proc/self/fd"))
    head, tail = ZmqBus("head", run_dir, exchange=exchange), ZmqBus("tail", run_dir, exchange=exchange)
    tail.subscribe(STATE)
    tail.close()
    head.publish(STATE, state(1.0))
    head.close()
    assert len(os.listdir("/proc/self/fd")) <= before
