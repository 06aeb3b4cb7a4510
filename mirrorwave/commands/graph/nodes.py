"""`mirrorwave node`: the nodes of a running graph, as their heartbeats tell, and the modules that nodes are made of."""

from __future__ import annotations

import json
import os
import shlex
import signal
import time
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from mirrorwave.completion import NodeName
from mirrorwave.console import (
    DEFAULT_DOMAIN,
    AsJson,
    Domain,
    ExitCode,
    print_json,
    print_line,
    print_result,
    print_rows,
    print_table,
)
from mirrorwave.diagnose.running_graph import no_heartbeat
from mirrorwave.terminal import ends_with_reader
from msgs.bus.topics import ABOUT_NODES
from msgs.values.diagnostics import NodeState, NodeStatus, TopicCount
from msgs.values.wording import counted, did_you_mean
from nodes.viewer.node_table import is_of_peer

app = typer.Typer(help="Look at the nodes of a running graph, and at those there are.", no_args_is_help=True)

#: Long enough for two heartbeats of each node after it was found.
WINDOW_S = 1.6
WindowS = Annotated[float, typer.Option("--window", metavar="S", min=0.1, help="Listen this long.")]

Heartbeats = dict[str, list[NodeStatus]]
_NO_PROCESS: dict[str, Any] = {"command": None, "params": None}


def collect_heartbeats(run_dir: Path, window_s: float = WINDOW_S) -> Heartbeats:
    """All heartbeats of the graph in `run_dir` within `window_s`, oldest first, by node in order of name."""
    from msgs.bus.zmq import ZmqBus

    bus = ZmqBus(f"node-{os.getpid()}", run_dir)
    beats: Heartbeats = {}
    try:
        bus.subscribe("diagnostics/node")
        deadline_s = time.monotonic() + window_s
        with ends_with_reader():
            while (remaining_s := deadline_s - time.monotonic()) > 0.0:
                for received in bus.receive(min(remaining_s, 0.1)):
                    if isinstance(received.message, NodeStatus):
                        beats.setdefault(received.message.node, []).append(received.message)
    finally:
        bus.close()
    return {name: beats[name] for name in sorted(beats)}


def node_row(beats: list[NodeStatus]) -> dict[str, Any]:
    """Return the row of one node from its heartbeats; rates need two of them from one process."""
    last = beats[-1]
    first = next(status for status in beats if status.pid == last.pid)
    elapsed_s = last.uptime_s - first.uptime_s
    cpu_s = last.cpu_s - first.cpu_s if elapsed_s > 0.0 else last.cpu_s
    return {
        "node": last.node,
        "state": str(last.state),
        "reason": last.reason,
        "pid": last.pid,
        "uptime_s": last.uptime_s,
        "cpu_percent": 100.0 * cpu_s / max(elapsed_s or last.uptime_s, 1e-3),
        "resident_bytes": last.resident_bytes,
        "in_hz": _rate_hz(first.received, last.received, elapsed_s),
        "out_hz": _rate_hz(first.published, last.published, elapsed_s),
        "lost": sum(count.lost for count in last.received),
        "rejected": sum(count.rejected for count in last.received),
        "outdated": sum(count.outdated for count in last.received),
        "shed": [msgspec.to_builtins(count) for count in last.shed],
    }


def topic_rows(beats: list[NodeStatus]) -> list[dict[str, Any]]:
    """Each topic that a node receives (`direction` in) or publishes (out): totals, and rates between its heartbeats."""
    last = beats[-1]
    first = next(status for status in beats if status.pid == last.pid)
    elapsed_s = last.uptime_s - first.uptime_s
    rows = []
    for direction, before, counts in (("in", first.received, last.received), ("out", first.published, last.published)):
        earlier = {count.topic: count for count in before}
        for count in counts:
            start = earlier.get(count.topic, TopicCount(topic=count.topic, messages=0, bytes=0))
            hz, bytes_per_s = (
                (now - then) / elapsed_s if elapsed_s > 0.0 else None
                for now, then in ((count.messages, start.messages), (count.bytes, start.bytes))
            )
            rows.append({"way": direction, **msgspec.to_builtins(count), "hz": hz, "bytes_per_s": bytes_per_s})
    return rows


def node_process(node: str, pid: int) -> dict[str, Any]:
    """Command line of a node's process on this machine and the parameters it was started with; None where unknown."""
    import psutil

    from nodes.process.launch_file import GROUP_MODULE

    try:
        # a forked node's command is followed by the room that it leaves free
        words = [word for word in psutil.Process(pid).cmdline() if word]
    except psutil.Error:
        return _NO_PROCESS
    params = None
    if GROUP_MODULE in words:
        params = json.loads(words[words.index(GROUP_MODULE) + 1])[node]["params"]
    elif "nodes.node" in words and "--params" in words:
        params = json.loads(words[words.index("--params") + 1])
    return {"command": shlex.join(words) or None, "params": params}


def shed_text(shed: list[dict[str, Any]]) -> str:
    """Describe the work that a node left out, in words: "12 scans behind, 1 beam late"."""
    return ", ".join(f"{counted(count['count'], count['what'])} {count['reason']}" for count in shed)


@app.command("list")
def list_nodes(window: WindowS = WINDOW_S, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """State, pid, load, rates, losses and what was shed of each node."""
    rows = [node_row(beats) for beats in _heartbeats(domain, window).values()]
    if as_json:
        print_json(rows)
        return
    for row in rows:
        row["rss_mib"] = row["resident_bytes"] / (1 << 20)
        row["reason"] = row["reason"] or None
        row["shed"] = shed_text(row["shed"]) or None
    figures = ("uptime_s", "cpu_percent", "rss_mib", "in_hz", "out_hz", "lost", "rejected", "outdated")
    columns = ("node", "state", "pid", *figures, "shed", "reason")
    print_rows(columns, rows, ("uptime_s", "pid", "outdated", "rejected", "rss_mib", "cpu_percent", "out_hz", "in_hz"))


@app.command()
def info(name: NodeName, window: WindowS = WINDOW_S, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """One node: parameters, rates and losses of its topics, the time its stages take."""
    heard = _heartbeats(domain, window)
    if name not in heard:
        raise ValueError(f"unknown node {name!r}; heard of are {', '.join(heard)}{did_you_mean(name, heard)}")
    beats = heard[name]
    status = next((beat for beat in reversed(beats) if beat.stages), beats[-1])
    # a peer's process is none of this machine, though one here may have its number
    row = {**node_row(beats), **(_NO_PROCESS if is_of_peer(name) else node_process(name, beats[-1].pid))}
    topics = topic_rows(beats)
    if as_json:
        rows = {key: [each for each in topics if each["way"] == direction] for key, direction in _DIRECTIONS.items()}
        print_json({**row, **rows, "stages": list(status.stages)})
        return
    about = {**row, "shed": shed_text(row["shed"]), "params": json.dumps(row["params"])}
    print_table(("NODE", about.pop("node")), about.items())
    columns = ("way", "topic", "hz", "bytes_per_s", "messages", "bytes", "lost", "rejected", "outdated")
    print_rows(columns, topics, ("bytes", "messages", "bytes_per_s", "outdated", "rejected"))
    stages = [(stage.name, stage.count, stage.last_ms, stage.mean_ms, stage.max_ms) for stage in status.stages]
    print_table(("STAGE", "COUNT", "LAST MS", "MEAN MS", "MAX MS"), stages)


@app.command()
def types(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="One of them, with all its parameters.")] = None,
    as_json: AsJson = False,
) -> None:
    """Modules that a launch file can name: shipped ones, and those that installed packages bring; exit code 1 if a
    package's is broken."""
    from mirrorwave.diagnose.node_types import named_types, node_types

    rows = node_types() if name is None else named_types(name)
    if as_json:
        print_json(rows)
    elif name is None:
        columns = ("module", "package", "inputs", "outputs", "about")
        print_rows(columns, [_type_row(row) for row in rows], ("package", "outputs", "inputs"))
    else:
        for row in rows:
            print_line(f"{row['module']}, {row['package']}: {row['error'] or row['about']}")
            print_table(("PARAMETER", "TYPE", "DEFAULT", ""), [list(param.values()) for param in row["params"]])
    if any(row["error"] for row in rows):
        raise typer.Exit(ExitCode.FAILED)


def _type_row(row: dict[str, Any]) -> dict[str, Any]:
    texts = {key: ", ".join(value) for key, value in row.items() if key in ("inputs", "outputs")}
    return {**row, **texts, "about": f"BROKEN: {row['error']}" if row["error"] else row["about"]}


_DIRECTIONS = {"received": "in", "published": "out"}


def _heartbeats(domain: str, window_s: float) -> Heartbeats:
    from msgs.bus.zmq import run_dir

    heard = collect_heartbeats(run_dir(domain), window_s)
    alive = {name: beats for name, beats in heard.items() if beats[-1].state is not NodeState.STOPPING}
    if not alive:
        raise no_heartbeat(domain, window_s)
    return alive


def _rate_hz(first: tuple[TopicCount, ...], last: tuple[TopicCount, ...], elapsed_s: float) -> float | None:
    """Messages per second between two heartbeats, diagnostics apart."""
    if elapsed_s <= 0.0:
        return None
    first_total, last_total = (
        sum(count.messages for count in counts if count.topic not in ABOUT_NODES) for counts in (first, last)
    )
    return (last_total - first_total) / elapsed_s


@app.command()
def restart(
    node: NodeName,
    params: Annotated[
        list[str] | None, typer.Option("-p", "--param", metavar="KEY=VALUE", help="Parameter to start it with.")
    ] = None,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Stop a node and start it again, with other parameters if wished.

    It starts with those of the graph's launch file, changes of earlier restarts and -p merged over them; what `param
    set` changed is as it was before. If -p is refused nothing is stopped (exit code 2); a node that cannot start with
    it is started as it was.
    """
    from mirrorwave.control.node_params import parse_changes, restart_node

    answer = restart_node(domain, node, parse_changes(node, params or []))
    if answer.error:
        raise ValueError(f"{node} was not restarted with these parameters: {answer.error}" if params else answer.error)
    print_result(as_json, json.loads(answer.params), f"{node} is ready again")


@app.command()
def kill(
    name: NodeName,
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Kill the process of a node; the graph starts it again, as its `restart` says."""
    heard = _heartbeats(domain, WINDOW_S)
    own = {key: beats for key, beats in heard.items() if not is_of_peer(key)}
    if name not in own:
        raise ValueError(f"unknown node {name!r}; heard of are {', '.join(own)}{did_you_mean(name, own)}")
    pid = own[name][-1].pid
    os.kill(pid, signal.SIGKILL)
    print_line(f"{name}: SIGKILL to pid {pid}")
