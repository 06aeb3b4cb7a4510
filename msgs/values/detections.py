"""Detections of a radar that gives no beats: positions, radial speeds and strengths, with their uncertainties."""

from __future__ import annotations

import msgspec
import numpy as np

from msgs.values.arrays import require_array, require_stamps, require_within
from msgs.values.frames import Pose2
from msgs.values.perception import PEAK_LIMITS

#: Maximum number of a measurement: imaging radars give some ten thousand.
MAX_DETECTIONS = 16384

#: Fields that a sensor may leave out, one entry a detection.
OPTIONAL_COLUMNS = ("elevation_rad", "elevation_std_rad", "radial_speed_mps", "radial_speed_std_mps", "rcs_dbsm",
                    "snr_db")  # fmt: skip


class RadarDetections(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Detections of one measurement of one radar (topic `radar/detections`), N of them, in the radar's frame.

    Arrays are float64 [N] unless stated. What a sensor does not measure at all is None, what it lacks for one detection
    is NaN.
    """

    stamp_ns: int
    scan_id: int
    #: Name of the sensor that measured them: its limits and errors are parameters of who reads them.
    sensor: str = ""
    range_m: np.ndarray
    azimuth_rad: np.ndarray
    #: Polar covariance (range [m], azimuth [rad]), [N, 2, 2].
    covariance: np.ndarray
    elevation_rad: np.ndarray | None = None
    elevation_std_rad: np.ndarray | None = None
    #: Positive away from the radar: relative to it, or over ground where the sensor takes its own motion off.
    radial_speed_mps: np.ndarray | None = None
    radial_speed_std_mps: np.ndarray | None = None
    over_ground: bool = False
    rcs_dbsm: np.ndarray | None = None
    snr_db: np.ndarray | None = None
    #: Detections that the sensor announced and that did not arrive.
    lost: int = 0
    vehicle_from_radar: Pose2 = Pose2()

    def __post_init__(self) -> None:
        require_array("detections.range_m", self.range_m, "<f8", (None,))
        count = len(self.range_m)
        require_within("detections.count", 0, MAX_DETECTIONS, count)
        require_array("detections.azimuth_rad", self.azimuth_rad, "<f8", (count,))
        require_array("detections.covariance", self.covariance, "<f8", (count, 2, 2))
        for name, largest in (("range_m", 1e6), ("azimuth_rad", 1e3), ("covariance", PEAK_LIMITS["covariance"])):
            values = getattr(self, name)
            if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > largest:
                raise ValueError(f"detections.{name} must be finite and at most {largest:g}")
        for name in OPTIONAL_COLUMNS:
            values = getattr(self, name)
            if values is None:
                continue
            require_array(f"detections.{name}", values, "<f8", (count,))
            if (np.abs(values[~np.isnan(values)]) > PEAK_LIMITS["snr_db"]).any():
                raise ValueError(f"detections.{name} must be at most {PEAK_LIMITS['snr_db']:g}, or NaN")
        require_stamps("detections.stamp_ns", self.stamp_ns)
        require_within("detections.lost", 0, 1 << 31, self.lost)

    def __len__(self) -> int:
        return len(self.range_m)
