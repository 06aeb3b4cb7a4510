"""Values that tests of several rooms build alike."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.perception.chain import Chain
from models.perception.find.detectors import CfarDetector
from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.form.beams_to_maps import FormingStage
from models.perception.form.ra_forming import FormingParams
from models.perception.track.scan_state import MemoryParams
from models.perception.track.views_over_scans import ViewStage
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap


def cfar_chain(setup: RadarSetup, forming: FormingParams | None = None, memory: MemoryParams | None = None) -> Chain:
    """A chain that looks with CFAR, of the defaults unless told otherwise."""
    detector = CfarDetector(setup)
    chain = Chain(FormingStage(forming), DetectionStage(lambda _: detector), ViewStage(memory=memory))
    chain.set_up(setup)
    return chain


def example_map(values: np.ndarray, **fields: Any) -> RangeAzimuthMap:
    """A coherent map of these values, of scan 0 at time 0 with a noise of 1 mW, unless told otherwise."""
    bins, azimuths = values.shape
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "noise_power_mw": 1.0, "incoherent": np.zeros(bins, bool)}
    plain["azimuth_stamp_ns"] = np.zeros(azimuths, np.int64)
    return RangeAzimuthMap(values=values.astype(np.complex64), **plain | fields)


def example_beam(**fields: Any) -> RadarBeam:
    """The first of 25 beams, straight ahead, of one sample of silence, unless told otherwise."""
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "beam_index": 0, "beam_count": 25, "azimuth_rad": 0.0}
    return RadarBeam(**{"samples": np.zeros((1, 1, 2), np.int16), "full_scale_dbm": 0.0} | plain | fields)
