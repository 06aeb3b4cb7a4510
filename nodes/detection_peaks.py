"""Peaks from the detections of a radar that gives no beats."""

from __future__ import annotations

import logging
from functools import partial
from typing import ClassVar

import msgspec

from models.perception.mirrors.peaks_to_view import FORMERLY
from models.perception.target_lists.defaults import DetectionGeometry
from models.perception.target_lists.sensor import DetectionSensor
from models.perception.target_lists.targets_to_peaks import DetectionsStage
from msgs.bus.interface import Outgoing, Received
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import NodeState
from msgs.values.vehicle import VehicleState
from nodes.inputs.refusals import Refusals
from nodes.node import Node

_LOG = logging.getLogger(__name__)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The sensor, and how its walls and images are told."""

    formerly: ClassVar[dict[str, str]] = {
        **{f"geometry.{place}".rstrip("."): module for place, module in FORMERLY.items()},
        "classes": "models.perception.target_lists.classification",
        "sensor": "models.perception.target_lists.sensor",
    }

    sensor: DetectionSensor = DetectionSensor()
    #: Of the walls that images lie behind; the geometry node has its own, `geometry.detections`.
    geometry: DetectionGeometry = DetectionGeometry()

    def __post_init__(self) -> None:
        # what the stage refuses is refused here
        _ = self.geometry.geometry


class DetectionPeaksNode(Node):
    """radar/detections -> perception/peaks; vehicle/state gives the radar's own motion, else the detections do."""

    inputs = ("radar/detections", "vehicle/state")
    outputs = ("perception/peaks",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._stage = DetectionsStage(params.sensor, params.geometry.geometry, self.stages)
        self._refusals = Refusals(_LOG, self.shed)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one set of peaks per measurement; what is of another sensor is refused, counted and logged."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "radar/detections"):
            match received.message:
                case VehicleState() as state:
                    self._stage.add_state(state)
                case RadarDetections() as detections:
                    work = partial(self._stage.peaks, detections)
                    peaks = self._refusals.attempt("scan", work, f"scan {detections.scan_id}")
                    out += [] if peaks is None else [Outgoing("perception/peaks", peaks)]
        return out

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while detections are refused."""
        return self._refusals.health()


def create(params: Params) -> DetectionPeaksNode:
    """Return the node with its parameters."""
    return DetectionPeaksNode(params)
