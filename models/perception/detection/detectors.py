"""From a range-azimuth map to classified peaks: with a network or without, by the same call."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from models.perception.detection.cfar import PHOTON_CFAR, CfarParams, cfar_peaks, warm
from models.perception.detection.onnx_model import DEFAULT_MODEL, DensePredictor
from models.perception.detection.peaks import PeakParams, find_peaks, find_pursued_peaks, peaks_at
from models.perception.detection.pursuit import pursued_peaks
from models.perception.detection.refinement import EchoRefiner, RefinementParams, refined_peaks
from models.perception.detection.ridge_matching import NamedParams, named_peaks
from models.perception.detection.score_calibration import calibrated_peaks
from models.perception.geometry.observability import UNKNOWN_SENSITIVITY_DB, sensitivity_db
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap


class Refine(StrEnum):
    """Where a network's peaks lie; what profiles and committed cards use is `PURSUIT`, the published form `NONE`.

    The other three are rows of the committed accuracy-versus-time table, each below `PURSUIT` in it.
    """

    #: At the heatmap's own maxima.
    NONE = "none"
    #: On the ridges of the map that the heatmap names.
    RIDGE = "ridge"
    #: On the ridges, then where the complex map makes point echoes likeliest.
    LIKELIHOOD = "likelihood"
    #: At the maxima, then there too.
    MAXIMA_LIKELIHOOD = "maxima_likelihood"
    #: As many peaks as the heatmap's mass is worth: the best on the validation scenes (docs/learned-reconstruction.md).
    PURSUIT = "pursuit"

    @classmethod
    def of(cls, spelling: bool | str) -> Refine:
        """Return what a switch or a word stands for: true is `PURSUIT`, false `NONE`; `ValueError` for another word."""
        if isinstance(spelling, bool):
            return cls.PURSUIT if spelling else cls.NONE
        if spelling not in tuple(cls):
            raise ValueError(f"refine must be a bool or one of {', '.join(cls)}, got {spelling!r}")
        return cls(spelling)


class Detector(Protocol):
    """Finds LOS and mirrored returns in a map."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""


class NetworkDetector:
    """Dense prediction (section 3.1.1): a heatmap of LOS and mirrored returns, then peaks.

    `refine` "pursuit" (True) takes as many peaks as the heatmap's mass is worth. "ridge" takes peaks from the ridges of
    the map that the heatmap names, and the heatmap's own maxima only where the map has no ridge; "likelihood" then
    moves them below the cell on the complex map. "none" (False) are the published local maxima, "maxima_likelihood"
    moves those; both also take networks that answer at anchors. `flip_test`: as `DensePredictor`. `calibrate` turns
    scores into probabilities by the table of the model's card. `params` None: the released settings with the card's
    threshold. Raises ValueError for another word, and where the network's input is too coarse for the set-up's array.
    """

    def __init__(
        self,
        setup: RadarSetup,
        model: Path = DEFAULT_MODEL,
        threads: int = 1,
        params: PeakParams | None = None,
        named: NamedParams | None = None,
        refine: bool | str = Refine.PURSUIT,
        refinement: RefinementParams | None = None,
        calibrate: bool = False,
        flip_test: bool = False,
    ) -> None:
        way = Refine.of(refine)
        self._predictor = DensePredictor(model, threads, flip_test)
        self._predictor.card.encoding.check_array(setup, self._predictor.card.grid)
        self._params = params or PeakParams(threshold=self._predictor.card.threshold_for(way))
        if way is Refine.PURSUIT:
            # the first map should not pay for compiling
            pursued_peaks(np.zeros((1, 1)), self._params.threshold, self._params.pursuit)
        self._named, self._refine = named or NamedParams(), way
        self._name = detector_name(self._predictor.card.sha256, way, flip_test)
        self._refiner = EchoRefiner(setup, refinement) if way in (Refine.LIKELIHOOD, Refine.MAXIMA_LIKELIHOOD) else None
        self._table = self._predictor.card.calibration if calibrate else ()
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        peaks = self._own_peaks(ra_map)
        if self._refiner is not None:
            peaks = refined_peaks(peaks, ra_map, self._refiner)
        peaks = calibrated_peaks(self._table, peaks)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db, detector=self._name)

    def _own_peaks(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Peaks before any refinement on the complex map."""
        if self._refine in (Refine.RIDGE, Refine.LIKELIHOOD):
            return named_peaks(self._predictor.predict(ra_map), ra_map, self._params, self._named)
        if self._refine is Refine.PURSUIT:
            return find_pursued_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        if self._predictor.card.head == "heatmap":
            return find_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        points = self._predictor.points(ra_map, self._params.threshold, self._params.min_distance)
        cells = np.rint(points.cells).astype(np.int64)
        return peaks_at(ra_map, cells, points.cells, points.score, points.path_class, self._params)


def detector_name(sha256: str, way: str, flip_test: bool) -> str:
    """What `Peaks.detector` says of a network's peaks: which file, placed how."""
    return f"{sha256}/{way}{'/flip_test' if flip_test else ''}"


class CfarDetector:
    """No network: constant false alarm rate, and what lies behind a wall is mirrored."""

    def __init__(self, setup: RadarSetup, params: CfarParams | None = None) -> None:
        self._params = params or CfarParams()
        warm(self._params)
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        peaks = cfar_peaks(ra_map, self._params)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db)


class PhotonDetector:
    """The same for maps of a LiDAR: what it would see of an object is not stated, so that nothing counts as observed.

    A radar cross-section says nothing of light.
    """

    def __init__(self, params: CfarParams = PHOTON_CFAR) -> None:
        self._params = params

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Classified peaks of one map."""
        return msgspec.structs.replace(cfar_peaks(ra_map, self._params), sensitivity_db=UNKNOWN_SENSITIVITY_DB)
