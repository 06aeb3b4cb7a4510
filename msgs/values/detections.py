"""Detections of a radar that gives no beats: positions, radial speeds and strengths, with their uncertainties."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import msgspec
import numpy as np

from msgs.values.arrays import MAX_SPEED_MPS, Array, Checked, Count, StampNs, require_within
from msgs.values.frames import Pose2

#: Maximum number of a measurement: imaging radars give some ten thousand.
MAX_DETECTIONS = 16384

#: Fields that a sensor may leave out, one entry a detection, and their limits.
OPTIONAL_COLUMNS: dict[str, tuple[float, float]] = {
    "elevation_rad": (-math.pi / 2, math.pi / 2),
    "elevation_std_rad": (0.0, math.pi),
    "radial_speed_mps": (-MAX_SPEED_MPS, MAX_SPEED_MPS),
    "radial_speed_std_mps": (0.0, MAX_SPEED_MPS),
    "rcs_dbsm": (-300.0, 300.0),
    "snr_db": (-300.0, 300.0),
}


def _optional(name: str) -> Array:
    return Array("<f8", ("range_m",), *OPTIONAL_COLUMNS[name], or_nan=True)


class RadarDetections(Checked, frozen=True, kw_only=True, eq=False):
    """Detections of one measurement of one radar (topic `radar/detections`), N of them, in the radar's frame.

    Arrays are float64 [N] unless stated. What a sensor does not measure at all is None, what it lacks for one detection
    is NaN.
    """

    label: ClassVar[str] = "detections"

    stamp_ns: StampNs
    scan_id: Count
    #: Name of the sensor that measured them: its limits and errors are parameters of who reads them.
    sensor: str = ""
    range_m: Annotated[np.ndarray, Array("<f8", (None,), 0.0, 1e6)]
    azimuth_rad: Annotated[np.ndarray, Array("<f8", ("range_m",), -math.pi, math.pi)]
    #: Polar covariance (range [m], azimuth [rad]), [N, 2, 2]; zeros: the sensor's own errors hold.
    covariance: Annotated[np.ndarray, Array("<f8", ("range_m", 2, 2), covariances=True)]
    elevation_rad: Annotated[np.ndarray, _optional("elevation_rad")] | None = None
    elevation_std_rad: Annotated[np.ndarray, _optional("elevation_std_rad")] | None = None
    #: Positive away from the radar: relative to it, or over ground where the sensor takes its own motion off.
    radial_speed_mps: Annotated[np.ndarray, _optional("radial_speed_mps")] | None = None
    radial_speed_std_mps: Annotated[np.ndarray, _optional("radial_speed_std_mps")] | None = None
    over_ground: bool = False
    rcs_dbsm: Annotated[np.ndarray, _optional("rcs_dbsm")] | None = None
    snr_db: Annotated[np.ndarray, _optional("snr_db")] | None = None
    #: Detections that the sensor announced and that did not arrive.
    lost: Annotated[int, msgspec.Meta(ge=0, le=1 << 31)] = 0
    vehicle_from_radar: Pose2 = Pose2()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within("detections.count", 0, MAX_DETECTIONS, len(self))

    def __len__(self) -> int:
        return len(self.range_m)
