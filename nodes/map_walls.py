"""Node `map_walls`: walls of a map about the place that GNSS gives, for the fusion with those of the scans."""

from __future__ import annotations

import logging
from functools import partial

import msgspec

from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import shipped_path
from msgs.values.diagnostics import NodeState
from msgs.values.environment import GnssPose
from nodes.inputs.refusals import Refusals
from nodes.node import Node
from sim_player.maps.map_scene import read_map
from sim_player.maps.map_walls import MapWalls

_LOG = logging.getLogger(__name__)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The map."""

    #: Building footprints: GeoJSON (.geojson, .json; WGS 84) or OpenStreetMap XML (.osm, .xml).
    map: str


class MapWallsNode(Node):
    """vehicle/gnss -> environment/walls."""

    inputs = ("vehicle/gnss",)
    outputs = ("environment/walls",)

    def __init__(self, walls: MapWalls) -> None:
        super().__init__()
        self._walls = walls
        self._refusals = Refusals(_LOG, self.shed)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the walls about the newest place; what cannot be used is refused, counted and logged."""
        poses = [item.message for item in inputs if isinstance(item.message, GnssPose)]
        if not poses:
            return []
        with self.stages("walls"):
            walls = self._refusals.attempt("pose", partial(self._walls.at, poses[-1]))
        return [] if walls is None else [Outgoing("environment/walls", walls)]

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while poses are refused."""
        return self._refusals.health()


def create(params: Params) -> MapWallsNode:
    """Return the node; `ValueError` naming a map that is missing or cannot be read."""
    path = shipped_path(params.map)
    if not path.is_file():
        raise ValueError(f"map: {params.map}: no such file")
    return MapWallsNode(MapWalls(read_map(path)))
