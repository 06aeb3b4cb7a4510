"""The node of a radar that gives detections, with the geometry after it."""

from __future__ import annotations

import msgspec
import numpy as np

from models.perception.target_lists.sensor import DetectionSensor
from msgs.bus.interface import Envelope, Received
from msgs.values.diagnostics import NodeState
from msgs.values.vehicle import VehicleState
from nodes import detection_peaks, geometry
from tests.models.perception.target_lists.street import CAR_M, SENSOR, detections, standing_speeds, street_points


def received(topic: str, message: msgspec.Struct) -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


def test_detections_become_peaks_and_these_a_hidden_car() -> None:
    """The vehicle's state, which came beside them, counts for them: what stands has no speed over ground.

    Where it says 2 m/s more than the street shows, all drives ahead so fast.
    """
    node = detection_peaks.create(detection_peaks.Params(sensor=SENSOR))
    message = detections(street_points(), scan_id=4)
    message = msgspec.structs.replace(message, radial_speed_mps=standing_speeds(message, np.array([12.0, 0.0])))
    state = VehicleState(stamp_ns=0, speed_mps=12.0)
    faster = detection_peaks.create(detection_peaks.Params(sensor=SENSOR))
    ahead = received("vehicle/state", msgspec.structs.replace(state, speed_mps=14.0))
    (out,) = faster.step([received("radar/detections", message), ahead], 0)
    np.testing.assert_allclose(out.message.radial_speed_mps, 2.0 * np.cos(out.message.azimuth_rad), atol=1e-3)
    (out,) = node.step([received("radar/detections", message), received("vehicle/state", state)], 0)
    assert (out.topic, out.message.scan_id, out.message.sensor) == ("perception/peaks", 4, SENSOR.limits)
    np.testing.assert_allclose(out.message.radial_speed_mps, 0.0, atol=1e-9)
    after = geometry.create(geometry.Params(object_network="evidence_unet.int8"))
    (view,) = after.step([received("perception/peaks", out.message)], 0)
    (car,) = view.message.objects
    assert np.hypot(car.x_m - CAR_M[0], car.y_m - CAR_M[1]) < 1.5
    assert car.object_class
    # no map is missed: the network looks at the list
    assert list(after.shed.counts()) == []


def test_detections_of_another_sensor_are_refused_aloud_and_counted() -> None:
    node = detection_peaks.create(detection_peaks.Params(sensor=DetectionSensor(name="front")))
    assert node.step([received("radar/detections", detections([[10.0, 0.0]], sensor="rear"))], 0) == []
    assert node.health() == (NodeState.DEGRADED, "detections.sensor must be 'front', got 'rear'")
    assert [(count.what, count.reason, count.count) for count in node.shed.counts()] == [("scan", "refused", 1)]
    assert len(node.step([received("radar/detections", detections([[10.0, 0.0]], sensor="front"))], 0)) == 1
    assert node.health() == (NodeState.READY, "")
