"""Detectors of classified peaks in a range-azimuth map, with a network or without, behind one call."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol, get_args

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

#: Placement of a network's peaks. "none": at the maxima of the heatmap. "ridge": on the ridges of the map.
#: "likelihood": on the ridges, then moved to the likeliest positions of point echoes on the complex map.
#: "maxima_likelihood": at the maxima, then moved likewise. "pursuit": as many peaks as the heatmap's mass is worth.
Refine = Literal["none", "ridge", "likelihood", "maxima_likelihood", "pursuit"]
#: Placement that `True` stands for: the best on the validation scenes (docs/results/learned.md).
DEFAULT_REFINE: Refine = "pursuit"


class Detector(Protocol):
    """Finds LOS and mirrored returns in a map."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""


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
        ridge_matching: NamedParams | None = None,
        refine: bool | Refine = True,
        refinement: RefinementParams | None = None,
        calibrate: bool = False,
        flip_test: bool = False,
    ) -> None:
        placement = refine_way(refine)
        self._predictor = DensePredictor(model, threads, flip_test)
        self._predictor.card.encoding.check_array(setup, self._predictor.card.grid)
        self._params = params or PeakParams(threshold=self._predictor.card.threshold_for(placement))
        if placement == "pursuit":
            # compile now: the first map must not wait for it
            pursued_peaks(np.zeros((1, 1)), self._params.threshold, self._params.pursuit)
        self._ridge_matching, self._refine = ridge_matching or NamedParams(), placement
        self._name = detector_name(self._predictor.card.sha256, placement, flip_test)
        self._refiner = EchoRefiner(setup, refinement) if placement.endswith("likelihood") else None
        self._table = self._predictor.card.calibration if calibrate else ()
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""
        peaks = self._own_peaks(ra_map)
        if self._refiner is not None:
            peaks = refined_peaks(peaks, ra_map, self._refiner)
        peaks = calibrated_peaks(self._table, peaks)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db, detector=self._name)

    def _own_peaks(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the peaks before any refinement on the complex map."""
        if self._refine in ("ridge", "likelihood"):
            return named_peaks(self._predictor.predict(ra_map), ra_map, self._params, self._ridge_matching)
        if self._refine == "pursuit":
            return find_pursued_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        if self._predictor.card.head == "heatmap":
            return find_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        points = self._predictor.points(ra_map, self._params.threshold, self._params.min_distance)
        cells = np.rint(points.cells).astype(np.int64)
        return peaks_at(ra_map, cells, points.cells, points.score, points.path_class, self._params)


def detector_name(sha256: str, placement: Refine, flip_test: bool) -> str:
    """Return the value of `Peaks.detector` for a network: its file and the placement of its peaks."""
    return f"{sha256}/{placement}{'/flip_test' if flip_test else ''}"


def refine_way(refine: bool | Refine) -> Refine:
    """Return the placement that a switch or a word stands for; raises ValueError for another word."""
    if isinstance(refine, bool):
        return DEFAULT_REFINE if refine else "none"
    if refine not in get_args(Refine):
        raise ValueError(f"refine must be a bool or one of {', '.join(get_args(Refine))}, got {refine!r}")
    return refine


class CfarDetector:
    """Detector without a network: constant false alarm rate; returns behind a wall are classified as mirrored."""

    def __init__(self, setup: RadarSetup, params: CfarParams | None = None) -> None:
        self._params = params or CfarParams()
        warm(self._params)
        self._sensitivity_db = sensitivity_db(setup)

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""
        peaks = cfar_peaks(ra_map, self._params)
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db)


class PhotonDetector:
    """CFAR detector for maps of a LiDAR, without a stated sensitivity, so that nothing counts as observed.

    A radar cross-section says nothing about light.
    """

    def __init__(self, params: CfarParams = PHOTON_CFAR) -> None:
        self._params = params

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""
        return msgspec.structs.replace(cfar_peaks(ra_map, self._params), sensitivity_db=UNKNOWN_SENSITIVITY_DB)
