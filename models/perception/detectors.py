"""From a range-azimuth map to classified peaks: two ways that answer the same call."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import msgspec

from models.perception import cfar
from models.perception.cfar import CfarParams
from models.perception.observability import sensitivity_db
from models.perception.onnx_model import DEFAULT_MODEL, DensePredictor
from models.perception.peaks import PeakParams, find_peaks
from msgs.perception import Peaks
from msgs.radar import RadarSetup, RangeAzimuthMap


class Detector(Protocol):
    """Finds LOS and mirrored returns in a map."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""


class NetworkDetector:
    """Dense prediction (section 3.1.1): a heatmap of LOS and mirrored returns, then its local maxima."""

    def __init__(
        self, setup: RadarSetup, model: Path = DEFAULT_MODEL, threads: int = 1, params: PeakParams | None = None
    ):
        self._predictor = DensePredictor(model, threads)
        self._params = params or PeakParams()
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        peaks = find_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db)


class CfarDetector:
    """No network: constant false alarm rate, and what lies behind a wall is mirrored."""

    def __init__(self, setup: RadarSetup, params: CfarParams | None = None) -> None:
        self._params = params or CfarParams()
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        peaks = cfar.classify_behind_walls(cfar.detect(ra_map, self._params), self._params)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db)
