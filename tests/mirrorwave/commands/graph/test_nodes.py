"""`mirrorwave node`: rates of a node from its heartbeats."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mirrorwave.cli import main
from mirrorwave.commands.graph import nodes
from mirrorwave.commands.graph.nodes import node_process, node_row, topic_rows
from mirrorwave.reference import node_modules
from msgs.files.plugins import NODES
from msgs.values.diagnostics import NodeStatus, TopicCount
from nodes.process.launch_file import GROUP_MODULE
from tests.builders import example_status
from tests.plugins import NODE, write_package


def _beat(uptime_s: float, cpu_s: float, messages: int, pid: int = 2) -> NodeStatus:
    counts = (
        TopicCount(topic="radar/beam", messages=messages, bytes=8 * messages, lost=2),
        TopicCount(topic="log", messages=99 * messages, bytes=0),
    )
    return example_status(node="a", uptime_s=uptime_s, cpu_s=cpu_s, received=counts, pid=pid)


def test_rates_come_from_two_heartbeats_of_one_process() -> None:
    beats = [_beat(9.0, 9.0, 900, pid=1), _beat(1.0, 0.5, 10), _beat(3.0, 1.5, 30)]
    row = node_row(beats)
    assert (row["in_hz"], row["cpu_percent"], row["lost"]) == (10.0, 50.0, 2)
    beams = topic_rows(beats)[0]
    assert (beams["way"], beams["messages"], beams["hz"], beams["bytes_per_s"]) == ("in", 30, 10.0, 80.0)
    first = node_row(beats[:2])
    assert (first["in_hz"], first["cpu_percent"]) == (None, 50.0)


@pytest.mark.parametrize(
    "words",
    [("nodes.node", "nodes.geometry", "--params", '{"b": 1}'), (GROUP_MODULE, '{"a": {"params": {"b": 1}}}'), ("x",)],
    ids=["alone", "in a group", "no node"],
)
def test_the_command_of_a_node_is_what_one_would_type(words: tuple[str, ...]) -> None:
    """Without the empty words with which a forked process fills the room that its command leaves free."""
    command = [sys.executable, "-c", "print(flush=True); input()", *words]
    with subprocess.Popen([*command, "", ""], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        # a process that is about to begin has no command yet
        process.stdout.readline()
        assert node_process("a", process.pid) == {
            "command": shlex.join(command),
            "params": None if words == ("x",) else {"b": 1},
        }
        process.communicate(b"\n")
    assert node_process("a", process.pid) == {"command": None, "params": None}


def test_the_process_that_is_killed_is_the_one_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[tuple[int, int]] = []
    monkeypatch.setattr(nodes, "_heartbeats", lambda *_: {"a": [_beat(9.0, 9.0, 9, pid=1), _beat(1.0, 1.0, 1)]})
    monkeypatch.setattr(nodes.os, "kill", lambda *words: killed.append(words))
    assert main(["node", "kill", "a"]) == 0
    assert main(["node", "kill", "b"]) == 2
    assert killed == [(2, signal.SIGKILL)]


def test_node_types_lists_shipped_and_plugged_in_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Shipped ones, one of another package with its parameters, and one that is broken: named, and exit code 1."""
    assert main(["node", "types", "--json"]) == 0
    shipped = json.loads(capsys.readouterr().out)
    assert {row["package"] for row in shipped} == {"mirrorwave"}
    assert {row["module"] for row in shipped} == set(node_modules())
    points = {"their_radar": "acme_types", "broken_radar": "acme_broken", "no-name": "acme_types"}
    sources = {"acme_types": NODE, "acme_broken": "oops"}
    monkeypatch.syspath_prepend(write_package(tmp_path, "acme", NODES, points, **sources))
    assert main(["node", "types", "their_radar", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [
        {
            "module": "their_radar",
            "package": "acme 1.2",
            "about": "A node of somebody else.",
            "inputs": ["radar/ra_map"],
            "outputs": ["vehicle/state"],
            "params": [{"name": "rate_hz", "type": "float", "default": "10.0", "about": "Times a second."}],
            "error": "",
        }
    ]
    assert main(["node", "types", "--json"]) == 1
    rows = {row["module"]: row for row in json.loads(capsys.readouterr().out)}
    assert len(rows) == len(shipped) + 3
    assert rows["broken_radar"]["error"].startswith("acme_broken cannot be imported: NameError: name 'oops'")
    assert rows["no-name"]["error"].startswith("a name must be of a-z")
    assert main(["node", "types"]) == 1
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("broken_radar"))
    assert "acme 1.2" in line
    assert "BROKEN: acme_broken cannot be imported" in line


def test_node_types_shows_a_node_with_all_its_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["node", "types", "nodes.dense_predictor"]) == 0
    shown = capsys.readouterr().out
    assert "cfar.ridges.azimuth_lobe_db" in shown
    assert "str | None" in shown
    assert main(["node", "types", "nodes.nothing"]) == 2
    assert capsys.readouterr().err == "mirrorwave: nodes.nothing.module: no module named 'nodes.nothing'\n"
