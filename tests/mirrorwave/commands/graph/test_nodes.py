"""`mirrorwave node`: rates of a node from its heartbeats."""

from __future__ import annotations

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
