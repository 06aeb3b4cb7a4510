"""Every node against any message that its peers could send, at any time, and against any parameters.

`MIRRORWAVE_FUZZ_EXAMPLES=2000` looks at so many examples of each node; without it at a few, the same each time.
"""

from __future__ import annotations

import collections
import functools
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from contrib.boards import dca1000_radar, phaser_radar
from models.perception.form import beams_to_maps as forming_stage
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from msgs.bus.codec import decode, encode
from msgs.bus.interface import Envelope, Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from nodes import bev_viewer
from nodes.can import bus as can_link
from nodes.node import Node, load_node
from nodes.recording import snapshot_recorder
from tests.fuzz.cases import CASES, PERIOD_NS, PageStandIn, WhimsicalBus, WhimsicalCard, WhimsicalDevice
from tests.fuzz.strategies import Said, Step, carried, scripts, wrong_params

EXAMPLES = int(os.environ.get("MIRRORWAVE_FUZZ_EXAMPLES", "0"))
FUZZ = settings(
    max_examples=EXAMPLES or 4,
    derandomize=not EXAMPLES,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
    print_blob=True,
)
#: Steps that may follow one input before a node rests: more is a node that never does.
MAX_STEPS = 200
#: The good answers of a fresh node are known for so many ways to make it.
VARIANTS = 8
#: Things that any node holds after any of these scripts, some hundred messages: arrays and strings count as one.
MAX_HELD = 20_000


def check(node: Node, out: Iterable[Outgoing], now_ns: int) -> list[Received]:
    """What went out, as a peer gets it: declared topics, messages that travel, numbers that are some."""
    received = []
    for topic, message in out:
        assert topic in node.outputs
        envelope = Envelope(publisher="node", topic=topic, sequence=0, sent_ns=max(now_ns, 0))
        received.append(decode([bytes(frame) for frame in encode(envelope, message)]))
        if topic not in ("radar/setup", "sim/truth"):
            assert is_finite(message), message
    return received


def is_finite(value: Any) -> bool:
    if isinstance(value, msgspec.Struct):
        return all(is_finite(getattr(value, name)) for name in value.__struct_fields__)
    if isinstance(value, np.ndarray):
        return value.dtype.kind not in "fc" or bool(np.isfinite(value).all())
    if isinstance(value, tuple):
        return all(map(is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def run(node: Node, script: Sequence[Step], end: int | None = None) -> list[Received]:
    """Step a node as its loop would, with what is of its inputs; what it answered."""
    answers: list[Received] = []
    for step in script[:end]:
        inputs = [one for one in step.inputs if one.topic in node.inputs]
        answers += check(node, node.step(inputs, step.now_ns), step.now_ns)
        answers += rest(node, step.now_ns)
        state, reason = node.health()
        assert state in NodeState
        assert "\n" not in reason
    return answers


def rest(node: Node, now_ns: int) -> list[Received]:
    """Due calls and pending work until the node waits."""
    answers: list[Received] = []
    for _ in range(MAX_STEPS):
        due_ns = node.due_ns(now_ns)
        assert due_ns is None or isinstance(due_ns, int)
        if node.finished() or not (node.pending() or (due_ns is not None and due_ns <= now_ns)):
            return answers
        answers += check(node, node.step([], now_ns), now_ns)
    if not isinstance(node.due_ns(now_ns), int) or node.pending():
        raise AssertionError("the node never rests")
    return answers


def held(value: Any, seen: set[int]) -> int:
    """How many things hang on a node: elements of containers, fields of objects."""
    if id(value) in seen or isinstance(value, str | bytes | int | float | np.ndarray | type | None):
        return 1
    seen.add(id(value))
    if isinstance(value, dict):
        # at once: a node's threads go on meanwhile
        return 1 + sum(held(one, seen) for one in list(value.values()))
    if isinstance(value, list | tuple | set | frozenset | collections.deque):
        return 1 + sum(held(one, seen) for one in list(value))
    return 1 + sum(held(one, seen) for one in list(vars(value).values())) if hasattr(value, "__dict__") else 1


@pytest.fixture(autouse=True)
def _maps_of_few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps a sixteenth as large: ten times as many examples in the same time."""
    monkeypatch.setattr(forming_stage, "RaFormer", small_former)


def small_former(setup: RadarSetup, params: FormingParams) -> RaFormer:
    grid = RangeAzimuthGrid(range_bin_m=setup.radar.range_bin_m, range_bins=128, azimuth_bins=64)
    return RaFormer(setup, params, grid)


class Meter:
    """What the examples of one test take: CPU time in seconds, and the process's memory early on and at the end."""

    def __init__(self) -> None:
        self._examples, self._cpu_s, self._slowest_s, self._start_mib = 0, 0.0, 0.0, 0.0

    @contextmanager
    def example(self) -> Iterator[None]:
        """One example; those that fail count as well."""
        start_s = time.process_time()
        yield
        took_s = time.process_time() - start_s
        self._examples += 1
        self._cpu_s, self._slowest_s = self._cpu_s + took_s, max(self._slowest_s, took_s)
        if self._examples <= max(EXAMPLES // 10, 1):
            # whatever is loaded or compiled once is there by then
            self._start_mib = resident_mib()

    def say(self, record: Callable[[str, object], None]) -> None:
        """Hand the figures over as properties of the test's report."""
        figures = {"examples": self._examples, "cpu_s": self._cpu_s, "slowest_cpu_s": self._slowest_s}
        for name, value in (figures | {"start_mib": self._start_mib, "end_mib": resident_mib()}).items():
            record(name, round(value, 2))


def resident_mib() -> float:
    """Memory of this process that is in use."""
    return float(psutil.Process().memory_info().rss) / 2**20


@pytest.mark.parametrize("name", CASES)
def test_no_message_and_no_time_breaks_a_node(name: str, record_property: Callable[[str, object], None]) -> None:
    case, meter = CASES[name], Meter()
    topics = sorted({said.topic for said in case.natural}) or ["vehicle/state"]

    @FUZZ
    @given(seed=st.integers(0, 999), script=scripts(case.natural, topics), data=st.data())
    def holds(seed: int, script: list[Step], data: st.DataObject) -> None:
        steps = script or [Step([], 10**9 * i) for i in range(5)]
        # first: a draw may end the example, and nobody would close the node
        end = data.draw(st.one_of(st.none(), st.integers(0, len(steps))), "closed after")
        with meter.example(), tempfile.TemporaryDirectory(prefix="mw") as folder:
            node = case.make(Path(folder), seed, script)
            try:
                run(node, steps, end)
                assert held(vars(node), set()) < MAX_HELD
                if case.talk and end is None and seed % 3 == 0:
                    assert_recovered(name, node, seed)
            finally:
                node.close()

    try:
        holds()
    finally:
        meter.say(record_property)


def assert_recovered(name: str, node: Node, seed: int) -> None:
    """After good scans in a row, later than all before, a node answers what a fresh one answers."""
    used, new = again(name, node), answers_of_fresh(name, seed % VARIANTS)
    assert new
    assert used
    assert_same(used[-1].message, new[-1].message, CASES[name].remembered)


@functools.cache
def answers_of_fresh(name: str, variant: int) -> list[Received]:
    node = CASES[name].make(Path(), variant, ())
    answers = again(name, node)
    node.close()
    return answers


def again(name: str, node: Node) -> list[Received]:
    start_ns = 2**61 + 2**60
    answers: list[Received] = []
    talk = CASES[name].talk
    assert talk is not None
    for scan in range(5):
        stamp_ns = start_ns + 4 * scan * PERIOD_NS
        for number, said in enumerate(talk(5000 + 2 * scan, stamp_ns)):
            envelope = Envelope(publisher="good", topic=said.topic, sequence=100 * scan + number, sent_ns=1, paced=True)
            received = carried(Said(said.topic, said.message), envelope)
            assert received is not None
            answers += check(node, node.step([received], stamp_ns), stamp_ns) + rest(node, stamp_ns)
    return answers


def assert_same(one: Any, other: Any, but: Sequence[str] = ()) -> None:
    assert type(one) is type(other)
    if isinstance(one, msgspec.Struct):
        for name in one.__struct_fields__:
            if name not in but:
                assert_same(getattr(one, name), getattr(other, name))
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


@pytest.mark.parametrize("name", CASES)
def test_parameters_make_a_node_or_a_line(
    name: str, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    case, meter = CASES[name], Meter()
    module = import_module(case.module)
    quiet(monkeypatch)
    with tempfile.TemporaryDirectory(prefix="mw") as root:
        good = case.good(Path(root))
        monkeypatch.chdir(root)

        @FUZZ
        @given(params=wrong_params(good, module.Params))
        def holds(params: dict[str, Any]) -> None:
            with meter.example():
                assert_made_or_line(case.module, params)

        try:
            holds()
        finally:
            meter.say(record_property)


def assert_made_or_line(module: str, params: dict[str, Any]) -> None:
    """A node that can be stepped and closed, or one line that says why there is none."""
    node = made_or_line(module, params)
    if isinstance(node, str):
        assert node
        return
    try:
        for now_ns in (0, 10**9, 2 * 10**9):
            check(node, node.step([], now_ns), now_ns)
            node.due_ns(now_ns)
    finally:
        node.close()


def made_or_line(module: str, params: dict[str, Any]) -> Node | str:
    """A node, or why there is none, as its host says it; `OSError` of a file that is not there is documented."""
    try:
        return load_node(module, params)
    except (ValueError, OSError) as error:
        return " ".join(str(error).split())


def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for a page, a kit, a CAN interface and the process's signals."""
    monkeypatch.setattr(bev_viewer, "ViewerServer", PageStandIn)
    monkeypatch.setattr(can_link, "open_bus", lambda params: WhimsicalBus(1))
    monkeypatch.setattr(can_link.CanLink.__init__, "__defaults__", (can_link.open_bus,))
    monkeypatch.setattr(dca1000_radar.dca1000, "Card", lambda params, lanes: WhimsicalCard(0))
    monkeypatch.setattr(phaser_radar.phaser_device, "Cn0566", lambda params, beams: WhimsicalDevice(0))
    monkeypatch.setattr(snapshot_recorder.signal, "signal", lambda number, action: None)
