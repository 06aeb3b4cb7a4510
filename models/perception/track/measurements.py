"""Measurements of a scan for a tracker: its objects in the odometry frame, and where it would have seen one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from models.perception.mirrors.observability import visibility_at
from models.perception.track.estimate import Estimate, symmetric
from msgs.values.frames import Pose2, wrap_angle
from msgs.values.perception import BevFrame, HiddenObject, RadialSpeed, Visibility
from msgs.values.units import s_from_ns

#: An object measured further from its scan's stamp does not belong to that scan.
LONGEST_SCAN_NS = 2_000_000_000
#: Road users are slower.
MAX_SPEED_MPS = 100.0
#: Scores are probabilities that an object exists; none is a certainty.
LEAST_SCORE, GREATEST_SCORE = 0.05, 0.95
#: Chance of a report of an object where the mask says that none is observable, of that where it says so: walls that the
#: scan has not found mirror too.
UNOBSERVABLE_SHARE = 0.2
#: Points of a Gaussian in the plane, in standard deviations: its centre and four around it, with weights that give its
#: mean and covariance.
_SIGMA_POINTS = math.sqrt(3.0) * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
_SIGMA_WEIGHTS = np.array([1, 0.5, 0.5, 0.5, 0.5]) / 3.0

#: Pose of the radar at a time [s] after a scan's stamp, in the odometry frame.
RadarPath = Callable[[float], Pose2]


@dataclass(frozen=True)
class Sighting:
    """A hidden object in the odometry frame: position [2], covariance [2, 2], time of measurement, score and class."""

    stamp_ns: int
    position_m: np.ndarray
    covariance_m2: np.ndarray
    #: Probability that it is an object if no track explains it.
    score: float = 0.5
    object_class: str = ""
    #: Part of its velocity along a direction of the frame; None: not measured.
    radial_speed: RadialSpeed | None = None

    @property
    def direction(self) -> np.ndarray:
        """Unit vector [2] of the measured part of the velocity."""
        azimuth_rad = self.radial_speed.azimuth_rad if self.radial_speed else math.nan
        return np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])


def sightings(frame: BevFrame, radar: Pose2 | RadarPath, place_std_m: float) -> list[Sighting]:
    """Return the hidden objects of a timely scan in the odometry frame.

    `radar`: `odom_from_radar` at the scan's stamp; where ego motion was not compensated, its path.
    """
    return [_sighting(item, frame, radar, place_std_m) for item in frame.objects if _is_timely(item, frame.stamp_ns)]


def _is_timely(item: HiddenObject, stamp_ns: int) -> bool:
    return item.stamp_ns == 0 or abs(item.stamp_ns - stamp_ns) <= LONGEST_SCAN_NS


def _sighting(item: HiddenObject, frame: BevFrame, radar: Pose2 | RadarPath, place_std_m: float) -> Sighting:
    # an object without a stamp of its own was measured at the frame's
    stamp_ns = item.stamp_ns or frame.stamp_ns
    odom_from_radar = radar if isinstance(radar, Pose2) else radar(s_from_ns(stamp_ns - frame.stamp_ns))
    turn = rotation(odom_from_radar)
    return Sighting(
        stamp_ns=stamp_ns,
        position_m=odom_from_radar.apply(np.array([item.x_m, item.y_m])),
        covariance_m2=symmetric(turn @ np.array(item.cov_m2) @ turn.T) + place_std_m**2 * np.eye(2),
        score=min(max(item.score, LEAST_SCORE), GREATEST_SCORE),
        object_class=item.object_class,
        radial_speed=_turned(item.radial_speed, odom_from_radar),
    )


def _turned(radial: RadialSpeed | None, odom_from_radar: Pose2) -> RadialSpeed | None:
    """Return a radial speed in the odometry frame; None for one that nothing moves at."""
    if radial is None or abs(radial.speed_mps) > MAX_SPEED_MPS or not 0.0 < radial.std_mps <= MAX_SPEED_MPS:
        return None
    return msgspec.structs.replace(radial, azimuth_rad=wrap_angle(radial.azimuth_rad + odom_from_radar.yaw_rad))


def detection_probabilities(
    frame: BevFrame, estimates: Sequence[Estimate], odom_from_radar: Pose2, probability: float
) -> np.ndarray:
    """Return the probability that a scan reports each object as hidden [T], by the mask where it stands.

    `probability` in an observable cell, `UNOBSERVABLE_SHARE` of it elsewhere; without a mask all are observable.
    """
    if not estimates or not frame.visibility.any():
        return np.full(len(estimates), probability)
    radar_from_odom = odom_from_radar.inverse()
    positions_m = np.array([_sigma_points_m(estimate) for estimate in estimates])
    points_m = radar_from_odom.apply(positions_m.reshape(-1, 2))
    cells = visibility_at(frame.visibility, frame.grid, points_m).reshape(len(estimates), -1)
    observable = (cells == Visibility.MIRRORED) @ _SIGMA_WEIGHTS
    return np.asarray(probability * (UNOBSERVABLE_SHARE + (1.0 - UNOBSERVABLE_SHARE) * observable))


def _sigma_points_m(estimate: Estimate) -> np.ndarray:
    """Return positions [5, 2] that stand for the uncertainty of one."""
    variances, axes = np.linalg.eigh(estimate.covariance[:2, :2])
    return np.asarray(estimate.mean[:2] + (_SIGMA_POINTS * np.sqrt(np.maximum(variances, 0.0))) @ axes.T)


def rotation(pose: Pose2) -> np.ndarray:
    """Return the rotation matrix [2, 2] of a pose."""
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return np.array([[c, -s], [s, c]])
