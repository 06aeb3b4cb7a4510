"""The whole graph at the real rate for an hour, nodes killed and stopped at random in its middle third.

`launch/soak.yaml`: radar by the player, CAN in and out, page with a client that reads along, recording. Three phases:
`quiet` (half of the time), `kills` (a third: SIGKILL or, one in four, SIGSTOP of a node drawn at random, gaps
exponential) and `healed` (a sixth). Per phase: views a second, latency quantiles (nominal end of the last beam to the
arrival of the view), deadline misses, and what nodes counted as lost, rejected or shed. Per process: growth of resident
memory in percent an hour by the slope through the medians of minutes (Theil and Sen), after five minutes of warm-up.
Per kill: when the supervisor said it, when the node was ready again, when the first view of a later scan came.
The same seed draws the same nodes, signals and gaps.
Usage: python -m benchmarks.live.soak [--duration 3600] [--seed 0] [--gap 20] [--out runs/soak.json] [--figure soak.png]
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
import tempfile
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.progress import Progress
from scipy.stats import theilslopes
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks.live.live_graph import quantiles, shed_of
from benchmarks.live.processes import processes_of
from mirrorwave.plots.style import legend_beside, new_figure, save
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus
from msgs.values.perception import BevFrame
from nodes.inputs.view_latency import DEADLINE_S, latency_ns
from nodes.process.supervisor import read_lock

ROOT = CHECKOUT
LAUNCH = ROOT / "launch" / "soak.yaml"
#: By then what a node said at its start stands in the log.
LOGGED_S = 1.0
#: Shares of the whole time.
PHASES = {"quiet": 1 / 2, "kills": 1 / 3, "healed": 1 / 6}
NODES = ("player", "ra_former", "dense_predictor", "geometry", "vehicle_can", "can_out", "bev_viewer", "recorder")
NODES += ("car",)
FEWEST_S, STOPPED_SHARE = 8.0, 0.25
START_S, STOP_S, WARM_S = 60.0, 30.0, 300.0
MINUTE_S = 60.0


@dataclass
class Kill:
    """A node that was killed or stopped, on the bus clock; None: did not happen before the next one."""

    node: str
    signal: str
    at_ns: int
    pid: int
    seen_s: float | None = None
    ready_s: float | None = None
    view_s: float | None = None


@dataclass
class Life:
    """One process of a node: resident memory over time, and what it counted last."""

    seconds: list[float] = field(default_factory=list)
    resident: list[int] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)


@dataclass
class Phase:
    """What came in one phase."""

    name: str
    start_ns: int
    end_ns: int = 0
    latency_ms: list[float] = field(default_factory=list)
    counted: dict[str, int] = field(default_factory=dict)


class Reader:
    """A page that looks on, whatever address the viewer has after its last start."""

    def __init__(self) -> None:
        self._url: str | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def look_at(self, url: str) -> None:
        """Leave the old address, if any, for this one."""
        if url != self._url:
            self.close()
            self._url, self._ended = url, threading.Event()
            self._thread = threading.Thread(target=self._read, args=(url, self._ended), daemon=True)
            self._thread.start()

    def close(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(10.0)

    def _read(self, url: str, ended: threading.Event) -> None:
        """Take and acknowledge every update, as the page does, until the end or until the viewer is killed."""
        origin, address = url.rsplit("/", 2)[0], url.replace("http://", "ws://") + "ws"
        if ended.wait(1.0):
            return
        # a viewer that was killed has another address in its next life
        with (
            contextlib.suppress(WebSocketException, OSError),
            connect(address, origin=origin, max_size=2**24) as page,  # type: ignore[arg-type]
        ):
            while not ended.is_set():
                with contextlib.suppress(TimeoutError):
                    message = page.recv(timeout=0.2)
                    if isinstance(message, str) and (update := json.loads(message)).get("type") == "update":
                        for _ in range(update.get("messages", 0)):
                            page.recv(timeout=5.0)
                        page.send(json.dumps({"type": "ack", "number": update["number"]}))


class Soak:
    """A graph and all that is seen of it."""

    def __init__(self, domain: str, seed: int, gap_s: float) -> None:
        self._domain = domain
        self.bus = ZmqBus("soak", run_dir(domain))
        for topic in ("perception/hidden_objects", "diagnostics/node", "log"):
            self.bus.subscribe(topic)
        self.phases: list[Phase] = []
        self.lives: dict[tuple[str, int], Life] = {}
        self.kills: list[Kill] = []
        self.pids: dict[str, int] = {}
        self.minutes: list[dict[str, Any]] = []
        self._rng, self._gap_s = np.random.default_rng(seed), gap_s
        self._next_kill_s: float | None = None
        self._start_s = time.monotonic()
        self._reader = Reader()
        #: The viewer's process whose page is looked at.
        self._looked_at: int | None = None

    def phase(self, name: str, duration_s: float, tick: Any = None) -> None:
        """Look on for so long; kill now and then in the phase of that name."""
        self.phases.append(Phase(name, time.monotonic_ns()))
        end_s = time.monotonic() + duration_s
        self._next_kill_s = self._drawn_s() if name == "kills" else None
        minute_s = time.monotonic()
        while (now_s := time.monotonic()) < end_s:
            self.listen(0.05)
            # no kill whose healing the phase would not see
            if self._next_kill_s is not None and self._next_kill_s <= now_s < end_s - FEWEST_S:
                self._kill()
            if tick is not None and now_s - minute_s >= MINUTE_S:
                minute_s = now_s
                tick(self)
        self.phases[-1].end_ns = time.monotonic_ns()

    def listen(self, timeout_s: float) -> None:
        """Take down what came in."""
        for received in self.bus.receive(timeout_s):
            now_ns = time.monotonic_ns()
            message = received.message
            if isinstance(message, BevFrame):
                self._take_view(message, now_ns)
            elif isinstance(message, NodeStatus):
                self._take_status(message)
            elif isinstance(message, LogRecord):
                self._take_log(message)

    def close(self) -> None:
        self._reader.close()
        self.bus.close()

    def _take_view(self, view: BevFrame, now_ns: int) -> None:
        if self.phases:
            self.phases[-1].latency_ms.append(1e-6 * latency_ns(view.stamp_ns, now_ns))
        for kill in self.kills[-1:]:
            if kill.view_s is None and view.stamp_ns > kill.at_ns:
                kill.view_s = 1e-9 * (now_ns - kill.at_ns)

    def _take_status(self, status: NodeStatus) -> None:
        self.pids[status.node] = status.pid
        # a moment after its start its address stands in the log file, which is for this user alone; on no topic
        is_new = status.node == "bev_viewer" and status.pid != self._looked_at and status.uptime_s > LOGGED_S
        if is_new and (address := page_address(self._domain)) is not None:
            self._looked_at = status.pid
            self._reader.look_at(address)
        life = self.lives.setdefault((status.node, status.pid), Life())
        life.seconds.append(time.monotonic() - self._start_s)
        life.resident.append(status.resident_bytes)
        counts = {f"{status.node}: {what}": count for what, count in shed_of(status).items()}
        for count in status.received:
            counts[f"{status.node}: {count.topic} lost"] = count.lost
            counts[f"{status.node}: {count.topic} rejected"] = count.rejected
        if self.phases:
            counted = self.phases[-1].counted
            for what, count in counts.items():
                if more := count - life.counts.get(what, 0):
                    counted[what] = counted.get(what, 0) + more
        life.counts = counts
        for kill in self.kills[-1:]:
            is_new = status.node == kill.node and status.pid != kill.pid and status.state is NodeState.READY
            if kill.ready_s is None and is_new:
                kill.ready_s = 1e-9 * (status.stamp_ns - kill.at_ns)

    def _take_log(self, record: LogRecord) -> None:
        for kill in self.kills[-1:]:
            is_said = record.node == "supervisor" and record.text.startswith(f"{kill.node} ")
            if kill.seen_s is None and is_said and record.stamp_ns > kill.at_ns:
                kill.seen_s = 1e-9 * (record.stamp_ns - kill.at_ns)

    def _drawn_s(self) -> float:
        return time.monotonic() + FEWEST_S + self._rng.exponential(max(self._gap_s - FEWEST_S, 0.0))

    def _kill(self) -> None:
        node = NODES[self._rng.integers(len(NODES))]
        number = signal.SIGSTOP if self._rng.random() < STOPPED_SHARE else signal.SIGKILL
        self.kills.append(Kill(node, number.name, time.monotonic_ns(), self.pids[node]))
        os.kill(self.pids[node], number)
        self._next_kill_s = self._drawn_s()


def page_address(domain: str) -> str | None:
    """The newest address that a viewer of the graph has given; None where the log does not hold it yet."""
    lines = (Path(read_lock(run_dir(domain))["run"]) / "log.jsonl").read_text(encoding="utf-8").splitlines()
    texts = [json.loads(line)["text"] for line in lines]
    return next((text.split()[1] for text in reversed(texts) if text.startswith("open http")), None)


def report(soak: Soak, duration_s: float, seed: int) -> dict[str, Any]:
    """All figures, JSON-ready."""
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "duration_s": duration_s,
        "seed": seed,
        "phases": [phase_report(phase) for phase in soak.phases],
        "first_and_last_tenth": first_and_last(soak.phases),
        "memory": memory_report(soak.lives),
        "kills": kills_report(soak.kills),
        "minutes": soak.minutes,
    }


def phase_report(phase: Phase) -> dict[str, Any]:
    """Views, latency and counters of a phase."""
    seconds = 1e-9 * ((phase.end_ns or time.monotonic_ns()) - phase.start_ns)
    return {
        "name": phase.name,
        "seconds": round(seconds, 1),
        "views": len(phase.latency_ms),
        "views_per_s": round(len(phase.latency_ms) / max(seconds, 1e-9), 3),
        "latency_ms": quantiles(phase.latency_ms) if phase.latency_ms else None,
        "late": sum(one > 1e3 * DEADLINE_S for one in phase.latency_ms),
        "counted": dict(sorted(phase.counted.items())),
    }


def first_and_last(phases: list[Phase]) -> dict[str, Any]:
    """Latency in the first and in the last tenth of the run (both without faults)."""
    first, last = phases[0].latency_ms, phases[-1].latency_ms
    share = max(1, sum(len(phase.latency_ms) for phase in phases) // 10)
    edges = {"first": first[:share], "last": last[-share:]}
    return {name: quantiles(values) if values else None for name, values in edges.items()}


def memory_report(lives: dict[tuple[str, int], Life]) -> dict[str, Any]:
    """Growth of the longest life of each node after warm-up; None where it is shorter than ten minutes."""
    longest: dict[str, Life] = {}
    for (node, _), life in lives.items():
        if node not in longest or span_s(life) > span_s(longest[node]):
            longest[node] = life
    return {node: growth(life) for node, life in sorted(longest.items())}


def span_s(life: Life) -> float:
    """Time between its first and last heartbeat."""
    return life.seconds[-1] - life.seconds[0]


def growth(life: Life) -> dict[str, Any]:
    """Resident memory of a process, and its slope in percent an hour with 95 % interval."""
    seconds, resident = np.array(life.seconds), np.array(life.resident) / 2**20
    warm = seconds >= seconds[0] + WARM_S
    figures: dict[str, Any] = {"minutes": round(span_s(life) / 60.0, 1), "resident_mib": round(float(resident[-1]), 1)}
    if span_s(life) < 2 * WARM_S:
        return figures | {"percent_per_hour": None}
    minute = (seconds[warm] // MINUTE_S).astype(int)
    medians = np.array([np.median(resident[warm][minute == one]) for one in np.unique(minute)])
    slope, _, low, high = theilslopes(medians, np.unique(minute) / 60.0)
    percent = 100.0 / medians[0] * np.array([slope, low, high])
    return figures | {"percent_per_hour": round(percent[0], 2), "interval": percent[1:].round(2).tolist()}


def kills_report(kills: list[Kill]) -> dict[str, Any]:
    """Each kill, and medians and maxima per signal."""
    summary = {}
    for name in sorted({kill.signal for kill in kills}):
        own = [kill for kill in kills if kill.signal == name]
        summary[name] = {"kills": len(own)} | {
            what: middle_and_most([getattr(kill, what) for kill in own]) for what in ("seen_s", "ready_s", "view_s")
        }
    return {"summary": summary, "each": [asdict(kill) for kill in kills]}


def middle_and_most(seconds: list[float | None]) -> dict[str, Any]:
    """Median and longest; `never`: how often it did not happen before the next kill."""
    known = [one for one in seconds if one is not None]
    figures = {"median": round(float(np.median(known)), 3), "max": round(max(known), 3)} if known else {}
    return figures | {"never": len(seconds) - len(known)}


def run(duration_s: float, seed: int, gap_s: float, out: Path, overrides: list[str]) -> dict[str, Any]:
    """Launch, look on, kill, report; `out` is written every minute."""
    domain = f"soak{os.getpid()}"
    soak = Soak(domain, seed, gap_s)
    with tempfile.TemporaryDirectory() as folder, Progress() as progress:
        command = [sys.executable, "-m", "mirrorwave", "launch", str(LAUNCH), "--domain", domain]
        command += ["-p", f"recorder.path={folder}/drive.mcap", "--runs-dir", folder]
        command += [part for item in overrides for part in ("-p", item)]
        graph = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, start_new_session=True)
        task = progress.add_task("soak", total=duration_s)
        started = time.monotonic()

        def tick(soak: Soak) -> None:
            progress.update(task, completed=time.monotonic() - started)
            soak.minutes.append(minute_of(soak))
            write(out, report(soak, duration_s, seed))

        try:
            until_all_ready(soak)
            for name, share in PHASES.items():
                soak.phase(name, share * duration_s, tick)
            result = report(soak, duration_s, seed)
        finally:
            stop_s = time.monotonic()
            os.killpg(graph.pid, signal.SIGINT)
            code = graph.wait(STOP_S)
            soak.close()
    result |= {"exit_code": code, "stop_s": round(time.monotonic() - stop_s, 2), "left": len(processes_of(domain))}
    write(out, result)
    return result


def until_all_ready(soak: Soak) -> None:
    """Wait for a heartbeat of every node and the first view, and two seconds more."""
    soak.phase("start", 0.0)
    end_s = time.monotonic() + START_S
    while not (set(NODES) <= set(soak.pids) and soak.phases[0].latency_ms):
        if time.monotonic() > end_s:
            raise TimeoutError(f"no view, or no word from {sorted(set(NODES) - set(soak.pids))}, in {START_S:g} s")
        soak.listen(0.1)
    end_s = time.monotonic() + 2.0
    while time.monotonic() < end_s:
        soak.listen(0.1)
    soak.phases.clear()


def minute_of(soak: Soak) -> dict[str, Any]:
    """Latency of the last minute's views, resident memory of each process, and load of the machine."""
    latency_ms = soak.phases[-1].latency_ms[-int(MINUTE_S / DEADLINE_S) :]
    return {
        "at_s": round(time.monotonic() - soak._start_s, 1),
        "phase": soak.phases[-1].name,
        "latency_ms": quantiles(latency_ms) if latency_ms else None,
        "resident_mib": {
            node: round(soak.lives[node, pid].resident[-1] / 2**20, 1) for node, pid in sorted(soak.pids.items())
        },
        "kills": len(soak.kills),
        "load": round(psutil.getloadavg()[0], 2),
    }


def write(out: Path, result: dict[str, Any]) -> None:
    """JSON at `out`, whole or as it was."""
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_suffix(".part")
    part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    part.replace(out)


def draw(result: dict[str, Any], path: Path) -> None:
    """Latency and memory over the minutes, kills as ticks."""
    minutes = result["minutes"]
    at_min = [one["at_s"] / 60.0 for one in minutes]
    figure = new_figure(9.0, 6.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for name in ("p50", "p99", "max"):
        upper.plot(at_min, [one["latency_ms"][name] if one["latency_ms"] else np.nan for one in minutes], label=name)
    upper.axhline(1e3 * DEADLINE_S, color="0.6", linestyle=":", label="deadline")
    upper.set(ylabel="last beam to view [ms]", yscale="log")
    for node in sorted(minutes[-1]["resident_mib"]):
        lower.plot(at_min, [one["resident_mib"].get(node, np.nan) for one in minutes], label=node)
    lower.set(ylabel="resident memory [MiB]", xlabel="minutes", ylim=(0.0, None))
    for axes in (upper, lower):
        in_kills = [minute for minute, one in zip(at_min, minutes, strict=True) if one["phase"] == "kills"]
        if in_kills:
            axes.axvspan(in_kills[0] - 1.0, in_kills[-1], color="tab:red", alpha=0.08, label="kills")
        legend_beside(axes)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gap", type=float, default=20.0, help="mean seconds between kills")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "soak.json")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("-p", dest="overrides", action="append", default=[])
    arguments = parser.parse_args()
    # what is started from here hears Ctrl-C, also where this runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
    result = run(arguments.duration, arguments.seed, arguments.gap, arguments.out, arguments.overrides)
    if arguments.figure is not None and result["minutes"]:
        draw(result, arguments.figure)
    for item in ("phases", "first_and_last_tenth", "memory", "exit_code", "stop_s", "left"):
        print(item, json.dumps(result[item]))
    print("kills", json.dumps(result["kills"]["summary"]))


if __name__ == "__main__":
    main()
