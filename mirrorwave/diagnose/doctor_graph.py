"""The doctor's findings in a running graph: the node that fails, the topic that is silent, and the reason.

Heartbeats and socket files say what is; the supervisor's log and the process table say why. A silent topic is followed
back, from reader to publisher, to the first node that does not do its part.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from mirrorwave.commands.graph.nodes import Heartbeats, node_row, shed_text, topic_rows
from mirrorwave.commands.graph.top import GraphWatch, watched_topics
from mirrorwave.diagnose.findings import Finding, Status
from msgs.bus.topics import (
    ABOUT_NODES,
    DETECTIONS_TOPIC,
    SENSOR_TOPICS,
    SHIPPED,
    SIDE_TOPICS,
    TOPICS,
    plain_topic,
    sensor_of,
    sensor_topic,
)
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.lidar import LidarSetup
from msgs.values.radar import RadarSetup
from nodes.inputs.view_latency import ViewFigures, scan_period_s, views_text
from nodes.viewer.node_table import is_of_peer

_MIB, _GIB = 1 << 20, 1 << 30
#: Six heartbeats, ten views.
WINDOW_S = 3.0
#: A topic slower than this share of its nominal rate is named.
_SLOW = 0.7
#: Topics that a graph does without: their absence is said, and is no failure.
_SPARE_TOPICS = frozenset({"vehicle/state", "sim/truth"})
#: Topics that most graphs do without: their absence is not said.
_OPTIONAL_TOPICS = frozenset({"environment/walls", "vehicle/gnss", *SIDE_TOPICS})
#: Modules of nodes that read every topic.
_TAKES_ALL = frozenset({"nodes.recorder", "contrib.foxglove.foxglove_bridge"})
_LOG_BYTES = 1 << 18
_ROOM_WARNING_BYTES, _ROOM_FAILED_BYTES = 5 * _GIB, 200 * _MIB
_LOST = ("lost", "rejected")


class _Graph(NamedTuple):
    """All that is known of a running graph."""

    #: Pid, run folder and nodes, as the supervisor's lock has them; empty where none runs.
    owner: dict[str, Any]
    publishers: dict[str, list[str]]
    heard: Heartbeats
    views: ViewFigures
    #: Newest entries of the supervisor's log, oldest first.
    log: list[dict[str, Any]]
    #: The resolved launch file's nodes.
    entries: dict[str, Any]
    #: Longest scan of the sensors that told theirs, and how long was looked.
    scan_period_s: float = 0.0
    window_s: float = WINDOW_S

    @property
    def names(self) -> list[str]:
        """All nodes, expected or heard."""
        return sorted({*self.owner.get("nodes", ()), *self.heard})

    def rows(self, topic: str, direction: str) -> dict[str, dict[str, Any]]:
        """Return the row of each node of this host on a topic that it reads ("in") or publishes ("out")."""
        return {
            name: row
            for name, beats in self.heard.items()
            for row in topic_rows(beats)
            if row["topic"] == topic and row["way"] == direction and not is_of_peer(name)
        }


def graph_findings(run_dir: Path, window_s: float = WINDOW_S) -> Iterator[Finding]:
    """Nodes, topics, views, recordings and buses of the graph that runs in `run_dir`."""
    from msgs.bus.zmq import list_publishers
    from nodes.process.supervisor import read_lock

    if not read_lock(run_dir) and not list_publishers(run_dir):
        yield Finding("graph", Status.OK, "none runs in this domain; `mirrorwave launch FILE` starts one")
        yield from _last_run(Path("runs"))
        return
    graph = _look(run_dir, window_s)
    for name in graph.names:
        yield _check_node(graph, name)
    yield from _check_topics(graph)
    yield from _check_views(graph)
    for name, entry in graph.entries.items():
        yield from _check_recorder(name, entry)
        yield from _check_can(name, entry)


def _look(run_dir: Path, window_s: float) -> _Graph:
    from msgs.bus.zmq import ZmqBus, list_publishers
    from nodes.process.supervisor import read_lock

    bus = ZmqBus(f"doctor-{os.getpid()}", run_dir)
    heard: Heartbeats = {}
    longest_s = 0.0
    try:
        for topic in watched_topics(run_dir):
            bus.subscribe(topic)
        watch = GraphWatch(bus.now_ns(), window_s)
        end_s = time.monotonic() + window_s
        while (remaining_s := end_s - time.monotonic()) > 0.0:
            for received in bus.receive(min(remaining_s, 0.1)):
                watch.take(received.message, bus.now_ns())
                if isinstance(received.message, RadarSetup | LidarSetup):
                    longest_s = max(longest_s, scan_period_s(received.message))
                if isinstance(received.message, NodeStatus):
                    heard.setdefault(received.message.node, []).append(received.message)
        views = watch.report(bus.now_ns())["graph"]
    finally:
        bus.close()
    owner = read_lock(run_dir)
    publishers: dict[str, list[str]] = {}
    for topic, node in list_publishers(run_dir):
        publishers.setdefault(topic, []).append(node)
    figures = msgspec.convert({name: views[name] for name in ViewFigures.__struct_fields__}, ViewFigures)
    alive = {name: beats for name, beats in heard.items() if beats[-1].state is not NodeState.STOPPING}
    run = Path(owner["run"]) if owner.get("run") else None
    return _Graph(owner, publishers, alive, figures, _log_entries(run), _launch_entries(run), longest_s, window_s)


def _check_node(graph: _Graph, name: str) -> Finding:
    check = f"node {name}"
    beats = graph.heard.get(name, [])
    if not beats and _has_ended(graph, name):
        return Finding(check, Status.WARNING, "has come to its end (exit code 0) and is not started again")
    if not beats:
        return Finding(check, Status.FAILED, _why_silent(graph, name))
    row = node_row(beats)
    load = f"{row['cpu_percent']:.0f} % cpu, {row['resident_bytes'] / _MIB:.0f} MiB"
    if row["state"] == NodeState.DEGRADED:
        # a supervisor that is degraded has a node that it gave up
        status = Status.FAILED if name == "supervisor" else Status.WARNING
        return Finding(check, status, f"degraded: {row['reason'] or 'no reason given'}; {load}")
    troubles = [*_losses(graph, name, beats), *_restarts(graph, name)]
    if row["shed"]:
        troubles.append(f"left undone so far: {shed_text(row['shed'])}")
    return Finding(check, Status.WARNING if troubles else Status.OK, "; ".join([row["state"], *troubles, load]))


def _why_silent(graph: _Graph, name: str) -> str:
    """No heartbeat: because there is no process, because it was stopped, or because it hangs."""
    said = _last_word(graph, name)
    word = f"; the log says: {said}" if said else ""
    silent = f"no heartbeat in {graph.window_s:g} s"
    process = _process_of(graph, name)
    if process is None:
        return f"{silent}: its process has ended or was never started{word}"
    if process["status"] == "stopped":
        return f"{silent}: pid {process['pid']} is stopped; kill -CONT {process['pid']} wakes it"
    return f"{silent}: pid {process['pid']} is there ({process['status']}), it starts still or hangs in a step{word}"


def _has_ended(graph: _Graph, name: str) -> bool:
    """Return whether the supervisor's last entry on a node is that it finished its work: that is no failure."""
    said = (entry["text"] for entry in reversed(graph.log) if entry["node"] == "supervisor")
    return next((text for text in said if text.startswith(f"{name} ")), "") == f"{name} has ended"


def _process_of(graph: _Graph, name: str) -> dict[str, Any] | None:
    """Pid and state of a node's process, found by its command line among the supervisor's children."""
    import psutil

    try:
        for child in psutil.Process(graph.owner.get("pid", 0)).children():
            words = child.cmdline()
            if "--name" in words and words[words.index("--name") + 1 :][:1] == [name]:
                return {"pid": child.pid, "status": str(child.status())}
    except psutil.Error:
        return None
    return None


def _losses(graph: _Graph, name: str, beats: list[NodeStatus]) -> list[str]:
    first = {count.topic: count for count in beats[0].received}
    texts = []
    for count in beats[-1].received:
        before = first.get(count.topic)
        parts = []
        for kind in _LOST:
            total = getattr(count, kind)
            new = total - getattr(before, kind, 0)
            if total:
                parts.append(f"{total} {kind} ({new} in the last {graph.window_s:g} s)")
        if parts:
            # who publishes on a peer's host is not known here
            senders = "" if is_of_peer(name) else f" from {', '.join(graph.publishers.get(count.topic, ['nobody']))}"
            why = _last_word(graph, name, "rejected:") if count.rejected else ""
            texts.append(f"{count.topic}{senders}: {', '.join(parts)}{'; ' + why if why else ''}")
    return texts


def _restarts(graph: _Graph, name: str) -> list[str]:
    """Return how often the supervisor restarted a node, and the last reason."""
    texts = [
        entry["text"]
        for entry in graph.log
        if entry["node"] == "supervisor" and entry["text"].startswith(f"{name} ") and "; restart in" in entry["text"]
    ]
    return [f"restarted {len(texts)}x, last: {texts[-1].partition('; restart in')[0]}"] if texts else []


def _check_topics(graph: _Graph) -> Iterator[Finding]:
    used = (row["topic"] for beats in graph.heard.values() for row in topic_rows(beats))
    for topic in dict.fromkeys((*TOPICS, *used)):
        if topic not in TOPICS:
            continue
        facts, plain = TOPICS[topic], plain_topic(topic)
        readers, publishers = graph.rows(topic, "in"), graph.publishers.get(topic, [])
        readers.pop("supervisor", None)
        if topic in ABOUT_NODES or not (readers or publishers) or _is_spare_sensor(graph, topic):
            continue
        spare = Status.WARNING if plain in _SPARE_TOPICS else Status.FAILED
        is_own = plain not in SHIPPED
        # a recorder and a bridge take whatever there is
        is_needed = any(graph.entries.get(name, {}).get("module") not in _TAKES_ALL for name in readers)
        if not publishers and (plain in _OPTIONAL_TOPICS or (is_own and not is_needed)):
            continue
        # a player publishes what its recording has
        if plain in _OPTIONAL_TOPICS and not is_needed and _is_silent(graph, topic):
            continue
        if not publishers:
            yield Finding(f"topic {topic}", spare, f"no publisher; {', '.join(readers)} reads it")
        elif facts.rate_hz:
            yield _check_rate(graph, topic, facts.rate_hz, spare)


def _is_spare_sensor(graph: _Graph, topic: str) -> bool:
    """Return whether a sensor is silent because nobody reads it, or because one of the other kind is in use."""
    kinds = [[sensor_topic(name, sensor_of(topic)) for name in kind] for kind in (*SENSOR_TOPICS, (DETECTIONS_TOPIC,))]
    for kind in kinds:
        raw, rivals = kind[-1], [rival[-1] for rival in kinds if rival is not kind]
        if topic in kind and _is_silent(graph, raw):
            in_use = (not _is_silent(graph, rival) for rival in rivals)
            looks = any(in_use) if raw in graph.publishers else any(rival in graph.publishers for rival in rivals)
            return looks or not graph.rows(topic, "in").keys() - {"supervisor"}
    return False


def _check_rate(graph: _Graph, topic: str, nominal_hz: float, spare: Status) -> Finding:
    check = f"topic {topic}"
    rates = [row["hz"] for row in graph.rows(topic, "out").values()]
    hz = sum(rate or 0.0 for rate in rates)
    senders = ", ".join(graph.publishers[topic])
    if _is_slow(graph, topic):
        longest_s = graph.scan_period_s
        text = f"{senders} sends one a scan of {longest_s:.3g} s, longer than the {graph.window_s:g} s that were looked"
        return Finding(check, Status.OK, text)
    if hz == 0.0 and None in rates:
        return Finding(check, Status.OK, f"{senders} has just started")
    if hz == 0.0:
        return Finding(check, spare, f"silent: {_why_no_message(graph, topic, ())}")
    if _is_of_a_scan(topic) and graph.scan_period_s:
        nominal_hz = min(nominal_hz, 1.0 / graph.scan_period_s)
    if hz < _SLOW * nominal_hz:
        return Finding(check, Status.WARNING, f"{hz:.3g} Hz from {senders}, nominal are {nominal_hz:.3g} Hz")
    return Finding(check, Status.OK, f"{hz:.3g} Hz from {senders}")


def _why_no_message(graph: _Graph, topic: str, visited: tuple[str, ...]) -> str:
    """The first node upstream that does not do its part, and those that wait for it."""
    reasons = []
    for name in graph.publishers.get(topic, []):
        if name not in graph.heard:
            reasons.append(f"{name} {'has come to its end' if _has_ended(graph, name) else 'gives no heartbeat'}")
        elif name not in visited:
            waits = [input_topic for input_topic in _inputs_of(graph, name) if _is_silent(graph, input_topic)]
            reasons += [
                f"{name} waits for {input_topic}: {_why_no_message(graph, input_topic, (*visited, name))}"
                for input_topic in waits[:1]
            ]
            if not waits:
                state, reason = node_row(graph.heard[name])["state"], graph.heard[name][-1].reason
                reasons.append(f"{name} is {state} and publishes none{': ' + reason if reason else ''}")
    return "; ".join(reasons) or f"nobody publishes {topic}"


def _inputs_of(graph: _Graph, name: str) -> list[str]:
    """Topics that a node makes its own of; a link has those from another host."""
    if graph.entries.get(name, {}).get("module") == "contrib.two_machines.link":
        return []
    rows = topic_rows(graph.heard[name])
    return [row["topic"] for row in rows if row["way"] == "in" and row["topic"] not in _SPARE_TOPICS | _OPTIONAL_TOPICS]


def _is_silent(graph: _Graph, topic: str) -> bool:
    rate_hz = 0.0 if _is_slow(graph, topic) else TOPICS[topic].rate_hz
    return bool(rate_hz) and not any(row["hz"] for row in graph.rows(topic, "out").values())


def _is_slow(graph: _Graph, topic: str) -> bool:
    """Whether a topic has one message a scan, and a scan may take longer than was looked."""
    return _is_of_a_scan(topic) and graph.scan_period_s >= graph.window_s


def _is_of_a_scan(topic: str) -> bool:
    """Whether a topic has one message a scan."""
    return TOPICS[topic].rate_hz == TOPICS["radar/ra_map"].rate_hz


def _check_views(graph: _Graph) -> Iterator[Finding]:
    if "perception/hidden_objects" not in graph.publishers:
        return
    late = graph.views.misses or graph.views.overdue or not graph.views.views_total
    yield Finding("views", Status.WARNING if late else Status.OK, views_text(graph.views))


def _check_recorder(name: str, entry: dict[str, Any]) -> Iterator[Finding]:
    if entry.get("module") == "nodes.recorder":
        yield check_room(f"disk of {name}", Path(entry.get("params", {}).get("path", ".")).absolute().parent)


def check_room(check: str, folder: Path) -> Finding:
    """Room for a recording; raw beams take 350 MB/s."""
    free = shutil.disk_usage(folder).free
    status = Status.FAILED if free < _ROOM_FAILED_BYTES else Status.OK
    status = Status.WARNING if _ROOM_FAILED_BYTES <= free < _ROOM_WARNING_BYTES else status
    return Finding(check, status, f"{free / _GIB:.1f} GiB free in {folder}: {free / 350e6:.0f} s of raw beams")


_CAN_MODULES = ("nodes.vehicle_can", "nodes.can_out", "nodes.car_sim", "contrib.boards.detections_radar")


def _check_can(name: str, entry: dict[str, Any]) -> Iterator[Finding]:
    params = entry.get("params", {})
    if (
        str(entry.get("module", "")) in _CAN_MODULES
        and params.get("interface", "socketcan") == "socketcan"
        and not params.get("log")
    ):
        yield check_can_interface(f"bus of {name}", params.get("channel", "can0"))


def check_can_interface(check: str, channel: str) -> Finding:
    """Check that a CAN interface of the kernel exists and is up."""
    folder = Path("/sys/class/net") / channel
    if not folder.is_dir():
        return Finding(check, Status.FAILED, f"{channel} is absent: no such interface of the kernel")
    if (folder / "operstate").read_text().strip() == "down":
        command = f"ip link set {channel} up type can bitrate 500000"
        return Finding(check, Status.FAILED, f"{channel} is down; `{command}` brings it up")
    return Finding(check, Status.OK, f"{channel} is up")


def _log_entries(run: Path | None) -> list[dict[str, Any]]:
    """Newest entries of a run's log."""
    if run is None or not (run / "log.jsonl").is_file():
        return []
    with (run / "log.jsonl").open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _LOG_BYTES))
        lines = file.read().split(b"\n")[1 if size > _LOG_BYTES else 0 :]
    entries = []
    for line in lines:
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(entry, dict) and all(isinstance(entry.get(key), str) for key in ("node", "level", "text")):
            entries.append(entry)
    return entries


def _last_word(graph: _Graph, name: str, opening: str = "") -> str:
    """The last warning or error that a node gave, or that the supervisor gave of it."""
    for entry in reversed(graph.log):
        own = entry["node"] == name or (entry["node"] == "supervisor" and entry["text"].startswith(f"{name} "))
        if own and entry["level"] in ("warning", "error", "critical") and entry["text"].startswith(opening):
            return " ".join(entry["text"].split())
    return ""


def _launch_entries(run: Path | None) -> dict[str, Any]:
    from nodes.process.launch_file import read_yaml_mapping

    if run is None or not (run / "launch.yaml").is_file():
        return {}
    nodes = read_yaml_mapping(run / "launch.yaml").get("nodes")
    return nodes if isinstance(nodes, dict) else {}


def _last_run(runs_dir: Path) -> Iterator[Finding]:
    """Report why the newest run of this folder failed, if it did."""
    runs = sorted(runs_dir.glob("*/log.jsonl"), key=lambda path: path.stat().st_mtime) if runs_dir.is_dir() else []
    if not runs:
        return
    failures = [
        entry["text"]
        for entry in _log_entries(runs[-1].parent)
        if entry["node"] == "supervisor" and entry["level"] == "error" and " FAILED" in entry["text"]
    ]
    if failures:
        yield Finding("last run", Status.WARNING, f"{runs[-1].parent}: {' '.join(failures[-1].split())}")
