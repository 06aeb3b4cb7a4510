"""`mirrorwave node`: rates of a node from its heartbeats."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mirrorwave.cli import main
from mirrorwave.commands.graph.nodes import node_row
from mirrorwave.reference import node_modules
from msgs.files.plugins import NODES
from msgs.values.diagnostics import NodeStatus, TopicCount
from tests.builders import example_status
from tests.plugins import NODE, write_package


def _beat(uptime_s: float, cpu_s: float, messages: int) -> NodeStatus:
    counts = (
        TopicCount(topic="radar/beam", messages=messages, bytes=0, lost=2),
        TopicCount(topic="log", messages=99 * messages, bytes=0),
    )
    return example_status(node="a", uptime_s=uptime_s, cpu_s=cpu_s, received=counts)


def test_rates_come_from_two_heartbeats_of_one_process() -> None:
    row = node_row([_beat(1.0, 0.5, 10), _beat(3.0, 1.5, 30)])
    assert (row["in_hz"], row["cpu_percent"], row["lost"]) == (10.0, 50.0, 2)
    assert node_row([_beat(2.0, 1.0, 10)])["in_hz"] is None


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
