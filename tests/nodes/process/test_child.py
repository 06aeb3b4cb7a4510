"""How a process is asked to end: gently, firmly, and then not asked."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from nodes.process.child import Child, _command
from nodes.process.launch_file import GROUP_MODULE, NodeEntry


@pytest.mark.parametrize(
    ("times_s", "sent"),
    [
        ((100.0, 101.9), ["SIGINT", "SIGCONT"]),
        ((100.0, 102.0), ["SIGINT", "SIGCONT", "SIGTERM"]),
        ((100.0, 105.0, 107.9), ["SIGINT", "SIGCONT", "SIGTERM"]),
        ((100.0, 105.0, 108.0), ["SIGINT", "SIGCONT", "SIGTERM", "SIGKILL"]),
    ],
)
def test_a_process_is_terminated_and_killed_when_its_time_is_over(times_s: tuple[float, ...], sent: list[str]) -> None:
    """Asked at 100 s, with 2 s to end and 3 s more after SIGTERM."""
    child = object.__new__(Child)
    child._asked_s = child._terminated_s = None
    signals: list[str] = []
    child._signal = lambda number: signals.append(signal.Signals(number).name)  # type: ignore[method-assign]
    for now_s in times_s:
        child.stop(now_s, 2.0, 3.0)
    assert signals == sent


def test_a_node_is_told_its_name_and_a_group_its_members() -> None:
    entry = NodeEntry(module="nodes.geometry", params={"a": 1})
    words = _command("fold", entry, Path("/run/x"))
    assert words[:4] == ["nodes.node", "nodes.geometry", "--name", "fold"]
    assert json.loads(words[words.index("--params") + 1]) == {"a": 1}
    assert words[-5:] == ["--run-dir", "/run/x", "--die-with", str(os.getpid()), "--wait"]
    group = _command("both", NodeEntry(module=GROUP_MODULE, params={"a": {"module": "nodes.geometry"}}), Path("/run/x"))
    assert (group[0], json.loads(group[1])) == (GROUP_MODULE, {"a": {"module": "nodes.geometry"}})
