"""The graph with half the cores taken away and given back: what was shed, counted and lost, and how fast it recovers.

Runs `launch/corner.yaml` at the real rate in three phases. In the second the nodes (not the player: it stands for the
radar, which has its own electronics) may run on the upper half of the cores only (`sched_setaffinity`), and `--busy`
processes a core of that half compete there at equal priority; `--busy 0` takes the cores alone. `--quota CORES` limits
the nodes' processor time instead, as on a small board: so many cores in all, in periods of 100 ms (needs root and the
kernel's control groups). Then all is given back.
Each scan falls into the phase in which its last beam ended; it brings a view in time, a late one or none, and for each
that brings none the nodes' counters must have a reason. Recovered is the graph from the first of ten successive scans
on whose views come in time. `source_late_ms` is what the player itself was late: where it is not near 0 the machine has
too few cores for this experiment, and latencies hold that lateness too. The scene's seed is that of the launch file
(0); what competes draws no numbers.
Usage: python -m benchmarks.live.overload [--phase S] [--busy N | --quota CORES] [--profile NAME] [-p node.key=value]
       [--group PROCESS=NODE,NODE] [--json]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from benchmarks.live.live_graph import quantiles, shed_of, stages_ms
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import DEADLINE_S, latency_ns

ROOT = CHECKOUT
LAUNCH = ROOT / "launch" / "corner.yaml"
PHASES = ("before", "during", "after")
#: The player stands for the radar: its share of the machine is not what the graph may lose.
SPARED = ("player", "supervisor")
START_S, STOP_S = 120.0, 30.0
_CGROUPS, _PERIOD_US = Path("/sys/fs/cgroup"), 100_000
#: So many successive scans in time are a graph that has recovered.
STEADY_SCANS = 10


class View(NamedTuple):
    """A view as it arrived."""

    scan_id: int
    #: Nominal end of the last beam, on the bus clock.
    ended_ns: int
    latency_ms: float


class Watch:
    """All views and heartbeats of a graph."""

    def __init__(self, domain: str) -> None:
        self.bus = ZmqBus("observer", run_dir(domain))
        for topic in ("perception/hidden_objects", "diagnostics/node", "vehicle/state"):
            self.bus.subscribe(topic)
        self.views: list[View] = []
        self.status: dict[str, list[NodeStatus]] = {}
        #: Sending of each beam's vehicle state, and how late by its stamp: what the simulated radar is late itself.
        self.source_late: list[tuple[int, float]] = []

    def listen(self, duration_s: float, until_view: bool = False) -> None:
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s and not (until_view and self.views):
            for received in self.bus.receive(0.05):
                now_ns = time.monotonic_ns()
                if isinstance(received.message, BevFrame):
                    late_ns = latency_ns(received.message.stamp_ns, now_ns)
                    self.views.append(View(received.message.scan_id, now_ns - late_ns, 1e-6 * late_ns))
                elif isinstance(received.message, VehicleState):
                    sent_ns = received.envelope.sent_ns
                    self.source_late.append((sent_ns, 1e-6 * (sent_ns - received.message.stamp_ns)))
                elif isinstance(received.message, NodeStatus):
                    self.status.setdefault(received.message.node, []).append(received.message)


class Squeeze:
    """Half the cores for the graph's nodes, shared with busy processes, until `release`."""

    def __init__(self, pids: list[int], busy: int) -> None:
        self._cores = sorted(os.sched_getaffinity(0))
        self._pids = pids
        half = self._cores[len(self._cores) // 2 :]
        self._pin(half)
        context = multiprocessing.get_context("spawn")
        self._busy = [context.Process(target=_burn, args=(core,), daemon=True) for core in half for _ in range(busy)]
        for process in self._busy:
            process.start()

    def release(self) -> None:
        for process in self._busy:
            process.kill()
            process.join()
        self._pin(self._cores)

    def _pin(self, cores: list[int]) -> None:
        for pid in self._pids:
            for thread in psutil.Process(pid).threads():
                os.sched_setaffinity(thread.id, cores)


class Quota:
    """A limit in cores on the processor time that all nodes have together, until `release`."""

    def __init__(self, pids: list[int], cores: float) -> None:
        is_unified = (_CGROUPS / "cgroup.controllers").exists()
        self._parent = _CGROUPS if is_unified else _CGROUPS / "cpu"
        self._group = self._parent / f"mirrorwave-{os.getpid()}"
        self._group.mkdir()
        quota_us = round(cores * _PERIOD_US)
        if is_unified:
            (self._group / "cpu.max").write_text(f"{quota_us} {_PERIOD_US}")
        else:
            (self._group / "cpu.cfs_period_us").write_text(str(_PERIOD_US))
            (self._group / "cpu.cfs_quota_us").write_text(str(quota_us))
        self._pids = pids
        self._move(self._group)

    def release(self) -> None:
        self._move(self._parent)
        self._group.rmdir()

    def _move(self, group: Path) -> None:
        for pid in self._pids:
            (group / "cgroup.procs").write_text(str(pid))


def _burn(core: int) -> None:
    os.sched_setaffinity(0, {core})
    while True:
        sum(range(10_000))


def run(phase_s: float, busy: int, quota: float | None, options: list[str]) -> dict:
    domain = f"overload{os.getpid()}"
    command = [sys.executable, "-m", "mirrorwave", "launch", str(LAUNCH), "--headless", "--domain", domain]
    command += options
    watch = Watch(domain)
    graph = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, start_new_session=True)
    edges_ns, counters = [], []
    try:
        watch.listen(START_S, until_view=True)
        watch.listen(2.0)
        for phase in PHASES:
            edges_ns.append(time.monotonic_ns())
            counters.append(counters_of(watch))
            if phase == "during":
                pids = sorted({items[-1].pid for name, items in watch.status.items() if name not in SPARED})
                squeeze = Squeeze(pids, busy) if quota is None else Quota(pids, quota)
            elif phase == "after":
                squeeze.release()
            watch.listen(phase_s)
        counters.append(counters_of(watch))
    finally:
        os.killpg(graph.pid, signal.SIGINT)
        graph.wait(STOP_S)
        watch.bus.close()
    return report(watch, [*edges_ns, time.monotonic_ns()], counters, phase_s) | {
        "busy_processes_a_core": busy if quota is None else None,
        "quota_cores": quota,
        "options": options,
    }


def counters_of(watch: Watch) -> dict[str, int]:
    """Everything that nodes count as lost, rejected or left undone, so far."""
    counts: dict[str, int] = {}
    for name, items in watch.status.items():
        counts |= {f"{name}: {what}": count for what, count in shed_of(items[-1]).items()}
        for count in items[-1].received:
            counts[f"{name}: {count.topic} lost"] = count.lost
            counts[f"{name}: {count.topic} rejected"] = count.rejected
    # of views that come in one turn of this observer it sees the newest
    overtaken = {count.topic: count.outdated for count in watch.bus.counts()[0]}
    return counts | {"observer: perception/hidden_objects outdated": overtaken["perception/hidden_objects"]}


def report(watch: Watch, edges_ns: list[int], counters: list[dict[str, int]], phase_s: float) -> dict:
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "phase_s": phase_s,
        "phases": {
            phase: {
                **scans_of(watch.views, edges_ns[index], edges_ns[index + 1]),
                "source_late_ms": source_late_ms(watch.source_late, edges_ns[index], edges_ns[index + 1]),
                "counted": grown(counters[index], counters[index + 1]),
                "stages_ms": stages_of(watch, edges_ns[index], edges_ns[index + 1]),
            }
            for index, phase in enumerate(PHASES)
        },
        "recovered_after_s": recovered_after_s(watch.views, edges_ns[2]),
        "restarted": sorted(name for name, items in watch.status.items() if len({item.pid for item in items}) > 1),
    }


def scans_of(views: list[View], start_ns: int, end_ns: int) -> dict:
    """What became of the scans that ended in a phase; those without view are the gaps between numbers."""
    own = [view for view in views if start_ns <= view.ended_ns < end_ns]
    if not own:
        return {"views": 0}
    before = [view for view in views if view.ended_ns < start_ns]
    first = before[-1].scan_id + 1 if before else own[0].scan_id
    latency_ms = np.array([view.latency_ms for view in own])
    return {
        "scans": own[-1].scan_id - first + 1,
        "views_in_time": int((latency_ms <= 1e3 * DEADLINE_S).sum()),
        "views_late": int((latency_ms > 1e3 * DEADLINE_S).sum()),
        "without_view": own[-1].scan_id - first + 1 - len({view.scan_id for view in own}),
        "latency_ms": quantiles(latency_ms),
    }


def source_late_ms(source_late: list[tuple[int, float]], start_ns: int, end_ns: int) -> dict[str, float]:
    """How late the player sent: part of each view's latency, and none of the graph's doing."""
    late_ms = [late_ms for sent_ns, late_ms in source_late if start_ns <= sent_ns < end_ns] or [float("nan")]
    p50_ms, max_ms = np.percentile(late_ms, [50, 100]).round(1).tolist()
    return {"p50": p50_ms, "max": max_ms}


def grown(before: dict[str, int], after: dict[str, int]) -> dict[str, int]:
    """Counters that grew in a phase."""
    return {name: more for name in after if (more := after[name] - before.get(name, 0))}


def stages_of(watch: Watch, start_ns: int, end_ns: int) -> dict[str, dict]:
    """Stage times of the nodes by the heartbeats of a phase."""
    return {
        name: stages_ms([item for item in items if start_ns <= item.stamp_ns < end_ns])
        for name, items in watch.status.items()
    }


def recovered_after_s(views: list[View], released_ns: int) -> float | None:
    """From giving the cores back to the first of `STEADY_SCANS` successive views in time; None: never."""
    after = [view for view in views if view.ended_ns + 1e6 * view.latency_ms >= released_ns]
    for start in range(len(after) - STEADY_SCANS + 1):
        steady = after[start : start + STEADY_SCANS]
        in_time = all(view.latency_ms <= 1e3 * DEADLINE_S for view in steady)
        if in_time and steady[-1].scan_id - steady[0].scan_id == STEADY_SCANS - 1:
            return round(1e-9 * (steady[0].ended_ns - released_ns) + 1e-3 * steady[0].latency_ms, 2)
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--phase", type=float, default=60.0)
    parser.add_argument("--busy", type=int, default=1)
    parser.add_argument("--quota", type=float, metavar="CORES")
    parser.add_argument("--profile")
    parser.add_argument("-p", dest="overrides", action="append", default=[])
    parser.add_argument("--group", dest="groups", action="append", default=[])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    options = ["--profile", arguments.profile] if arguments.profile else []
    options += [part for item in arguments.overrides for part in ("-p", item)]
    options += [part for item in arguments.groups for part in ("--group", item)]
    result = run(arguments.phase, arguments.busy, arguments.quota, options)
    print(json.dumps(result, indent=None if arguments.json else 2))


if __name__ == "__main__":
    main()
