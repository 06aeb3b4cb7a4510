"""The LiDAR in the graph: its former's refusals, its player's order and stamps, what does not apply to it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from mirrorwave.commands.sim.group import write_recording
from msgs.bus.interface import Envelope, Received
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import LidarSetup, PhotonHistograms
from msgs.values.perception import SceneTruth
from nodes.lidar_former import LidarFormerNode, Params, create
from nodes.player import Params as PlayerParams
from nodes.player import capture_events, moved, scene_events, scene_player

SCENE = "launch/scenes/hidden_car_spad.yaml"


def received(message: msgspec.Struct, topic: str) -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


def histograms(scan: int = 0, azimuths: int = 256) -> Received:
    counts = np.full((azimuths, 512), 100, "<u4")
    message = PhotonHistograms(
        stamp_ns=scan, scan_id=scan, counts=counts, azimuth_stamp_ns=np.arange(azimuths, dtype=np.int64)
    )
    return received(message, "lidar/histograms")


SETUP = received(LidarSetup(), "lidar/setup")


@pytest.fixture
def node() -> LidarFormerNode:
    return create(Params())


def test_histograms_become_a_map_with_the_set_up_that_came_beside_them(node: LidarFormerNode) -> None:
    (out,) = node.step([histograms(scan=3), SETUP], 0)
    assert (out.topic, out.message.scan_id, out.message.mode) == ("radar/ra_map", 3, "photons")
    np.testing.assert_array_equal(out.message.azimuth_stamp_ns, np.arange(256))
    assert node.health() == (NodeState.READY, "")


def test_what_does_not_fit_is_refused_aloud_and_counted(node: LidarFormerNode) -> None:
    assert node.step([histograms()], 0) == []
    assert node.health() == (NodeState.DEGRADED, "histograms of scan 0 came before lidar/setup")
    assert node.step([SETUP, histograms(azimuths=255)], 0) == []
    assert "(255, 512)" in node.health()[1]
    assert [(one.what, one.reason, one.count) for one in node.shed.counts()] == [("scan", "refused", 2)]
    assert len(node.step([histograms(scan=1)], 0)) == 1
    assert node.health()[0] is NodeState.READY


def test_a_scan_goes_out_when_its_last_azimuth_is_measured(tmp_path: Path) -> None:
    """And a recording of it says the same."""
    source = scene_player(PlayerParams(scene=SCENE))
    events = list(scene_events(source, 2))
    assert events[0].outgoing.topic == "lidar/setup"
    scans = [(one.offset_ns, one.outgoing.message) for one in events if one.outgoing.topic == "lidar/histograms"]
    assert [at for at, _ in scans] == [300_000_000, 600_000_000]
    assert [scan.stamp_ns for _, scan in scans] == [0, 300_000_000]
    states = [one.offset_ns for one in events if one.outgoing.topic == "vehicle/state"]
    assert 0 in states
    assert max(np.diff(states)) < 110_000_000
    assert sum(isinstance(one.outgoing.message, SceneTruth) for one in events) == 2
    path = tmp_path / "spad.mcap"
    write_recording(path, (one.outgoing for one in events), {})
    again = [one.outgoing.message for one in capture_events(path) if one.outgoing.topic == "lidar/histograms"]
    np.testing.assert_array_equal(again[1].counts, scans[1][1].counts)
    later = moved(scans[1][1], 5)
    assert (later.stamp_ns, later.azimuth_stamp_ns[0]) == (300_000_005, 300_000_005)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "change", [{"chirps_per_beam": 8}, {"phase_jitter_rad": 0.1}, {"effects": "all"}, {"budget_db": -10.0}]
)
def test_parameters_of_radars_are_refused_in_a_line(change: dict) -> None:
    with pytest.raises(ValueError, match=rf"player\.{next(iter(change))} is for radars, and .*spad.yaml") as caught:
        scene_player(PlayerParams(scene=SCENE, **change))
    assert "\n" not in str(caught.value)
