"""Parameters changed while nodes run: between two scans, all or nothing, with what earlier scans have left."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from models.perception.mirrors.peaks_to_view import synthetic_peaks
from msgs.bus.interface import Outgoing, Received
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarBeam, RangeAzimuthMap
from nodes import dense_predictor, geometry, ra_former
from nodes.node import Node
from tests.models.perception.form.test_ra_forming import RADAR, SETUP, _scan
from tests.nodes.test_detection_and_geometry import received


def beams(scans: int) -> list[RadarBeam]:
    noise_mw = RADAR.noise_power_mw
    return [beam for scan in range(scans) for beam in _scan(SETUP, (28.0, 9.0), noise_power_mw=noise_mw, scan_id=scan)]


def answers(node: Node, messages: list[Received]) -> list[Any]:
    outgoing: list[Any] = []
    for message in messages:
        outgoing += node.step([message], 0)
        while node.pending():
            outgoing += node.step([], 0)
    return [item.message for item in outgoing if isinstance(item, Outgoing)]


def test_a_scan_is_formed_by_the_parameters_that_it_began_with() -> None:
    """Changed after beam 12 of the first scan: that scan is as if nothing had been changed, the next as if made so."""
    node, whole = (ra_former.create(ra_former.Params()) for _ in range(2))
    welch = ra_former.Params(mode="welch")
    stream = [received(SETUP, "radar/setup"), *(received(beam, "radar/beam") for beam in beams(2))]
    maps = answers(node, stream[:13])
    node.change_params(welch)
    maps += answers(node, stream[13:])
    first, second = maps
    assert isinstance(first, RangeAzimuthMap)
    assert (first.mode, second.mode, second.scan_id) == ("coherent", "welch", 1)
    assert first.values.tobytes() == answers(whole, stream)[0].values.tobytes()
    fresh = ra_former.create(welch)
    assert second.values.tobytes() == answers(fresh, stream)[1].values.tobytes()


def test_a_former_that_waits_takes_a_new_set_up_with_its_new_parameters() -> None:
    node = ra_former.create(ra_former.Params())
    node.change_params(ra_former.Params(chirps=4))
    stream = [received(SETUP, "radar/setup"), *(received(beam, "radar/beam") for beam in beams(1))]
    fresh = ra_former.create(ra_former.Params(chirps=4))
    assert answers(node, stream)[0].values.tobytes() == answers(fresh, stream)[0].values.tobytes()


def test_the_predictor_detects_by_the_other_method_from_the_next_map_on() -> None:
    node = dense_predictor.create(dense_predictor.Params(model="compact_unet.int8"))
    stream = [received(SETUP, "radar/setup"), *(received(beam, "radar/beam") for beam in beams(1))]
    (ra_map,) = answers(ra_former.create(ra_former.Params()), stream)
    by_network, *_ = answers(node, [received(ra_map, "radar/ra_map")])
    node.change_params(dense_predictor.Params(method="cfar"))
    by_cfar, *_ = answers(node, [received(ra_map, "radar/ra_map")])
    assert by_network.detector != ""
    assert by_cfar.detector == ""
    with pytest.raises(ValueError, match="nowhere"):
        node.change_params(dense_predictor.Params(model="nowhere"))
    again, *_ = answers(node, [received(ra_map, "radar/ra_map")])
    assert again.detector == ""


def test_what_earlier_scans_have_left_outlives_a_change_of_the_geometry() -> None:
    """Tracks, walls and vehicle states are those of before; the next view has the mask for people."""
    node = geometry.create(geometry.Params())
    peaks = received(synthetic_peaks(), "perception/peaks")
    answers(node, [peaks])
    memory = node._stage._memory
    node.change_params(geometry.Params(visibility=geometry.Mask(rcs_dbsm=-5.0)))
    assert node._stage._memory is memory
    (frame,) = answers(node, [peaks])
    assert isinstance(frame, BevFrame)
    assert frame.visibility_rcs_dbsm == -5.0


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"object_threshold": 2.0}, "object_threshold must lie in 0..1, got 2.0"),
        ({"object_network": "evidence_unet.int8"}, "object_network: whether there is one is fixed at its start"),
        ({"memory": {"tracking": False}}, "memory: what is kept from scan to scan is fixed"),
        ({"residual": "nowhere.onnx"}, "nowhere"),
    ],
)
def test_what_the_geometry_cannot_change_is_refused(changes: dict[str, Any], rule: str) -> None:
    node = geometry.create(geometry.Params())
    with pytest.raises((ValueError, FileNotFoundError), match=rule):
        node.change_params(msgspec.convert(changes, geometry.Params))


def test_other_nodes_say_that_they_take_them_only_at_their_start() -> None:
    with pytest.raises(ValueError, match="Node takes other parameters only when it starts"):
        Node().change_params(None)
