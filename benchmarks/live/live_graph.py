"""The whole graph at the radar's real rate, one process a node: losses, latency, CPU and memory.

Latency counts from the nominal end of the last beam (its start plus its time on air) to the arrival of the view at a
subscriber outside the graph. The age of an object counts from the beams that measured it to the arrival of the first
view that says so. Cores and memory are those of the graph's processes: resident memory counts a page that several
share in each of them, proportional memory once.
Usage: python -m benchmarks.live.live_graph [--launch FILE] [--duration S] [--viewer] [--json]
       [--profile NAME | --budget-ms N] [--group PROCESS=NODE,NODE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from nodes.inputs.view_latency import NewObjects, latency_ns, stage_figures

ROOT = CHECKOUT
#: The graph runs so much longer than it is looked at: a scan that the end cuts short waits for beams that never come.
STOPPING_S = 2.0
QUANTILES = ("p50", "p90", "p99", "max")


def run(launch: Path, duration_s: float, overrides: list[str], viewer: bool, options: list[str]) -> dict:
    domain = f"bench{os.getpid()}"
    command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--duration", str(duration_s + STOPPING_S)]
    command += ["--domain", domain] + [part for item in overrides for part in ("-p", item)]
    command += options + ([] if viewer else ["--headless"])
    bus = ZmqBus("benchmark", run_dir(domain))
    for topic in ("perception/hidden_objects", "diagnostics/node"):
        bus.subscribe(topic)
    latency_ms, age_ms, status = [], [], {}
    usage: list[Usage] = []
    with tempfile.TemporaryFile("w+") as said:
        graph = subprocess.Popen(command, cwd=ROOT, stdout=said)
        _watch(bus, graph, duration_s, latency_ms, age_ms, status, usage)
        said.seek(0)
        selected = [line.strip() for line in said if line.startswith("profile ")]
    bus.close()
    if not usage:
        sys.exit("the graph must start, its reason is above")
    return {"options": options, "chosen": selected, **report(latency_ms, age_ms, status, usage, graph.returncode)}


class Usage(NamedTuple):
    """What the graph's processes have taken up to a time, in all."""

    at_s: float
    cpu_s: float
    resident_mib: float
    proportional_mib: float


def usage_of(graph_pid: int) -> Usage:
    """Return what the supervisor's process and all that it started have taken so far."""
    cpu_s = resident = proportional = 0.0
    supervisor = psutil.Process(graph_pid)
    for process in (supervisor, *supervisor.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            memory, times = process.memory_full_info(), process.cpu_times()
            cpu_s += times.user + times.system
            resident += memory.rss / 2**20
            proportional += memory.pss / 2**20
    return Usage(time.monotonic(), cpu_s, resident, proportional)


def _watch(
    bus: ZmqBus,
    graph: subprocess.Popen,
    duration_s: float,
    latency_ms: list[float],
    age_ms: list[float],
    status: dict[str, list[NodeStatus]],
    usage: list[Usage],
) -> None:
    """Take down when views come, for so long since the first, and what the nodes say until the graph ends."""
    end_ns, new_objects = None, NewObjects()
    while graph.poll() is None:
        if end_ns is not None and len(usage) < 1 + (time.monotonic_ns() >= end_ns):
            usage.append(usage_of(graph.pid))
        for received in bus.receive(0.05):
            now_ns = time.monotonic_ns()
            if isinstance(received.message, BevFrame):
                end_ns = end_ns or now_ns + round(1e9 * duration_s)
                if now_ns < end_ns:
                    latency_ms.append(1e-6 * latency_ns(received.message.stamp_ns, now_ns))
                    age_ms += [1e-6 * (now_ns - item.stamp_ns) for item in new_objects.of(received.message)]
            elif isinstance(received.message, NodeStatus):
                status.setdefault(received.message.node, []).append(received.message)


def report(
    latency_ms: list[float],
    age_ms: list[float],
    status: dict[str, list[NodeStatus]],
    usage: list[Usage],
    exit_code: int,
) -> dict:
    ready = {name: [item for item in items if item.state == "ready"] for name, items in status.items()}
    nodes = {name: node_report(items) for name, items in ready.items() if len(items) >= 2}
    lost = {
        f"{name}: {count.topic}": count.lost + count.rejected
        for name, items in status.items()
        for count in items[-1].received
    }
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "exit_code": exit_code,
        "bev_frames": len(latency_ms),
        "latency_ms": quantiles(latency_ms),
        "object_age_ms": quantiles(age_ms),
        "lost_or_rejected": lost,
        "shed": {name: shed for name, items in status.items() if (shed := shed_of(items[-1]))},
        "nodes": nodes,
        "cores": round((usage[-1].cpu_s - usage[0].cpu_s) / max(usage[-1].at_s - usage[0].at_s, 1e-9), 2),
        "resident_mib": round(usage[-1].resident_mib),
        "proportional_mib": round(usage[-1].proportional_mib),
    }


def quantiles(latency_ms: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Median, 90 and 99 percent and longest, to a tenth of a millisecond; not a number of none."""
    if len(latency_ms) == 0:
        return dict.fromkeys(QUANTILES, float("nan"))
    return dict(zip(QUANTILES, np.percentile(latency_ms, [50, 90, 99, 100]).round(1).tolist(), strict=True))


def node_report(items: list[NodeStatus]) -> dict:
    first, last = items[0], items[-1]
    wall_s = max(last.uptime_s - first.uptime_s, 1e-9)
    quarter = items[len(items) // 4]
    return {
        "cpu_share": round((last.cpu_s - first.cpu_s) / wall_s, 3),
        "resident_mib": round(last.resident_bytes / 2**20, 1),
        "growth_after_first_quarter_mib": round((last.resident_bytes - quarter.resident_bytes) / 2**20, 1),
        "stages_ms": stages_ms(items),
    }


def shed_of(status: NodeStatus) -> dict[str, int]:
    """What a node left undone so far, messages that a newer one overtook included."""
    shed = {f"{count.what} {count.reason}": count.count for count in status.shed}
    return shed | {f"{count.topic} outdated": count.outdated for count in status.received if count.outdated}


def stages_ms(items: list[NodeStatus]) -> dict[str, dict[str, float | None]]:
    """Durations of each stage over all heartbeats."""
    figures = stage_figures([stage for item in items for stage in item.stages])
    return {
        one.name: {
            "mean": round(one.mean_ms, 2),
            "p99": None if one.p99_ms is None else round(one.p99_ms, 2),
            "max": round(one.max_ms, 2),
        }
        for one in figures
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--launch", type=Path, default=ROOT / "launch" / "corner.yaml")
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("-p", dest="overrides", action="append", default=[])
    parser.add_argument("--viewer", action="store_true", help="start the launch file's viewers too")
    parser.add_argument("--profile")
    parser.add_argument("--budget-ms", help="let the graph choose the profile")
    parser.add_argument("--group", action="append", default=[], help="host these nodes in one process")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    options = ["--profile", arguments.profile] if arguments.profile else []
    options += ["--latency-budget-ms", arguments.budget_ms] if arguments.budget_ms else []
    options += [part for group in arguments.group for part in ("--group", group)]
    result = run(arguments.launch, arguments.duration, arguments.overrides, arguments.viewer, options)
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
