"""The node that links two graphs: what it refuses to open, and two of them back to back."""

from __future__ import annotations

import logging
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from contrib.two_machines.keys import generate
from contrib.two_machines.link import Link
from msgs.bus.codec import encode
from msgs.bus.interface import Bus, Envelope, Forwarded
from msgs.bus.local import LocalNetwork
from msgs.bus.sequencing import MAX_LATCHED
from msgs.bus.zmq import ZmqBus
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import LogRecord, NodeState
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.node import Heartbeat, Stop, load_node, run_loop
from nodes.process.launch_file import read_launch_file
from nodes.process.validation import merged

ROOT = CHECKOUT
PATIENCE_S = 60.0


class Host:
    """A folder of keys, and the buses of a graph with a link in it."""

    def __init__(self, folder: Path, name: str) -> None:
        self.name, self.keys = name, folder / name
        generate(name, self.keys)
        (self.keys / "allowed").mkdir(mode=0o700)
        self.network = LocalNetwork(start_ns=time.monotonic_ns())
        self.said, self.bus = self.network.bus("nodes"), self.network.bus("link")
        self.seen: list[Envelope] = []

    def trusts(self, other: Host) -> None:
        shutil.copy(other.keys / f"{other.name}.key", self.keys / "allowed")

    def params(self, *export: str) -> dict[str, Any]:
        own = {"key": str(self.keys / f"{self.name}.key_secret"), "allowed": str(self.keys / "allowed")}
        return {**own, "bind": "tcp://127.0.0.1:*", "export": export}

    def importing(self, other: Host, address: str, *topics: str) -> dict[str, Any]:
        return {other.name: {"address": address, "key": str(self.keys / f"allowed/{other.name}.key"), "topics": topics}}

    def turn(self, link: Link) -> None:
        """What the loop does in a turn, and one who listens to all."""
        self.network.advance(max(0, time.monotonic_ns() - self.network.now_ns))
        for message in link.step(self.bus.receive(0.0), self.network.now_ns):
            assert message.topic in link.outputs
            self.bus.forward(message)
            self.seen.append(message.envelope)


@pytest.fixture
def hosts(tmp_path: Path) -> tuple[Host, Host]:
    sensor, compute = Host(tmp_path, "sensor"), Host(tmp_path, "compute")
    sensor.trusts(compute)
    compute.trusts(sensor)
    return sensor, compute


def link(host: Host, params: dict[str, Any]) -> Link:
    node = load_node("contrib.two_machines.link", params, "link")
    assert isinstance(node, Link)
    for topic in node.inputs:
        host.bus.subscribe(topic)
    return node


def free_address() -> str:
    """Where nobody listens: the port of an end that was bound and is closed."""
    with closing(load_node("contrib.two_machines.link", {"bind": "tcp://127.0.0.1:*", "export": ["log"]})) as node:
        assert isinstance(node, Link)
        return node.address


def turn_until(done: Any, *ends: tuple[Host, Link]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline_s, "waited in vain"
        for host, node in ends:
            host.turn(node)
        time.sleep(0.005)


def test_two_hosts_hear_each_other_and_nothing_goes_round_in_circles(hosts: tuple[Host, Host]) -> None:
    sensor, compute = hosts
    # both give and take the same topic: what came from one must not go back to it
    one = link(sensor, {**sensor.params("log"), "connect": sensor.importing(compute, free := free_address(), "log")})
    connect = compute.importing(sensor, one.address, "log")
    other = link(compute, {**compute.params("log"), "bind": free, "connect": connect})
    ends = (sensor, one), (compute, other)
    with closing(one), closing(other):
        assert one.health() == (NodeState.DEGRADED, "compute: no word yet")
        turn_until(lambda: one.health()[0] is other.health()[0] is NodeState.READY, *ends)
        for number in range(3):
            for host in hosts:
                host.said.publish("log", LogRecord(stamp_ns=1, node=f"n{number}", level="info", text="x"))
            turn_until(lambda count=number + 1: min(len(host.seen) for host in hosts) >= count, *ends)
        # three more of one side after all others: had anything been sent back, it would have come before
        for host in hosts:
            assert {envelope.publisher for envelope in host.seen} == {
                f"{'compute' if host is sensor else 'sensor'}.nodes"
            }
            assert [envelope.sequence for envelope in host.seen] == [0, 1, 2]
        assert "round trip" in one.stages.drain()[0].name


def test_a_key_taken_off_the_list_is_cut_off_and_one_put_back_is_admitted(
    hosts: tuple[Host, Host], caplog: pytest.LogCaptureFixture
) -> None:
    """The reader says nothing more after it has subscribed, and still loses its connection; the sender starts nothing
    again.
    """
    sensor, compute = hosts
    caplog.set_level(logging.INFO)
    one = link(sensor, sensor.params("log"))
    other = link(compute, {"key": compute_key(compute), "connect": compute.importing(sensor, one.address, "log")})
    ends = (sensor, one), (compute, other)
    listed = sensor.keys / "allowed" / "compute.key"
    with closing(one), closing(other):
        turn_until(lambda: other.health()[0] is NodeState.READY, *ends)
        kept = listed.read_bytes()
        listed.unlink()
        # only the sender turns: nobody asks it for anything
        turn_until(lambda: "compute is no longer allowed" in caplog.text, (sensor, one))
        assert "is open to nobody" in caplog.text
        turn_until(lambda: other.health()[0] is NodeState.DEGRADED, *ends)
        sensor.said.publish("log", LogRecord(stamp_ns=1, node="n", level="info", text="x"))
        turn_until(lambda: one._exporter is not None and one._exporter.refused > 0, *ends)
        assert compute.seen == []
        listed.write_bytes(kept)
        turn_until(lambda: other.health()[0] is NodeState.READY, *ends)


def test_a_list_that_cannot_be_read_leaves_the_one_of_before(hosts: tuple[Host, Host]) -> None:
    sensor, compute = hosts
    one = link(sensor, sensor.params("log"))
    broken = sensor.keys / "allowed" / "broken.key"
    with closing(one):
        broken.write_text("no key")
        turn_until(lambda: one.health()[0] is NodeState.DEGRADED, (sensor, one))
        assert one.health()[1] == f"the list of peers is that of before: {broken}: holds no public key"
        other = link(compute, {"key": compute_key(compute), "connect": compute.importing(sensor, one.address, "log")})
        with closing(other):
            turn_until(lambda: other.health()[0] is NodeState.READY, (sensor, one), (compute, other))
        broken.unlink()
        turn_until(lambda: one.health()[0] is NodeState.READY, (sensor, one))


def compute_key(host: Host) -> str:
    return str(host.keys / f"{host.name}.key_secret")


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (
            {"bind": "tcp://*:7100", "export": ["log"]},
            r"^link.params: tcp://\*:7100: TCP beyond this machine needs keys",
        ),
        (
            {"connect": {"car": {"address": "tcp://car:7100", "topics": ["log"]}}},
            r"^link.params: tcp://car:7100: TCP beyond this machine needs keys \(key and allowed, connect.PEER.key\)$",
        ),
        ({"bind": "tcp://127.0.0.1:*"}, "bind and export belong together"),
        ({"export": ["log"]}, "bind and export belong together"),
        ({}, "a link needs bind and export, or connect, or both"),
        ({"bind": "ipc:///tmp/x", "export": ["log"]}, "an address must be tcp://HOST:PORT, got 'ipc:///tmp/x'"),
        ({"bind": "tcp://127.0.0.1:*", "export": ["logs"]}, "unknown topic 'logs'"),
        ({"bind": "tcp://127.0.0.1:*", "export": ["log"], "key": "k"}, "key, allowed and bind belong together"),
        ({"bind": "tcp://127.0.0.1:*", "export": ["log"], "allowed": "k"}, "key, allowed and bind belong together"),
        ({"connect": {"a.b": {"address": "tcp://[::1]:1", "topics": []}}}, "a peer's name must be of a-z, 0-9 and _"),
        ({"connect": {"a": {"address": "tcp://[::1]:1", "topics": [], "key": "k"}}}, "its key needs an own one"),
        ({"connect": {"a": {"address": "tcp://[::1]:1", "topics": [], "keys": "k"}}}, "unknown field keys"),
        ({"binds": "tcp://127.0.0.1:*"}, "unknown field binds"),
    ],
)
def test_what_is_not_safe_or_makes_no_sense_is_refused_by_one_line(params: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load_node("contrib.two_machines.link", params, "link")
    assert "\n" not in str(caught.value)


def test_insecure_is_said_aloud_and_stays_in_the_heartbeat(caplog: pytest.LogCaptureFixture) -> None:
    params = {"bind": "tcp://0.0.0.0:*", "export": ["log"], "insecure": True}
    with closing(load_node("contrib.two_machines.link", params, "link")) as node:
        assert node.health() == (NodeState.DEGRADED, "tcp://0.0.0.0:* is open without keys")
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "INSECURE: tcp://0.0.0.0:*" in caplog.text


def test_keys_that_others_may_read_and_folders_without_peers_are_refused(hosts: tuple[Host, Host]) -> None:
    sensor, compute = hosts
    (sensor.keys / "allowed" / "compute.key").unlink()
    with pytest.raises(ValueError, match="nobody could connect"):
        load_node("contrib.two_machines.link", sensor.params("log"), "link")
    (compute.keys / "compute.key_secret").chmod(0o640)
    with pytest.raises(ValueError, match="must be readable by its owner alone"):
        load_node("contrib.two_machines.link", compute.params("log"), "link")


@pytest.fixture
def meeting() -> Iterator[Path]:
    # pytest's own folders are too deep for a socket address
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder)


def test_a_peer_s_message_ends_the_wait_of_the_loop(hosts: tuple[Host, Host], meeting: Path) -> None:
    sensor, compute = hosts
    one = link(sensor, sensor.params("vehicle/state"))
    other = link(
        compute, {"key": compute.params()["key"], "connect": compute.importing(sensor, one.address, "vehicle/state")}
    )
    bus, listener = ZmqBus("link", meeting), ZmqBus("listener", meeting)
    listener.subscribe("vehicle/state")
    stop = Stop()
    loop = threading.Thread(target=run_loop, args=(other, bus, stop, Heartbeat(bus, "link")))
    loop.start()
    came: list[Any] = []
    try:
        with closing(one):
            number = 0
            deadline_s = time.monotonic() + PATIENCE_S
            while len(came) < 3:
                assert time.monotonic() < deadline_s, "waited in vain"
                sensor.said.publish("vehicle/state", VehicleState(stamp_ns=number))
                number += 1
                sensor.turn(one)
                came += listener.receive(0.02)
    finally:
        stop.request(at_once=True)
        loop.join()
        for each in (bus, listener):
            each.close()
    assert {received.envelope.publisher for received in came} == {"sensor.nodes"}
    stamps = [received.message.stamp_ns for received in came]
    assert stamps == [received.envelope.sequence for received in came]


def test_launch_files_of_two_hosts_fit_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With keys made as docs/guides/two-machines.md says, and addresses of this machine."""
    monkeypatch.chdir(tmp_path)
    Path("keys/allowed").mkdir(mode=0o700, parents=True)
    launches = {}
    for name in ("sensor", "compute"):
        generate(name, Path("keys"))
        shutil.copy(f"keys/{name}.key", "keys/allowed")
        launches[name] = read_launch_file(ROOT / f"launch/two_hosts_{name}.yaml").nodes["link"].params
    for name, other in (("sensor", "compute"), ("compute", "sensor")):
        params = launches[name]
        assert params["bind"].startswith("tcp://*:")
        assert set(params["connect"][other]["topics"]) == set(launches[other]["export"])
        changes = {"bind": "tcp://127.0.0.1:*", "connect": {other: {"address": "tcp://127.0.0.1:1"}}}
        with closing(load_node("contrib.two_machines.link", merged(params, changes), "link")) as node:
            assert node.inputs == tuple(params["export"])
            assert node.health() == (NodeState.DEGRADED, f"{other}: no word yet")


def forwarded(publisher: str, sequence: int) -> Forwarded:
    envelope = Envelope(publisher=publisher, topic="radar/setup", sequence=sequence, sent_ns=sequence)
    return Forwarded("radar/setup", envelope, encode(envelope, RadarSetup(stamp_ns=sequence)))


def test_what_is_forwarded_is_latched_for_each_origin_and_spends_no_number_of_ours(meeting: Path) -> None:
    bus: Bus
    with closing(ZmqBus("link", meeting)) as bus:
        bus.forward(forwarded("front.radar", 3))
        bus.forward(forwarded("rear.radar", 8))
        bus.forward(forwarded("front.radar", 4))
        bus.publish("radar/setup", RadarSetup(stamp_ns=1))
        with closing(ZmqBus("late", meeting)) as late:
            late.subscribe("radar/setup")
            came: dict[str, int] = {}
            deadline_s = time.monotonic() + PATIENCE_S
            while len(came) < 3:
                assert time.monotonic() < deadline_s, "waited in vain"
                bus.receive(0.0)
                came |= {one.envelope.publisher: one.envelope.sequence for one in late.receive(0.02)}
            assert came == {"front.radar": 4, "rear.radar": 8, "link": 0}
            assert late.counts()[0][0].lost == 0


def test_a_newcomer_gets_the_last_message_of_all_origins_at_once(meeting: Path) -> None:
    """Its connection must hold them all before it has read the first: it does not look at what comes for a while."""
    with closing(ZmqBus("link", meeting)) as link, closing(ZmqBus("late", meeting)) as late:
        for index in range(MAX_LATCHED):
            link.forward(forwarded(f"front.radar{index}", index))
        late.subscribe("radar/setup")
        deadline_s = time.monotonic() + PATIENCE_S
        while not link.subscribers("radar/setup"):
            assert time.monotonic() < deadline_s, "never subscribed"
        came: set[str] = set()
        while len(came) < MAX_LATCHED:
            assert time.monotonic() < deadline_s, f"{len(came)} of {MAX_LATCHED} came"
            came |= {received.envelope.publisher for received in late.receive(0.02)}
