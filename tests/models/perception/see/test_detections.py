"""Objects as a view reports them."""

from __future__ import annotations

import numpy as np

from models.perception.see.detections import Detections, hidden_objects
from msgs.values.perception import RadialSpeed


def test_every_report_has_its_own_stamp_and_values() -> None:
    """Two cars that two beams have measured, 60 ms apart."""
    two = Detections(
        score=np.array([0.9, 0.4]),
        place_m=np.array([[1.0, 2.0], [3.0, 4.0]]),
        covariance_m2=np.array([[[1.0, 0.1], [0.1, 2.0]], [[3.0, 0.2], [0.2, 4.0]]]),
        centre_m=np.array([[1.5, 2.5], [3.5, 4.5]]),
        size_m=np.array([[4.0, 2.0], [6.0, 3.0]]),
        yaw_rad=np.array([0.1, 0.2]),
        object_class=np.array([2, 4]),
        range_m=np.zeros(2),
        azimuth_rad=np.zeros(2),
        away_rad=np.zeros(2),
    )
    speeds = [None, RadialSpeed(azimuth_rad=0.5, speed_mps=1.0, std_mps=0.1)]
    first, second = hidden_objects(two, np.array([100, 160]), speeds)
    assert (first.id, first.x_m, first.y_m, first.length_m, first.width_m) == (0, 1.0, 2.0, 4.0, 2.0)
    assert (second.id, second.x_m, second.y_m, second.length_m, second.width_m) == (1, 3.0, 4.0, 6.0, 3.0)
    assert (first.stamp_ns, first.score, first.yaw_rad, first.object_class) == (100, 0.9, 0.1, "car")
    assert (second.stamp_ns, second.score, second.yaw_rad, second.object_class) == (160, 0.4, 0.2, "truck")
    assert second.cov_m2 == ((3.0, 0.2), (0.2, 4.0))
    assert (first.radial_speed, second.radial_speed) == (None, speeds[1])
