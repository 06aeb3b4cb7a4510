"""The contract of nodes and the loop, on the in-process bus."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalBus, LocalNetwork
from msgs.files.plugins import NODES
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.vehicle import VehicleState
from nodes.node import (
    EXIT_FAILED,
    SETTLE_S,
    Heartbeat,
    InProcessGraph,
    Node,
    StageClock,
    Stop,
    _outputs_of,
    load_node,
    run_loop,
    run_process,
)
from nodes.player import SENSED_TOPICS
from nodes.process import group
from nodes.process.group import Group, Member
from nodes.process.logs import BusLogHandler, LineSplitter, parse_line
from tests.graph import toy_nodes
from tests.plugins import NODE, write_package

ROOT = CHECKOUT
TOY = "tests.graph.toy_nodes"


def _toy(**params: object) -> Node:
    return toy_nodes.create(toy_nodes.Params(period_s=0.0, **params))  # type: ignore[arg-type]


class _StopAfter(toy_nodes.Echo):
    """Asks for the end when the first message comes, and counts what it still gets."""

    def __init__(self, stop: Stop, at_once: bool) -> None:
        super().__init__(toy_nodes.Params())
        self.stop, self.at_once = stop, at_once

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.stop.request(self.at_once)
        return super().step(inputs[:1], now_ns)


@pytest.mark.parametrize(
    ("module", "params", "message"),
    [
        (TOY, {"ticks": "many"}, r"^toy\.params\.ticks: Expected int, got str$"),
        (TOY, {"tocks": 1}, r"^toy\.params: .*unknown field tocks; known are kind, period_s, ticks, "),
        (TOY, {"kind": "nonsense"}, "toy.kind must be one of"),
        ("nodes.no_such_node", {}, "no module named 'nodes.no_such_node'"),
        ("nodes.process.logs", {}, r"is no node, it must define Params and create"),
        ("../evil", {}, "dotted module name"),
    ],
)
def test_wrong_nodes_and_params_are_refused_by_name(module: str, params: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_node(module, params, "toy")


def test_a_library_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "thirsty.py").write_text("import no_such_library.part")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"^toy\.module: thirsty needs no_such_library, which is not installed$"):
        load_node("thirsty", {}, "toy")


def test_loop_publishes_until_finished_and_says_so() -> None:
    network = LocalNetwork()
    listener = network.bus("listener")
    listener.subscribe("vehicle/state")
    listener.subscribe("diagnostics/node")
    bus = network.bus("tick")
    run_loop(_toy(ticks=3), bus, Stop(), Heartbeat(bus, "tick"))
    messages = [received.message for received in listener.receive(0.0)]
    assert [message.speed_mps for message in messages if isinstance(message, VehicleState)] == [1.0, 2.0, 3.0]
    beats = [message for message in messages if isinstance(message, NodeStatus)]
    assert [beat.state for beat in beats] == [NodeState.READY, NodeState.STOPPING]
    assert beats[-1].stages[0].name == "tick"
    assert beats[-1].stages[0].count == 3


class _VirtualWait(LocalBus):
    """A bus whose waits pass on the virtual clock."""

    def receive(self, timeout_s: float) -> list[Received]:
        inputs = super().receive(timeout_s)
        if not inputs:
            self._network.advance(round(1e9 * timeout_s))
        return inputs


def test_loop_waits_no_longer_than_until_a_node_is_due() -> None:
    """Due every 7 ms, on a bus that waits as long as it may: a step each 7 ms, not each turn of 0.1 s."""
    network = LocalNetwork()
    listener = network.bus("listener")
    listener.subscribe("vehicle/state")
    bus = _VirtualWait(network, "tick")
    node = toy_nodes.create(toy_nodes.Params(period_s=0.007, ticks=4))
    run_loop(node, bus, Stop(), Heartbeat(bus, "tick"))
    stamps_ns = [received.message.stamp_ns for received in listener.receive(0.0)]
    assert [stamp_ns - stamps_ns[0] for stamp_ns in stamps_ns] == [0, 7_000_000, 14_000_000, 21_000_000]


@pytest.mark.parametrize(("settled_s", "times"), [(60.0, 0), (-1.0, 3)])
def test_memory_is_given_back_once_the_start_is_over(
    monkeypatch: pytest.MonkeyPatch, settled_s: float, times: int
) -> None:
    """With each of three heartbeats, none of them before: what the start needs is in use until then."""
    calls: list[None] = []
    monkeypatch.setattr("nodes.node.SETTLED_S", settled_s)
    monkeypatch.setattr("nodes.node.HEARTBEAT_S", 0.0)
    monkeypatch.setattr("nodes.node._keep_small", calls.append)
    bus = LocalNetwork().bus("tick")
    run_loop(_toy(ticks=3), bus, Stop(), Heartbeat(bus, "tick"))
    assert len(calls) == times


@pytest.mark.parametrize(("open_for_s", "rest_s"), [(None, SETTLE_S), (10.0, 0.0)])
def test_a_source_rests_until_its_outputs_can_have_been_found(open_for_s: float | None, rest_s: float) -> None:
    network = LocalNetwork()
    listener = network.bus("listener")
    listener.subscribe("vehicle/state")
    bus = _VirtualWait(network, "tick")
    node = toy_nodes.create(toy_nodes.Params(ticks=1))
    node.open_since_s = None if open_for_s is None else time.monotonic() - open_for_s
    run_loop(node, bus, Stop(), Heartbeat(bus, "tick"))
    (first,) = listener.receive(0.0)
    assert isinstance(first.message, VehicleState)
    assert first.message.stamp_ns == pytest.approx(1e9 * rest_s)


@pytest.mark.parametrize(
    ("module", "outputs"),
    [
        ("nodes.player", SENSED_TOPICS),
        ("nodes.geometry", ()),
        ("contrib.two_machines.link", ()),
        ("nodes.no_such_node", ()),
        ("plugin_without_dot", ()),
    ],
)
def test_what_a_module_publishes_is_known_before_its_node_is_made(module: str, outputs: tuple[str, ...]) -> None:
    assert _outputs_of(module) == outputs


def test_a_step_that_raises_leaves_with_its_reason() -> None:
    network = LocalNetwork()
    listener = network.bus("listener")
    listener.subscribe("diagnostics/node")
    bus = network.bus("crash")
    with pytest.raises(RuntimeError, match="the toy is broken"):
        run_loop(_toy(kind="crash"), bus, Stop(), Heartbeat(bus, "crash"))
    last = listener.receive(0.0)[-1].message
    assert isinstance(last, NodeStatus)
    assert (last.state, last.reason) == (NodeState.STOPPING, "RuntimeError: the toy is broken")


def test_an_undeclared_output_is_refused() -> None:
    bus = LocalNetwork().bus("x")
    with pytest.raises(ValueError, match="published 'vehicle/state'"):
        run_loop(_toy(kind="undeclared"), bus, Stop(), Heartbeat(bus, "x"))


@pytest.mark.parametrize(("at_once", "again", "total"), [(False, False, 3.0), (True, False, 1.0), (False, True, 1.0)])
def test_stop_answers_what_waits_unless_at_once_or_asked_again(at_once: bool, again: bool, total: float) -> None:
    network = LocalNetwork()
    stop = Stop()
    node = _StopAfter(stop, at_once)
    bus = network.bus("echo")
    bus.subscribe("vehicle/state")
    sender = network.bus("sender")

    class _Refill(_StopAfter):
        def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
            if self.total < 2.0:
                sender.publish("vehicle/state", VehicleState(stamp_ns=1, speed_mps=1.0))
                network.advance(1)
            return super().step(inputs, now_ns)

    node = _Refill(stop, at_once)
    sender.publish("vehicle/state", VehicleState(stamp_ns=0, speed_mps=1.0))
    if not at_once:
        # the node's own request is a second one
        node.stop = stop if again else Stop()
        stop.request()
    run_loop(node, bus, stop, Heartbeat(bus, "echo"))
    assert node.total == total


def test_in_process_graph_is_deterministic_and_runs_on_the_virtual_clock() -> None:
    def run() -> tuple[float, int]:
        network = LocalNetwork()
        tick = toy_nodes.create(toy_nodes.Params(period_s=0.1, ticks=5))
        echo = toy_nodes.Echo(toy_nodes.Params())
        graph = InProcessGraph(network, {"tick": tick, "echo": echo})
        graph.run()
        graph.close()
        return echo.total, network.now_ns

    assert run() == run() == (15.0, 400_000_000)


def test_stage_clock_keeps_order_and_starts_anew() -> None:
    clock = StageClock()
    for name in ("b", "a", "b"):
        with clock(name):
            pass
    assert [(stage.name, stage.count) for stage in clock.drain()] == [("b", 2), ("a", 1)]
    assert clock.drain() == ()


def test_a_node_that_gives_way_does_so_with_all_its_threads() -> None:
    """Linux keeps a niceness for each thread: also one that `create` started must give way, and later ones inherit."""
    program = """
import os, threading
from nodes.node import _lower_priority
def priorities():
    return sorted(os.getpriority(os.PRIO_PROCESS, int(task)) for task in os.listdir('/proc/self/task'))
end = threading.Event()
threading.Thread(target=end.wait).start()
before = priorities()
_lower_priority(3)
threading.Thread(target=end.wait).start()
after = priorities()
end.set()
assert after == [min(19, one + 3) for one in [*before, before[0]]], (before, after)
"""
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_log_records_travel_with_the_heartbeat() -> None:
    network = LocalNetwork()
    listener = network.bus("listener")
    listener.subscribe("log")
    bus = network.bus("x")
    handler = BusLogHandler("x")
    handler.emit(logging.LogRecord("n", logging.WARNING, "", 0, "careful", None, None))
    Heartbeat(bus, "x", handler).beat(NodeState.READY)
    record = listener.receive(0.0)[0].message
    assert (record.node, record.level, record.text) == ("x", "warning", "careful")


def test_lines_are_cut_cleaned_and_parsed() -> None:
    splitter = LineSplitter(limit=4)
    assert splitter.feed(b"a\x1b[2J\nbcdefg\xff") == ["a[2J", "bcde"]
    assert splitter.finish() == ["fg\ufffd"]
    entry = parse_line("n", '\x1e{"text": "t", "level": "info"}')
    assert (entry["node"], entry["level"], entry["text"]) == ("n", "info", "t")
    assert parse_line("n", '\x1e{"text": 1}')["level"] == "output"


def test_files_of_a_process_are_its_users_alone_and_its_failure_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    before = os.umask(0o022)
    try:
        assert run_process(lambda: (tmp_path / "written").touch() or 7) == 7  # type: ignore[func-returns-value]
        assert run_process(lambda: int("seven")) == EXIT_FAILED
    finally:
        os.umask(before)
    assert (tmp_path / "written").stat().st_mode & 0o777 == 0o600
    assert [record.getMessage() for record in caplog.records] == [
        "ValueError: invalid literal for int() with base 10: 'seven'"
    ]


def test_a_group_ends_at_once_with_the_member_that_fails(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its members are made in their own names, and the thread that makes them keeps its own."""
    # another program would take the place of the one that runs the tests, if that has compiled a kernel
    monkeypatch.setattr(group, "start_again_if_compiled", lambda words, close: None)
    name, stop = threading.current_thread().name, Stop()
    members = {kind: Member(module=TOY, params={"kind": kind}) for kind in ("echo", "crash")}
    handlers = logging.getLogger().handlers[:]
    try:
        assert Group(members, tmp_path, stop, []).run() == EXIT_FAILED
    finally:
        logging.getLogger().handlers[:] = handlers
    assert (stop.at_once, threading.current_thread().name) == (True, name)
    assert {record.threadName for record in caplog.records if record.levelname == "CRITICAL"} == {"crash"}


def test_a_node_of_another_package_goes_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The name of its entry point stands for its module, which may lie anywhere; its dotted name works as well."""
    monkeypatch.syspath_prepend(write_package(tmp_path, "acme", NODES, {"their_radar": "acme_nodes"}, acme_nodes=NODE))
    assert type(load_node("their_radar", {"rate_hz": 5.0}, "radar")).__name__ == "Theirs"
    assert type(load_node("acme_nodes", {}, "radar")).__name__ == "Theirs"
    with pytest.raises(ValueError, match=r"^radar\.params: .*unknown field rate_mhz; known are rate_hz"):
        load_node("their_radar", {"rate_mhz": 5.0}, "radar")


@pytest.mark.parametrize(
    ("module", "source", "line"),
    [
        ("broken_a", "oops", r"broken_a of acme 1\.2: broken_a cannot be imported: NameError: .*broken_a\.py:1\)"),
        ("broken_b", "def create(params): ...", r"broken_b is no node, it must define Params and create\(params\)"),
        ("broken_c", "Params = dict\ndef create(params): ...", "Params of broken_c must be a msgspec Struct, got .*"),
        ("broken_d", NODE.replace("Theirs()", "None"), r"create\(params\) of broken_d must return a Node, got None"),
    ],
)
def test_a_broken_node_of_another_package_is_one_line(
    module: str, source: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(write_package(tmp_path, "acme", NODES, {module: module}, **{module: source}))
    with pytest.raises(ValueError, match=rf"^radar\.module: {line}$"):
        load_node(module, {}, "radar")
