"""The dense predictor and the geometry node: one answer a message, the detector by parameter, errors at start."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from models.perception.ra_forming import RaFormer
from msgs.bus import Envelope, Received
from msgs.perception import BevFrame, Peaks
from msgs.radar import RadarSetup, RangeAzimuthMap
from msgs.vehicle import VehicleState
from nodes import dense_predictor, geometry
from nodes.player import Params, scene_player


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
