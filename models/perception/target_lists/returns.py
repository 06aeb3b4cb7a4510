"""Returns in the plane: the detections of one reflector joined, errors filled in, heights from elevations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.perception.mirrors.recovery import cartesian_covariance
from models.perception.target_lists.sensor import DetectionSensor
from msgs.values.array_table import ArrayTable
from msgs.values.detections import RadarDetections
from msgs.values.frames import xy_from_polar

#: A reflector moves as a whole: detections of one cell further apart in radial speed than this are of several.
SAME_SPEED_MPS = 0.5
#: Beside this an array measures no angle.
MIN_COSINE = 0.1


@dataclass(frozen=True)
class Returns(ArrayTable):
    """Returns of a scan in the radar's plane, N of them, strongest first; float64.

    Height over the radar and radial speed over ground, with their standard deviations, are NaN where they are not
    known.
    """

    range_m: np.ndarray
    azimuth_rad: np.ndarray
    #: Polar (range [m], azimuth [rad]), [N, 2, 2].
    covariance: np.ndarray
    snr_db: np.ndarray
    height_m: np.ndarray
    height_std_m: np.ndarray
    speed_mps: np.ndarray
    speed_std_mps: np.ndarray

    @property
    def points_m(self) -> np.ndarray:
        """Positions [N, 2]."""
        return xy_from_polar(self.range_m, self.azimuth_rad)

    @property
    def covariance_m2(self) -> np.ndarray:
        """Covariances [N, 2, 2] of the positions."""
        return cartesian_covariance(self.range_m, self.azimuth_rad, self.covariance)


def column(values: np.ndarray | None, count: int, missing: float = np.nan) -> np.ndarray:
    """Return an optional column [count], `missing` where the sensor measured nothing."""
    if values is None:
        return np.full(count, missing)
    return np.where(np.isnan(values), missing, values)


def returns_of(detections: RadarDetections, speed_mps: np.ndarray, sensor: DetectionSensor) -> Returns:
    """Return the detections in the plane, with radial speeds over ground [N]; nothing is joined yet."""
    count = len(detections)
    elevation_rad = column(detections.elevation_rad, count)
    flat_rad = np.nan_to_num(elevation_rad)
    elevation_std_rad = column(detections.elevation_std_rad, count, np.radians(sensor.elevation_std_deg))
    order = np.argsort(-snr_of(detections, sensor), kind="stable")
    return Returns(
        range_m=detections.range_m * np.cos(flat_rad),
        azimuth_rad=detections.azimuth_rad,
        covariance=filled_covariance(detections, sensor),
        snr_db=snr_of(detections, sensor),
        height_m=detections.range_m * np.sin(elevation_rad),
        height_std_m=detections.range_m * elevation_std_rad,
        speed_mps=speed_mps,
        speed_std_mps=column(detections.radial_speed_std_mps, count, sensor.speed_std_mps),
    ).take(order)


def filled_covariance(detections: RadarDetections, sensor: DetectionSensor) -> np.ndarray:
    """Return the covariances [N, 2, 2] with the sensor's variances where a detection has none, or a singular one.

    An array measures the sine of an azimuth: its error grows with one over the cosine.
    """
    covariance = detections.covariance
    cosine = np.maximum(np.cos(detections.azimuth_rad), MIN_COSINE)
    own = np.zeros_like(covariance)
    own[:, 0, 0] = sensor.range_std_m**2
    own[:, 1, 1] = (np.radians(sensor.azimuth_std_deg) / cosine) ** 2
    variance = covariance[:, [0, 1], [0, 1]]
    is_given = np.abs(covariance[:, 0, 1]) < np.sqrt(variance.prod(axis=1))
    return np.where(is_given[:, None, None], covariance, own)


def snr_of(detections: RadarDetections, sensor: DetectionSensor) -> np.ndarray:
    """Return the SNR [N] in dB: measured, else of the RCS by the radar equation, else the sensor's threshold."""
    count = len(detections)
    snr_db = column(detections.snr_db, count)
    sensitivity_db = sensor.sensitivity_db if sensor.reference_range_m else sensor.threshold_db
    lost_db = 40.0 * np.log10(np.maximum(detections.range_m, 1.0)) if sensor.reference_range_m else 0.0
    of_rcs_db = sensitivity_db + column(detections.rcs_dbsm, count) - lost_db
    # as far as a message goes
    snr_db = np.where(np.isnan(snr_db), np.clip(of_rcs_db, -300.0, 300.0), snr_db)
    return np.where(np.isnan(snr_db), sensor.threshold_db, snr_db)


def joined_returns(returns: Returns, sensor: DetectionSensor, most: int) -> Returns:
    """Return the strongest of each resolution cell with the mean of its cell's positions; at most `most`, strongest
    first.

    A cell is one range resolution by one beam width, near the radar by one range resolution, by `SAME_SPEED_MPS`;
    returns of one reflector that fall into two
    cells stay two. The error of a mean is no smaller than that of its strongest return: errors within a cell are those
    of one measurement.
    """
    if len(returns) == 0:
        return returns
    resolution_m = sensor.range_resolution_m
    ring = np.floor(returns.range_m / resolution_m)
    sector_rad = np.maximum(np.radians(sensor.beam_width_deg), 1.0 / (ring + 0.5))
    speed = np.floor(np.nan_to_num(returns.speed_mps, nan=1e6) / SAME_SPEED_MPS)
    cells = np.stack([ring, np.floor(returns.azimuth_rad / sector_rad), speed], axis=1)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    weight = 10.0 ** (0.05 * (returns.snr_db - returns.snr_db.max()))
    total = np.bincount(cell, weight)
    mean = {
        name: np.bincount(cell, weight * getattr(returns, name)) / total
        for name in ("range_m", "azimuth_rad", "height_m", "speed_mps")
    }
    strongest = returns.take(first)
    columns = {name: getattr(strongest, name) for name in strongest.__dataclass_fields__}
    joined = Returns(**{**columns, **mean})
    return joined.take(np.argsort(-joined.snr_db, kind="stable")[:most])
