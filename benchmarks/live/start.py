"""Where the time goes from the command to the first view, and from a node's interpreter to what it works with.

`graph`: N launches of a launch file, seconds from the command to each step, medians; the first launch is not counted.
A node *lives* with its first heartbeat and *begins* when it is ready and all nodes before it are; between the two it is
imported and made, and waits for others.
`nodes`: each node by itself in a fresh interpreter, milliseconds of processor time by step, medians; kernels are those
that its making and a set-up load from numba's cache.

Usage: python -m benchmarks.live.start graph|nodes [--repeats 5] [--launch FILE] [--group PROCESS=NODE,NODE] [--json]
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.live.faults import HEARD, LAUNCHES, ROOT, Graph, hear_ctrl_c
from mirrorwave.studies.report import table
from msgs.bus.interface import Received
from msgs.files.shipped import LAUNCH
from msgs.values.diagnostics import NodeState, NodeStatus
from nodes.process.fork_server import NODE_ENVIRONMENT
from nodes.process.launch_file import SUPERVISOR

VIEW = "perception/hidden_objects"
SCENE = str(LAUNCH / "scenes" / "facade_across_lane.yaml")
#: What several nodes import beside numpy and the bus, which this program has imported already.
LIBRARIES = ("numba", "scipy.fft", "scipy.ndimage")
NODES = ("player", "ra_former", "dense_predictor", "geometry")


class LaunchSteps:
    """Seconds from the command to each step of one launch, and what nodes say of their start."""

    def __init__(self, started_ns: int) -> None:
        self._started_ns = started_ns
        self.steps_s: dict[str, float] = {}
        self.took_s: dict[str, float] = {}

    def take(self, received: Received) -> None:
        """Note what a message tells."""
        message, publisher = received.message, received.envelope.publisher
        if isinstance(message, NodeStatus):
            self._take_status(message)
        elif received.topic in HEARD:
            self._note(f"{publisher}: {received.topic}", received.envelope.sent_ns)

    def is_over(self) -> bool:
        """Return whether there is a view, and each node has said how long it took to be made."""
        has_view = any(step.endswith(VIEW) for step in self.steps_s)
        return has_view and sum(name.endswith("made in") for name in self.took_s) >= len(NODES)

    def _take_status(self, status: NodeStatus) -> None:
        if status.node == SUPERVISOR:
            self._note("supervisor runs", status.stamp_ns)
            return
        self._note(f"{status.node} {'lives' if status.state is NodeState.STARTING else 'begins'}", status.stamp_ns)
        for stage in status.stages:
            if stage.name == "make":
                self.took_s.setdefault(f"{status.node} imported and made in", 1e-3 * stage.last_ms)

    def _note(self, step: str, at_ns: int) -> None:
        self.steps_s.setdefault(step, 1e-9 * (at_ns - self._started_ns))


def launch_steps(launch: Path, domain: str, folder: Path, options: list[str]) -> LaunchSteps:
    """Return the steps of one launch."""
    graph = Graph(launch, domain, folder, options=options)
    steps = LaunchSteps(graph.started_ns)
    try:
        graph.observe()
        graph.wait_for(steps.is_over, steps.take)
    finally:
        graph.stop()
    return steps


def launches(launch: Path, repeats: int, options: list[str]) -> dict[str, dict[str, float]]:
    """Return the medians of the steps of all launches but the first."""
    with tempfile.TemporaryDirectory() as folder:
        runs = [launch_steps(launch, f"start{os.getpid()}-{i}", Path(folder), options) for i in range(repeats + 1)][1:]
    steps = _medians([run.steps_s for run in runs])
    return {
        "seconds_from_command": dict(sorted(steps.items(), key=lambda item: item[1])),
        "seconds": _medians([run.took_s for run in runs]),
        "first_view_s": {str(i): round(run.steps_s[f"geometry: {VIEW}"], 3) for i, run in enumerate(runs)},
    }


def alone(node: str) -> dict[str, float]:
    """Make one node here; milliseconds of processor time by step."""
    steps: dict[str, float] = {"interpreter, numpy, bus": _cpu_ms()}

    def note(step: str) -> None:
        steps[step] = _cpu_ms() - sum(steps.values())

    for name in LIBRARIES:
        importlib.import_module(name)
        note(name)
    from models.compiled import KernelCache, prepare

    prepare()
    note("kernels' runtime")
    importlib.import_module(f"nodes.{node}")
    note("node's modules")
    loads_ms = _count_loads(KernelCache)
    _make(node)
    kernels_ms = sum(loads_ms)
    note("made and set up")
    steps["made and set up"] -= kernels_ms
    return {**steps, f"{len(loads_ms)} kernels": kernels_ms}


def _make(node: str) -> None:
    from mirrorwave.profiles import read_profile
    from msgs.bus.interface import Envelope
    from msgs.values.radar import RadarSetup
    from nodes.node import load_node

    params: dict[str, Any] = {"scene": SCENE} if node == "player" else read_profile("default").get(node, {})
    made = load_node(f"nodes.{node}", params)
    if "radar/setup" in made.inputs:
        envelope = Envelope(publisher="start", topic="radar/setup", sequence=0, sent_ns=0)
        made.step([Received("radar/setup", RadarSetup(), envelope)], 0)


def _count_loads(cache: Any) -> list[float]:
    """Return a list that grows by a duration [ms] with every kernel that is loaded."""
    loads_ms: list[float] = []
    load = cache.load_overload

    def timed(*arguments: Any) -> Any:
        start_ms = _cpu_ms()
        loaded = load(*arguments)
        loads_ms.append(_cpu_ms() - start_ms)
        return loaded

    cache.load_overload = timed
    return loads_ms


def _cpu_ms() -> float:
    return 1e3 * time.process_time()


def nodes_alone(repeats: int) -> dict[str, dict[str, float]]:
    """Return the medians of each node's steps, each time in a fresh interpreter; the first is not counted."""
    command = [sys.executable, "-m", "benchmarks.live.start", "alone", "--node"]
    env = {**os.environ, **NODE_ENVIRONMENT}
    runs = {
        node: [
            json.loads(subprocess.run([*command, node], cwd=ROOT, env=env, capture_output=True, check=True).stdout)
            for _ in range(repeats + 1)
        ][1:]
        for node in NODES
    }
    return {node: _medians(found) for node, found in runs.items()}


def _medians(runs: list[dict[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for run in runs for name in run)
    return {name: round(statistics.median(run[name] for run in runs if name in run), 3) for name in names}


def page(columns: dict[str, dict[str, float]]) -> str:
    """Return a table in Markdown, a row a step."""
    steps = dict.fromkeys(step for column in columns.values() for step in column)
    rows = [(step, *(f"{column[step]:g}" if step in column else "" for column in columns.values())) for step in steps]
    return "\n".join(table(("", *columns), rows))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("graph", "nodes", "alone"))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--launch", type=Path, default=LAUNCHES[0])
    parser.add_argument("--group", action="append", default=[], help="host these nodes in one process")
    parser.add_argument("--node", choices=NODES, default=NODES[0], help="for `alone`")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    hear_ctrl_c()
    if arguments.what == "alone":
        print(json.dumps(alone(arguments.node)))
        return
    if arguments.what == "nodes":
        found = nodes_alone(arguments.repeats)
    else:
        options = ["--headless", *(part for group in arguments.group for part in ("--group", group))]
        found = launches(arguments.launch, arguments.repeats, options)
    print(json.dumps(found) if arguments.json else page(found))


if __name__ == "__main__":
    main()
