"""CAN to radar/detections: a stand-in on a virtual bus, losses in messages and health, buses that fail."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import can
import numpy as np
import pytest

from contrib.boards import detections_radar
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import NodeState
from nodes.node import InProcessGraph, Node, load_node
from nodes.vehicle_can import POLL_NS
from tests.contrib.boards.target_radar_stand_in import Frame, measurement, message, random_targets

SECOND_NS = 1_000_000_000
CYCLES_PER_S, TARGETS = 17, 64
_channels = itertools.count()


class StandIn(Node):
    """A radar that sends its frames on a bus, a measurement a cycle; `drop` takes frames away by their number."""

    def __init__(self, bus: can.BusABC, measurements: Sequence[list[Frame]], drop: int = 0) -> None:
        super().__init__()
        self._bus, self._measurements = bus, list(measurements)
        self._drop, self._sent, self._next_ns = drop, 0, 0
        self.dropped = 0

    def due_ns(self, now_ns: int) -> int | None:
        """Return the start of the next cycle."""
        return self._next_ns or now_ns if self._measurements else None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Send a measurement."""
        self._next_ns = (self._next_ns or now_ns) + SECOND_NS // CYCLES_PER_S
        for frame in self._measurements.pop(0):
            self._sent += 1
            if self._drop and self._sent % self._drop == 0:
                self.dropped += 1
            else:
                self._bus.send(message(frame, 1e-9 * now_ns))
        return []

    def finished(self) -> bool:
        return not self._measurements

    def close(self) -> None:
        self._bus.shutdown()


class Listener(Node):
    """Keeps all detections that it hears."""

    inputs = ("radar/detections",)
    wants_all = True

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[RadarDetections] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.messages += [item.message for item in inputs]
        return []


@pytest.fixture
def bus() -> dict:
    """A virtual bus of its own for each test, whose frames keep the stamps of the virtual clock."""
    return {
        "interface": "virtual", "channel": f"detections-{next(_channels)}", "options": {"preserve_timestamps": True},
    }  # fmt: skip


def run(
    bus: dict, measurements: Sequence[list[Frame]], drop: int = 0, rest_s: float = 0.5, **params: object
) -> tuple[list[RadarDetections], detections_radar.DetectionsRadarNode, StandIn]:
    """Messages of the node while the stand-in sends, and for a while after."""
    node = load_node("contrib.boards.detections_radar", {**bus, **params})
    assert isinstance(node, detections_radar.DetectionsRadarNode)
    options = {key: value for key, value in bus.items() if key != "options"} | bus["options"]
    stand_in = StandIn(can.Bus(**options), measurements, drop)
    network = LocalNetwork(start_ns=5 * SECOND_NS)
    listener = Listener()
    graph = InProcessGraph(network, {"radar": node, "stand_in": stand_in, "listener": listener})
    graph.run(round((5.0 + len(measurements) / CYCLES_PER_S + rest_s) * SECOND_NS))
    health = node.health()
    graph.close()
    node.health = lambda: health  # type: ignore[method-assign]
    return listener.messages, node, stand_in


def test_64_targets_17_times_a_second_are_all_read(bus: dict) -> None:
    """Two seconds: every measurement in order, each target's place and speed, nothing lost."""
    sent = [random_targets(TARGETS, seed) for seed in range(2 * CYCLES_PER_S)]
    found, node, _ = run(bus, [measurement(targets, counter) for counter, targets in enumerate(sent)])
    assert [each.scan_id for each in found] == list(range(len(sent)))
    for each, targets in zip(found, sent, strict=True):
        position_m = np.array([target.position_m for target in targets])
        assert np.allclose(each.range_m, np.hypot(*position_m.T), atol=1e-9)
        assert np.allclose(each.azimuth_rad, np.arctan2(position_m[:, 1], position_m[:, 0]), atol=1e-12)
        assert np.allclose(each.radial_speed_mps, [target.radial_speed_mps for target in targets], atol=1e-9)
        assert each.lost == 0
    steps_ns = {b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(found)}
    # a frame's stamp is known to the rest before it was polled; stamps are seconds in double precision in python-can
    assert all(abs(step_ns - SECOND_NS // CYCLES_PER_S) < POLL_NS + 1000 for step_ns in steps_ns)
    assert node.health() == (NodeState.READY, "")
    assert not [count for count in node.shed.counts() if count.count]


def test_lost_frames_are_counted_where_they_are_missed(bus: dict) -> None:
    """Every 40th frame is gone: announced less arrived targets is what each message says, and the node in sum."""
    sent = [random_targets(TARGETS, seed) for seed in range(CYCLES_PER_S)]
    found, node, stand_in = run(bus, [measurement(targets, at) for at, targets in enumerate(sent)], drop=40)
    assert stand_in.dropped == 17 * 129 // 40
    assert all(len(each) + each.lost == TARGETS for each in found)
    counts = {(count.what, count.reason): count.count for count in node.shed.counts()}
    assert counts["target", "lost"] == sum(each.lost for each in found) > 0
    state, reason = node.health()
    assert (state, found[-1].lost > 0) == (NodeState.DEGRADED, True)
    assert (
        reason == f"{found[-1].lost} targets of the last measurement did not arrive; {counts['target', 'lost']} so far"
    )


def test_another_sensor_and_another_list_are_said(bus: dict) -> None:
    sent = [measurement(random_targets(4, 0), at, sensor_id=3) for at in range(3)]
    found, node, _ = run(bus, sent, rest_s=2.0)
    assert found == []
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert reason.startswith("no measurement of sensor 0 for ")
    assert reason.endswith(" s; frames of sensor 3 arrive")
    found, node, _ = run(bus, sent, rest_s=2.0, radar={"sensor_id": 3, "kind": "objects"})
    assert found == []
    assert node.health()[1].endswith("refused: 12 frames (CLUSTER_GENERAL: the list is to be of objects)")


def test_silence_is_said(bus: dict) -> None:
    found, node, _ = run(bus, [measurement(random_targets(4, 0), 1)], rest_s=3.0)
    assert len(found) == 1
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert reason.startswith("no measurement of sensor 0 for 3.")


def test_a_bus_that_is_not_there_is_said() -> None:
    node = detections_radar.create(detections_radar.Params(interface="socketcan", channel="no-such-bus"))
    assert node.step([], 1) == []
    state, reason = node.health()
    assert (state, "no-such-bus" in reason) == (NodeState.DEGRADED, True)


@pytest.mark.parametrize(
    ("params", "rule"),
    [
        ({"radar": {"sensor_id": 9}}, r"radar\.params\.radar: sensor_id must lie in 0\.\.7"),
        ({"radar": {"kind": "tracks"}}, r"radar\.params\.radar\.kind"),
        ({"dbc": "launch/can/mirrorwave.dbc"}, "mirrorwave.dbc: the DBC has no message 'CLUSTER_STATUS'"),
        ({"sensr": "a"}, "unknown field"),
    ],
)
def test_wrong_params_are_one_line(params: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        load_node("contrib.boards.detections_radar", {"interface": "virtual", **params}, "radar")
