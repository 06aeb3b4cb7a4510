"""One publisher for each input, on the in-process bus and its virtual clock."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalBus, LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.environment import WallPriors
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.inputs.publishers import AWAY_NS, NAMED_NS, SILENT_NS
from nodes.node import InProcessGraph, Node
from tests.builders import example_beam, example_status

MS = 1_000_000


class Listener(Node):
    """Keeps from whom it takes what."""

    def __init__(self, topics: Iterable[str], takes_all: bool = False) -> None:
        super().__init__()
        self.inputs, self.takes_all_publishers = tuple(topics), takes_all
        self.taken: list[tuple[str, str]] = []
        self.setups: list[RadarSetup] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.taken += [(item.topic, item.envelope.publisher) for item in inputs]
        self.setups += [item.message for item in inputs if isinstance(item.message, RadarSetup)]
        return []


class Stand:
    """A listener in a graph, and publishers by name."""

    def __init__(self, *topics: str, takes_all: bool = False) -> None:
        self.network = LocalNetwork(start_ns=5_000 * MS)
        self.listener = Listener(topics, takes_all)
        self.graph = InProcessGraph(self.network, {"listener": self.listener})
        self.buses: dict[str, LocalBus] = {}

    def bus(self, name: str) -> LocalBus:
        return self.buses.setdefault(name, self.network.bus(name))

    def send(self, name: str, topic: str = "vehicle/state", after_ns: int = 0, beat_sign: int = 1) -> None:
        self.network.advance(after_ns)
        now_ns = self.network.now_ns
        message = {
            "vehicle/state": VehicleState(stamp_ns=now_ns, speed_mps=1.0),
            "radar/beam": example_beam(stamp_ns=now_ns, beam_count=1),
            "radar/setup": RadarSetup(beat_sign=beat_sign),
            "environment/walls": WallPriors(stamp_ns=now_ns, source=name),
            "diagnostics/node": example_status(stamp_ns=now_ns, node=name, uptime_s=0.0, cpu_s=0.0, resident_bytes=0),
        }[topic]  # fmt: skip
        self.bus(name).publish(topic, message)
        self.graph.run()

    def end(self, name: str) -> None:
        self.buses.pop(name).close()

    def wait(self, duration_ns: int) -> None:
        self.network.advance(duration_ns)
        self.graph.run()

    @property
    def beat_signs(self) -> list[int]:
        return [setup.beat_sign for setup in self.listener.setups]

    @property
    def taken(self) -> list[str]:
        """From whom it has taken what came since the last call."""
        taken = [publisher for _, publisher in self.listener.taken]
        self.listener.taken.clear()
        return taken


def test_a_flood_of_a_second_publisher_is_dropped_counted_and_named(caplog: pytest.LogCaptureFixture) -> None:
    stand = Stand("vehicle/state")
    for _ in range(10):
        stand.send("car", after_ns=100 * MS)
        for _ in range(60):
            stand.send("stray", after_ns=MS)
    assert stand.taken == ["car"] * 10
    (count,) = stand.listener.shed.counts()
    assert (count.what, count.reason, count.count) == ("vehicle/state message", "of another publisher", 600)
    named = "vehicle/state has 2 publishers: car is taken, 600 messages of stray dropped"
    assert stand.graph.health("listener") == (NodeState.DEGRADED, named)
    assert caplog.text.count("stray publishes it too") == 1
    stand.send("car", after_ns=NAMED_NS + MS)
    assert stand.graph.health("listener") == (NodeState.READY, "")


@pytest.mark.parametrize(
    ("interval_ms", "is_dead", "silent_ms", "taken"),
    [
        (20, True, 1400, "car"),
        (20, True, 1600, "other"),
        (1000, True, 2900, "car"),
        (1000, True, 3100, "other"),
        (20, False, 4900, "car"),
        (20, False, 5100, "other"),
        (2000, False, 5900, "car"),
        (2000, False, 6100, "other"),
    ],
)
def test_another_publisher_follows_one_that_died_without_a_word(
    interval_ms: int, is_dead: bool, silent_ms: int, taken: str
) -> None:
    """After 1.5 s, 5 s where it is there still, or three of its intervals where these are longer; then it stays."""
    stand = Stand("vehicle/state")
    for _ in range(3):
        stand.send("car", after_ns=interval_ms * MS)
    assert stand.taken == ["car"] * 3
    if is_dead:
        stand.end("car")
    stand.send("other", after_ns=silent_ms * MS)
    stand.send("car", after_ns=MS)
    assert stand.taken == [taken]


def test_a_restarted_publisher_is_taken_from_its_first_message_on() -> None:
    stand = Stand("vehicle/state")
    stand.send("car")
    stand.end("car")
    stand.send("stray", after_ns=400 * MS)
    stand.send("car", after_ns=400 * MS)
    stand.send("stray", after_ns=400 * MS)
    assert stand.taken == ["car", "car"]


def test_a_busy_listener_takes_no_publisher_for_silent() -> None:
    """Both sent while it was busy for ten seconds, the other one first."""
    stand = Stand("vehicle/state")
    stand.send("car")
    stand.network.advance(10_000 * MS)
    for name in ("another", "car"):
        stand.bus(name).publish("vehicle/state", VehicleState(stamp_ns=0, speed_mps=1.0))
    stand.graph.run()
    assert stand.taken == ["car", "car"]


def test_a_node_comes_before_a_program_that_only_publishes() -> None:
    stand = Stand("vehicle/state")
    stand.send("by_hand")
    stand.send("node", "diagnostics/node")
    stand.send("node", after_ns=MS)
    stand.send("by_hand", after_ns=MS)
    assert stand.taken == ["by_hand", "node"]


@pytest.mark.parametrize("topics", [("radar/setup", "radar/beam"), ("radar/setup",)], ids=["with beams", "without"])
def test_a_set_up_of_another_publisher_replaces_none(topics: tuple[str, ...]) -> None:
    stand = Stand(*topics)
    stand.send("radar", "radar/setup")
    stand.send("radar", "radar/beam")
    stand.send("stray", "radar/setup", after_ns=5_000 * MS, beat_sign=-1)
    assert stand.graph.health("listener")[0] is NodeState.DEGRADED
    stand.end("stray")
    stand.wait(5_000 * MS)
    # its own is: a radar that is configured anew
    stand.send("radar", "radar/setup")
    assert stand.beat_signs == [1, 1]


def test_the_set_up_is_that_of_the_beams_whichever_came_first() -> None:
    stand = Stand("radar/setup", "radar/beam")
    stand.send("stray", "radar/setup", beat_sign=-1)
    stand.send("radar", "radar/setup", after_ns=MS)
    stand.send("radar", "radar/beam", after_ns=MS)
    assert stand.beat_signs == [-1, 1]
    # another radar takes over once this one is silent
    stand.send("spare", "radar/setup", after_ns=100 * MS, beat_sign=-1)
    stand.send("spare", "radar/beam", after_ns=SILENT_NS)
    assert stand.beat_signs == [-1, 1, -1]


def test_a_set_up_without_beams_is_replaced_once_its_publisher_has_closed() -> None:
    """`topic pub` of set-up and beams by two processes, then a recording is played."""
    stand = Stand("radar/setup")
    stand.send("by_hand", "radar/setup", beat_sign=-1)
    stand.send("played", "radar/setup", after_ns=MS)
    stand.wait(5_000 * MS)
    assert stand.beat_signs == [-1]
    stand.end("by_hand")
    stand.wait(AWAY_NS - 500 * MS)
    assert stand.beat_signs == [-1]
    stand.wait(600 * MS)
    assert stand.beat_signs == [-1, 1]


def test_the_publishers_of_a_peer_replace_each_other_alone() -> None:
    """What is behind a link cannot be asked: its last set-up counts, and none of this host takes its place."""
    stand = Stand("radar/setup")
    stand.send("sensor.radar", "radar/setup")
    stand.send("stray", "radar/setup", after_ns=5_000 * MS, beat_sign=-1)
    assert stand.beat_signs == [1]
    stand.send("sensor.played", "radar/setup", after_ns=MS, beat_sign=-1)
    assert stand.beat_signs == [1, -1]


@pytest.mark.parametrize(("topic", "takes_all"), [("environment/walls", False), ("vehicle/state", True)])
def test_messages_of_all_publishers_are_taken(topic: str, takes_all: bool) -> None:
    """Walls of several sources; whatever a recorder hears."""
    stand = Stand(topic, takes_all=takes_all)
    for name in ("one", "two", "one"):
        stand.send(name, topic, after_ns=MS)
    assert stand.taken == ["one", "two", "one"]
    assert stand.graph.health("listener") == (NodeState.READY, "")
