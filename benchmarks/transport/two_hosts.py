"""One graph on two hosts, and what becomes of it when the link between them is cut, silent or slow.

Two network namespaces joined by a wire (`benchmarks.transport.net`) stand for the hosts; in one runs
`launch/two_hosts_sensor.yaml`, in the other `launch/two_hosts_compute.yaml`, with keys made for the occasion. Measured
are, after the same nodes on one host: the steady state; then, for each way to harm the link, what each side said and
counted, and the time from healing it to the first view of a scan measured after that; then the steady state on links
that are slow for good (`SLOW`); then the steady state with the compute host's monotonic clock 100,000 s ahead (a time
namespace); and whether words of the messages can be read on the wire, with keys and without. Needs root, `ip`
(iproute2) and /dev/net/tun. The scene's seed is that of its file.
Usage: python -m benchmarks.transport.two_hosts [--steady 30] [--cut 10] [--slow-only] [-p node.key=value] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import yaml

from benchmarks.live.live_graph import QUANTILES, quantiles
from benchmarks.transport.net import Host, Wire, why_no_namespaces
from contrib.two_machines import keys as curve_keys
from mirrorwave.plots.markdown import table
from msgs.bus.interface import Received
from msgs.bus.zmq import ZmqBus
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from msgs.values.units import NANOSECONDS_PER_SECOND
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import DEADLINE_S, latency_ns

ROOT = CHECKOUT
LAUNCH = ROOT / "launch"
SIDES = ("sensor", "compute")
START_S, STOP_S, HEAL_S, SETTLE_S = 120.0, 30.0, 60.0, 6.0
#: Connections have found the new rate of a link.
SLOW_SETTLE_S = 10.0
#: Links that are slow for good: rate and delay of each direction.
SLOW = {"0.2 s late": (float("inf"), 0.2), "20 Mbit/s, 0.1 s late": (20.0, 0.1), "4 Mbit/s, 0.1 s late": (4.0, 0.1)}
#: How far the compute host's clock is ahead in the run with two clocks.
AHEAD_S = 100_000
#: What must not be readable on the wire: topics, a field, a node.
WORDS = (b"radar/ra_map", b"vehicle/state", b"diagnostics/node", b"speed_mps", b"ra_former")
_NUMBER = re.compile(r"\d+(\.\d+)?")


class ShiftedBus(ZmqBus):
    """An observer whose clock is that of a host in another time namespace."""

    def __init__(self, run_dir: Path, ahead_s: int) -> None:
        self._ahead_ns = ahead_s * NANOSECONDS_PER_SECOND
        super().__init__("observer", run_dir)

    def now_ns(self) -> int:
        return super().now_ns() + self._ahead_ns


class Graph:
    """A launched graph on a host, and all that an observer there hears."""

    def __init__(self, host: Host, launch: dict[str, Any], folder: Path, options: list[str], ahead_s: int = 0) -> None:
        name = launch["name"]
        file = folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump(launch))
        command = [sys.executable, "-m", "mirrorwave", "launch", str(file), "--headless", "--domain", name]
        command += ["--runs-dir", str(folder / "runs"), *options]
        environment = {**os.environ, "MIRRORWAVE_RUN_DIR": str(folder)}
        self.bus = ShiftedBus(folder / name, ahead_s)
        for topic in ("perception/hidden_objects", "vehicle/state", "diagnostics/node"):
            self.bus.subscribe(topic)
        self._said = (folder / f"{name}.log").open("a")
        self._process = subprocess.Popen(
            host.inside(command, ahead_s), cwd=ROOT, env=environment, stdout=self._said, start_new_session=True
        )
        #: Scan, its stamp and its arrival, on the host's clock.
        self.views: list[tuple[int, int, int]] = []
        #: Ages of vehicle states on arrival.
        self.state_ages_ns: list[int] = []
        self.status: dict[str, list[NodeStatus]] = {}
        #: When a node of this host said that its health is another one: time, node, state and reason.
        self.changes: list[tuple[int, str, str]] = []

    def take(self, timeout_s: float) -> None:
        for received in self.bus.receive(timeout_s):
            if isinstance(received.message, BevFrame):
                self.views.append((received.message.scan_id, received.message.stamp_ns, self.bus.now_ns()))
            elif isinstance(received.message, VehicleState):
                self.state_ages_ns.append(self.bus.now_ns() - received.message.stamp_ns)
            elif isinstance(received.message, NodeStatus) and "." not in received.envelope.publisher:
                self._hear(received, received.message)

    def _hear(self, received: Received, status: NodeStatus) -> None:
        known = self.status.setdefault(status.node, [])
        said = f"{status.state} {status.reason}".strip()
        if known and _form(said) != _form(f"{known[-1].state} {known[-1].reason}".strip()):
            self.changes.append((received.envelope.sent_ns, status.node, said))
        known.append(status)

    def counted(self) -> dict[str, int]:
        """What the nodes of this host count as lost, rejected or left undone so far."""
        counts = {}
        for name, items in self.status.items():
            counts |= {f"{name}: {item.what} {item.reason}": item.count for item in items[-1].shed}
            counts |= {f"{name}: {item.topic} lost": item.lost for item in items[-1].received if item.lost}
        return counts

    def resident_mib(self) -> dict[str, float]:
        return {name: round(items[-1].resident_bytes / 2**20, 1) for name, items in self.status.items()}

    def pids(self) -> dict[str, int]:
        return {name: items[-1].pid for name, items in self.status.items()}

    def stop(self) -> int:
        """Ctrl-C; the exit code."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGINT)
        try:
            code = self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            for process in [*psutil.Process(self._process.pid).children(recursive=True), self._process]:
                process.kill()
            code = self._process.wait()
        self._said.close()
        self.bus.close()
        return code


def _form(text: str) -> str:
    """A text without its numbers."""
    return _NUMBER.sub("n", text)


@contextlib.contextmanager
def running(*graphs: Graph) -> Iterator[None]:
    """Graphs that are stopped at the end, however it comes."""
    try:
        yield
    finally:
        for graph in graphs:
            graph.stop()


def listen(graphs: tuple[Graph, ...], duration_s: float, until: Callable[[], bool] = lambda: False) -> bool:
    """Take in what all observers hear for so long, or until something holds; whether it does."""
    end_s = time.monotonic() + duration_s
    while not (held := until()) and time.monotonic() < end_s:
        for graph in graphs:
            graph.take(0.02)
    return held


def await_views(*graphs: Graph) -> None:
    """Until the last of the graphs has views, and a little longer."""
    if not listen(graphs, START_S, lambda: bool(graphs[-1].views)):
        raise TimeoutError(f"no view within {START_S:g} s: {[graph.changes for graph in graphs]}")
    listen(graphs, 3.0)


# ------------------------------------------------------------------------------------------------------- the two hosts


def make_keys(folder: Path) -> None:
    """Keys of both hosts, each on the other's list."""
    for side, other in (SIDES, SIDES[::-1]):
        public, _ = curve_keys.generate(side, folder / side)
        allowed = folder / f"of_{other}"
        allowed.mkdir(mode=0o700)
        shutil.copy(public, allowed)


def launch_of(side: str, hosts: dict[str, Host], keys: Path | None) -> dict[str, Any]:
    """The launch file of a side, with addresses and keys of this run; without keys where there are none."""
    launch: dict[str, Any] = yaml.safe_load((LAUNCH / f"two_hosts_{side}.yaml").read_text())
    params = launch["nodes"]["link"]["params"]
    secrets = {"key": str(keys / side / f"{side}.key_secret"), "allowed": str(keys / f"of_{side}")} if keys else {}
    params |= {"key": "", "allowed": "", "insecure": keys is None} | secrets
    for peer, entry in params["connect"].items():
        entry["address"] = f"tcp://{hosts[peer].address}:7100"
        entry["key"] = str(keys / f"of_{side}" / f"{peer}.key") if keys else ""
    return launch


def pair(wire: Wire, folder: Path, options: list[str], keys: Path | None, ahead_s: int = 0) -> tuple[Graph, Graph]:
    """Both graphs; overrides of nodes that a side does not have are left out there."""
    hosts = dict(zip(SIDES, wire.hosts, strict=True))
    launches = {side: launch_of(side, hosts, keys) for side in SIDES}
    own = {side: _own_overrides(options, launches[side]) for side in SIDES}
    compute = Graph(hosts["compute"], launches["compute"], folder, own["compute"], ahead_s)
    return Graph(hosts["sensor"], launches["sensor"], folder, own["sensor"]), compute


def _own_overrides(overrides: list[str], launch: dict[str, Any]) -> list[str]:
    return [part for item in overrides if item.partition(".")[0] in launch["nodes"] for part in ("-p", item)]


# --------------------------------------------------------------------------------------------------------- the figures


def steady(graphs: tuple[Graph, ...], duration_s: float) -> dict[str, Any]:
    """Views at the last of the graphs for so long: how many, how old on arrival, scans without one."""
    start, before = len(graphs[-1].views), [graph.counted() for graph in graphs]
    listen(graphs, duration_s)
    views = graphs[-1].views[start:]
    age_ms = [1e-6 * latency_ns(stamp_ns, came_ns) for _, stamp_ns, came_ns in views]
    scans = views[-1][0] - views[0][0] + 1 if views else 0
    return {
        "views": len(views),
        "views_per_s": round(len(views) / duration_s, 2),
        "scans_without_view": scans - len({scan for scan, _, _ in views}),
        "late": sum(age > 1e3 * DEADLINE_S for age in age_ms),
        "age_ms": _quantiles(age_ms),
        "counted": {graph_name: grown for graph_name, grown in _grown(graphs, before).items() if grown},
    }


def _quantiles(values: list[float]) -> dict[str, float | None]:
    return {**quantiles(values)} if values else dict.fromkeys(QUANTILES)


def _grown(graphs: tuple[Graph, ...], before: list[dict[str, int]]) -> dict[str, dict[str, int]]:
    """Counters that grew, by host."""
    names = SIDES if len(graphs) == 2 else ("one host",)
    return {
        name: {what: more for what, count in graph.counted().items() if (more := count - known.get(what, 0))}
        for name, graph, known in zip(names, graphs, before, strict=True)
    }


def harm(graphs: tuple[Graph, Graph], act: Callable[[], None], heal: Callable[[], None], cut_s: float) -> dict:
    """Harm the link for so long and heal it; what was said, counted and seen."""
    compute = graphs[1]
    before = [graph.counted() for graph in graphs]
    resident = [graph.resident_mib() for graph in graphs]
    pids = [graph.pids() for graph in graphs]
    begun_ns = [graph.bus.now_ns() for graph in graphs]
    changes = [len(graph.changes) for graph in graphs]
    start = len(compute.views)
    act()
    during = steady(graphs, cut_s)
    heal()
    healed_ns = compute.bus.now_ns()
    is_back = listen(graphs, HEAL_S, lambda: bool(compute.views) and compute.views[-1][1] > healed_ns)
    back_s = 1e-9 * (compute.bus.now_ns() - healed_ns)
    listen(graphs, SETTLE_S)
    return {
        "cut_s": cut_s,
        "views_during": during["views"],
        "age_ms_during": during["age_ms"],
        "fresh_view_after_heal_s": round(back_s, 2) if is_back else None,
        "scans_without_view": _missing(compute.views[max(0, start - 1) :]),
        "counted": _grown(graphs, before),
        "said": {
            side: [f"{1e-9 * (at_ns - begun):+.1f} s {node}: {said}" for at_ns, node, said in graph.changes[known:]]
            for side, graph, known, begun in zip(SIDES, graphs, changes, begun_ns, strict=True)
        },
        "link_resident_mib": {
            side: [known["link"], graph.resident_mib()["link"]]
            for side, graph, known in zip(SIDES, graphs, resident, strict=True)
        },
        "restarted": [
            name
            for graph, known in zip(graphs, pids, strict=True)
            for name, pid in graph.pids().items()
            if known.get(name, pid) != pid
        ],
    }


def _missing(views: list[tuple[int, int, int]]) -> int:
    """Scans between the first and the last of some views that brought none."""
    scans = {scan for scan, _, _ in views}
    return max(scans) - min(scans) + 1 - len(scans) if scans else 0


def slow(graphs: tuple[Graph, Graph], wire: Wire, rate_mbit_per_s: float, delay_s: float, duration_s: float) -> dict:
    """The steady state on a slow link, from `SLOW_SETTLE_S` after it became so; then the link as it was."""
    compute = graphs[1]
    wire.rate_mbit_per_s, wire.delay_s = rate_mbit_per_s, delay_s
    listen(graphs, SLOW_SETTLE_S)
    known, moved = len(compute.state_ages_ns), sum(wire.bytes)
    result = steady(graphs, duration_s)
    result["wire_mbit_per_s"] = round(8e-6 * (sum(wire.bytes) - moved) / duration_s, 1)
    result["state_age_ms"] = _quantiles([1e-6 * age_ns for age_ns in compute.state_ages_ns[known:]])
    wire.rate_mbit_per_s, wire.delay_s = float("inf"), 0.0
    healed_ns = compute.bus.now_ns()
    listen(graphs, HEAL_S, lambda: bool(compute.views) and compute.views[-1][1] > healed_ns)
    listen(graphs, SETTLE_S)
    return result


def ways_to_harm(wire: Wire) -> dict[str, tuple[Callable[[], None], Callable[[], None]]]:
    """Each way to harm the link, and how it is healed."""
    return {
        "interface down": (lambda: wire.hosts[0].link("down"), lambda: wire.hosts[0].link("up")),
        "all frames lost": (lambda: setattr(wire, "is_dead", True), lambda: setattr(wire, "is_dead", False)),
        "frames 0.2 s late": (lambda: setattr(wire, "delay_s", 0.2), lambda: setattr(wire, "delay_s", 0.0)),
        "frames 1 s late": (lambda: setattr(wire, "delay_s", 1.0), lambda: setattr(wire, "delay_s", 0.0)),
    }


def run_slow(steady_s: float, overrides: list[str]) -> dict[str, Any]:
    """The slow links alone."""
    result: dict[str, Any] = {"machine": _machine(), "overrides": overrides}
    with Wire("mwh") as wire, tempfile.TemporaryDirectory(prefix="mw") as root:
        make_keys(Path(root) / "keys")
        graphs = pair(wire, Path(root), overrides, Path(root) / "keys")
        with running(*graphs):
            await_views(*graphs)
            result["slow"] = {name: slow(graphs, wire, *link, steady_s) for name, link in SLOW.items()}
    return result


def _machine() -> str:
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}"


def run(steady_s: float, cut_s: float, overrides: list[str]) -> dict[str, Any]:
    result: dict[str, Any] = {"machine": _machine(), "overrides": overrides}
    with Wire("mwh") as wire, tempfile.TemporaryDirectory(prefix="mw") as root:
        folder, keys = Path(root), Path(root) / "keys"
        make_keys(keys)
        wire.seen = dict.fromkeys(WORDS, 0)
        result["one_host"] = _one_host(wire, folder, overrides, steady_s)
        graphs = pair(wire, folder, overrides, keys)
        with running(*graphs):
            await_views(*graphs)
            moved = sum(wire.bytes)
            result["two_hosts"] = steady(graphs, steady_s)
            result["wire_mb_per_s"] = round(1e-6 * (sum(wire.bytes) - moved) / steady_s, 2)
            ways = ways_to_harm(wire)
            result["harm"] = {name: harm(graphs, act, heal, cut_s) for name, (act, heal) in ways.items()}
            result["slow"] = {name: slow(graphs, wire, *link, steady_s) for name, link in SLOW.items()}
        result["readable_with_keys"] = _readable(wire)
        result["two_clocks"] = _two_clocks(wire, folder, overrides, keys, steady_s)
        wire.seen = dict.fromkeys(WORDS, 0)
        graphs = pair(wire, folder, overrides, None)
        with running(*graphs):
            await_views(*graphs)
            listen(graphs, 5.0)
        result["readable_without_keys"] = _readable(wire)
    return result


def _one_host(wire: Wire, folder: Path, overrides: list[str], duration_s: float) -> dict[str, Any]:
    launch = yaml.safe_load((LAUNCH / "corner.yaml").read_text())
    graph = Graph(wire.hosts[0], launch, folder, _own_overrides(overrides, launch))
    with running(graph):
        await_views(graph)
        return steady((graph,), duration_s)


def _two_clocks(wire: Wire, folder: Path, overrides: list[str], keys: Path, duration_s: float) -> dict[str, Any]:
    """The steady state with two clocks; what the machine says where it has no time namespaces."""
    probe = subprocess.run(wire.hosts[1].inside(["true"], AHEAD_S), capture_output=True, text=True)
    if probe.returncode != 0:
        return {"not_measured": " ".join(probe.stderr.split())}
    graphs = pair(wire, folder, overrides, keys, AHEAD_S)
    with running(*graphs):
        await_views(*graphs)
        return {"ahead_s": AHEAD_S, **steady(graphs, duration_s)}


def _readable(wire: Wire) -> dict[str, int]:
    """In how many frames each word was seen, and how many frames there were."""
    return {word.decode(): count for word, count in wire.seen.items()} | {"frames": sum(wire.frames)}


# ---------------------------------------------------------------------------------------------------------- the tables


def markdown(result: dict[str, Any]) -> str:
    """The result as tables."""
    if "harm" not in result:
        return "\n".join(_slow_table(result["slow"]))
    runs = []
    for name in ("one_host", "two_hosts", "two_clocks"):
        row = result[name]
        if "views" in row:
            age = (row["age_ms"][quantile] for quantile in ("p50", "p90", "p99", "max"))
            runs.append((name, row["views_per_s"], row["scans_without_view"], row["late"], *age))
    heads = ("run", "views/s", "scans without view", "late", "age p50 ms", "p90", "p99", "max")
    head = ("harm", "views during (age p50 ms)", "fresh view after heal s", "scans without view")
    head += ("counted", "said", "link's memory MiB, before and after", "restarted")
    harms = []
    for name, row in result["harm"].items():
        counted = [f"{side}: {count} {what}" for side, own in row["counted"].items() for what, count in own.items()]
        said = [f"{side} {text}" for side, own in row["said"].items() for text in own]
        memory = [f"{side} {before} {after}" for side, (before, after) in row["link_resident_mib"].items()]
        cells = [f"{name}, {row['cut_s']:g} s", f"{row['views_during']} ({row['age_ms_during']['p50']})"]
        cells += [str(row["fresh_view_after_heal_s"]), str(row["scans_without_view"])]
        cells += ["; ".join(counted), "; ".join(said), "; ".join(memory), ", ".join(row["restarted"]) or "nothing"]
        harms.append(cells)
    plain = result["readable_without_keys"]
    words = [(word, count, plain[word]) for word, count in result["readable_with_keys"].items()]
    lines = [*table(heads, runs), "", *table(head, harms), "", *_slow_table(result["slow"]), ""]
    return "\n".join(lines + table(("word on the wire", "frames with keys", "without"), words))


def _slow_table(rows: dict[str, dict[str, Any]]) -> list[str]:
    head = ("slow link", "views/s", "scans without view", "age of a view p50, p90, p99 ms")
    head += ("of a vehicle state", "Mbit/s", "counted")
    lines = []
    for name, row in rows.items():
        counted = [f"{side}: {more} {what}" for side, own in row["counted"].items() for what, more in own.items()]
        cells = [name, row["views_per_s"], row["scans_without_view"], _in_words(row["age_ms"])]
        cells += [_in_words(row["state_age_ms"]), row["wire_mbit_per_s"], "; ".join(counted)]
        lines.append(cells)
    return table(head, lines)


def _in_words(age_ms: dict[str, float | None]) -> str:
    return ", ".join(str(age_ms[quantile]) for quantile in ("p50", "p90", "p99"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steady", type=float, default=30.0)
    parser.add_argument("--cut", type=float, default=10.0)
    parser.add_argument("--slow-only", action="store_true", help="measure the slow links alone")
    parser.add_argument("-p", dest="overrides", action="append", default=[])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    arguments = parser.parse_args()
    if reason := why_no_namespaces():
        print(f"two_hosts: {reason}", file=sys.stderr)
        return 1
    # as Ctrl-C: the namespaces and graphs are taken away
    signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    try:
        if arguments.slow_only:
            result = run_slow(arguments.steady, arguments.overrides)
        else:
            result = run(arguments.steady, arguments.cut, arguments.overrides)
    except KeyboardInterrupt:
        print("two_hosts: stopped", file=sys.stderr)
        return 130
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    print(markdown(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
