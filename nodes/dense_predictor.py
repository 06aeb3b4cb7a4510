"""Node `dense_predictor`: finds LOS and mirrored returns in each range-azimuth map."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from models.perception.cards import learned_path
from models.perception.detection.cfar import PHOTON_CFAR, CfarParams
from models.perception.detection.detectors import CfarDetector, Detector, NetworkDetector, PhotonDetector, Refine
from models.perception.detection.onnx_model import DEFAULT_MODEL
from models.perception.detection.peaks import PeakParams
from models.perception.detection.refinement import RefinementParams
from models.perception.detection.ridge_matching import NamedParams
from msgs.bus.interface import Outgoing, Received
from msgs.values.arrays import require_within
from msgs.values.diagnostics import NodeState
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from nodes.node import Node

_LOG = logging.getLogger(__name__)

#: Its square, and sums of squares over a map, are finite in float32.
MAX_AMPLITUDE = 1e15
#: Noise power is zero, which means unknown, or at least this.
NOISE_LIMITS_MW = (1e-60, 1e60)
#: More would take the machine longer to start than any map takes to process.
MAX_THREADS = 256


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Detector and its parameters."""

    method: Literal["network", "cfar"] = "network"
    #: An exported network (FILE.onnx) with its card beside it, or the name of a committed one; None: the default.
    model: str | None = None
    threads: int = 1
    #: Placement of a network's peaks (`models.perception.detection.detectors.Refine`): true is "pursuit", false
    #: "none".
    refine: bool | Refine = True
    refinement: RefinementParams = RefinementParams()
    #: Average the answers to the map and to the map with left and right exchanged.
    flip_test: bool = False
    #: Turn scores into probabilities, by the table of the model's card.
    calibrate: bool = False
    named: NamedParams = NamedParams()
    #: None: the released settings with the threshold of the model's card.
    peaks: PeakParams | None = None
    cfar: CfarParams = CfarParams()
    #: For maps of a LiDAR, which CFAR processes whatever the method: no committed network was trained on any.
    photons: CfarParams = PHOTON_CFAR

    def __post_init__(self) -> None:
        if not 1 <= self.threads <= MAX_THREADS:
            raise ValueError(f"threads must be 1..{MAX_THREADS}, got {self.threads!r}")


class DensePredictorNode(Node):
    """radar/ra_map -> perception/peaks."""

    inputs = ("radar/setup", "radar/ra_map")
    outputs = ("perception/peaks",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params
        # the default set-up until the radar's own arrives: a missing or broken model shows at start, not with a map
        self._detector = detector_for(params, RadarSetup())
        self._photon_detector = PhotonDetector(params.photons)
        self._trouble = ""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one set of peaks per map; unsuitable set-ups and maps are refused, counted and reported."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "radar/ra_map"):
            match received.message:
                case RadarSetup() as setup:
                    self._set_up(setup)
                case RangeAzimuthMap() as ra_map:
                    out += self._detected(ra_map)
        return out

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while maps are refused."""
        return (NodeState.DEGRADED, self._trouble) if self._trouble else (NodeState.READY, "")

    def _set_up(self, setup: RadarSetup) -> None:
        """Use another set-up; an unsuitable one changes nothing."""
        try:
            self._detector = detector_for(self._params, setup)
        except ValueError as error:
            self._warn_refused(str(error), "setup")

    def _detected(self, ra_map: RangeAzimuthMap) -> list[Outgoing]:
        detector = self._photon_detector if ra_map.mode == "photons" else self._detector
        try:
            with self.stages("detect"):
                _require_sound(ra_map)
                peaks = detector.detect(ra_map)
        except ValueError as error:
            self._warn_refused(str(error), "map")
            return []
        self._trouble = ""
        return [Outgoing("perception/peaks", peaks)]

    def _warn_refused(self, trouble: str, kind: str) -> None:
        self.shed.add(kind, "refused")
        if trouble != self._trouble:
            _LOG.warning("%s refused: %s", kind, trouble)
        self._trouble = trouble


def _require_sound(ra_map: RangeAzimuthMap) -> None:
    """Raise `ValueError` for a map with numbers that would spread over their neighbours and have no finite power."""
    largest = float(np.maximum(np.abs(ra_map.values.real), np.abs(ra_map.values.imag)).max())
    if not largest <= MAX_AMPLITUDE:
        raise ValueError(f"map.values must be finite, of at most {MAX_AMPLITUDE:g}, got {largest!r}")
    if ra_map.noise_power_mw:
        require_within("map.noise_power_mw", *NOISE_LIMITS_MW, ra_map.noise_power_mw)


def model_path(model: str | None) -> Path:
    """Return the file of a network from its parameter."""
    return DEFAULT_MODEL if model is None else learned_path(model, ".onnx")


def detector_for(params: Params, setup: RadarSetup) -> Detector:
    """Return the detector of the parameters; raises `ValueError` naming a file that is missing or broken."""
    if params.method == "cfar":
        return CfarDetector(setup, params.cfar)
    return NetworkDetector(
        setup,
        model_path(params.model),
        params.threads,
        params.peaks,
        params.named,
        params.refine,
        params.refinement,
        params.calibrate,
        params.flip_test,
    )


def create(params: Params) -> DensePredictorNode:
    """Return the node with its parameters."""
    return DensePredictorNode(params)
