"""Detections of a radar: what a sensor may leave out, and what it may not say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.detections import OPTIONAL_COLUMNS, RadarDetections


def detections(**changes: object) -> RadarDetections:
    fields: dict[str, object] = {
        "stamp_ns": 0,
        "scan_id": 0,
        "range_m": np.array([3.0, 4.0]),
        "azimuth_rad": np.zeros(2),
        "covariance": np.zeros((2, 2, 2)),
    }
    return RadarDetections(**(fields | changes))  # type: ignore[arg-type]


def test_a_sensor_may_leave_out_what_it_does_not_measure() -> None:
    assert all(getattr(detections(), name) is None for name in OPTIONAL_COLUMNS)
    partly = detections(radial_speed_mps=np.array([1.0, math.nan]))
    assert len(partly) == 2


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"azimuth_rad": np.zeros(3)}, r"detections.azimuth_rad must have shape 2, got \(3,\)"),
        ({"snr_db": np.zeros(2, np.float32)}, "detections.snr_db must have dtype <f8"),
        (
            {"range_m": np.ones(17000), "azimuth_rad": np.ones(17000), "covariance": np.zeros((17000, 2, 2))},
            r"detections.count must lie in 0..16384, got 17000",
        ),
    ],
)
def test_what_no_sensor_measures_is_refused_by_name(changes: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=f"^{rule}"):
        detections(**changes)
