"""The dense predictor and the geometry node: one answer a message, the detector by parameter, errors at start."""

from __future__ import annotations

import inspect
import logging
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from benchmarks.perception.yaw_bias import limited
from models.perception.find.detectors import NetworkDetector
from models.perception.mirrors.peaks_to_view import synthetic_peaks
from msgs.bus.interface import Envelope, Received
from msgs.bus.local import LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.environment import GnssPose, PriorWall, WallPriors
from msgs.values.perception import BevFrame, Peaks
from msgs.values.radar import ArrayParams, BeamGrid, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes import dense_predictor, geometry, map_walls
from nodes.node import InProcessGraph
from tests.builders import example_map
from tests.models.perception.see.networks_by_hand import echoes, empty_map, evidence_network
from tests.models.perception.track.test_yaw_rate_bias import drive, town, turns


def received(message: msgspec.Struct, topic: str) -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


def noise_map() -> RangeAzimuthMap:
    rng = np.random.default_rng(0)
    values = (rng.standard_normal((512, 256)) + 1j * rng.standard_normal((512, 256))).astype("<c8") * 1e-7
    return example_map(values, stamp_ns=7, scan_id=3, noise_power_mw=2e-14)


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


def test_every_parameter_reaches_the_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each differs from its default and is handed on under its own name."""
    handed: dict[str, Any] = {}
    signature = inspect.signature(NetworkDetector)

    def detector(*args: Any, **kwargs: Any) -> str:
        handed.update(signature.bind(*args, **kwargs).arguments)
        return "network"

    monkeypatch.setattr(dense_predictor, "NetworkDetector", detector)
    monkeypatch.setattr(dense_predictor, "CfarDetector", lambda *args: args)
    setup = RadarSetup(beat_sign=-1)
    params = dense_predictor.Params(
        model="compact_unet.int8",
        threads=3,
        refine=False,
        flip_test=True,
        cfar=dense_predictor.Cfar(false_alarm_rate=1e-3),
    )
    assert dense_predictor.detector_for(params, setup) == "network"  # type: ignore[comparison-overlap]
    path = handed.pop("model")
    assert path.name == "compact_unet.int8.onnx"
    names = ("threads", "refine", "flip_test")
    assert handed == {name: getattr(params, name) for name in names} | {"setup": setup}
    by_cfar = msgspec.structs.replace(params, method="cfar")
    assert dense_predictor.detector_for(by_cfar, setup) == (setup, params.cfar_params)  # type: ignore[comparison-overlap]


def test_a_missing_model_ends_the_node_at_start(tmp_path: Path) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=r"nowhere\.json"):
        dense_predictor.create(dense_predictor.Params(model=str(tmp_path / "nowhere.onnx")))


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
    other = example_map(np.zeros(grid.shape, "<c8"), grid=grid)
    assert node.step([received(fine, "radar/setup"), received(other, "radar/ra_map")], 0) == []
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert "map.grid.range_bins must be 512, as compact_unet was trained, got 64" in reason
    assert [(one.what, one.reason, one.count) for one in node.shed.counts()] == [
        ("setup", "refused", 1), ("map", "refused", 1),
    ]  # fmt: skip
    assert len(node.step([received(noise_map(), "radar/ra_map")], 0)) == 1
    assert node.health() == (NodeState.READY, "")


def test_maps_of_a_radar_that_no_network_was_trained_for_are_flagged_and_said(tmp_path: Path) -> None:
    """Three beams: each network says so in its node's health, and the view is flagged once. Beams of the radar in
    training that were not asked for are as good as none; those that it alone has more are no fault.
    """
    detect = dense_predictor.create(dense_predictor.Params())
    judge = geometry.create(geometry.Params(object_network=str(evidence_network(tmp_path, name="objects"))))
    few = RadarSetup(beams=BeamGrid(azimuth_deg=(-20.0, 0.0, 20.0)))
    scans = (
        (few, (), True),
        (RadarSetup(), (), False),
        (RadarSetup(), tuple(range(3, 25)), True),
        (RadarSetup(), tuple(range(1, 25, 2)), False),
    )
    for scan, (setup, unused, doubts) in enumerate(scans):
        ra_map = msgspec.structs.replace(noise_map(), scan_id=scan, unused_beams=unused)
        inputs = [received(setup, "radar/setup"), received(ra_map, "radar/ra_map")]
        (peaks,) = detect.step(inputs, 0)
        (view,) = judge.step([*inputs, received(peaks.message, "perception/peaks")], 0)
        assert view.message.flags == (("untrained_setup",) if doubts else ())  # type: ignore[attr-defined]
        for node, network in ((detect, "compact_unet"), (judge, "objects")):
            state, reason = node.health()
            assert state is (NodeState.DEGRADED if doubts else NodeState.READY)
            assert reason.startswith(f"{network} was trained for another radar: no beam within 5 deg of") is doubts


def test_a_number_of_threads_no_machine_has_is_refused() -> None:
    with pytest.raises(ValueError, match=r"threads must be 1\.\.256, got 2147483648"):
        dense_predictor.Params(threads=1 << 31)


@pytest.mark.parametrize("method", ["network", "cfar"])
@pytest.mark.parametrize(
    ("cell", "noise_power_mw"), [(1e30, 1.0), (-1e30, 1.0), (1e30j, 1.0), (-1e30j, 1.0), (1.0, 5e-324)]
)
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


def test_views_go_out_in_the_order_of_their_scans() -> None:
    """A scan whose map is late, followed by one whose map is there: both wait for the first, which is given up."""
    node = geometry.create(geometry.Params(object_network="evidence_unet.int8"))
    peaks = [msgspec.structs.replace(synthetic_peaks(), scan_id=scan, detector="sha256/pursuit") for scan in (3, 4)]
    assert node.step([received(item, "perception/peaks") for item in peaks] + [map_of(4)], 0) == []
    outgoing = node.step([], geometry.MAP_PATIENCE_NS)
    assert [item.message.scan_id for item in outgoing if isinstance(item.message, BevFrame)] == [3, 4]


def map_of(scan: int) -> Received:
    return received(empty_map(scan_id=scan, values=echoes((28.0, -4.0))), "radar/ra_map")


def test_the_geometry_node_joins_peaks_with_the_map_they_came_from(tmp_path: Path) -> None:
    """With an object network it listens to maps too. A scan whose map comes with it, one whose map came before another,
    one whose map comes 20 ms later, and one whose map the bus has dropped: the last is clustered as without a network
    once the wait is over, and counted.
    """
    path = evidence_network(tmp_path)
    node = geometry.create(geometry.Params(object_network=str(path)))
    assert "radar/ra_map" in node.inputs
    assert "radar/ra_map" not in geometry.create(geometry.Params()).inputs
    objects = []
    for scan, maps, late_ns, late in ((0, [0], 0, []), (1, [1, 2], 0, []), (5, [], 20_000_000, [5]), (9, [], None, [])):
        peaks = msgspec.structs.replace(synthetic_peaks(), scan_id=scan, detector="sha256/pursuit")
        outgoing = list(node.step([received(peaks, "perception/peaks"), *map(map_of, maps)], 0))
        if not maps:
            assert (outgoing, node.due_ns(0)) == ([], geometry.MAP_PATIENCE_NS)
            outgoing += node.step([map_of(number) for number in late], late_ns or geometry.MAP_PATIENCE_NS)
        assert node.due_ns(0) is None
        (out,) = outgoing
        assert isinstance(out.message, BevFrame)
        assert out.message.scan_id == scan
        objects.append(out.message.objects)
    assert objects[0]
    assert objects[1] == objects[2] == objects[0]
    assert objects[3] == geometry.view_stage(geometry.Params()).view(synthetic_peaks()).objects != objects[0]
    assert [(count.what, count.reason, count.count) for count in node.shed.counts()] == [
        ("view", "made without a map", 1)
    ]
    # four maps wait for their peaks, whatever comes
    node.step([map_of(scan) for scan in range(20, 26)], 0)
    assert [item.scan_id for item in node._maps] == [22, 23, 24, 25]


def test_a_missing_object_network_shows_at_start() -> None:
    with pytest.raises(ValueError, match=r"nowhere\.json"):
        geometry.create(geometry.Params(object_network="nowhere"))


def test_the_geometry_node_fuses_walls_from_elsewhere() -> None:
    """Walls that come with the peaks of their scan, whichever comes first in a step; none change nothing."""
    wall = PriorWall(ends_m=((4.0, 13.0), (14.0, 13.0)), offset_std_m=0.1, angle_std_rad=0.01, end_std_m=0.5)
    walls = received(WallPriors(stamp_ns=0, source="map", walls=(wall,)), "environment/walls")
    peaks = received(synthetic_peaks(), "perception/peaks")
    views = []
    for inputs in ([peaks], [walls, peaks], [peaks, walls]):
        node = geometry.create(geometry.Params())
        assert "environment/walls" in node.inputs
        (view,) = node.step(inputs, 0)
        assert isinstance(view.message, BevFrame)
        views.append(view.message)
    alone, first, last = (view.walls for view in views)
    assert len(first) == len(alone) + 1
    assert first == last


def test_walls_of_a_map_stand_about_the_place_of_gnss() -> None:
    """Turned by 90 deg and 2 m to the north, the street's walls turn and shift as one, with the pose's errors; a place
    in a building is one too, and far from the map there is no wall.
    """
    network = LocalNetwork(lossless=True)
    node = map_walls.create(map_walls.Params(map="launch/maps/invented_street.geojson"))
    graph = InProcessGraph(network, {"map_walls": node})
    bus, listener = network.bus("receiver"), network.bus("listener")
    listener.subscribe("environment/walls")
    here = GnssPose(
        stamp_ns=5, latitude_deg=10.0, longitude_deg=-30.0, heading_deg=0.0, position_std_m=3.0, heading_std_deg=0.5
    )

    def walls(**changes: float) -> WallPriors:
        bus.publish("vehicle/gnss", msgspec.structs.replace(here, **changes))
        graph.run()
        (item,) = listener.receive(0.0)
        assert isinstance(item.message, WallPriors)
        return item.message

    first = walls()
    assert (first.stamp_ns, first.source, len(first.walls)) == (5, "map", 51)
    assert first.walls[0].offset_std_m == pytest.approx(np.hypot(0.2, 3.0))
    turned = walls(heading_deg=90.0, latitude_deg=10.0 + 2.0 / 110_608.0)
    was, now = (np.array([wall.ends_m for wall in message.walls]) for message in (first, turned))
    expected = np.stack([-was[..., 1], was[..., 0] - 2.0], axis=-1)
    away_m = np.abs(now[:, None] - expected).max(axis=(2, 3))
    assert away_m.min(axis=0).max() < 0.01
    assert len(walls(latitude_deg=10.0, longitude_deg=-30.0001).walls) == len(first.walls)
    assert walls(latitude_deg=20.0).walls == ()
    # of two places at once the newest counts
    bus.publish("vehicle/gnss", msgspec.structs.replace(here, latitude_deg=20.0))
    assert walls() == first
    with pytest.raises(ValueError, match=r"map: nowhere\.osm: no such file"):
        map_walls.create(map_walls.Params(map="nowhere.osm"))
