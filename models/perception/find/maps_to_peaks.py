"""The detection stage: range-azimuth maps of any sensor in, classified peaks out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np

from models.perception.find.detectors import Detector, PhotonDetector
from models.perception.timing import Timed
from msgs.values.arrays import require_within
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap

#: Squares of it, and sums of them over a map, are numbers that float32 holds.
MAX_AMPLITUDE = 1e15
#: Zero, which is not known, or so much.
NOISE_LIMITS_MW = (1e-60, 1e60)


class DetectionStage:
    """One detector for a radar's maps, made for its set-up by `detector_for`, and another for those of a LiDAR."""

    def __init__(self, detector_for: Callable[[RadarSetup], Detector], timed: Timed = nullcontext) -> None:
        self._detector_for, self._timed = detector_for, timed
        self.detector = detector_for(RadarSetup())
        self._photon_detector = PhotonDetector()

    @property
    def doubt(self) -> str:
        """In what the radar is not the one that the detector was made for, in one line; empty: in nothing."""
        return getattr(self.detector, "doubt", "")

    def set_up(self, setup: RadarSetup) -> None:
        """Detect by another set-up; `ValueError` for one that cannot be used, which changes nothing."""
        self.detector = self._detector_for(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the peaks of one map; `ValueError` for a map that does not suit the detector."""
        detector = self._photon_detector if ra_map.mode == "photons" else self.detector
        with self._timed("detect"):
            require_sound(ra_map)
            return detector.detect(ra_map)


def require_sound(ra_map: RangeAzimuthMap) -> None:
    """Raise `ValueError` for a map with numbers that would spread over all that are near: no power follows of them."""
    largest = float(np.maximum(np.abs(ra_map.values.real), np.abs(ra_map.values.imag)).max())
    if not largest <= MAX_AMPLITUDE:
        raise ValueError(f"map.values must be finite, of at most {MAX_AMPLITUDE:g}, got {largest!r}")
    if ra_map.noise_power_mw:
        require_within("map.noise_power_mw", *NOISE_LIMITS_MW, ra_map.noise_power_mw)
