"""Overload on the in-process bus and a virtual clock: what is shed in which order, that all is counted, recovery.

The radar sends a beam every 12 ms whatever happens; a former that takes `cost_ms` a beam takes its next turn when it
has done with the last. Nothing is timed: cost is counted in folded beams.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from msgs.bus.interface import Bus, Envelope, Received
from msgs.bus.local import Faults, LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup, RangeAzimuthMap
from nodes.bev_viewer import Params as ViewerParams
from nodes.bev_viewer import create as create_viewer
from nodes.inputs.view_latency import DEADLINE_S, last_beam_ns
from nodes.node import _turn
from nodes.ra_former import PATIENCE_NS, Params, RaFormerNode, create
from nodes.viewer.assembly import LATE_MAP_PERIOD_NS, Assembly
from nodes.viewer.newest import Board
from tests.builders import beam_of
from tests.nodes.test_bev_viewer import frame, ra_map

MS = 1_000_000
BEAMS = 25
SETUP = RadarSetup(radar=RadarParams(chirps_per_beam=1))
NOISE = np.random.default_rng(0).integers(-300, 300, (1, 8192, 2)).astype("<i2")


class Map(NamedTuple):
    """A map and when its former had done with it."""

    at_ns: int
    message: RangeAzimuthMap

    @property
    def late_ms(self) -> float:
        return 1e-6 * (self.at_ns - self.message.stamp_ns - last_beam_ns(SETUP))


class Rig:
    """A radar, a former with a price, and who listens."""

    def __init__(self, **params: Any) -> None:
        self.network = LocalNetwork(seed=1)
        self.radar, self.bus, self.listener = (self.network.bus(name) for name in ("radar", "ra_former", "listener"))
        self.node: RaFormerNode = create(Params(**params))
        self.node._clock_ns = self._clock_ns
        self.cost_ns = self.clock_ns = 0
        for topic in self.node.inputs:
            self.bus.subscribe(topic)
        self.listener.subscribe("radar/ra_map")
        self.radar.publish("radar/setup", SETUP)
        self.free_ns = 0
        self.sent = 0
        self.maps: list[Map] = []
        self.longest_queue = 0

    def run(self, scans: int, cost_ms: float) -> list[Map]:
        """Play so many scans; the maps that came meanwhile."""
        before = len(self.maps)
        for _ in range(scans * BEAMS):
            self.radar.publish("radar/beam", self._beam())
            self.network.advance(12 * MS)
            self._turns(cost_ms)
        return self.maps[before:]

    def finish(self) -> None:
        """Let the former do what waits."""
        while self.node.pending() or self.bus_waits():
            self.network.advance(100 * MS)
            self._turns(0.0)

    def bus_waits(self) -> bool:
        return _turn(self.node, self.bus, self.bus.receive(0.0))

    def shed(self) -> dict[str, int]:
        return {f"{count.what} {count.reason}": count.count for count in self.node.shed.counts()}

    def _beam(self) -> RadarBeam:
        scan, index = divmod(self.sent, BEAMS)
        self.sent += 1
        return beam_of(SETUP, index, NOISE, stamp_ns=self.network.now_ns, scan_id=scan, beam_count=BEAMS)

    def _clock_ns(self) -> int:
        """Read before and after each fold: the fold's cost lies between two readings."""
        self.clock_ns += self.cost_ns
        return self.clock_ns

    def _turns(self, cost_ms: float) -> None:
        self.cost_ns = round(cost_ms * MS)
        while self.free_ns <= self.network.now_ns:
            start_ns = self.free_ns if self.node.pending() else self.network.now_ns
            if not _turn(self.node, self.bus, self.bus.receive(0.0)):
                return
            folded = sum(stage.count for stage in self.node.stages.drain())
            self.free_ns = start_ns + round(folded * cost_ms * MS)
            self.longest_queue = max(self.longest_queue, len(self.node._queue))
            for received in self.listener.receive(0.0):
                assert isinstance(received.message, RangeAzimuthMap)
                self.maps.append(Map(self.free_ns, received.message))


def test_a_former_that_keeps_up_sheds_nothing() -> None:
    rig = Rig()
    assert len(rig.run(10, cost_ms=11.0)) == 10
    assert rig.shed() == {}


@pytest.mark.parametrize("cost_ms", [16.0, 25.0, 60.0, 150.0])
def test_overload_sheds_whole_scans_and_counts_each(cost_ms: float) -> None:
    rig = Rig()
    rig.run(60, cost_ms)
    rig.finish()
    shed = rig.shed()
    assert all(one.message.missing_beams == () for one in rig.maps), "a scan is whole or not there"
    assert shed["scan behind"] > 0
    assert len(rig.maps) + shed["scan behind"] == 60
    assert shed == {"scan behind": shed["scan behind"], "beam of a scan left out": BEAMS * shed["scan behind"]}
    scans = [one.message.scan_id for one in rig.maps]
    assert scans == sorted(set(scans))


@pytest.mark.slow
@pytest.mark.parametrize("cost_ms", [16.0, 25.0])
def test_what_is_published_under_overload_is_not_old(cost_ms: float) -> None:
    """Begun at most half a scan late, a scan is done when its beams have been folded: never a growing delay."""
    rig = Rig()
    begun_late_ms = 0.5 * 300.0 + 12.0
    longest_ms = begun_late_ms + BEAMS * cost_ms - 288.0
    assert all(one.late_ms <= longest_ms + 12.0 for one in rig.run(60, cost_ms))


def test_without_shedding_the_delay_would_grow() -> None:
    """The same rig with the rule switched off: what the test above would see."""
    rig = Rig()
    rig.node._queue.behind = 1e9
    assert rig.run(60, cost_ms=25.0)[-1].late_ms > 5_000.0


@pytest.mark.slow
def test_the_former_recovers_with_the_next_scan() -> None:
    rig = Rig()
    rig.run(10, cost_ms=2.0)
    rig.run(30, cost_ms=60.0)
    assert rig.node.health()[0] is NodeState.DEGRADED
    after = rig.run(10, cost_ms=2.0)
    shed = rig.shed()
    assert len([one for one in after if one.message.scan_id >= 41]) == 9, "of the ten all but the one under way"
    # the scan that the load left behind is done late, all others at once
    assert all(one.late_ms < 1e3 * DEADLINE_S for one in after[2:])
    rig.run(5, cost_ms=2.0)
    assert rig.shed() == shed
    assert rig.node.health() == (NodeState.READY, "")


@pytest.mark.parametrize(("pause_ms", "shed_scans"), [(250.0, 0), (1_000.0, 3)])
def test_a_fast_former_catches_up_with_a_pause(pause_ms: float, shed_scans: int) -> None:
    """A pause of less than a scan costs none; a longer one costs those that nobody would wait for."""
    rig = Rig()
    rig.run(2, cost_ms=2.0)
    rig.free_ns = rig.network.now_ns + round(pause_ms * MS)
    rig.run(8, cost_ms=2.0)
    assert rig.shed().get("scan behind", 0) == shed_scans
    assert len(rig.maps) == 10 - shed_scans


@pytest.mark.slow
def test_the_queue_is_bounded() -> None:
    rig = Rig()
    rig.run(60, cost_ms=11.9)
    assert rig.longest_queue <= 2
    rig = Rig()
    rig.run(60, cost_ms=60.0)
    assert rig.longest_queue <= BEAMS + 26


def torn_maps(drop: float, **params: Any) -> tuple[Rig, list[Map]]:
    rig = Rig(**params)
    rig.run(2, cost_ms=1.0)
    rig.network.inject("radar/beam", Faults(drop=drop))
    rig.run(1, cost_ms=1.0)
    rig.network.inject("radar/beam", Faults())
    rig.run(3, cost_ms=1.0)
    return rig, rig.maps


def test_a_scan_torn_by_the_bus_is_left_out_whole_and_counted() -> None:
    rig, maps = torn_maps(drop=0.7)
    assert [one.message.scan_id for one in maps] == [0, 1, 3, 4, 5]
    assert rig.shed() == {"scan torn": 1}
    (count,) = [one for one in rig.bus.counts()[0] if one.topic == "radar/beam"]
    assert count.lost > 0.4 * BEAMS


def test_a_scan_with_few_holes_is_published_and_says_so() -> None:
    rig, maps = torn_maps(drop=0.1)
    (holed,) = [one.message for one in maps if one.message.missing_beams]
    assert holed.scan_id == 2
    assert rig.shed() == {}
    (count,) = [one for one in rig.bus.counts()[0] if one.topic == "radar/beam"]
    assert count.lost == len(holed.missing_beams)


@pytest.mark.parametrize(("lost", "published"), [(5, True), (6, False)])
def test_the_limit_of_holes_counts_the_beams_that_are_looked_at(lost: int, published: bool) -> None:
    """Every other beam is looked at: 13 of 25, of which 0.4 is 5.2. Five may be lost on the bus, not six; of all 25
    beams it would be ten. Numbers of messages jump where beams were lost.
    """
    node = create(Params(beam_step=2))
    known = Envelope(publisher="radar", topic="radar/setup", sequence=0, sent_ns=0)
    node.step([Received("radar/setup", SETUP, known)], 0)
    gone = set(range(2, 2 + 2 * lost, 2))
    maps: list[RangeAzimuthMap] = []
    for index in sorted(set(range(BEAMS)) - gone):
        beam = beam_of(SETUP, index, NOISE, beam_count=BEAMS)
        envelope = Envelope(publisher="radar", topic="radar/beam", sequence=index, sent_ns=0)
        maps += [out.message for out in node.step([Received("radar/beam", beam, envelope)], 0)]
    maps += [out.message for out in node.step([], PATIENCE_NS)]
    assert [one.missing_beams for one in maps] == ([tuple(sorted(gone))] if published else [])
    assert [(one.what, one.reason, one.count) for one in node.shed.counts()] == (
        [] if published else [("scan", "torn", 1)]
    )


# what is shed before any scan: pictures


def show(take: Callable[[RangeAzimuthMap | BevFrame, int], object], *late_ms: float) -> None:
    """Maps and views of scans that come so late."""
    for scan, late in enumerate(late_ms):
        stamp_ns = scan * 300 * MS
        for message in (ra_map(scan), frame(scan)):
            take(msgspec.structs.replace(message, stamp_ns=stamp_ns), stamp_ns + last_beam_ns() + round(late * MS))


def posts(board: Board) -> dict[str, int]:
    posted = {kind: posted.version for kind, posted in board.newer({}).items()}
    return {kind: posted[kind] for kind in ("view", "map")}


def test_pictures_are_shed_first_while_views_come_late_and_views_never() -> None:
    """The former of the same graph sheds nothing by a late view: pictures go first, and the viewer counts them."""
    maps = -(-30 // -(-LATE_MAP_PERIOD_NS // (300 * MS)))
    with contextlib.closing(create_viewer(ViewerParams(port=0))) as viewer:
        envelope = Envelope(publisher="a", topic="radar/ra_map", sequence=0, sent_ns=0)
        show(lambda message, now_ns: viewer.step([Received("", message, envelope)], now_ns), *[301.0] * 30)
        assert posts(viewer.server._board) == {"view": 30, "map": maps}
        assert [(one.what, one.reason, one.count) for one in viewer.shed.counts()] == [
            ("picture", "views late", 30 - maps)
        ]


@pytest.mark.parametrize(("late_ms", "sheds_maps"), [(299.0, True), (301.0, False)], ids=["in time", "played back"])
def test_in_time_every_picture_is_posted(late_ms: float, sheds_maps: bool) -> None:
    assembly = Assembly(board := Board(), sheds_maps)
    show(assembly.take, *[late_ms] * 30)
    assert posts(board) == {"view": 30, "map": 30}
    assert assembly.maps_shed == 0


def test_pictures_come_back_with_the_first_view_in_time() -> None:
    assembly = Assembly(board := Board(), sheds_maps=True)
    show(assembly.take, 301, 301, 301, 50, 50)
    assert (posts(board)["map"], assembly.maps_shed) == (3, 2)


# what comes after scans: maps and peaks that a newer one overtook


def test_a_node_behind_passes_over_old_maps_and_counts_them() -> None:
    network = LocalNetwork()
    sender, receiver = network.bus("ra_former"), network.bus("dense_predictor")
    receiver.subscribe("radar/ra_map")
    seen: Callable[[Bus], list[int]] = lambda bus: [one.message.scan_id for one in bus.receive(0.0)]  # type: ignore[attr-defined]  # noqa: E731
    for scan in range(4):
        sender.publish("radar/ra_map", ra_map(scan))
    assert seen(receiver) == [3]
    sender.publish("radar/ra_map", ra_map(4))
    assert seen(receiver) == [4]
    (count,) = receiver.counts()[0]
    assert (count.messages, count.outdated, count.lost) == (5, 3, 0)


def test_work_left_over_is_done_before_the_end() -> None:
    """A node asked to stop answers what waits, also what it took in and has not begun."""
    from nodes.node import Heartbeat, Stop, _drain, bound_inputs

    rig = Rig()
    rig.node._queue.behind = 1e9
    for _ in range(3 * BEAMS):
        rig.radar.publish("radar/beam", rig._beam())
    _turn(rig.node, rig.bus, rig.bus.receive(0.0))
    assert rig.node.pending()
    _drain(rig.node, rig.bus, Stop(), Heartbeat(rig.bus, "ra_former"), bound_inputs(rig.node, rig.bus))
    assert not rig.node.pending()
    assert rig.listener.counts()[0][0].messages == 0
    assert [one.message.scan_id for one in rig.listener.receive(0.0)] == [2], "the newest of three maps"  # type: ignore[attr-defined]
    assert rig.listener.counts()[0][0].messages == 3
