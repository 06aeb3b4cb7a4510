"""A street as a radar of detections sees it: a facade on the right, a building on the left that hides a car, its image.

The image of a point (x, y) in the facade y = -12 is (x, -24 - y). The ray to the car (28, 12) crosses the building, the
one to its image the facade at x = 9.3, and from there the car is free: y = 6 is met at x = 23.3, past the building. The
facade shows the building too.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from models.perception.target_lists.sensor import DetectionSensor
from msgs.values.detections import RadarDetections
from msgs.values.frames import polar_from_xy

FACADE_Y_M, BUILDING_Y_M = -12.0, 6.0
CAR_M = np.array([28.0, 12.0])
SENSOR = DetectionSensor(azimuth_std_deg=0.3, range_std_m=0.05, range_resolution_m=0.2, beam_width_deg=0.5)
RANGE_STD_M, AZIMUTH_STD_RAD = 0.05, np.radians(0.2)


def line(start: tuple[float, float], end: tuple[float, float], count: int) -> np.ndarray:
    return np.linspace(start, end, count)


def car_points(centre_m: np.ndarray = CAR_M) -> np.ndarray:
    """The two faces of a car towards the facade and the radar."""
    front = line((-2.0, -0.9), (2.0, -0.9), 7)
    return centre_m + np.concatenate([front, line((-2.0, -0.6), (-2.0, 0.9), 4)])


def images(points_m: np.ndarray) -> np.ndarray:
    return np.stack([points_m[:, 0], 2.0 * FACADE_Y_M - points_m[:, 1]], axis=1)


def street_points(car: bool = True) -> np.ndarray:
    parts = [
        line((4.0, FACADE_Y_M), (44.0, FACADE_Y_M), 120),
        line((4.0, BUILDING_Y_M), (20.0, BUILDING_Y_M), 70),
        images(line((4.0, BUILDING_Y_M), (20.0, BUILDING_Y_M), 24)),
    ]
    return np.concatenate([*parts, images(car_points())] if car else parts)


def detections(points_m: np.ndarray, seed: int = 0, **changes: Any) -> RadarDetections:
    """Points [N, 2] as measured, without covariances, speeds or elevations."""
    rng = np.random.default_rng(seed)
    range_m, azimuth_rad = polar_from_xy(np.asarray(points_m, np.float64).reshape(-1, 2))
    count = len(range_m)
    message = RadarDetections(
        stamp_ns=0,
        scan_id=0,
        range_m=range_m + rng.normal(0.0, RANGE_STD_M, count),
        azimuth_rad=azimuth_rad + rng.normal(0.0, AZIMUTH_STD_RAD, count),
        covariance=np.zeros((count, 2, 2)),
        snr_db=np.full(count, 25.0),
    )
    return msgspec.structs.replace(message, **changes)


def standing_speeds(message: RadarDetections, velocity_mps: np.ndarray) -> np.ndarray:
    """Radial speeds of standing things as a radar of this velocity measures them."""
    return -np.stack([np.cos(message.azimuth_rad), np.sin(message.azimuth_rad)], axis=1) @ velocity_mps
