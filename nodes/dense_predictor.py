"""Finds LOS and mirrored returns in each range-azimuth map."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from models.perception.cards import learned_path
from models.perception.cfar import CfarParams
from models.perception.detectors import CfarDetector, Detector, NetworkDetector, Refine
from models.perception.named import NamedParams
from models.perception.onnx_model import DEFAULT_MODEL
from models.perception.peaks import PeakParams
from models.perception.refinement import RefinementParams
from msgs.bus import Outgoing, Received
from msgs.radar import RadarSetup, RangeAzimuthMap
from nodes.node import Node


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which detector, and its parameters."""

    method: Literal["network", "cfar"] = "network"
    #: An exported network (FILE.onnx) with its card beside it, or the name of a committed one; None: the default.
    model: str | None = None
    threads: int = 1
    #: How a network's peaks are placed (`models.perception.detectors.Refine`): true is "pursuit", false "none".
    refine: bool | Refine = True
    refinement: RefinementParams = RefinementParams()
    #: The mean answer to the map and to the map with left and right exchanged.
    flip_test: bool = False
    #: Scores become probabilities, by the table of the model's card.
    calibrate: bool = False
    named: NamedParams = NamedParams()
    #: None: the released settings with the threshold of the model's card.
    peaks: PeakParams | None = None
    cfar: CfarParams = CfarParams()


class DensePredictorNode(Node):
    """radar/ra_map -> perception/peaks."""

    inputs = ("radar/setup", "radar/ra_map")
    outputs = ("perception/peaks",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params
        # the default set-up until the radar's own comes: a missing or broken model shows at start, not at the first map
        self._detector = detector_for(params, RadarSetup())

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """One set of peaks per map."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "radar/ra_map"):
            match received.message:
                case RadarSetup() as setup:
                    self._detector = detector_for(self._params, setup)
                case RangeAzimuthMap() as ra_map:
                    with self.stages("detect"):
                        out.append(Outgoing("perception/peaks", self._detector.detect(ra_map)))
        return out


def model_path(model: str | None) -> Path:
    """The file of a network as parameters name it."""
    return DEFAULT_MODEL if model is None else learned_path(model, ".onnx")


def detector_for(params: Params, setup: RadarSetup) -> Detector:
    """The detector that parameters name; raises `ValueError` naming a file that is missing or broken."""
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
    """The node with its parameters."""
    return DensePredictorNode(params)
