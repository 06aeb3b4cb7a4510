"""Figures of the Foxglove bridge that are derived from two messages."""

from __future__ import annotations

import pytest

from msgs.values.diagnostics import NodeState, NodeStatus
from nodes.bridges.foxglove_messages import _cores


def beat(pid: int, uptime_s: float, cpu_s: float) -> NodeStatus:
    return NodeStatus(stamp_ns=1, node="geometry", pid=pid, state=NodeState.READY, uptime_s=uptime_s, cpu_s=cpu_s)


@pytest.mark.parametrize(
    ("last", "cores"),
    [
        (beat(1, 10.0, 2.0), 1.5),
        # another process, one that has not run since, and none before
        (beat(2, 10.0, 2.0), None),
        (beat(1, 12.0, 5.0), None),
        (None, None),
    ],
)
def test_cores_are_those_of_one_process_between_two_heartbeats(last: NodeStatus | None, cores: float | None) -> None:
    """3 s of processor time in 2 s are 1.5 cores."""
    assert _cores(beat(1, 12.0, 5.0), last) == cores
