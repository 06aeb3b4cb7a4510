"""The in-process bus: order, virtual time, latching, bounded history, faults; all of it repeatable."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from msgs.bus.codec import CodecError
from msgs.bus.interface import Bus, Received
from msgs.bus.local import Faults, LocalNetwork
from msgs.bus.sequencing import Tally
from msgs.bus.topics import TOPICS
from msgs.values.diagnostics import LogRecord, TopicCount
from msgs.values.perception import Peaks
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.vehicle import VehicleState
from tests.builders import example_beam, peaks_at


def state(stamp_ns: int) -> VehicleState:
    return VehicleState(stamp_ns=stamp_ns)


def stamps(received: list[Received]) -> list[int]:
    return [message.message.stamp_ns for message in received]  # type: ignore[attr-defined]


def peaks(stamp_ns: int) -> Peaks:
    return peaks_at((), stamp_ns=stamp_ns)


def beam(index: int) -> RadarBeam:
    return example_beam(stamp_ns=index, scan_id=index, beam_count=1, samples=np.zeros((128, 8192, 2), np.int16))


def received_counts(bus: Bus) -> TopicCount:
    (count,) = bus.counts()[0]
    return count


def test_messages_come_in_order_with_the_virtual_clock() -> None:
    network = LocalNetwork(start_ns=100)
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    for stamp_ns in range(3):
        sender.publish("vehicle/state", state(stamp_ns))
        network.advance(10)
    received = receiver.receive(1.0)
    assert stamps(received) == [0, 1, 2]
    assert [message.envelope.sent_ns for message in received] == [100, 110, 120]
    assert [message.envelope.sequence for message in received] == [0, 1, 2]
    assert receiver.now_ns() == network.now_ns == 130
    assert receiver.receive(1.0) == []


def test_equal_times_are_ordered_by_publisher_then_sequence() -> None:
    network = LocalNetwork()
    receiver = network.bus("receiver")
    receiver.subscribe("log")
    receiver.subscribe("vehicle/state")
    for node in ("b", "a"):
        bus = network.bus(node)
        bus.publish("vehicle/state", state(0))
        bus.publish("log", LogRecord(stamp_ns=1, node=node, level="info", text=""))
    assert [message.envelope.publisher for message in receiver.receive(0.0)] == ["a", "a", "b", "b"]


def test_latched_topics_reach_late_joiners_and_others_do_not() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    sender.publish("radar/setup", RadarSetup(stamp_ns=1))
    sender.publish("radar/setup", RadarSetup(stamp_ns=2))
    sender.publish("vehicle/state", state(3))
    receiver.subscribe("radar/setup")
    receiver.subscribe("vehicle/state")
    assert stamps(receiver.receive(0.0)) == [2]


def test_history_is_bounded_in_bytes_and_losses_are_counted() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("radar/beam")
    sender.publish("radar/beam", beam(0))
    assert stamps(receiver.receive(0.0)) == [0]
    for index in range(1, 51):
        sender.publish("radar/beam", beam(index))
    kept = receiver.receive(0.0)
    # 4 MiB and a header of some hundred bytes each: 31 fit into 125 MiB, the newest
    assert TOPICS["radar/beam"].history_bytes == 125 << 20
    assert stamps(kept) == list(range(20, 51))
    assert received_counts(receiver).lost == 19


def test_newest_only_skips_without_loss() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("perception/peaks")
    for stamp_ns in range(4):
        sender.publish("perception/peaks", peaks(stamp_ns))
    assert stamps(receiver.receive(0.0)) == [3]
    assert received_counts(receiver).lost == 0
    assert received_counts(receiver).messages == 4
    assert received_counts(receiver).outdated == 3


def test_delay_holds_messages_back() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    network.inject("vehicle/state", Faults(delay_ns=10))
    sender.publish("vehicle/state", state(1))
    network.advance(9)
    assert receiver.receive(0.0) == []
    network.advance(1)
    assert stamps(receiver.receive(0.0)) == [1]


def test_corrupt_messages_are_rejected_and_later_ones_come(caplog: pytest.LogCaptureFixture) -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    network.inject("vehicle/state", Faults(corrupt=1.0))
    for stamp_ns in range(5):
        sender.publish("vehicle/state", state(stamp_ns))
    assert receiver.receive(0.0) == []
    network.inject("vehicle/state", Faults())
    sender.publish("vehicle/state", state(5))
    assert stamps(receiver.receive(0.0)) == [5]
    assert received_counts(receiver).rejected == 5
    assert len(caplog.records) == 1, "one warning line, not five"


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"sent_ns": -1}, "sent_ns must not be negative, got -1"),
        ({"sent_ns": 10**18}, "sent_ns must not lie in the future"),
        ({"sequence": -1}, "sequence must not be negative, got -1"),
        ({"sequence": (1 << 64) - 1}, "sequence must be at most 281474976710656"),
        ({"paced": "yes"}, "Expected `bool`, got `str`"),
        ({"paced": 1}, "Expected `bool`, got `int`"),
        ({"pace": True}, "pace"),
    ],
)
def test_an_envelope_that_nobody_wrote_so_is_rejected(
    change: dict[str, Any], rule: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The sum of all gaps has to fit a heartbeat: two of the largest numbers brought a node down."""
    tally = Tally("reader")
    tally.expect("vehicle/state")
    _, frames = Tally("car").pack("vehicle/state", state(0), 5)
    header = msgspec.msgpack.decode(frames[1])
    header["envelope"].update(change)
    assert tally.accept("vehicle/state", [frames[0], msgspec.msgpack.encode(header)], 9) is None
    assert rule in caplog.text
    assert tally.counts()[0][0].rejected == 1
    assert tally.accept("vehicle/state", frames, 9) is not None


def run_with_faults(seed: int) -> tuple[list[int], TopicCount]:
    network = LocalNetwork(seed=seed)
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    network.inject("vehicle/state", Faults(drop=0.2, jitter_ns=30, duplicate=0.2, corrupt=0.1))
    got = []
    for stamp_ns in range(200):
        sender.publish("vehicle/state", state(stamp_ns))
        network.advance(10)
        got += stamps(receiver.receive(0.0))
    network.inject("vehicle/state", Faults())
    network.advance(30)
    sender.publish("vehicle/state", state(200))
    return got + stamps(receiver.receive(0.0)), received_counts(receiver)


def test_same_seed_same_faults() -> None:
    assert run_with_faults(seed=4) == run_with_faults(seed=4)
    assert run_with_faults(seed=4) != run_with_faults(seed=5)


def test_what_cannot_travel_is_refused_and_spends_no_number() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    with pytest.raises(CodecError):
        sender.publish("vehicle/state", RadarSetup())
    with pytest.raises(ValueError, match="unknown topic"):
        sender.publish("vehicle", state(0))
    sender.publish("vehicle/state", state(0))
    assert receiver.receive(0.0)[0].envelope.sequence == 0


def test_closed_bus_receives_nothing_more() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("sender"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    receiver.close()
    sender.publish("vehicle/state", state(0))
    assert receiver.receive(0.0) == []


@pytest.mark.parametrize("change", [{"drop": 1.5}, {"corrupt": -0.1}, {"duplicate": float("nan")}, {"delay_ns": -1}])
def test_faults_refuse(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"faults.{next(iter(change))}"):
        Faults(**change)  # type: ignore[arg-type]


def test_time_does_not_run_back() -> None:
    with pytest.raises(ValueError, match="duration_ns must not be negative"):
        LocalNetwork().advance(-1)
