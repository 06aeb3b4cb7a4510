"""The supervisor's view of one node, without a process: when it is looked at, and the time it gets to stop."""

from __future__ import annotations

import pytest

from nodes.process import supervisor
from nodes.process.launch_file import launch_from_mapping
from nodes.process.liveness import LATE_S, Sample
from nodes.process.supervisor import DRAIN_S, Phase

HEARD_S = 1000.0


class _Child:
    """A process that is asked to stop."""

    pid = 1

    def __init__(self) -> None:
        self.patience_s: list[float] = []

    def stop(self, now_s: float, patience_s: float, last_s: float) -> None:
        self.patience_s.append(patience_s)


@pytest.mark.parametrize(("silent_s", "is_late"), [(0.9 * LATE_S, False), (2.0 * LATE_S, True)])
def test_a_node_that_waits_for_input_between_heartbeats_gets_all_its_time_to_stop(
    silent_s: float, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All its threads sleep, as a node's do that waits for a scan. Only a late heartbeat makes that a block, and one
    that is blocked gets half a second.
    """
    now_s = HEARD_S
    monkeypatch.setattr(supervisor, "sample", lambda pid: Sample(now_s, "SS", 1.0, 0.0))
    entry = launch_from_mapping({"name": "one", "nodes": {"one": {"module": "nodes.geometry"}}}, "one.yaml").nodes[
        "one"
    ]
    node, child = supervisor._Watched(entry), _Child()
    node.child, node.phase = child, Phase.READY  # type: ignore[assignment]
    node.heard(HEARD_S)
    for step in range(1, 21):
        now_s = HEARD_S + silent_s * step / 20
        assert node.look(now_s) == ""
    now_s += 0.01
    node.stop(now_s, DRAIN_S, by_hand=False)
    assert child.patience_s == [0.5 if is_late else DRAIN_S]


def test_restarts_are_forgotten_a_window_later() -> None:
    """Restarts at 0, 10 and 65 s in a window of 60 s: at 65 s the first is past, at 70 s the second too."""
    text = {"module": "nodes.geometry", "restart": {"window_s": 60.0}}
    node = supervisor._Watched(launch_from_mapping({"name": "one", "nodes": {"one": text}}, "one.yaml").nodes["one"])
    counted = []
    for now_s in (0.0, 10.0, 65.0):
        node.restarts.append(now_s)
        counted.append(node.recent_restarts(now_s))
    assert (counted, node.recent_restarts(70.0), node.recent_restarts(125.1)) == ([1, 2, 2], 1, 0)
