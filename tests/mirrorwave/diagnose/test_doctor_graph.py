"""The doctor on living graphs: a node that is stopped, killed, fed with garbage, or was given no model."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest
import zmq

from mirrorwave.cli import main
from mirrorwave.diagnose import doctor_graph
from mirrorwave.diagnose.doctor_graph import (
    _check_node,
    _check_topics,
    _Graph,
    _why_no_message,
    check_can_interface,
    check_room,
    graph_findings,
)
from mirrorwave.diagnose.doctor_machine import check_weights
from mirrorwave.diagnose.findings import Finding, Status
from msgs.bus.topics import DETECTIONS_TOPIC, SENSOR_TOPICS
from msgs.bus.zmq import socket_path
from msgs.values.diagnostics import NodeStatus, TopicCount
from nodes.inputs.view_latency import ViewWatch
from nodes.process.supervisor import read_lock
from tests.builders import example_status

PATIENCE_S = 120.0
#: Holds two heartbeats, and so a rate.
SHORT_S = 1.2
VIEW = "topic perception/hidden_objects"
LAUNCH = """
name: toys
nodes:
  head: {module: tests.mirrorwave.toy_chain, hang_timeout_s: 600}
  tail: {module: tests.mirrorwave.toy_chain, params: {head: false}, hang_timeout_s: 600}
"""


def found(run_dir: Path) -> dict[str, Finding]:
    return {finding.check: finding for finding in graph_findings(run_dir, SHORT_S)}


def until(run_dir: Path, wanted: Callable[[dict[str, Finding]], bool]) -> dict[str, Finding]:
    """Findings once they are as wanted."""
    end_s = time.monotonic() + PATIENCE_S
    while not wanted(findings := found(run_dir)):
        assert time.monotonic() < end_s, findings
    return findings


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="mw") as root:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", root)
        launch = Path(root) / "corner.yaml"
        launch.write_text(LAUNCH)
        command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--runs-dir", f"{root}/runs"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield Path(root) / "default"
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


def pid_of(run_dir: Path, name: str) -> int:
    """A node's process, from the process table: no heartbeat has to be waited for."""
    children = psutil.Process(read_lock(run_dir)["pid"]).children()
    (pid,) = [child.pid for child in children if name in child.cmdline()]
    return pid


def asked(words: list[str], is_so: Callable[[Any], Any], capsys: pytest.CaptureFixture[str]) -> Any:
    """What a verb says once its short window held what is wanted."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        code, said = main([*words, "--window", str(SHORT_S), "--json"]), capsys.readouterr().out
        if code == 0 and is_so(told := json.loads(said)):
            return told
        assert time.monotonic() < end_s, said


def _are_well(findings: dict[str, Finding]) -> bool:
    wanted = [findings[check].status for check in (VIEW, "node head") if check in findings]
    return wanted == [Status.OK] * 2 and Status.FAILED not in {one.status for one in findings.values()}


def _is_understood(findings: dict[str, Finding]) -> bool:
    waits, tail = VIEW in findings and "waits for" in findings[VIEW].detail, findings.get("node tail")
    return bool(waits and tail and tail.status is not Status.FAILED)


def _rates_of_tail(told: dict[str, Any]) -> list[float]:
    return [link["hz"] for row in told["nodes"] if row["node"] == "tail" for link in row["inputs"] if link["hz"]]


@pytest.mark.graph
def test_the_node_that_fails_is_named_and_why(
    graph: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One trouble after the other: none, garbage, a stopped node, a killed one."""

    until(graph, _are_well)
    told = asked(["node", "info", "tail"], lambda told: told["received"], capsys)
    assert told["params"] == {"head": False}
    assert "nodes.node tests.mirrorwave.toy_chain" in told["command"]
    assert [row["topic"] for row in told["received"]] == ["param/request", "perception/peaks"]

    drawn = {row["node"]: row for row in asked(["graph"], _rates_of_tail, capsys)["nodes"]}
    assert [link["topic"] for link in drawn["head"]["outputs"]] == ["perception/peaks"]

    with zmq.Context() as context, context.socket(zmq.PUB) as mallory:
        mallory.linger = 0
        mallory.bind(f"ipc://{socket_path(graph, 'perception/peaks', 'mallory')}")

        def heard(findings: dict[str, Finding]) -> bool:
            for _ in range(20):
                mallory.send_multipart([b"perception/peaks\0", b"\xc1garbage"])
            tail, seen = findings.get("node tail"), findings.get(VIEW)
            is_named = tail and "rejected" in tail.detail and "perception/peaks from head, mallory" in tail.detail
            return bool(is_named and tail.status is Status.WARNING and seen and seen.status is Status.OK)

        until(graph, heard)
    socket_path(graph, "perception/peaks", "mallory").unlink(missing_ok=True)

    pid = pid_of(graph, "head")
    os.kill(pid, signal.SIGSTOP)
    try:
        stopped = until(graph, _is_understood)
        # two heartbeats are enough here
        monkeypatch.setattr(doctor_graph.graph_findings, "__defaults__", (SHORT_S,))
        assert main(["doctor", "--json"]) == 1
        checks = {row["check"]: row for row in json.loads(capsys.readouterr().out)}
    finally:
        os.kill(pid, signal.SIGCONT)
    assert f"pid {pid} is stopped" in stopped["node head"].detail
    assert stopped["node head"].status is Status.FAILED
    assert stopped["topic perception/peaks"].detail == "silent: head gives no heartbeat"
    assert stopped[VIEW].detail == "silent: tail waits for perception/peaks: head gives no heartbeat"
    assert checks["topic perception/peaks"]["status"] == "failed"

    os.kill(pid_of(graph, "head"), signal.SIGKILL)
    killed = until(graph, lambda findings: "restarted" in findings["node head"].detail)
    assert "restarted 1x, last: head was ended by SIGKILL" in killed["node head"].detail


@pytest.mark.graph
def test_a_graph_that_ended_for_want_of_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="mw") as root:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", root)
        launch = tmp_path / "l.yaml"
        launch.write_text(
            f"name: x\nnodes: {{a: {{module: nodes.dense_predictor, params: {{model: {root}/gone.onnx}}}}}}"
        )
        command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--runs-dir", str(tmp_path / "runs")]
        done = subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False)
        assert done.returncode == 2
        monkeypatch.chdir(tmp_path)
        findings = {finding.check: finding for finding in graph_findings(Path(root) / "default")}
    assert findings["graph"].detail == "none runs in this domain; `mirrorwave launch FILE` starts one"
    assert findings["last run"].status is Status.WARNING
    assert "runs/x-1: a FAILED" in findings["last run"].detail
    assert f"{root}/gone" in findings["last run"].detail


def test_a_node_that_has_done_its_work_has_not_failed() -> None:
    """A source that ended with exit code 0 while the graph goes on; one that was then started again and is gone has."""
    said = [
        {"node": "supervisor", "level": "info", "text": text}
        for text in ("player ready after 1 s, pid 7", "player has ended", "player_2 ready after 1 s, pid 8")
    ]
    views = ViewWatch(0, 3.0).figures(0)
    graph = _Graph({"nodes": ["player"]}, {"radar/beam": ["player"]}, {}, views, said, {})
    assert _check_node(graph, "player").status is Status.WARNING
    assert _why_no_message(graph, "radar/beam", ()) == "player has come to its end"
    again = graph._replace(log=[*said, said[0]])
    assert _check_node(again, "player").status is Status.FAILED
    assert _why_no_message(again, "radar/beam", ()) == "player gives no heartbeat"


def _beats(node: str, sent: dict[str, int], read: tuple[str, ...] = ()) -> list[NodeStatus]:
    """Two heartbeats 3 s apart, with so many messages sent between them."""
    return [
        example_status(
            node=node,
            uptime_s=3.0 * beat,
            published=tuple(TopicCount(topic=topic, messages=beat * count, bytes=0) for topic, count in sent.items()),
            received=tuple(TopicCount(topic=topic, messages=0, bytes=0) for topic in read),
        )
        for beat in (0, 1)
    ]


@pytest.mark.parametrize("looks", [0, 1, 2])
@pytest.mark.parametrize("takes_both", [False, True])
@pytest.mark.parametrize("sends_both", [False, True])
def test_a_graph_does_not_miss_the_other_kind_of_sensor(looks: int, takes_both: bool, sends_both: bool) -> None:
    """Whether somebody waits or could send; where nothing comes of the own one, that is said."""
    kinds = (*SENSOR_TOPICS, (DETECTIONS_TOPIC,))
    own, raw = kinds[looks], kinds[looks][-1]
    every = tuple(itertools.chain(*kinds))
    read = every if takes_both else own
    sends = every if sends_both else own
    views = ViewWatch(0, 3.0).figures(0)
    for messages in (250, 0):
        heard = {
            "player": _beats("player", dict.fromkeys(sends, 0) | {raw: messages}),
            "former": _beats("former", {}, read),
        }
        graph = _Graph({}, {topic: ["player"] for topic in sends}, heard, views, [], {})
        said = {one.check.removeprefix("topic "): one.status for one in _check_topics(graph)}
        if messages:
            assert said == {raw: Status.OK}
        else:
            assert said[raw] is Status.FAILED


@pytest.mark.parametrize(("scan_period_s", "window_s"), [(7.68, 3.0), (7.68, 10.0), (0.3, 3.0)])
def test_a_scan_longer_than_the_window_is_not_silence(scan_period_s: float, window_s: float) -> None:
    """A LiDAR that takes 7.7 s a scan says nothing in 3 s; in 10 s, or at 0.3 s a scan, nothing is silence."""
    topics = ("lidar/histograms", "radar/ra_map")
    heard = {"player": _beats("player", dict.fromkeys(topics, 0)), "former": _beats("former", {}, topics)}
    views = ViewWatch(0, 3.0).figures(0)
    publishers = {topic: ["player"] for topic in topics}
    graph = _Graph({}, publishers, heard, views, [], {}, scan_period_s, window_s)
    said = {one.check.removeprefix("topic "): one for one in _check_topics(graph)}
    if scan_period_s > window_s:
        assert {one.status for one in said.values()} == {Status.OK}
        assert "one a scan of 7.68 s" in said["lidar/histograms"].detail
    else:
        assert said["lidar/histograms"].status is Status.FAILED


def test_a_slow_scan_is_not_a_slow_topic() -> None:
    """One message in 7.7 s is the rate of that scan, and a tenth of the rate of scans of 0.3 s."""
    heard = {"player": _beats("player", {"lidar/histograms": 1}), "former": _beats("former", {}, ("lidar/histograms",))}
    views, publishers = ViewWatch(0, 3.0).figures(0), {"lidar/histograms": ["player"]}
    for scan_period_s, status in ((2.9, Status.OK), (0.3, Status.WARNING)):
        graph = _Graph({}, publishers, heard, views, [], {}, scan_period_s, 3.0)
        assert [one.status for one in _check_topics(graph)] == [status]


def test_the_radar_of_several_that_is_silent_is_named() -> None:
    """The right one has no driver; beats of the left one come, as its name says."""
    heard = {
        "left_driver": _beats("left_driver", {"radar/left/beam": 250}),
        "former_left": _beats("former_left", {}, ("radar/left/beam",)),
        "former_right": _beats("former_right", {}, ("radar/right/beam", "lidar/right/points", "no/topic")),
    }
    graph = _Graph({}, {"radar/left/beam": ["left_driver"]}, heard, ViewWatch(0, 3.0).figures(0), [], {})
    said = {one.check.removeprefix("topic "): (one.status, one.detail) for one in _check_topics(graph)}
    assert said == {
        "radar/left/beam": (Status.OK, "83.3 Hz from left_driver"),
        "radar/right/beam": (Status.FAILED, "no publisher; former_right reads it"),
    }


def test_what_a_peer_s_nodes_read_and_publish_is_not_this_graph_s() -> None:
    """Their beams stay there, and a map that two heartbeats count, theirs and the link's, comes once."""
    heard = {
        "link": _beats("link", {"radar/ra_map": 10}, ("perception/hidden_objects",)),
        "sensor.ra_former": _beats("sensor.ra_former", {"radar/ra_map": 10}, ("radar/beam",)),
        "geometry": _beats("geometry", {"perception/hidden_objects": 0}, ("radar/ra_map",)),
    }
    publishers = {"radar/ra_map": ["link"], "perception/hidden_objects": ["geometry"]}
    entries = {"link": {"module": "contrib.two_machines.link"}}
    graph = _Graph({}, publishers, heard, ViewWatch(0, 3.0).figures(0), [], entries)
    said = {one.check.removeprefix("topic "): one for one in _check_topics(graph)}
    assert set(said) == set(publishers)
    assert (said["radar/ra_map"].status, said["radar/ra_map"].detail) == (Status.OK, "3.33 Hz from link")
    # a link does not make maps of the views that it sends away
    cut = graph._replace(heard=heard | {"link": _beats("link", {"radar/ra_map": 0}, ("perception/hidden_objects",))})
    silent = {one.check.removeprefix("topic "): one.detail for one in _check_topics(cut)}
    assert silent["radar/ra_map"] == "silent: link is ready and publishes none"
    lost = TopicCount(topic="radar/beam", messages=9, bytes=9, lost=3)
    lossy = [msgspec.structs.replace(beat, received=(lost,)) for beat in heard["geometry"]]
    assert "radar/beam: 3 lost" in _check_node(graph._replace(heard={"sensor.x": lossy}), "sensor.x").detail


def test_weights_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"n")
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "b.onnx").mkdir()
    (tmp_path / "b.json").write_text("{}")
    findings = list(check_weights(tmp_path))
    assert [finding.status for finding in findings] == [Status.FAILED] * 2
    assert [finding.check for finding in findings] == ["weights a", "weights b"]
    assert "cannot be read" in findings[0].detail


@pytest.mark.parametrize(("free", "status"), [(1 << 40, "ok"), (1 << 30, "warning"), (1 << 20, "failed")])
def test_room_for_recordings(free: int, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_graph.shutil, "disk_usage", lambda path: type("Usage", (), {"free": free}))
    assert check_room("disk", tmp_path).status == status


def test_a_can_interface_that_is_absent_is_named() -> None:
    finding = check_can_interface("bus of vehicle_can", "can77")
    assert (finding.status, finding.detail) == (Status.FAILED, "can77 is absent: no such interface of the kernel")
