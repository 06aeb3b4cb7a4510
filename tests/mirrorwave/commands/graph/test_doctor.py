"""The doctor names what fails and why."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from mirrorwave.commands.graph.doctor import Status, check_graph, check_packages, check_run_dir, check_weights
from mirrorwave.commands.graph.nodes import node_row
from msgs.values.diagnostics import NodeState, NodeStatus, TopicCount


def _beat(uptime_s: float, cpu_s: float, messages: int) -> NodeStatus:
    counts = (
        TopicCount(topic="radar/beam", messages=messages, bytes=0, lost=2),
        TopicCount(topic="log", messages=99 * messages, bytes=0),
    )
    return NodeStatus(
        stamp_ns=0, node="a", pid=1, state=NodeState.READY, uptime_s=uptime_s, cpu_s=cpu_s, received=counts
    )


def test_rates_come_from_two_heartbeats_of_one_process() -> None:
    row = node_row([_beat(1.0, 0.5, 10), _beat(3.0, 1.5, 30)])
    assert (row["in_hz"], row["cpu_percent"], row["lost"]) == (10.0, 50.0, 2)
    assert node_row([_beat(2.0, 1.0, 10)])["in_hz"] is None


def test_packages_load_and_a_quiet_domain_is_well(tmp_path: Path) -> None:
    assert {finding.status for finding in check_packages()} == {Status.OK}
    assert {finding.status for finding in [*check_run_dir(tmp_path), *check_graph(tmp_path)]} == {Status.OK}


@pytest.mark.parametrize(
    ("card", "status"),
    [
        (None, Status.FAILED),
        ({"sha256": "0"}, Status.FAILED),
        ({"sha256": hashlib.sha256(b"n").hexdigest()}, Status.OK),
    ],
)
def test_weights_must_be_what_their_card_says(tmp_path: Path, card: dict | None, status: Status) -> None:
    (tmp_path / "net.onnx").write_bytes(b"n")
    if card is not None:
        (tmp_path / "net.json").write_text(json.dumps(card))
    assert [finding.status for finding in check_weights(tmp_path)] == [status]
