"""Faults on the real processes: what the supervisor promises, measured.

Each node of a running graph is killed and stopped in turn, with every time counted from the fault: seen by the
supervisor, the first message of its new process on each of its topics, the first view of a scan measured afterwards;
and which other processes ended. Then launches, from the command to the first view, and Ctrl-C at different moments of
start and run: how long it takes, and what processes are left. Launches are warm: one comes before those that count.

Usage: python -m benchmarks.live.faults [--repeats 5] [--launches 10] [--stops 100] [--launch FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import psutil

from mirrorwave.plots.markdown import table
from msgs.bus.interface import Received
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus
from msgs.values.perception import BevFrame
from nodes.process.launch_file import SUPERVISOR

ROOT = CHECKOUT
LAUNCHES = (ROOT / "launch" / "corner.yaml", ROOT / "launch" / "corner_can.yaml")
#: Heard of the nodes; not the beams, because listening to 350 MB/s changes what is measured.
HEARD = ("radar/setup", "sim/truth", "vehicle/state", "radar/ra_map", "perception/peaks", "perception/hidden_objects")
PATIENCE_S = 90.0
#: Between two faults, in which the graph comes to rest.
REST_S = 3.0
#: Stops come at moments spread over so long: into the start, up to well into the run.
STOP_WITHIN_S = 7.0


class Graph:
    """A launched graph and an observer of it."""

    def __init__(
        self, launch: Path, domain: str, folder: Path, overrides: Iterable[str] = (), options: Iterable[str] = ()
    ) -> None:
        self.domain = domain
        command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--domain", domain]
        command += ["--runs-dir", str(folder), *(part for item in overrides for part in ("-p", item)), *options]
        self.started_ns = time.monotonic_ns()
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, start_new_session=True)
        self.pids: dict[str, int] = {}
        #: Topics that each node has published so far.
        self.said: dict[str, set[str]] = {}
        self._bus: ZmqBus | None = None

    def observe(self) -> None:
        """Listen in; a graph that is only to be stopped is left alone."""
        self._bus = ZmqBus("observer", run_dir(self.domain))
        for topic in ("log", "diagnostics/node", *HEARD):
            self._bus.subscribe(topic)

    def wait_for(self, done: Callable[[], bool], take: Callable[[Received], None] = lambda _: None) -> None:
        """Take in messages until `done`; `TimeoutError` after `PATIENCE_S`, `RuntimeError` if the graph ends."""
        assert self._bus is not None
        end_s = time.monotonic() + PATIENCE_S
        while not done():
            if self.process.poll() is not None:
                raise RuntimeError(f"{self.domain}: the graph has ended with code {self.process.returncode}")
            if time.monotonic() > end_s:
                raise TimeoutError(f"{self.domain}: what was waited for did not come within {PATIENCE_S:g} s")
            for received in self._bus.receive(0.05):
                if isinstance(received.message, NodeStatus):
                    self.pids[received.message.node] = received.message.pid
                elif received.topic in HEARD:
                    self.said.setdefault(received.envelope.publisher, set()).add(received.topic)
                take(received)

    def listen(self, duration_s: float) -> None:
        """Take in heartbeats for a while."""
        end_s = time.monotonic() + duration_s
        self.wait_for(lambda: time.monotonic() > end_s)

    def first_view_s(self) -> float:
        """Seconds from the command to the first view."""
        views: list[int] = []

        def take(received: Received) -> None:
            if isinstance(received.message, BevFrame):
                views.append(received.envelope.sent_ns)

        self.wait_for(lambda: bool(views), take)
        return 1e-9 * (views[0] - self.started_ns)

    def stop(self) -> tuple[float, int, int]:
        """Ctrl-C: seconds until it has ended, its exit code, and how many of its processes are left."""
        start_s = time.monotonic()
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
        code = self.process.wait(PATIENCE_S)
        took_s = time.monotonic() - start_s
        if self._bus is not None:
            self._bus.close()
        left = len(processes_of(self.domain))
        shutil.rmtree(run_dir(self.domain), ignore_errors=True)
        return took_s, code, left


class Aftermath:
    """Times after a fault of one node, in seconds from it: what was seen first of each kind."""

    def __init__(self, node: str, pid: int) -> None:
        self.node, self._old_pid, self.fault_ns = node, pid, time.monotonic_ns()
        self.times_s: dict[str, float] = {}

    def take(self, received: Received) -> None:
        """Note what a message tells."""
        message, sent_ns = received.message, received.envelope.sent_ns
        if sent_ns < self.fault_ns:
            return
        if isinstance(message, LogRecord) and message.node == SUPERVISOR:
            name, _, text = message.text.partition(" ")
            if name == self.node and text.startswith(("was ended", "has not answered", "hangs")):
                self._note("seen", message.stamp_ns)
                if not text.startswith("has not answered"):
                    self._note("given up", message.stamp_ns)
        elif isinstance(message, NodeStatus):
            if (message.node, message.state) == (self.node, NodeState.READY) and message.pid != self._old_pid:
                self._note("ready", sent_ns)
        elif received.envelope.publisher == self.node and received.topic in HEARD:
            self._note(received.topic, sent_ns)
        if isinstance(message, BevFrame) and message.stamp_ns > self.fault_ns:
            self._note("view", sent_ns)

    def is_over(self, kinds: Iterable[str]) -> bool:
        """Whether all of these have been seen."""
        return {*kinds, "seen", "view"} <= self.times_s.keys()

    def _note(self, kind: str, at_ns: int) -> None:
        self.times_s.setdefault(kind, 1e-9 * (at_ns - self.fault_ns))


def processes_of(graph: str | Path) -> list[int]:
    """Every process whose command line names a graph's domain or folder, this one and zombies left out."""
    found = []
    for process in psutil.process_iter(["pid", "cmdline", "status"]):
        names_it = any(str(graph) in part for part in process.info["cmdline"] or ())
        if names_it and process.info["pid"] != os.getpid() and process.info["status"] != psutil.STATUS_ZOMBIE:
            found.append(process.info["pid"])
    return found


def overrides_of(launch: Path, own: list[str]) -> list[str]:
    """Overrides of a launch file: where it has a CAN bus, one of its own on this machine."""
    port = f"{20000 + os.getpid() % 10000}"
    can = [f"{node}.options.port={port}" for node in ("car", "vehicle_can")]
    return [*(can if launch.name == "corner_can.yaml" else []), *own]


def hurt(graph: Graph, node: str, number: signal.Signals) -> dict[str, Any]:
    """What comes after a signal to one node: times, and which others ended."""
    before = dict(graph.pids)
    aftermath = Aftermath(node, before[node])
    os.kill(before[node], number)
    said = sorted(graph.said.get(node, ()))
    graph.wait_for(lambda: aftermath.is_over(["ready", *said]), aftermath.take)
    graph.listen(REST_S)
    others = [name for name, pid in before.items() if name != node and graph.pids[name] != pid]
    # a node without topics, as a viewer, is back with its heartbeat
    again_s = max(aftermath.times_s[kind] for kind in said or ["ready"])
    times_s = {**aftermath.times_s, "again": again_s}
    return {"node": node, "signal": number.name, "times_s": times_s, "others_that_ended": others}


def hurt_each(launch: Path, folder: Path, repeats: int, own: list[str], only: list[str]) -> list[dict[str, Any]]:
    """Every node of a graph killed and stopped in turn; a fresh graph for each repeat, with no restarts in it yet."""
    rows = []
    for repeat in range(repeats):
        graph = Graph(launch, f"faults{os.getpid()}-{launch.stem}-{repeat}", folder, overrides_of(launch, own))
        try:
            graph.observe()
            graph.first_view_s()
            graph.listen(1.5)
            for node in sorted(name for name in graph.pids if name != SUPERVISOR and name in (only or graph.pids)):
                for number in (signal.SIGKILL, signal.SIGSTOP):
                    row = {"launch": launch.stem, **hurt(graph, node, number)}
                    _progress(f"{repeat + 1}/{repeats} {row}")
                    rows.append(row)
        finally:
            graph.stop()
    return rows


def launch_again_and_again(launch: Path, folder: Path, launches: int, own: list[str]) -> list[float]:
    """Seconds from the command to the first view, of each launch but the first."""
    times_s = []
    for index in range(launches + 1):
        graph = Graph(launch, f"launch{os.getpid()}-{index}", folder, overrides_of(launch, own))
        try:
            graph.observe()
            times_s.append(graph.first_view_s())
        finally:
            graph.stop()
        _progress(f"launch {index}/{launches}: first view after {times_s[-1]:.2f} s")
    return times_s[1:]


def stop_again_and_again(launch: Path, folder: Path, stops: int, own: list[str]) -> dict[str, Any]:
    """Ctrl-C at moments spread over start and run."""
    rows = []
    for index in range(stops):
        # the golden section spreads any number of moments evenly
        after_s = STOP_WITHIN_S * (0.618034 * index % 1.0)
        graph = Graph(launch, f"stops{os.getpid()}-{index}", folder, overrides_of(launch, own))
        time.sleep(after_s)
        took_s, code, left = graph.stop()
        rows.append({"after_s": after_s, "took_s": took_s, "exit_code": code, "left": left})
        _progress(f"stop {index + 1}/{stops}: {rows[-1]}")
    return {"stops": stops, "clean": sum(row["left"] == 0 for row in rows), "rows": rows}


def _progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def fault_table(rows: list[dict[str, Any]]) -> list[str]:
    """One line of Markdown a node and fault: median / maximum of each time."""
    heads = ("graph", "node", "fault", "seen", "given up", "publishes again", "view again", "others ended")
    lines = []
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["launch"], row["node"], row["signal"]), []).append(row)
    for (launch, node, number), found in groups.items():
        times = [row["times_s"] for row in found]
        kinds = ("seen", "given up", "again", "view")
        cells = [_span([item[kind] for item in times if kind in item]) for kind in kinds]
        others = sum(len(row["others_that_ended"]) for row in found)
        lines.append((launch, node, number, *cells, others))
    return table(heads, lines)


def _span(values: list[float]) -> str:
    return f"{statistics.median(values):.2f} / {max(values):.2f} s" if values else "-"


def report(result: dict[str, Any]) -> str:
    """All of it as Markdown."""
    lines = fault_table(result["faults"]) if result["faults"] else []
    if times_s := result["first_view_s"]:
        lines += ["", f"First view after launch, {len(times_s)} times: {_span(times_s)} (median / longest)."]
    if rows := result["ctrl_c"]["rows"]:
        clean, stops = result["ctrl_c"]["clean"], result["ctrl_c"]["stops"]
        lines += ["", f"Ctrl-C: no process left in {clean} of {stops}, {_span([row['took_s'] for row in rows])}."]
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--launch", dest="files", type=Path, action="append", help="instead of the usual launch files")
    parser.add_argument("--repeats", type=int, default=5, help="of each fault")
    parser.add_argument("--launches", type=int, default=10)
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument("--node", dest="nodes", action="append", default=[], help="only this node; may be repeated")
    parser.add_argument("-p", dest="overrides", action="append", default=[])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    files = arguments.files or LAUNCHES
    own = arguments.overrides
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        faults = [row for file in files for row in hurt_each(file, folder, arguments.repeats, own, arguments.nodes)]
        launches = launch_again_and_again(files[0], folder, arguments.launches, own) if arguments.launches else []
        stops = stop_again_and_again(files[0], folder, arguments.stops, own)
    result = {"faults": faults, "first_view_s": launches, "ctrl_c": stops}
    print(json.dumps(result) if arguments.json else report(result))


if __name__ == "__main__":
    main()
