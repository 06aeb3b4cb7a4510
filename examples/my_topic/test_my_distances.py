"""Test of the node on the in-process bus: mirrorwave's pytest plug-in brings `bus` and `graph`."""

import numpy as np
from my_distances import Params, create

from msgs.values.perception import BevFrame, HiddenObject

EYE = ((1.0, 0.0), (0.0, 1.0))


def test_the_nearest_object_is_named(bus, graph):
    """Objects out of reach are left out; a view without any is answered too."""
    car = HiddenObject(id=1, x_m=30.0, y_m=40.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=0.9, cov_m2=EYE)
    bike = HiddenObject(id=2, x_m=3.0, y_m=4.0, length_m=2.0, width_m=1.0, yaw_rad=0.0, score=0.9, cov_m2=EYE)
    nodes = graph(distances=create(Params(max_distance_m=40.0)))
    bus.subscribe("my/distances")
    for scan, objects in enumerate([(car, bike), ()]):
        points = {"los_points_m": np.zeros((0, 2), np.float32), "visibility": np.zeros((160, 120), np.uint8)}
        bus.publish("perception/hidden_objects", BevFrame(stamp_ns=scan, scan_id=scan, objects=objects, **points))
        nodes.run()
    assert [received.message.nearest_m for received in bus.receive(0.0)] == [5.0, None]
