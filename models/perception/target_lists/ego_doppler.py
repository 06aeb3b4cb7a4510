"""Radial speeds over ground: the radar's own motion taken off, as the vehicle states it or as the returns show it.

A standing reflector in the direction u has the radial speed -v.u, v the velocity of the radar; so has the image of a
standing reflector in a standing mirror, in the direction of the image. Most of what a radar on the road detects stands:
the velocity that most returns share is its own.
"""

from __future__ import annotations

import math

import numpy as np

from models.perception.target_lists.returns import column
from models.perception.target_lists.sensor import DetectionSensor
from msgs.values.detections import RadarDetections
from msgs.values.frames import Pose2
from msgs.values.vehicle import VehicleState

#: Speeds of the vehicle that are tried, along its axis.
SPEEDS_MPS = np.arange(-15.0, 70.0, 0.1)
#: Returns within this of the speed of a standing thing count as standing.
STANDING_MPS = 0.5
#: A velocity is that of the radar where at least so many returns, and so large a share of them, stand.
MIN_STANDING = 8
MIN_STANDING_SHARE = 0.5
#: More returns than these only repeat what the others say.
MAX_VOTES = 512


def over_ground(detections: RadarDetections, sensor: DetectionSensor, state: VehicleState | None) -> np.ndarray:
    """Return the radial speeds over ground [N], within half the ambiguous interval; NaN where not known."""
    count = len(detections)
    measured = column(detections.radial_speed_mps, count)
    if detections.over_ground:
        return measured
    directions = unit_vectors(detections)
    velocity = radar_velocity(state, detections.vehicle_from_radar) if state is not None and state.valid else None
    if velocity is None:
        velocity = shown_velocity(directions, measured, sensor.speed_period_mps, detections.vehicle_from_radar.yaw_rad)
    if velocity is None:
        return np.full(count, np.nan)
    return within_period(measured + directions @ velocity, sensor.speed_period_mps)


def unit_vectors(detections: RadarDetections) -> np.ndarray:
    """Return the horizontal part of the directions [N, 2] of detections."""
    flat = np.cos(np.nan_to_num(column(detections.elevation_rad, len(detections))))
    return np.stack([flat * np.cos(detections.azimuth_rad), flat * np.sin(detections.azimuth_rad)], axis=1)


def within_period(speed_mps: np.ndarray, period_mps: float | None) -> np.ndarray:
    """Return the speeds of least amount that an ambiguous measurement may mean."""
    return speed_mps if period_mps is None else speed_mps - period_mps * np.round(speed_mps / period_mps)


def radar_velocity(state: VehicleState, vehicle_from_radar: Pose2) -> np.ndarray:
    """Return the velocity [2] of the radar over ground in its own axes."""
    turn = state.yaw_rate_rps
    at_radar = np.array([state.speed_mps - turn * vehicle_from_radar.y_m, turn * vehicle_from_radar.x_m])
    return Pose2(yaw_rad=-vehicle_from_radar.yaw_rad).rotate(at_radar)


def shown_velocity(
    directions: np.ndarray, measured_mps: np.ndarray, period_mps: float | None, yaw_rad: float
) -> np.ndarray | None:
    """Return the velocity [2] of the radar that most returns share; None where there is none.

    The best speed along the vehicle's axis, then least squares over what stands.
    """
    known = ~np.isnan(measured_mps)
    directions, measured_mps = directions[known], measured_mps[known]
    heading = np.array([math.cos(yaw_rad), -math.sin(yaw_rad)])
    some = slice(None, None, 1 + len(measured_mps) // MAX_VOTES)
    residual = within_period(measured_mps[some] + SPEEDS_MPS[:, None] * (directions[some] @ heading), period_mps)
    velocity = SPEEDS_MPS[int((np.abs(residual) < STANDING_MPS).sum(axis=1).argmax())] * heading
    for _ in range(2):
        residual_mps = within_period(measured_mps + directions @ velocity, period_mps)
        stands = np.abs(residual_mps) < STANDING_MPS
        if stands.sum() < max(MIN_STANDING, MIN_STANDING_SHARE * len(measured_mps)):
            return None
        step, *_ = np.linalg.lstsq(directions[stands], -residual_mps[stands], rcond=1e-3)
        velocity = velocity + step
    return np.asarray(velocity)
