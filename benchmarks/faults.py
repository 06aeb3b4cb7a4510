"""Faults on the real processes: kill -9 of each node in turn, and Ctrl-C again and again.

For each node: time from the kill to the first view of a scan measured after it, and whether any other process ended.
For Ctrl-C: how many processes of the graph are left. Usage: python -m benchmarks.faults [--stops 20] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from msgs.diagnostics import NodeStatus
from msgs.perception import BevFrame
from msgs.zmq_bus import ZmqBus, run_dir

ROOT = Path(__file__).resolve().parents[1]
LAUNCH = ROOT / "launch" / "corner.yaml"
PATIENCE_S = 60.0


class Graph:
    """A launched graph and an observer of it."""

    def __init__(self, domain: str, overrides: list[str]) -> None:
        self.domain = domain
        command = [sys.executable, "-m", "mirrorwave", "launch", str(LAUNCH), "--domain", domain]
        command += [part for item in overrides for part in ("-p", item)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, start_new_session=True)
        self.bus = ZmqBus("observer", run_dir(domain))
        for topic in ("perception/hidden_objects", "diagnostics/node"):
            self.bus.subscribe(topic)
        self.pids: dict[str, int] = {}

    def wait_for_view(self, after_ns: int = 0) -> float:
        """Seconds from now to the first view of a scan that began after `after_ns`."""
        start_s = time.monotonic()
        self._until(lambda message: isinstance(message, BevFrame) and message.stamp_ns > after_ns)
        return time.monotonic() - start_s

    def listen(self, duration_s: float) -> None:
        """Take in heartbeats for a while."""
        end_s = time.monotonic() + duration_s
        self._until(lambda _: time.monotonic() > end_s)

    def stop(self) -> int:
        """Ctrl-C; number of the graph's processes that are left afterwards."""
        os.killpg(self.process.pid, signal.SIGINT)
        self.process.wait(PATIENCE_S)
        self.bus.close()
        return len(processes_of(self.domain))

    def _until(self, done: Callable[[object], bool]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            for received in self.bus.receive(0.05):
                if isinstance(received.message, NodeStatus):
                    self.pids[received.message.node] = received.message.pid
                if done(received.message):
                    return
        raise TimeoutError(f"nothing came within {PATIENCE_S} s")


def processes_of(domain: str) -> list[int]:
    """Every process whose command line names the domain, this one and zombies left out."""
    found = []
    for process in psutil.process_iter(["pid", "cmdline", "status"]):
        names_domain = any(domain in part for part in process.info["cmdline"] or ())
        if names_domain and process.info["pid"] != os.getpid() and process.info["status"] != psutil.STATUS_ZOMBIE:
            found.append(process.info["pid"])
    return found


def kill_each(overrides: list[str]) -> list[dict]:
    graph = Graph(f"faults{os.getpid()}", overrides)
    rows = []
    try:
        graph.wait_for_view()
        graph.listen(1.5)
        for node in ("player", "ra_former", "dense_predictor", "geometry"):
            before = dict(graph.pids)
            os.kill(before[node], signal.SIGKILL)
            again_s = graph.wait_for_view(after_ns=time.monotonic_ns())
            graph.listen(1.5)
            others = [name for name, pid in before.items() if name != node and graph.pids[name] != pid]
            rows.append({"node": node, "view_again_s": round(again_s, 2), "others_that_ended": others})
            graph.listen(2.0)
    finally:
        left = graph.stop()
    return [*rows, {"processes_left": left}]


def stop_again_and_again(stops: int, overrides: list[str]) -> dict:
    left, wall_s = [], []
    for index in range(stops):
        graph = Graph(f"stops{os.getpid()}_{index}", overrides)
        # a different moment of the start each time, up to well into the running graph
        time.sleep(0.35 * index)
        start_s = time.monotonic()
        left.append(graph.stop())
        wall_s.append(time.monotonic() - start_s)
    return {"stops": stops, "clean": left.count(0), "longest_stop_s": round(max(wall_s), 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=20)
    parser.add_argument("-p", dest="overrides", action="append", default=[])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = {
        "kill": kill_each(arguments.overrides),
        "ctrl_c": stop_again_and_again(arguments.stops, arguments.overrides),
    }
    print(json.dumps(result, indent=None if arguments.json else 2))


if __name__ == "__main__":
    main()
