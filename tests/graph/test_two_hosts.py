"""A link between two hosts is cut and healed."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from benchmarks.transport.link_stand import Side, make_keys
from benchmarks.transport.net import Wire, why_no_namespaces
from msgs.bus.zmq import ZmqBus
from msgs.values.diagnostics import NodeState
from msgs.values.vehicle import VehicleState

TOPIC = "vehicle/state"
PATIENCE_S = 120.0
PERIOD_S = 0.02

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(bool(why_no_namespaces()), reason=why_no_namespaces()),
]


class Hosts:
    """A publisher on one host, an observer on the other, and the link nodes between them."""

    def __init__(self, wire: Wire, folder: Path) -> None:
        make_keys(folder / "keys")
        sensor, compute = wire.hosts
        keys = {side: {"key": str(folder / f"keys/{side}/{side}.key_secret")} for side in ("sensor", "compute")}
        exports = {"bind": "tcp://*:7100", "export": [TOPIC], "allowed": str(folder / "keys/of_sensor")}
        key = str(folder / "keys/of_compute/sensor.key")
        peer = {"address": f"tcp://{sensor.address}:7100", "key": key, "topics": [TOPIC]}
        self.sensor = Side("s", folder, keys["sensor"] | exports, sensor.inside)
        self.compute = Side("c", folder, keys["compute"] | {"connect": {"sensor": peer}}, compute.inside)
        self.compute.bus.subscribe(TOPIC)
        self.player = ZmqBus("player", self.sensor.run_dir)
        self.sent = 0
        #: Numbers of the messages that came.
        self.came: list[int] = []

    def until(self, done: Callable[[], bool]) -> None:
        """Publish and receive until something holds."""
        end_s, next_s = time.monotonic() + PATIENCE_S, 0.0
        while not done():
            assert time.monotonic() < end_s
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + PERIOD_S
                self.player.publish(TOPIC, VehicleState(stamp_ns=self.player.now_ns(), speed_mps=0.01 * self.sent))
                self.sent += 1
            self.sensor.receive(0.002)
            for received in self.compute.receive(0.002):
                if isinstance(received.message, VehicleState):
                    self.came.append(round(100.0 * received.message.speed_mps))

    def new_ones_come(self) -> None:
        """Until messages arrive that are published from now on."""
        start = self.sent
        self.until(lambda: bool(self.came) and self.came[-1] > start)

    def lost(self) -> int:
        return self.compute.counted()[f"sensor {TOPIC} message lost on the link"]

    def close(self) -> None:
        self.player.close()
        self.compute.close()
        self.sensor.close()


@pytest.fixture
def wire() -> Iterator[Wire]:
    with Wire("mwt") as wire:
        yield wire


@pytest.fixture
def hosts(wire: Wire) -> Iterator[Hosts]:
    with tempfile.TemporaryDirectory(prefix="mw") as root:
        hosts = Hosts(wire, Path(root))
        try:
            yield hosts
        finally:
            hosts.close()


def test_a_cut_is_said_counted_and_healed(hosts: Hosts, wire: Wire) -> None:
    """No frame passes until the importing side says so; afterwards what it counts as lost is what did not come."""
    wire.seen = {TOPIC.encode(): 0, b"speed_mps": 0}
    hosts.new_ones_come()
    assert hosts.came == list(range(hosts.came[0], hosts.came[-1] + 1))
    wire.is_dead = True
    hosts.until(lambda: hosts.compute.status is not None and "no word for" in hosts.compute.status.reason)
    assert hosts.compute.status is not None
    assert hosts.compute.status.state == NodeState.DEGRADED
    known = len(hosts.came)
    # until then the kernel keeps what was sent, and would still bring it
    hosts.until(lambda: any("has gone" in text for text in hosts.sensor.said))
    assert len(hosts.came) == known
    wire.is_dead = False
    hosts.new_ones_come()
    missing = hosts.came[-1] - hosts.came[0] + 1 - len(hosts.came)
    assert missing > 0
    hosts.until(lambda: hosts.lost() >= missing and hosts.compute.status.state == NodeState.READY)
    assert hosts.lost() == hosts.came[-1] - hosts.came[0] + 1 - len(hosts.came)
    assert hosts.compute.is_running
    assert hosts.sensor.is_running
    assert sum(wire.frames) > 100
    assert wire.seen == {TOPIC.encode(): 0, b"speed_mps": 0}
