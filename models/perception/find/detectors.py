"""Detectors of classified peaks in a range-azimuth map, with a network or without, behind one call."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from models.perception.find.cfar import PHOTON_CFAR, CfarParams, cfar_peaks, warm
from models.perception.find.onnx_model import DEFAULT_MODEL, DensePredictor
from models.perception.find.peaks import PeakParams, find_peaks, find_pursued_peaks, peaks_at
from models.perception.find.pursuit import pursued_peaks
from models.perception.mirrors.observability import UNKNOWN_SENSITIVITY_DB, sensitivity_db
from models.perception.trained_radar import SetupCheck
from msgs.values.perception import UNTRAINED_SETUP, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap


class Refine(StrEnum):
    """Placement of a network's peaks: `PURSUIT`, or the published local maxima of the heatmap."""

    NONE = "none"
    #: As many peaks as the heatmap's mass explains: the best on the validation scenes (docs/results/README.md).
    PURSUIT = "pursuit"

    @classmethod
    def _missing_(cls, value: object) -> Refine | None:
        """Read the placements on ridges and by likelihood of earlier files, which lost, as `PURSUIT`."""
        return cls.PURSUIT if value in ("ridge", "likelihood", "maxima_likelihood") else None

    @classmethod
    def of(cls, spelling: bool | str) -> Refine:
        """Return the placement of a switch or a word (true: `PURSUIT`, false: `NONE`); `ValueError` for others."""
        if isinstance(spelling, bool):
            return cls.PURSUIT if spelling else cls.NONE
        try:
            return cls(spelling)
        except ValueError:
            raise ValueError(f"refine must be a bool or one of {', '.join(cls)}, got {spelling!r}") from None


class Detector(Protocol):
    """Finds LOS and mirrored returns in a map."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""


class NetworkDetector:
    """Dense prediction (section 3.1.1): a heatmap of LOS and mirrored returns, then peaks.

    `refine` "pursuit" (True) takes as many peaks as the heatmap's mass explains; "none" (False) the published maxima.
    `flip_test`: as `DensePredictor`. Peaks of a radar unlike the one in training are flagged "untrained_setup", and
    `doubt` says why. `ValueError` for another word, and where the input is too coarse for the array.
    """

    def __init__(
        self,
        setup: RadarSetup,
        model: Path = DEFAULT_MODEL,
        threads: int = 1,
        params: PeakParams | None = None,
        refine: bool | str = Refine.PURSUIT,
        flip_test: bool = False,
    ) -> None:
        placement = Refine.of(refine)
        self._predictor = DensePredictor(model, threads, flip_test)
        self._predictor.card.encoding.check_array(setup, self._predictor.card.grid)
        self._params = params or PeakParams(threshold=self._predictor.card.threshold_for(placement))
        if placement is Refine.PURSUIT:
            # compile now: the first map must not wait for it
            pursued_peaks(np.zeros((1, 1), np.float32), self._params.threshold)
        self._refine = placement
        self._name = f"{self._predictor.card.sha256}/{placement}{'/flip_test' if flip_test else ''}"
        self._sensitivity_db = sensitivity_db(setup)
        self._check = SetupCheck(self._predictor.card.name, self._predictor.card.radar, setup)
        #: How the radar of the last map differs from the one in training; empty: not at all.
        self.doubt = self._check.doubt()

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""
        self.doubt = self._check.doubt(ra_map.unused_beams)
        peaks = self._own_peaks(ra_map)
        faults = (*peaks.faults, UNTRAINED_SETUP) if self.doubt else peaks.faults
        return msgspec.structs.replace(peaks, sensitivity_db=self._sensitivity_db, detector=self._name, faults=faults)

    def _own_peaks(self, ra_map: RangeAzimuthMap) -> Peaks:
        if self._refine is Refine.PURSUIT:
            return find_pursued_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        if self._predictor.card.head == "heatmap":
            return find_peaks(self._predictor.predict(ra_map), ra_map, self._params)
        points = self._predictor.points(ra_map, self._params.threshold, self._params.min_distance)
        cells = np.rint(points.cells).astype(np.int64)
        return peaks_at(ra_map, cells, points.cells, points.score, points.path_class, self._params)


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
    """CFAR detector for maps of a LiDAR, without a stated sensitivity, so that nothing counts as observed."""

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the classified peaks of one map."""
        return msgspec.structs.replace(cfar_peaks(ra_map, PHOTON_CFAR), sensitivity_db=UNKNOWN_SENSITIVITY_DB)
