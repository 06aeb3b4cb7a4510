"""`mirrorwave node restart` on a real graph: with other parameters, refused, and back as it was."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from mirrorwave.cli import main
from mirrorwave.control.node_params import current_params, restart_node
from mirrorwave.diagnose.running_graph import is_running
from msgs.values.node_params import NodeParams, ParamRequest
from nodes.process.launch_file import NodeEntry
from nodes.process.restarts import RestartServer
from nodes.process.supervisor import read_lock

pytestmark = pytest.mark.graph

LAUNCH = """
name: readers
nodes:
  head: {module: tests.mirrorwave.control.file_reader, hang_timeout_s: 600}
  tail: {module: tests.mirrorwave.control.file_reader, params: {rate_hz: 2.0}, hang_timeout_s: 600}
"""


@pytest.fixture(scope="module")
def graph() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="mw") as root, pytest.MonkeyPatch.context() as patch:
        patch.setenv("MIRRORWAVE_RUN_DIR", root)
        launch = Path(root) / "readers.yaml"
        launch.write_text(LAUNCH)
        command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--runs-dir", f"{root}/runs"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while not is_running("default"):
                assert process.poll() is None
                time.sleep(0.02)
            yield Path(root) / "default"
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) == 0


def pid(graph: Path, node: str) -> int:
    """From the process table: no heartbeat has to be waited for."""
    children = psutil.Process(read_lock(graph)["pid"]).children()
    (found,) = [child.pid for child in children if node in child.cmdline()]
    return found


def params(node: str) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(current_params("default", node)[node].params)
    return value


def test_a_node_is_started_again_alone_and_keeps_what_it_was_given(
    graph: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # answered when ready; the graph may still be starting
    assert main(["node", "restart", "tail"]) == 0
    assert capsys.readouterr().out == "tail is ready again\n"
    before = {name: pid(graph, name) for name in ("head", "tail")}
    assert main(["node", "restart", "tail", "-p", "path=/dev/zero/..", "--json"]) == 2
    assert main(["node", "restart", "tail", "-p", "path=/proc/self/stat", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"tail": {"rate_hz": 2.0, "path": "/proc/self/stat"}}
    assert pid(graph, "head") == before["head"]
    assert params("tail") == {"rate_hz": 2.0, "path": "/proc/self/stat"}
    # a crash later brings it back with the same
    os.kill(pid(graph, "tail"), signal.SIGKILL)
    assert main(["node", "restart", "tail"]) == 0
    assert params("tail") == {"rate_hz": 2.0, "path": "/proc/self/stat"}


def test_what_is_refused_stops_nothing(graph: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = pid(graph, "head")
    refused = (
        (["head", "-p", "rate_hz=0"], "head.params: rate_hz must be above zero, got 0.0"),
        (["head", "-p", "rate_hz=.nan"], "must be above zero, got nan"),
        (["head", "-p", "rate_hz=fast"], "head.params.rate_hz: Expected float, got str"),
        (["head", "-p", "speed=1"], "unknown field speed; known are path, rate_hz"),
        (["head", "-p", "rate_hz"], "'rate_hz' must be KEY=VALUE"),
        (["nobody"], "unknown node 'nobody'; known are head, tail"),
        (["head", "-p", f"path={'x' * 70_000}"], "must have at most 60000 characters"),
    )
    for words, line in refused:
        assert main(["node", "restart", *words]) == 2, words
        error = capsys.readouterr().err
        assert line in error
        assert error.count("\n") == 1
    assert pid(graph, "head") == before


def test_a_node_that_cannot_start_so_is_started_as_it_was(graph: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["node", "restart", "head", "-p", "path=/missing"]) == 2
    error = capsys.readouterr().err
    assert "head was not restarted with these parameters" in error
    assert "/missing" in error
    assert params("head") == {"path": "/dev/null", "rate_hz": 1.0}
    assert main(["node", "restart", "head"]) == 0


def test_of_two_restarts_at_once_the_second_is_told_to_wait(graph: Path) -> None:
    answers: dict[str, str] = {}

    def restart(node: str) -> None:
        answers[node] = restart_node("default", node, {}).error

    threads = [threading.Thread(target=restart, args=(node,)) for node in ("head", "tail")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    refused = [error for error in answers.values() if error]
    assert len(refused) <= 1
    assert all("is being restarted; ask again when it is ready" in error for error in refused)


class _Bus:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.answers: list[NodeParams] = []

    def subscribe(self, topic: str) -> None:
        assert topic == "param/request"

    def advertise(self, topic: str) -> None:
        assert topic == "param/values"

    def now_ns(self) -> int:
        return 1

    def publish(self, topic: str, message: NodeParams) -> None:
        self.answers.append(message)


def request(changes: str, name: str = "1", node: str = "supervisor") -> ParamRequest:
    return ParamRequest(stamp_ns=1, request=name, node=node, changes=changes)


def test_a_repeated_request_is_answered_again_and_restarts_nothing() -> None:
    bus = _Bus()
    server = RestartServer(bus)  # type: ignore[arg-type]
    entries = {"head": NodeEntry(module="a.b", params={"x": {"y": 1, "z": 2}})}
    assert server.begin(request('{"head": {}}', node="head"), entries) is None
    restart = server.begin(request('{"head": {"x": {"y": 3}}}'), entries)
    assert restart is not None
    assert restart.entry.params == {"x": {"y": 3, "z": 2}}
    assert server.begin(request('{"head": {"x": {"y": 3}}}'), entries) is None
    assert not bus.answers
    server.end()
    assert server.begin(request('{"head": {"x": {"y": 3}}}'), entries) is None
    assert [json.loads(answer.params) for answer in bus.answers] == [{"head": {"x": {"y": 3, "z": 2}}}] * 2


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ("", "changes must be a JSON object"),
        ("[]", "changes must be a JSON object, got list"),
        ("{}", "must name one node to restart, got none"),
        ('{"head": {}, "tail": {}}', "must name one node to restart, got head, tail"),
        ('{"head": 1}', "head: expected a mapping of parameters, got 1"),
        ("[" * 10_000, "changes must be a JSON object"),
    ],
)
def test_requests_that_are_none_are_answered_with_the_rule(changes: str, line: str) -> None:
    bus = _Bus()
    server = RestartServer(bus)  # type: ignore[arg-type]
    assert server.begin(request(changes), {"head": NodeEntry(module="a.b")}) is None
    assert server.current is None
    assert line in bus.answers[0].error
