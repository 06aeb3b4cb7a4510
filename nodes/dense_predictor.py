"""Detection of LOS and mirrored returns in each range-azimuth map."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import msgspec

from models.perception.cards import learned_path
from models.perception.find.cfar import CfarParams
from models.perception.find.detectors import CfarDetector, Detector, NetworkDetector, Refine
from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.find.onnx_model import DEFAULT_MODEL
from models.perception.find.ridges import RidgeParams
from models.perception.timing import Timed
from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from nodes.inputs.refusals import Refusals
from nodes.node import Node
from nodes.process.machine import integer_kernels

_LOG = logging.getLogger(__name__)

#: More would take the machine longer to start than any map to detect in.
MAX_THREADS = 256


class Ridges(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Side lobes of the array."""

    #: What is weaker than a stronger return by this much, within three range bins, is its azimuth lobe.
    azimuth_lobe_db: float = RidgeParams().azimuth_lobe_db


class Cfar(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Detection at a constant false alarm rate."""

    false_alarm_rate: float = CfarParams().false_alarm_rate
    ridges: Ridges = Ridges()


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Choice of the detector, and its parameters."""

    formerly: ClassVar[dict[str, str]] = {
        "threshold": "models.perception.find.detectors",
        "cfar": "models.perception.find.cfar",
        "cfar.kind": "models.perception.find.cfar",
        "cfar.ridges": "models.perception.find.ridges",
        "cfar.peaks": "models.perception.find.peaks",
    }

    method: Literal["network", "cfar"] = "network"
    #: An exported network (FILE.onnx) with its card beside it, or the name of a committed one; None: the default.
    model: str | None = None
    threads: int = 1
    #: How a network's peaks are placed (`models.perception.find.detectors.Refine`): true is "pursuit", false
    #: "none".
    refine: bool | Refine = True
    #: The mean answer to the map and to the map with left and right exchanged.
    flip_test: bool = False
    cfar: Cfar = Cfar()

    def __post_init__(self) -> None:
        # what the detector refuses is refused here
        _ = self.cfar_params
        if not 1 <= self.threads <= MAX_THREADS:
            raise ValueError(f"threads must be 1..{MAX_THREADS}, got {self.threads!r}")

    @property
    def cfar_params(self) -> CfarParams:
        """Parameters of the detector without a network."""
        ridges = RidgeParams(azimuth_lobe_db=self.cfar.ridges.azimuth_lobe_db)
        return CfarParams(false_alarm_rate=self.cfar.false_alarm_rate, ridges=ridges)


class DensePredictorNode(Node):
    """radar/ra_map -> perception/peaks."""

    inputs = ("radar/setup", "radar/ra_map")
    outputs = ("perception/peaks",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        # the default set-up until the radar's own comes: a missing or broken model shows at start, not at the first map
        self._stage = detection_stage(params, self.stages)
        self._setup: RadarSetup | None = None
        self._refusals = Refusals(_LOG, self.shed)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one set of peaks per map; set-ups and maps that do not suit the detector are refused and counted."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "radar/ra_map"):
            match received.message:
                case RadarSetup() as setup:
                    self._set_up(setup)
                case RangeAzimuthMap() as ra_map:
                    peaks = self._refusals.attempt("map", partial(self._stage.detect, ra_map))
                    out += [] if peaks is None else [Outgoing("perception/peaks", peaks)]
        return out

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while maps are refused, and of a radar that the network was not trained for."""
        if not self._refusals.reason and self._setup is not None and self._stage.doubt:
            return NodeState.DEGRADED, self._stage.doubt
        return self._refusals.health()

    def change_params(self, params: Params) -> None:
        """Detect by other parameters from the next map on."""
        stage = detection_stage(params, self.stages)
        if self._setup is not None:
            stage.set_up(self._setup)
        self._stage = stage

    def _set_up(self, setup: RadarSetup) -> None:
        """Detect by another set-up; one that cannot be used changes nothing."""
        try:
            self._stage.set_up(setup)
            self._setup = setup
        except ValueError as error:
            self._refusals.refuse("setup", error)


def detection_stage(params: Params, timed: Timed = nullcontext) -> DetectionStage:
    """Return the stage that parameters name; errors as `detector_for`."""
    return DetectionStage(partial(detector_for, params), timed)


def model_path(model: str | None) -> Path:
    """Return the file of a network as parameters name it."""
    return DEFAULT_MODEL if model is None else learned_path(model)


def detector_for(params: Params, setup: RadarSetup) -> Detector:
    """Return the detector that parameters name; raises `ValueError` naming a file that is missing or broken."""
    if params.method == "cfar":
        return CfarDetector(setup, params.cfar_params)
    return NetworkDetector(
        setup,
        model_path(params.model),
        params.threads,
        refine=params.refine,
        flip_test=params.flip_test,
    )


def create(params: Params) -> DensePredictorNode:
    """Return the node with its parameters."""
    if params.method == "network":
        _LOG.info("int8 networks run on %s", integer_kernels())
    return DensePredictorNode(params)


#: The node opens its network and nothing else; what the log says of a start is not said here.
check = DensePredictorNode
