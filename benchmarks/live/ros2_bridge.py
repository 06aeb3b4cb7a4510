"""The bridge to ROS 2 beside the whole graph at the radar's real rate, heard by rclpy: losses, latency, restarts.

Latency added counts from the arrival of a message at a subscriber of the graph to that of what the bridge makes of it
at a node of ROS 2 on the same machine. The graph runs without the bridge too, for its own figures.
Usage: MIRRORWAVE_RCLPY=PYTHON python -m benchmarks.live.ros2_bridge [--duration S] [--domain N] [--json]
PYTHON is an interpreter with rclpy, sensor_msgs, nav_msgs, visualization_msgs and diagnostic_msgs of ROS 2; where it
has tf2_msgs, vision_msgs and radar_msgs too, all topics are heard.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.live import live_graph
from benchmarks.live.live_graph import quantiles
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import LogRecord, NodeStatus
from msgs.values.perception import BevFrame
from msgs.values.radar import RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import latency_ns

LAUNCH = CHECKOUT / "launch" / "corner_ros2.yaml"
SUBSCRIBER = Path(__file__).with_name("ros2_subscriber.py")
#: Longest wait for the first view, a restart, a late joiner.
PATIENCE_S = 300.0
#: The supervisor takes a node that is held for longer to hang.
LATE_S = 20.0
#: Stamps on both sides that differ by less are of one message; states are 10 ms apart at least.
SAME_NS = 3_000_000
#: Source of each topic on the graph's side.
SOURCES = {
    "/hidden_objects": BevFrame,
    "/hidden_detections": BevFrame,
    "/hidden_tracks": BevFrame,
    "/hidden_points": BevFrame,
    "/visibility": BevFrame,
    "/ra_map": RangeAzimuthMap,
    "/odom": VehicleState,
    "/tf": VehicleState,
    "/diagnostics": NodeStatus,
}
#: Sent once, for late joiners too.
LATCHED = "/tf_static"


class Subscriber:
    """A node of ROS 2 in a process of its own."""

    def __init__(self, python: str, domain: int, *options: str) -> None:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        environment.pop("PYTHONPATH", None)
        self._process = subprocess.Popen(
            [python, str(SUBSCRIBER), *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self.lines: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def topics(self) -> list[str]:
        """Return the topics whose types it has."""
        return next((line["subscribed"] for line in list(self.lines) if "subscribed" in line), [])

    def messages(self, topic: str) -> list[tuple[int, int]]:
        """Return stamp and arrival of what came on a topic."""
        return [(line["stamp_ns"], line["at_ns"]) for line in list(self.lines) if line.get("topic") == topic]

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._thread.join()
        self._process.wait()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self.lines.extend(json.loads(line) for line in self._process.stdout if line.startswith("{"))


class Graph:
    """The graph with its bridge, and what a subscriber of the graph receives."""

    def __init__(self, ros_domain: int) -> None:
        self.domain = f"bench{os.getpid()}"
        self.bus = ZmqBus("benchmark", run_dir(self.domain))
        for topic in ("perception/hidden_objects", "radar/ra_map", "vehicle/state", "diagnostics/node", "log"):
            self.bus.subscribe(topic)
        self.bus.want_all()
        command = [sys.executable, "-m", "mirrorwave", "launch", str(LAUNCH), "--domain", self.domain]
        self.process = subprocess.Popen(
            [*command, "-p", f"ros2.domain={ros_domain}"], cwd=CHECKOUT, stdout=subprocess.DEVNULL
        )
        self.arrivals: dict[type, list[tuple[int, int]]] = {}
        self.latency_ms: list[float] = []
        self.status: dict[str, list[NodeStatus]] = {}
        self.log: list[LogRecord] = []

    def until(self, is_done: Callable[[], bool], limit_s: float) -> bool:
        """Listen until a condition holds; false where the time is over before."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s:
            for received in self.bus.receive(0.02):
                self._take(received.message, time.monotonic_ns())
            if is_done():
                return True
        return False

    def close(self) -> None:
        """Stop the graph."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait()
        self.bus.close()

    def _take(self, message: Any, now_ns: int) -> None:
        if isinstance(message, LogRecord):
            self.log.append(message)
            return
        self.arrivals.setdefault(type(message), []).append((message.stamp_ns, now_ns))
        if isinstance(message, NodeStatus):
            self.status.setdefault(message.node, []).append(message)
        if isinstance(message, BevFrame):
            self.latency_ms.append(1e-6 * latency_ns(message.stamp_ns, now_ns))


def run(python: str, duration_s: float, domain: int) -> dict[str, Any]:
    """Run the graph without and with the bridge; returns the figures of both and of the topics."""
    without = live_graph.run(CHECKOUT / "launch" / "corner.yaml", duration_s, [], False, [])
    graph = Graph(domain)
    subscriber = Subscriber(python, domain)
    try:
        graph.until(lambda: len(subscriber.messages("/hidden_objects")) >= 5, PATIENCE_S)
        usage = [live_graph.usage_of(graph.process.pid)]
        start_ns = time.monotonic_ns()
        graph.latency_ms.clear()
        graph.status.clear()
        graph.until(lambda: False, duration_s)
        end_ns = time.monotonic_ns()
        usage.append(live_graph.usage_of(graph.process.pid))
        figures = live_graph.report(graph.latency_ms, [], graph.status, usage, 0)
        graph.until(lambda: False, 1.0)
        known = [name for name in SOURCES if name in subscriber.topics()]
        topics = {name: compare(graph, subscriber, name, start_ns, end_ns) for name in known}
        later = {
            "killed": killed(graph, subscriber),
            "mismatch": mismatch(graph, python, domain),
            "late_joiner": late_joiner(graph, python, domain),
        }
    finally:
        subscriber.close()
        graph.close()
    hashes = {line["hash_of"]: line["agrees"] for line in subscriber.lines if "hash_of" in line}
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "load_average": os.getloadavg(),
        "duration_s": duration_s,
        "topics": topics,
        "type_hash_agrees": hashes,
        **later,
        "bridge": figures["nodes"].get("ros2"),
        "graph_with_bridge": graph_figures(figures),
        "graph_without_bridge": graph_figures(without),
    }


def compare(graph: Graph, subscriber: Subscriber, name: str, start_ns: int, end_ns: int) -> dict[str, Any]:
    """Return how many messages of a stretch of time came, and how much later than at a subscriber of the graph."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    sent = [pair for pair in graph.arrivals[SOURCES[name]] if start_ns <= pair[1] < end_ns]
    came = subscriber.messages(name)
    stamps_ns = np.array([stamp_ns - offset_ns for stamp_ns, _ in came] or [0])
    added_ms, lost = [], 0
    for stamp_ns, at_ns in sent:
        nearest = int(np.argmin(np.abs(stamps_ns - stamp_ns)))
        if abs(stamps_ns[nearest] - stamp_ns) > SAME_NS:
            lost += 1
        else:
            added_ms.append(1e-6 * (came[nearest][1] - at_ns))
    return {"sent": len(sent), "lost": lost, "added_ms": quantiles(added_ms) if added_ms else None}


def late_joiner(graph: Graph, python: str, domain: int) -> dict[str, Any]:
    """Hold the geometry and start a new node: what it gets is the last grid from before its start."""
    pid, start_ns = graph.status["geometry"][-1].pid, time.time_ns()
    os.kill(pid, signal.SIGSTOP)
    subscriber = Subscriber(python, domain)
    try:
        came = graph.until(lambda: bool(subscriber.messages("/visibility")), LATE_S)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
        subscriber.close()
    first_ns = subscriber.messages("/visibility")[0][0] if came else start_ns
    return {
        "latched_grid": came and first_ns < start_ns,
        "age_at_start_s": round(1e-9 * (start_ns - first_ns), 2),
        "latched_transform": bool(subscriber.messages(LATCHED)),
    }


def killed(graph: Graph, subscriber: Subscriber) -> dict[str, Any]:
    """Kill the bridge; returns when the same subscriber received again, and the grid for late joiners with it."""
    pid, start_ns = graph.status["ros2"][-1].pid, time.monotonic_ns()
    os.kill(pid, signal.SIGKILL)

    def is_back() -> bool:
        restarted = graph.status["ros2"][-1].pid != pid
        return restarted and all(
            subscriber.messages(name) and subscriber.messages(name)[-1][1] > graph.arrivals[BevFrame][-1][1] - 10**9
            and subscriber.messages(name)[-1][1] > start_ns + 3 * 10**8
            for name in ("/hidden_objects", "/visibility", "/ra_map")
        )  # fmt: skip

    came = graph.until(is_back, PATIENCE_S)
    return {"receives_again": came, "after_s": round(1e-9 * (time.monotonic_ns() - start_ns), 2)}


def mismatch(graph: Graph, python: str, domain: int) -> list[str]:
    """Return what the bridge says of a node that wants latched points."""
    subscriber = Subscriber(python, domain, "--latched-points")
    try:
        graph.until(lambda: bool(said(graph)), PATIENCE_S)
    finally:
        subscriber.close()
    return said(graph)


def said(graph: Graph) -> list[str]:
    """Return lines of the bridge on qualities of service."""
    return [record.text for record in graph.log if record.node == "ros2" and "quality of service" in record.text]


def graph_figures(report: dict[str, Any]) -> dict[str, Any]:
    """Return what the bridge may change of the graph."""
    shares = {name: node["cpu_share"] for name, node in report["nodes"].items() if name != "ros2"}
    names = ("bev_frames", "latency_ms", "shed")
    lost = sum(count for where, count in report["lost_or_rejected"].items() if not where.startswith("ros2"))
    return {name: report[name] for name in names} | {"lost": lost, "cpu_shares": shares}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--domain", type=int, default=77, help="ROS_DOMAIN_ID of the run")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    python = os.environ.get("MIRRORWAVE_RCLPY")
    if not python:
        parser.error("MIRRORWAVE_RCLPY must name an interpreter with rclpy")
    result = run(python, arguments.duration, arguments.domain)
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
