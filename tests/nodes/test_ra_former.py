"""The RA former as a node: set-up first, refusals that say why, the vehicle state that holds for a scan, silence."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from msgs.bus.interface import Envelope, Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.radar import ArrayParams, BeamGrid, RadarParams, RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.ra_former import PATIENCE_NS, Params, RaFormerNode, create
from tests.builders import beam_of

SETUP = RadarSetup(radar=RadarParams(chirps_per_beam=8))


def received(message: msgspec.Struct, topic: str) -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


def setup() -> Received:
    return received(SETUP, "radar/setup")


def beam(index: int, scan: int = 0, samples: int = 8192) -> Received:
    noise = np.random.default_rng(index).integers(-300, 300, (8, samples, 2)).astype("<i2")
    stamp_ns = scan * 300_000_000 + index * SETUP.beam_interval_ns
    return received(beam_of(SETUP, index, noise, stamp_ns=stamp_ns, scan_id=scan), "radar/beam")


def state(stamp_ns: int, speed_mps: float, valid: bool = True) -> Received:
    return received(VehicleState(stamp_ns=stamp_ns, speed_mps=speed_mps, valid=valid), "vehicle/state")


def steps(node: RaFormerNode, *inputs: Received) -> list[Outgoing]:
    """As of a node that keeps up: one message a step."""
    return [one for message in inputs for one in node.step([message], 0)]


@pytest.fixture
def node() -> RaFormerNode:
    return create(Params())


def test_the_last_beam_brings_the_map(node: RaFormerNode) -> None:
    assert steps(node, setup(), *[beam(index) for index in range(24)]) == []
    (out,) = node.step([beam(24)], 0)
    assert out.topic == "radar/ra_map"
    assert out.message.missing_beams == ()
    assert not out.message.ego_compensated
    assert node.health() == (NodeState.READY, "")


def test_setup_counts_before_the_beams_that_came_with_it(node: RaFormerNode) -> None:
    node.step([beam(0), setup()], 0)
    assert len(steps(node, *[beam(index) for index in range(1, 25)])) == 1


def test_beams_before_the_setup_are_refused_aloud(node: RaFormerNode) -> None:
    assert node.step([beam(0)], 0) == []
    assert node.health() == (NodeState.DEGRADED, "beam 0 of scan 0 came before radar/setup")
    steps(node, setup(), *[beam(index, scan=1) for index in range(25)])
    assert node.health()[0] is NodeState.READY


def test_a_beam_of_another_size_is_refused_and_the_scan_goes_on(node: RaFormerNode) -> None:
    steps(node, setup(), beam(0), beam(1, samples=4096))
    reason = node.health()[1]
    assert "4096" in reason
    assert "8192" in reason
    (out,) = steps(node, *[beam(index) for index in range(2, 25)], beam(0, scan=1))
    assert out.message.missing_beams == (1,)


def test_after_a_silence_the_unfinished_scan_is_published(node: RaFormerNode) -> None:
    steps(node, setup(), *[beam(index) for index in range(19)])
    node.step([beam(19)], 1_000)
    assert node.due_ns(1_000) == 1_000 + PATIENCE_NS
    (out,) = node.step([], 1_000 + PATIENCE_NS)
    assert out.message.missing_beams == (20, 21, 22, 23, 24)
    assert node.due_ns(0) is None


@pytest.mark.parametrize(
    ("states", "compensated"),
    [
        ([state(600_000_000, 8.0)], True),
        ([state(600_000_001, 8.0)], False),
        ([state(600_000_000, 8.0, valid=False)], False),
        ([state(0, 8.0)], False),
        ([], False),
    ],
    ids=["at the first beam", "after it", "invalid", "too old", "none"],
)
def test_the_state_at_the_first_beam_holds_for_the_scan(
    node: RaFormerNode, states: list[Received], compensated: bool
) -> None:
    (out,) = steps(node, setup(), *states, *[beam(index, scan=2) for index in range(25)])
    assert out.message.ego_compensated is compensated


def test_a_setup_that_cannot_be_used_changes_nothing_and_is_said(node: RaFormerNode) -> None:
    """More beams and columns than maps can be formed of in time: the scan under way, of the set-up before, goes on."""
    large = RadarSetup(array=ArrayParams(columns=256), beams=BeamGrid(azimuth_deg=tuple(range(-20, 20))))
    steps(node, setup(), beam(0), received(large, "radar/setup"))
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert "at most 16384 beams times (2 columns - 1), got 40 beams and 256 columns" in reason
    (out,) = steps(node, *[beam(index) for index in range(1, 25)])
    assert out.message.missing_beams == ()
    assert [(one.what, one.reason, one.count) for one in node.shed.counts()] == [("setup", "refused", 1)]


def test_a_stuck_channel_is_named_in_the_map_and_in_the_state(node: RaFormerNode) -> None:
    """Until a scan comes in which it works."""
    steps(node, setup())
    for scan, faults, health in (
        (0, ("q_stuck",), (NodeState.DEGRADED, "Q does not change")),
        (1, (), (NodeState.READY, "")),
    ):
        beams = [beam(index, scan=scan) for index in range(25)]
        for each in beams if faults else ():
            each.message.samples[..., 1] = 3  # type: ignore[attr-defined]
        (out,) = steps(node, *beams)
        assert out.message.faults == faults
        assert node.health() == health
