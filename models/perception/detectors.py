"""From a range-azimuth map to classified peaks: two ways that answer the same call."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import msgspec

from models.perception.cfar import CfarParams, cfar_peaks
from models.perception.named import NamedParams, named_peaks
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
    """Dense prediction (section 3.1.1): a heatmap of LOS and mirrored returns, then peaks.

    `refine` takes peaks from the ridges of the map that the heatmap names, which are sharper than the heatmap, and the
    heatmap's own maxima only where the map has no ridge; without it they are the published local maxima.
    """

    def __init__(
        self,
        setup: RadarSetup,
        model: Path = DEFAULT_MODEL,
        threads: int = 1,
        params: PeakParams | None = None,
        named: NamedParams | None = None,
        refine: bool = True,
    ) -> None:
        self._predictor = DensePredictor(model, threads)
        self._params, self._named, self._refine = params or PeakParams(), named or NamedParams(), refine
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        heatmap = self._predictor.predict(ra_map)
        if self._refine:
            peaks = named_peaks(heatmap, ra_map, self._params, self._named)
        else:
            peaks = find_peaks(heatmap, ra_map, self._params)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db)


class CfarDetector:
    """No network: constant false alarm rate, and what lies behind a wall is mirrored."""

    def __init__(self, setup: RadarSetup, params: CfarParams | None = None) -> None:
        self._params = params or CfarParams()
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        peaks = cfar_peaks(ra_map, self._params)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db)
