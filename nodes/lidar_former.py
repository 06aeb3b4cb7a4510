"""Forming of the photon histograms of each scan of a LiDAR into a map on the radar's grid."""

from __future__ import annotations

import logging
from functools import partial

import msgspec

from models.perception.form.photon_map import PhotonFormer
from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import LidarSetup, PhotonHistograms
from nodes.inputs.refusals import Refusals
from nodes.node import Node

_LOG = logging.getLogger(__name__)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """None: all that matters is in `lidar/setup`."""


class LidarFormerNode(Node):
    """lidar/histograms -> radar/ra_map, on which all that follows works as it does for radars."""

    inputs = ("lidar/setup", "lidar/histograms")
    outputs = ("radar/ra_map",)

    def __init__(self) -> None:
        super().__init__()
        self._former = PhotonFormer(self.stages)
        self._refusals = Refusals(_LOG, self.shed, "scan")

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one map per scan; what does not fit the set-up is refused, counted and logged."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "lidar/histograms"):
            match received.message:
                case LidarSetup() as setup:
                    self._former.set_up(setup)
                case PhotonHistograms() as histograms:
                    ra_map = self._refusals.attempt("scan", partial(self._former.add, histograms))
                    out += [] if ra_map is None else [Outgoing("radar/ra_map", ra_map)]
        return out

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while histograms are refused or no set-up has come."""
        return self._refusals.health()


def create(params: Params) -> LidarFormerNode:
    """Return the node; it has no parameters."""
    return LidarFormerNode()
