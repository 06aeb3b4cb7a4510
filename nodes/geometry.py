"""Node `geometry`: folds mirror images back through their walls and publishes the bird's-eye view."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec

from models.perception.cards import learned_path
from models.perception.geometry.confidence import DEFAULT_CONFIDENCE, Confidence, FittedConfidences, load_confidence
from models.perception.geometry.recovery import Residual
from models.perception.geometry.stage import GeometryParams, recover_bev, warm
from models.perception.tracking.scan_state import MemoryParams, ScanMemory
from models.perception.tracking.yaw_rate_bias import BiasEstimate, BiasSource
from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import WEIGHTS
from msgs.values.diagnostics import NodeState
from msgs.values.perception import BevFrame, Peaks
from msgs.values.vehicle import VehicleState
from nodes.inputs.state_history import StateHistory
from nodes.node import Node

_LOG = logging.getLogger(__name__)

#: After this much driving without a bias of the yaw rate the node logs the reason.
BIAS_OVERDUE_S = 30.0


class Params(GeometryParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the geometry stage."""

    #: An exported residual network with its card beside it; `none`: the mirror law alone.
    residual: str = "none"
    #: A fitted `PlaceConfidence`, used for peaks of the detector it was fitted on; `auto`: the committed one that was
    #: fitted on the peaks' detector, none for peaks of another; `default`: that of the committed network;
    #: `none`: all positions are kept, with the scores of their peaks.
    confidence: str = "none"
    #: State that is kept from scan to scan: odometry, tracks, walls.
    memory: MemoryParams = MemoryParams()


class GeometryNode(Node):
    """perception/peaks -> perception/hidden_objects, with tracks and the vehicle's motion at the time of the scan."""

    inputs = ("perception/peaks", "vehicle/state")
    outputs = ("perception/hidden_objects",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        # loaded here: a missing or broken file shows at start, not at the first scan
        self._parts = parts_of(params)
        warm(params)
        self._states = StateHistory()
        self._memory = ScanMemory(params.memory)
        self._trouble = ""
        self._bias_source: BiasSource | None = None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one view per set of peaks; unsuitable peaks are refused, counted and reported."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "perception/peaks"):
            match received.message:
                case VehicleState() as state:
                    self._states.add(state)
                    self._memory.add(state)
                case Peaks() as peaks:
                    out += self._seen(peaks)
        return out

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while peaks are refused."""
        return (NodeState.DEGRADED, self._trouble) if self._trouble else (NodeState.READY, "")

    def _seen(self, peaks: Peaks) -> list[Outgoing]:
        try:
            view = self._view(peaks)
        except ValueError as error:
            self.shed.add("scan", "refused")
            if str(error) != self._trouble:
                _LOG.warning("scan %d refused: %s", peaks.scan_id, error)
            self._trouble = str(error)
            return []
        self._trouble = ""
        return [Outgoing("perception/hidden_objects", view)]

    def _view(self, peaks: Peaks) -> BevFrame:
        with self.stages("geometry"):
            view = recover_bev(peaks, *self._parts, self._memory.walls_at(peaks))
        with self.stages("tracking"):
            view = self._memory.tracked(view, peaks.vehicle_from_radar)
        self._note(self._memory.yaw_rate_bias)
        return msgspec.structs.replace(view, ego=self._states.at(peaks.stamp_ns))

    def _note(self, bias: BiasEstimate) -> None:
        """Log the source of the bias of the yaw rate, whenever that changes."""
        is_unknown = bias.source is BiasSource.NONE
        if bias.source == self._bias_source or (is_unknown and bias.driven_s < BIAS_OVERDUE_S):
            return
        self._bias_source = bias.source
        _LOG.log(logging.WARNING if is_unknown else logging.INFO, "%s", bias)


def parts_of(params: Params) -> tuple[GeometryParams, Residual | None, Confidence | None]:
    """Return the inputs of the stage beside the peaks; raises `ValueError` naming a missing or broken file."""
    residual = None if params.residual == "none" else _learned_residual(Path(params.residual))
    fitted = tuple(load_confidence(path) for path in confidence_paths(params.confidence))
    if params.confidence == "auto":
        return params, residual, FittedConfidences(fitted)
    return params, residual, fitted[0] if fitted else None


def _learned_residual(path: Path) -> Residual:
    # imported here: without a network this node starts faster by the import of its runtime
    from models.perception.geometry.residual_model import LearnedResidual

    return LearnedResidual(path)


def confidence_paths(confidence: str) -> list[Path]:
    """Return the files of fitted models of the parameter."""
    if confidence == "none":
        return []
    if confidence == "auto":
        return sorted(WEIGHTS.glob("*.confidence.json"))
    return [DEFAULT_CONFIDENCE if confidence == "default" else learned_path(confidence, ".json")]


def create(params: Params) -> GeometryNode:
    """Return the node with its parameters."""
    return GeometryNode(params)
