"""The stage of a radar that gives detections: one measurement in, classified peaks out."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np

from models.perception.mirrors.peaks_to_view import GeometryParams, warm
from models.perception.state_history import StateHistory
from models.perception.target_lists.classification import classified_peaks
from models.perception.target_lists.ego_doppler import over_ground
from models.perception.target_lists.returns import joined_returns, returns_of
from models.perception.target_lists.sensor import DetectionSensor
from models.perception.timing import Timed
from msgs.values.detections import RadarDetections
from msgs.values.perception import MAX_PEAKS, Peaks
from msgs.values.vehicle import VehicleState


class DetectionsStage:
    """Peaks of one radar's detections: errors filled in, joined to returns, classes by walls, Doppler and height."""

    def __init__(
        self,
        sensor: DetectionSensor | None = None,
        geometry: GeometryParams | None = None,
        timed: Timed = nullcontext,
    ) -> None:
        self._sensor, self._geometry = sensor or DetectionSensor(), geometry or GeometryParams()
        self._states = StateHistory()
        self._timed = timed
        warm(self._geometry)

    def add_state(self, state: VehicleState) -> None:
        """Take in a state of the vehicle: its stamp says which detections it counts for."""
        self._states.add(state)

    def peaks(self, detections: RadarDetections) -> Peaks:
        """Return the peaks of a measurement; `ValueError` for detections of another sensor."""
        sensor = self._sensor
        if sensor.name not in ("", detections.sensor):
            raise ValueError(f"detections.sensor must be {sensor.name!r}, got {detections.sensor!r}")
        with self._timed("classify"):
            speed_mps = over_ground(detections, sensor, self._states.at(detections.stamp_ns))
            returns = joined_returns(returns_of(detections, speed_mps, sensor), sensor, MAX_PEAKS)
            return classified_peaks(returns, _without_peaks(detections, sensor), sensor, self._geometry)


def _without_peaks(detections: RadarDetections, sensor: DetectionSensor) -> Peaks:
    """Return the message of a measurement's own fields, without any peak."""
    nothing = np.zeros(0)
    return Peaks(
        stamp_ns=detections.stamp_ns,
        scan_id=detections.scan_id,
        range_m=nothing,
        azimuth_rad=nothing,
        score=nothing,
        path_class=np.zeros(0, np.uint8),
        covariance=np.zeros((0, 2, 2)),
        peak_stamp_ns=np.zeros(0, np.int64),
        snr_db=nothing,
        sensitivity_db=sensor.sensitivity_db,
        vehicle_from_radar=detections.vehicle_from_radar,
        sensor=sensor.limits,
    )
