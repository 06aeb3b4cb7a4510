"""`mirrorwave top`: a running graph now: stage times, age of the view, deadlines missed, what was lost and shed."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import msgspec
import typer

from mirrorwave.commands.graph.nodes import node_row, shed_text
from mirrorwave.console import (
    DEFAULT_DOMAIN,
    AsJson,
    Domain,
    console_table,
    print_picture,
    print_result,
    stdout_console,
)
from mirrorwave.diagnose.running_graph import no_heartbeat, require_graph
from mirrorwave.terminal import ends_with_reader
from msgs.bus.interface import Bus
from msgs.bus.topics import plain_topic
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.lidar import LidarSetup
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarSetup
from msgs.values.units import ns_from_s
from nodes.inputs.view_latency import ViewFigures, ViewWatch, stage_figures, views_text
from nodes.viewer.node_table import MAX_NODES, SILENT_NS, is_of_peer

if TYPE_CHECKING:
    from rich.console import RenderableType

_SETUPS, _WATCHED = ("radar/setup", "lidar/setup"), ("perception/hidden_objects", "diagnostics/node")
#: Sixteen scans, ten heartbeats.
WINDOW_S = 5.0
_REFRESH_S = 0.5
#: Of one node; a window of two minutes has as many.
MAX_HEARTBEATS = 256


class _Heard(NamedTuple):
    at_ns: int
    status: NodeStatus


class GraphWatch:
    """Messages of a graph within a window, and its views since the watch began. Times in ns of one clock."""

    def __init__(self, start_ns: int, window_s: float = WINDOW_S) -> None:
        self._views = ViewWatch(start_ns, window_s)
        self._window_ns = ns_from_s(window_s)
        self._heard: dict[str, deque[_Heard]] = {}

    def take(self, message: msgspec.Struct, now_ns: int) -> None:
        """Take in one message of `watched_topics`."""
        match message:
            case RadarSetup() | LidarSetup():
                self._views.set_up(message)
            case BevFrame():
                self._views.add(message.scan_id, message.stamp_ns, now_ns)
            case NodeStatus():
                self._hear(message, now_ns)

    def report(self, now_ns: int) -> dict[str, Any]:
        """The graph's views and one row a node, in order of name; nodes that ended are left out."""
        views = self._views.figures(now_ns)
        rows = [_row(list(self._heard[name]), now_ns) for name in sorted(self._heard)]
        return {
            "graph": {**msgspec.to_builtins(views), "misses": views.misses, "misses_total": views.misses_total},
            "nodes": [row for row in rows if row["state"] != NodeState.STOPPING],
        }

    def _hear(self, status: NodeStatus, now_ns: int) -> None:
        self._views.hear(status, now_ns)
        heard = self._heard.setdefault(status.node, deque(maxlen=MAX_HEARTBEATS))
        if heard and heard[-1].status.pid != status.pid:
            heard.clear()
        heard.append(_Heard(now_ns, status))
        while len(heard) > 2 and now_ns - heard[0].at_ns > self._window_ns:
            heard.popleft()
        if len(self._heard) > MAX_NODES:
            # any name may stand on the bus; those of a peer do not drive out the nodes of this host
            del self._heard[min(self._heard, key=lambda name: (not is_of_peer(name), self._heard[name][-1].at_ns))]


def _row(heard: list[_Heard], now_ns: int) -> dict[str, Any]:
    first, last = heard[0].status, heard[-1].status
    row = node_row([heartbeat.status for heartbeat in heard])
    age_ns = now_ns - heard[-1].at_ns
    if age_ns > SILENT_NS and last.state is not NodeState.STOPPING:
        row |= {"state": "silent", "reason": f"no heartbeat for {1e-9 * age_ns:.0f} s"}
    before = {(count.what, count.reason): count.count for count in first.shed}
    for count in row["shed"]:
        count["window"] = count["count"] - before.get((count["what"], count["reason"]), 0)
    row["stages"] = msgspec.to_builtins(
        stage_figures([stage for heartbeat in heard for stage in heartbeat.status.stages])
    )
    return row


def top(
    window: Annotated[float, typer.Option("--window", metavar="S", min=0.5, help="Length of `now`.")] = WINDOW_S,
    once: Annotated[bool, typer.Option("--once", help="Show one table after one window, and end.")] = False,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """A running graph, live: load, stage times, losses, what is shed; age of the view, deadlines missed."""
    with _watching(domain, window) as (bus, watch):
        if not (once or as_json):
            with contextlib.suppress(KeyboardInterrupt), ends_with_reader():
                require_graph(domain)
                (_show_live if sys.stdout.isatty() else _show_tables)(bus, watch, domain, window)
            return
        with ends_with_reader():
            _listen(bus, watch, window)
        report = {"domain": domain, **watch.report(bus.now_ns())}
    if not report["nodes"]:
        raise no_heartbeat(domain, window)
    print_result(as_json, report, lambda: print_picture(_picture(report)))


def watched_topics(run_dir: Path) -> list[str]:
    """Return the topics that a watch takes in, with the set-ups of sensors that have names."""
    from msgs.bus.zmq import list_publishers

    published = {topic for topic, _ in list_publishers(run_dir) if plain_topic(topic) in _SETUPS}
    return list(dict.fromkeys((*_SETUPS, *_WATCHED, *sorted(published))))


@contextlib.contextmanager
def _watching(domain: str, window_s: float) -> Iterator[tuple[Bus, GraphWatch]]:
    from msgs.bus.zmq import ZmqBus, run_dir

    bus = ZmqBus(f"top-{os.getpid()}", run_dir(domain))
    try:
        for topic in watched_topics(run_dir(domain)):
            bus.subscribe(topic)
        yield bus, GraphWatch(bus.now_ns(), window_s)
    finally:
        bus.close()


def _listen(bus: Bus, watch: GraphWatch, duration_s: float) -> None:
    end_s = time.monotonic() + duration_s
    while (remaining_s := end_s - time.monotonic()) > 0.0:
        for received in bus.receive(min(remaining_s, 0.1)):
            watch.take(received.message, bus.now_ns())


def _show_tables(bus: Bus, watch: GraphWatch, domain: str, window_s: float) -> None:
    """One below the other after each window, for a file or another program; until Ctrl-C."""
    while True:
        _listen(bus, watch, window_s)
        print_picture(_picture({"domain": domain, **watch.report(bus.now_ns())}))


def _show_live(bus: Bus, watch: GraphWatch, domain: str, window_s: float) -> None:
    """One in place of the other; until Ctrl-C."""
    from rich.live import Live

    with Live(console=stdout_console(), auto_refresh=False, screen=True) as live:
        while True:
            live.update(_picture({"domain": domain, **watch.report(bus.now_ns())}), refresh=True)
            _listen(bus, watch, _REFRESH_S)


def _picture(report: dict[str, Any]) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    nodes = report["nodes"]
    if not nodes:
        return Text(f"domain {report['domain']}: no heartbeat yet")
    views = {name: report["graph"][name] for name in ViewFigures.__struct_fields__}
    return Group(
        Text(f"domain {report['domain']}: {views_text(msgspec.convert(views, ViewFigures))}"),
        Text(),
        console_table(_NODE_COLUMNS, [_node_cells(row) for row in nodes], _LEAST),
        Text(),
        console_table(_STAGE_COLUMNS, [cells for row in nodes for cells in _stage_cells(row)], ("COUNT",)),
    )


_NODE_COLUMNS = ("NODE", "STATE", "CPU %", "RSS MIB", "IN HZ", "OUT HZ", "LOST", "OUTDATED", "REASON", "SHED SO FAR")
_LEAST = ("OUTDATED", "RSS MIB", "CPU %", "OUT HZ", "IN HZ")
_STAGE_COLUMNS = ("NODE", "STAGE", "COUNT", "MEAN MS", "P50 MS", "P99 MS", "MAX MS")


def _node_cells(row: dict[str, Any]) -> list[object]:
    figures = [row["cpu_percent"], row["resident_bytes"] / (1 << 20), row["in_hz"], row["out_hz"]]
    counts = [row["lost"] + row["rejected"], row["outdated"]]
    return [row["node"], row["state"], *figures, *counts, row["reason"] or None, shed_text(row["shed"]) or None]


def _stage_cells(row: dict[str, Any]) -> list[list[object]]:
    names = ("name", "count", "mean_ms", "p50_ms", "p99_ms", "max_ms")
    return [[row["node"], *(stage[name] for name in names)] for stage in row["stages"]]
