"""What fuzzing found in nodes stays mended: each input as small as it became, and what the node now makes of it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from contrib.two_machines.peer_clock import ClockSample, PeerClock
from contrib.two_machines.peer_messages import PeerMessages
from models.perception.find.peaks import PeakParams
from models.perception.find.ridges import RidgeParams
from models.perception.form.coarray import _solve_each, require_formable
from models.perception.form.photon_map import MAX_CELLS, MAX_TIMES
from msgs.bus.codec import encode
from msgs.bus.interface import Envelope, Received
from msgs.values.arrays import MAX_STAMP_NS
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import SpadParams
from msgs.values.perception import MAX_PEAKS, Peaks
from msgs.values.radar import PRESETS, ArrayParams, BeamGrid, RadarSetup, RangeAzimuthGrid, orthogonal_beams
from msgs.values.vehicle import VehicleState
from nodes import dense_predictor, geometry, lidar_former, player, ra_former
from nodes.node import Node, load_node
from tests.fuzz.cases import SETUP, SPAD, beam, lidar_talk, peaks, ra_map


def told(node: Node, *messages: tuple[str, msgspec.Struct], now_ns: int = 0) -> list[msgspec.Struct]:
    """A node's answers to messages that come one by one."""
    answers: list[msgspec.Struct] = []
    for sequence, (topic, message) in enumerate(messages):
        envelope = Envelope(publisher="peer", topic=topic, sequence=sequence, sent_ns=0)
        answers += [one.message for one in node.step([Received(topic, message, envelope)], now_ns)]
    return answers


def shed(node: Node) -> dict[tuple[str, str], int]:
    return {(one.what, one.reason): one.count for one in node.shed.counts()}


def test_a_share_of_saturated_samples_is_a_share() -> None:
    with pytest.raises(ValueError, match=r"map\.saturated_share must be within 0\.\.1, got nan"):
        msgspec.structs.replace(ra_map(0, 0), saturated_share=float("nan"))


def test_a_clock_that_no_stamp_could_follow_is_refused() -> None:
    with pytest.raises(ValueError, match=r"player\.vehicle_clock_offset_s must be finite, within 1e\+09 s"):
        player.Params(capture="a.mcap", vehicle_clock_offset_s=-7e16)


def test_a_scan_without_its_first_beam_at_the_end_of_time() -> None:
    """Beam 0 would lie before the first stamp there is: no map, and the next scan is formed."""
    node = ra_former.create(ra_former.Params())
    late = msgspec.structs.replace(beam(SETUP, 0, 3, 0), stamp_ns=-MAX_STAMP_NS)
    assert told(node, ("radar/setup", SETUP), ("radar/beam", late)) == []
    for _ in range(3):
        assert node.step([], 10 * ra_former.PATIENCE_NS) == []
    assert shed(node) == {("scan", "refused"): 1}
    later = [("radar/beam", beam(SETUP, 9, index, 0)) for index in range(5)]
    assert [one.scan_id for one in told(node, *later)] == [9]  # type: ignore[attr-defined]


def test_a_scan_shorter_than_its_beams_are_many_nanoseconds() -> None:
    node = ra_former.create(ra_former.Params())
    setup = msgspec.structs.replace(SETUP, radar=msgspec.structs.replace(SETUP.radar, scan_period_s=1e-9))
    beams = [("radar/beam", beam(setup, 0, index, 0)) for index in range(5)]
    assert len(told(node, ("radar/setup", setup), *beams)) == 1


def test_a_setup_that_would_stall_the_former_is_refused() -> None:
    node = ra_former.create(ra_former.Params())
    large = RadarSetup(array=ArrayParams(columns=256), beams=BeamGrid(azimuth_deg=tuple(np.linspace(-60.0, 60.0, 500))))
    assert told(node, ("radar/setup", large)) == []
    assert node.health()[0] == NodeState.DEGRADED
    assert node.health()[1].startswith("setup must have at most 16384 beams times (2 columns - 1)")
    assert shed(node) == {("setup", "refused"): 1}


@pytest.mark.parametrize("setup", PRESETS.values(), ids=PRESETS)
def test_radars_that_exist_are_far_from_the_bound(setup: RadarSetup) -> None:
    require_formable(setup)
    require_formable(msgspec.structs.replace(setup, array=ArrayParams(columns=86), beams=orthogonal_beams(86)))


def test_the_smaller_of_two_equal_systems_is_solved() -> None:
    """(B'B + r) x = B'y straight from the definition against what is solved for 4 beams of 9 coefficients."""
    rng = np.random.default_rng(2)
    beams, magnitudes = rng.normal(size=(3, 4, 9)) + 1j * rng.normal(size=(3, 4, 9)), rng.random((3, 4))
    for matrix, seen, found in zip(beams, magnitudes, _solve_each(beams, magnitudes), strict=True):
        gram = matrix.conj().T @ matrix
        ridged = gram + 1e-3 * np.trace(gram).real / 9 * np.eye(9)
        np.testing.assert_allclose(found, np.linalg.solve(ridged, matrix.conj().T @ seen), rtol=1e-9)


@pytest.mark.parametrize("changes", [{"bins": 1 << 14}, {"grid": (8192, 128)}])
def test_a_setup_that_would_stall_the_lidar_is_refused(changes: dict[str, Any]) -> None:
    bins, (range_bins, azimuths) = changes.get("bins", 32), changes.get("grid", (24, 128))
    assert azimuths * bins > MAX_TIMES or azimuths * range_bins > MAX_CELLS
    grid = RangeAzimuthGrid(range_bins=range_bins, azimuth_bins=azimuths)
    setup = msgspec.structs.replace(SPAD, spad=SpadParams(bins=bins, measurement_time_s=1e-4), grid=grid)
    node = lidar_former.create(lidar_former.Params())
    assert told(node, ("lidar/setup", setup), *((one.topic, one.message) for one in lidar_talk()[1:])) == []
    assert "lidar.grid must have at most" in node.health()[1]


def test_a_grid_that_reaches_beyond_all_numbers_is_refused() -> None:
    with pytest.raises(ValueError, match=r"grid\.range_bin_m must lie in 1e-09\.\.1e\+09, got 1\.7e\+308"):
        RangeAzimuthGrid(range_bin_m=1.7e308)


def test_noise_beyond_float32() -> None:
    node = dense_predictor.create(dense_predictor.Params(method="cfar"))
    (found,) = told(node, ("radar/ra_map", msgspec.structs.replace(ra_map(0, 0), noise_power_mw=1e39)))
    assert len(found.range_m) == 0  # type: ignore[attr-defined]


def crowd(count: int) -> Peaks:
    """A wall, and images behind it three metres apart whose errors are as wide as all of them together."""
    few = peaks(0, 0)
    side = int(np.sqrt(count)) + 1
    images_m = np.stack(np.meshgrid(40.0 + 3.0 * np.arange(side), 3.0 * np.arange(side) - 1.5 * side), -1)
    images_m = images_m.reshape(-1, 2)[: count - 9]
    wall_m = np.stack([np.full(9, 20.0), np.linspace(-300.0, 300.0, 9)], axis=1)
    points_m = np.concatenate([wall_m, images_m])
    covariance = np.tile(np.diag([3600.0, 1e-4]), (count, 1, 1))
    covariance[:9] = few.covariance[0]
    return msgspec.structs.replace(
        few,
        range_m=np.hypot(*points_m.T),
        azimuth_rad=np.arctan2(points_m[:, 1], points_m[:, 0]),
        score=np.full(count, 0.8),
        path_class=(np.arange(count) >= 9).astype(np.uint8),
        covariance=covariance,
        peak_stamp_ns=np.zeros(count, np.int64),
        snr_db=np.full(count, 25.0),
    )


def test_a_scan_of_too_many_peaks_is_refused_and_the_next_one_seen() -> None:
    node = geometry.create(geometry.Params())
    assert told(node, ("perception/peaks", crowd(MAX_PEAKS + 1))) == []
    assert node.health() == (NodeState.DEGRADED, f"peaks must be at most {MAX_PEAKS} a scan, got {MAX_PEAKS + 1}")
    assert shed(node) == {("scan", "refused"): 1}
    assert len(told(node, ("perception/peaks", peaks(1, 0)))) == 1
    assert node.health() == (NodeState.READY, "")


def test_a_stamp_that_a_peers_clock_cannot_have_is_rejected() -> None:
    """Moved into this host's clock it would lie before the first stamp there is."""
    ahead_ns, topic = 10**12, "vehicle/state"
    clock, messages = PeerClock(), PeerMessages("sensor", [topic])
    clock.add(ClockSample(0, ahead_ns, 2))
    envelope = Envelope(publisher="can", topic=topic, sequence=0, sent_ns=ahead_ns)
    for stamp_ns, rejected in ((-MAX_STAMP_NS, 1), (ahead_ns, 1)):
        came = messages.take(topic, encode(envelope, VehicleState(stamp_ns=stamp_ns)), clock, 10**9)
        assert (came is None, messages.rejected) == (stamp_ns < 0, rejected)


@pytest.mark.parametrize(
    ("kind", "fields"), [(PeakParams, {"min_distance": 1 << 31}), (RidgeParams, {"spacing": (0, 1 << 62)})]
)
def test_parameters_that_no_map_could_be_looked_at_with(kind: type, fields: dict[str, Any]) -> None:
    (name,) = fields
    with pytest.raises(ValueError, match=rf"\.{name} must lie in .* got"):
        kind(**fields)


def test_a_line_about_a_file_is_one_whatever_its_name() -> None:
    with pytest.raises(ValueError, match="no such background"):
        load_node("nodes.ra_former", {"background": "\n"})
