"""Node `lidar_former`: turns the photon histograms of each scan of a LiDAR into a map on the radar's grid."""

from __future__ import annotations

import logging

import msgspec

from models.perception.forming.photon_map import photon_map
from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import LidarSetup, PhotonHistograms
from msgs.values.wording import counted
from nodes.node import Node

_LOG = logging.getLogger(__name__)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """None: all parameters are in `lidar/setup`."""


class LidarFormerNode(Node):
    """lidar/histograms -> radar/ra_map, which all later stages process as they do a radar's."""

    inputs = ("lidar/setup", "lidar/histograms")
    outputs = ("radar/ra_map",)

    def __init__(self) -> None:
        super().__init__()
        self._setup: LidarSetup | None = None
        self._refused = 0
        self._trouble = ""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one map per scan; histograms that do not fit the set-up are refused, counted and reported."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "lidar/histograms"):
            match received.message:
                case LidarSetup() as setup:
                    self._setup = setup
                case PhotonHistograms() as histograms:
                    out += self._formed(histograms)
        return out

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while histograms are refused or no set-up has come."""
        return (NodeState.DEGRADED, self._trouble) if self._trouble else (NodeState.READY, "")

    def _formed(self, histograms: PhotonHistograms) -> list[Outgoing]:
        try:
            if self._setup is None:
                raise ValueError(f"histograms of scan {histograms.scan_id} came before lidar/setup")
            with self.stages("map"):
                ra_map = photon_map(self._setup, histograms)
        except ValueError as error:
            self._warn_refused(str(error))
            return []
        self._trouble = ""
        return [Outgoing("radar/ra_map", ra_map)]

    def _warn_refused(self, trouble: str) -> None:
        self._refused += 1
        self.shed.add("scan", "refused")
        if trouble != self._trouble:
            _LOG.warning("%s (%s refused so far)", trouble, counted(self._refused, "scan"))
        self._trouble = trouble


def create(params: Params) -> LidarFormerNode:
    """Return the node; it has no parameters."""
    return LidarFormerNode()
