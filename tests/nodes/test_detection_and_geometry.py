"""The dense predictor and the geometry node: one answer a message, the detector by parameter, errors at start."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks.yaw_bias import limited
from models.perception.ra_forming import RaFormer
from msgs.bus import Envelope, Received
from msgs.diagnostics import NodeState
from msgs.perception import BevFrame, Peaks
from msgs.radar import ArrayParams, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.vehicle import VehicleState
from nodes import dense_predictor, geometry
from nodes.player import Params, scene_player
from tests.perception.test_yaw_rate_bias import drive, town, turns


def received(message: msgspec.Struct, topic: str) -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


def noise_map() -> RangeAzimuthMap:
    rng = np.random.default_rng(0)
    values = (rng.standard_normal((512, 256)) + 1j * rng.standard_normal((512, 256))).astype("<c8") * 1e-7
    return RangeAzimuthMap(
        stamp_ns=7, scan_id=3, values=values, azimuth_stamp_ns=np.zeros(256, "<i8"), noise_power_mw=2e-14,
        incoherent=np.zeros(512, bool),
    )  # fmt: skip


@pytest.mark.parametrize("method", ["network", "cfar"])
def test_noise_becomes_an_empty_view_of_the_same_scan(method: str) -> None:
    detect = dense_predictor.create(dense_predictor.Params(method=method))  # type: ignore[arg-type]
    (peaks,) = detect.step([received(RadarSetup(), "radar/setup"), received(noise_map(), "radar/ra_map")], 0)
    assert isinstance(peaks.message, Peaks)
    assert (peaks.message.stamp_ns, peaks.message.scan_id) == (7, 3)
    assert peaks.message.sensitivity_db > 50.0
    (view,) = geometry.create(geometry.Params()).step([received(peaks.message, "perception/peaks")], 0)
    assert isinstance(view.message, BevFrame)
    assert (view.message.stamp_ns, view.message.scan_id, view.message.objects) == (7, 3, ())


def test_the_published_peaks_stand_beside_ours() -> None:
    """One scene, both ways: the same kind of answer, other places."""
    player = scene_player(Params(scene="launch/scenes/corner.yaml", chirps_per_beam=16))
    former = RaFormer(player.setup)
    (ra_map,) = [ra_map for index in range(25) for ra_map in former.add(player.beam(0, index))]
    ours, published = (
        dense_predictor.create(dense_predictor.Params(refine=refine)).step([received(ra_map, "radar/ra_map")], 0)
        for refine in (True, False)
    )
    assert len(ours[0].message) > 0
    assert len(published[0].message) > 0
    assert ours[0].message.azimuth_rad.tolist() != published[0].message.azimuth_rad.tolist()


def test_a_missing_model_ends_the_node_at_start(tmp_path: Path) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=r"nowhere\.json"):
        dense_predictor.create(dense_predictor.Params(model=str(tmp_path / "nowhere.onnx")))


def test_another_method_is_refused_with_those_that_exist() -> None:
    with pytest.raises(msgspec.ValidationError, match="method"):
        msgspec.convert({"method": "magic"}, dense_predictor.Params)


def test_a_view_carries_the_vehicles_motion_at_its_scan() -> None:
    detect = dense_predictor.create(dense_predictor.Params(method="cfar"))
    (peaks,) = detect.step([received(noise_map(), "radar/ra_map")], 0)
    node = geometry.create(geometry.Params())
    states = [received(VehicleState(stamp_ns=at, speed_mps=float(at)), "vehicle/state") for at in (5, 7, 9)]
    # the scan began at 7
    (view,) = node.step([received(peaks.message, "perception/peaks"), *states], 0)
    assert view.message.ego.speed_mps == 7.0


@pytest.mark.parametrize("kept", ["nothing", "steering and wheels"])
def test_the_log_says_once_whether_the_bias_of_the_yaw_rate_is_known(
    kept: str, caplog: pytest.LogCaptureFixture
) -> None:
    """40 s in town without a standstill: from steering and wheels the bias is known, without them the log says why."""
    detect = dense_predictor.create(dense_predictor.Params(method="cfar"))
    (peaks,) = detect.step([received(noise_map(), "radar/ra_map")], 0)
    node = geometry.create(geometry.Params())
    states = drive(40.0, town, turns)
    if kept == "nothing":
        states = limited(states, steering=False, wheels=False)
    with caplog.at_level(logging.INFO, logger="nodes.geometry"):
        for scan_id in range(130):
            stamp_ns = scan_id * 300_000_000
            here = [state for state in states if stamp_ns - 300_000_000 < state.stamp_ns <= stamp_ns]
            scan = msgspec.structs.replace(peaks.message, scan_id=scan_id, stamp_ns=stamp_ns)
            inputs = [received(state, "vehicle/state") for state in here]
            node.step([*inputs, received(scan, "perception/peaks")], stamp_ns)
    (record,) = [one for one in caplog.records if "yaw rate bias" in one.message]
    if kept == "nothing":
        assert record.levelno == logging.WARNING
        assert record.message.endswith("the vehicle never stood, and neither steering nor wheel speeds are known")
    else:
        assert record.levelno == logging.INFO
        assert record.message.endswith("from driving")


def test_maps_and_setups_that_do_not_suit_the_network_are_refused_and_said() -> None:
    """An array of 200 columns, whose beams fall between the cells, and a map of another grid; then all is well."""
    node = dense_predictor.create(dense_predictor.Params())
    fine = RadarSetup(array=ArrayParams(columns=200))
    grid = RangeAzimuthGrid(range_bins=64, azimuth_bins=32)
    other = RangeAzimuthMap(
        stamp_ns=0, scan_id=0, grid=grid, values=np.zeros(grid.shape, "<c8"), azimuth_stamp_ns=np.zeros(32, "<i8"),
        noise_power_mw=1.0, incoherent=np.zeros(64, bool),
    )  # fmt: skip
    assert node.step([received(fine, "radar/setup"), received(other, "radar/ra_map")], 0) == []
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert "map.grid must be" in reason
    assert [(one.what, one.reason, one.count) for one in node.shed.counts()] == [
        ("setup", "refused", 1), ("map", "refused", 1),
    ]  # fmt: skip
    assert len(node.step([received(noise_map(), "radar/ra_map")], 0)) == 1
    assert node.health() == (NodeState.READY, "")


def test_a_number_of_threads_no_machine_has_is_refused() -> None:
    with pytest.raises(ValueError, match=r"threads must be 1\.\.256, got 2147483648"):
        dense_predictor.Params(threads=1 << 31)


@pytest.mark.parametrize("method", ["network", "cfar"])
@pytest.mark.parametrize(("cell", "noise_power_mw"), [(np.inf, 1.0), (np.nan, 1.0), (1e30, 1.0), (1.0, 5e-324)])
def test_a_map_of_which_no_powers_follow_is_refused(method: str, cell: float, noise_power_mw: float) -> None:
    """One such cell would spread over its neighbours, or divide by nothing: no peaks, and it is said."""
    node = dense_predictor.create(dense_predictor.Params(method=method))  # type: ignore[arg-type]
    good = noise_map()
    values = good.values.copy()
    values[40, 100] = cell
    bad = msgspec.structs.replace(good, values=values, noise_power_mw=noise_power_mw)
    assert node.step([received(bad, "radar/ra_map")], 0) == []
    assert node.health()[0] is NodeState.DEGRADED
    assert len(node.step([received(good, "radar/ra_map")], 0)) == 1
