"""The node that joins views of several radars, on the in-process bus."""

from __future__ import annotations

import logging

import msgspec
import numpy as np
import pytest

from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame
from msgs.values.vehicle import VehicleState
from nodes.node import InProcessGraph, Node, load_node
from nodes.view_fusion import Params, ViewFusion, create
from tests.builders import example_view, peaks_at
from tests.models.perception.track.test_view_fusion import LEFT, RIGHT, seen_by

PERIOD_NS, LAG_NS = 300_000_000, 350_000_000


class Radar(Node):
    """Sends the peaks and the view of one object, scan by scan, until it is killed."""

    outputs = ("perception/peaks", "perception/hidden_objects")

    def __init__(self, sensor: str, pose: Pose2, scans: int, clock_ns: int = 0, with_peaks: bool = True) -> None:
        super().__init__()
        self.sensor = sensor
        self._pose, self._scans, self._clock_ns, self._with_peaks = pose, scans, clock_ns, with_peaks
        self._scan = 0

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the next scan has been looked at."""
        return None if self._scan == self._scans else self._scan * PERIOD_NS + LAG_NS

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Send one scan."""
        stamp_ns, self._scan = self._scan * PERIOD_NS + self._clock_ns, self._scan + 1
        view = seen_by(self._pose, (20.0, 10.0), stamp_ns=stamp_ns, scan_id=self._scan - 1)
        peaks = peaks_at([[1.0, 0.0]], stamp_ns=stamp_ns, vehicle_from_radar=self._pose)
        sent = [Outgoing("perception/peaks", peaks)] if self._with_peaks else []
        return [*sent, Outgoing("perception/hidden_objects", view.frame)]


class Car(Node):
    """Says fifty times a second that it stands."""

    outputs = ("vehicle/state",)

    def due_ns(self, now_ns: int) -> int | None:
        """Return the next time."""
        return now_ns + 20_000_000

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Send a state."""
        return [Outgoing("vehicle/state", VehicleState(stamp_ns=now_ns, speed_mps=0.0, yaw_rate_rps=0.0))]


class Listener(Node):
    """Keeps the joined views, and the health of the node at each."""

    inputs = ("perception/hidden_objects",)
    wants_all = True

    def __init__(self, node: ViewFusion) -> None:
        super().__init__()
        self._node = node
        self.views: list[tuple[BevFrame, int, str]] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Keep them."""
        for received in inputs:
            assert isinstance(received.message, BevFrame)
            self.views.append((received.message, now_ns, self._node.health()[1]))
        return []


def run(*radars: Radar, names: tuple[str, ...] = ("left", "right"), scans: int = 10) -> tuple[ViewFusion, Listener]:
    """Run some scans of radars and the node."""
    node = create(Params(radars=names))
    listener = Listener(node)
    nodes: dict[str, Node] = {f"radar_{radar.sensor}": radar for radar in radars}
    graph = InProcessGraph(LocalNetwork(), {**nodes, "car": Car(), "view_fusion": node, "listener": listener})
    graph.run(until_ns=scans * PERIOD_NS + LAG_NS)
    graph.close()
    return node, listener


def test_both_see_one_object() -> None:
    """One view a scan, as soon as both have come, with one object and its track at its place on the car's plane."""
    node, listener = run(Radar("left", LEFT, 10), Radar("right", RIGHT, 10))
    assert [(view.scan_id, at_ns) for view, at_ns, _ in listener.views] == [
        (scan, scan * PERIOD_NS + LAG_NS) for scan in range(10)
    ]
    for view, _, trouble in listener.views:
        (item,) = view.objects
        assert (item.x_m, item.y_m) == pytest.approx((20.0, 10.0))
        assert (view.flags, trouble) == ((), "")
    assert len(listener.views[-1][0].tracks) == 1
    assert node.health() == (NodeState.READY, "")


@pytest.mark.parametrize("killed", ["left", "right"])
def test_a_killed_radar_leaves_the_view_of_the_other(killed: str, caplog: pytest.LogCaptureFixture) -> None:
    """From its last scan on every scan has its view, the first ones a quarter of a second late; the object is never
    lost, its track keeps its number, and one line says what is missing.
    """
    caplog.set_level(logging.WARNING)
    scans = {"left": 10, "right": 10} | {killed: 4}
    poses = {"left": LEFT, "right": RIGHT}
    node, listener = run(*(Radar(name, poses[name], count) for name, count in scans.items()))
    assert [view.stamp_ns for view, _, _ in listener.views] == [scan * PERIOD_NS for scan in range(10)]
    assert all(len(view.objects) == 1 for view, _, _ in listener.views)
    assert {track.id for view, _, _ in listener.views for track in view.tracks} == {1}
    assert all(len(view.tracks) == 1 for view, _, _ in listener.views[2:])
    late_ms = [(at_ns - view.stamp_ns - LAG_NS) / 1e6 for view, at_ns, _ in listener.views]
    assert late_ms[:4] == [0.0] * 4
    assert max(late_ms) == 250.0
    assert late_ms[-2:] == [0.0] * 2
    assert listener.views[3][0].flags == ()
    assert listener.views[-1][0].flags == ("radar_lost",)
    assert node.health() == (NodeState.DEGRADED, f"radar {killed} is silent: the view is that of the others")
    assert [record.getMessage() for record in caplog.records].count(node.health()[1]) == 1


def test_a_clock_a_second_ahead_is_one_line(caplog: pytest.LogCaptureFixture) -> None:
    """Nothing is lost: each scan is one view of both, at the times of the right clock."""
    caplog.set_level(logging.WARNING)
    node, listener = run(Radar("left", LEFT, 10), Radar("right", RIGHT, 10, clock_ns=1_000_000_000))
    assert [view.stamp_ns for view, _, _ in listener.views] == [scan * PERIOD_NS for scan in range(10)]
    assert all(len(view.objects) == 1 for view, _, _ in listener.views)
    line = "radar right: its clock is 1.0 s ahead of that of the others, its views are taken by their arrival"
    assert [record.getMessage() for record in caplog.records] == [line]
    assert node.health() == (NodeState.DEGRADED, line)


def test_radars_at_one_place_are_doubted() -> None:
    """Somebody forgot to say where they sit."""
    node, _ = run(Radar("left", Pose2(), 3), Radar("right", Pose2(), 3), scans=2)
    line = "radars left and right have one mounting: set vehicle_from_radar of each ra_former"
    assert node.health() == (NodeState.DEGRADED, line)


def test_a_view_without_peaks_has_no_place() -> None:
    """It is refused and counted; the other radar's view goes on."""
    node, listener = run(Radar("left", LEFT, 3, with_peaks=False), Radar("right", RIGHT, 3), scans=3)
    assert len(listener.views) == 3
    counts = {(item.what, item.reason): item.count for item in node.shed.counts()}
    assert counts == {("view", "refused"): 3}


@pytest.mark.parametrize(
    ("radars", "line"),
    [
        ([], "radars must be one or more different names, got none"),
        (["left", "left"], "radars must be one or more different names, got left, left"),
        (["Left"], "a sensor's name must be of a-z, 0-9 and _, begin with a letter and have at most 20 characters"),
        (["l" * 21], "a sensor's name must be"),
    ],
)
def test_bad_names_are_one_line(radars: list[str], line: str) -> None:
    """Parameters that no graph can have."""
    with pytest.raises(ValueError, match=line) as caught:
        load_node("nodes.view_fusion", {"radars": radars})
    assert "\n" not in str(caught.value)


def test_views_of_strange_shape_do_not_end_it() -> None:
    """Masks of other grids, objects of no size, stamps before those of the states."""
    stage = create(Params(radars=("left", "right")))
    frame = example_view(3, 5, stamp_ns=-5, visibility=np.ones((3, 5), np.uint8))
    received = [
        Received("perception/left/peaks", peaks_at([[1.0, 0.0]], stamp_ns=-5), _envelope("perception/left/peaks")),
        Received("perception/left/hidden_objects", frame, _envelope("perception/left/hidden_objects")),
    ]
    assert stage.step(received, 0) == []
    (out,) = stage.step([], 300_000_000)
    assert isinstance(out.message, BevFrame)


def _envelope(topic: str) -> msgspec.Struct:
    from msgs.bus.interface import Envelope

    return Envelope(publisher="graph", topic=topic, sequence=0, sent_ns=0)
