"""Properties of a radar that gives detections: errors, resolution, field of view, sensitivity."""

from __future__ import annotations

import math

import msgspec

from models.perception.mirrors.observability import UNKNOWN_SENSITIVITY_DB
from msgs.values.arrays import require_finite, require_positive
from msgs.values.perception import SensorLimits

#: Weaker by more than this at the same range: a side lobe.
LOBE_DB = 22.0


class DetectionSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A radar as its data sheet describes it; standard deviations count where a detection carries none."""

    #: Name that its detections carry; empty: any.
    name: str = ""
    range_std_m: float = 0.1
    azimuth_std_deg: float = 0.7
    elevation_std_deg: float = 2.0
    speed_std_mps: float = 0.1
    #: Detections within both of each other are returns of one reflector.
    range_resolution_m: float = 0.4
    beam_width_deg: float = 2.0
    azimuth_limit_deg: float = 60.0
    max_range_m: float = 100.0
    #: Interval after which radial speeds repeat; None: they are not ambiguous.
    speed_period_mps: float | None = None
    #: Height over ground, which elevations are measured from.
    height_m: float = 0.5
    #: SNR of the weakest detection that it reports.
    threshold_db: float = 12.0
    #: Range at which an object of the RCS is just detected; None: not known, and no cell counts as observed.
    reference_range_m: float | None = None
    reference_rcs_dbsm: float = 10.0

    def __post_init__(self) -> None:
        positive = ("range_std_m", "azimuth_std_deg", "elevation_std_deg", "speed_std_mps", "range_resolution_m",
                    "beam_width_deg", "azimuth_limit_deg", "max_range_m")  # fmt: skip
        for name in positive:
            require_positive(f"sensor.{name}", getattr(self, name))
        for name in ("speed_period_mps", "reference_range_m"):
            if getattr(self, name) is not None:
                require_positive(f"sensor.{name}", getattr(self, name))
        require_finite("sensor", self.height_m, self.threshold_db, self.reference_rcs_dbsm)

    @property
    def sensitivity_db(self) -> float:
        """SNR of an isotropic 0 dBsm target at 1 m, by the radar equation from the reference; dB."""
        if self.reference_range_m is None:
            return UNKNOWN_SENSITIVITY_DB
        return self.threshold_db - self.reference_rcs_dbsm + 40.0 * math.log10(self.reference_range_m)

    @property
    def limits(self) -> SensorLimits:
        """Limits that later stages heed."""
        return SensorLimits(
            beam_width_rad=math.radians(self.beam_width_deg),
            azimuth_limit_rad=math.radians(self.azimuth_limit_deg),
            max_range_m=self.max_range_m,
            lobe_db=LOBE_DB,
            threshold_db=self.threshold_db,
        )
