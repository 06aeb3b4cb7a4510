"""Folds beams as they arrive and publishes the range-azimuth map of each scan."""

from __future__ import annotations

import logging

from models.perception.ra_forming import FormingParams, RaFormer
from msgs.bus import Outgoing, Received
from msgs.diagnostics import NodeState
from msgs.radar import RadarBeam, RadarSetup
from msgs.vehicle import VehicleState
from nodes.node import Node
from nodes.state_history import StateHistory

_LOG = logging.getLogger(__name__)

#: A scan whose next beam has not come for this long is given up and published with what is there.
PATIENCE_NS = 500_000_000


class Params(FormingParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the forming stage; `ego_compensation` takes the vehicle's own motion out."""

    ego_compensation: bool = True


class RaFormerNode(Node):
    """radar/beam -> radar/ra_map."""

    inputs = ("radar/setup", "radar/beam", "vehicle/state")
    outputs = ("radar/ra_map",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params
        # compiles the folding kernel while the graph still waits for this node, not when the first beam does
        RaFormer(RadarSetup(), params)
        self._former: RaFormer | None = None
        self._states = StateHistory()
        self._give_up_ns: int | None = None
        self._refused = 0
        self._trouble = ""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Fold every beam that came; the last of a scan brings its map, a long silence that of an unfinished one."""
        out: list[Outgoing] = []
        # set-up and vehicle state first: what they say holds for the beams that came with them
        for received in sorted(inputs, key=lambda item: item.topic == "radar/beam"):
            match received.message:
                case RadarSetup() as setup:
                    self._former = RaFormer(setup, self._params)
                case VehicleState() as state:
                    self._states.add(state)
                case RadarBeam() as beam:
                    out += self._fold(beam)
                    self._give_up_ns = now_ns + PATIENCE_NS
        if self._former is not None and self._give_up_ns is not None and now_ns >= self._give_up_ns:
            out += [Outgoing("radar/ra_map", ra_map) for ra_map in self._former.flush()]
            self._give_up_ns = None
        return out

    def due_ns(self, now_ns: int) -> int | None:
        """When to stop waiting for the rest of a scan."""
        return self._give_up_ns

    def health(self) -> tuple[NodeState, str]:
        """DEGRADED while beams are refused or no set-up has come."""
        if self._trouble:
            return NodeState.DEGRADED, self._trouble
        return NodeState.READY, ""

    def _fold(self, beam: RadarBeam) -> list[Outgoing]:
        if self._former is None:
            self._say(f"beam {beam.beam_index} of scan {beam.scan_id} came before radar/setup")
            return []
        try:
            with self.stages("last beam" if beam.beam_index == beam.beam_count - 1 else "beam"):
                maps = self._former.add(beam, self._state_for(beam))
        except ValueError as error:
            self._say(str(error))
            return []
        if maps:
            self._trouble = ""
        return [Outgoing("radar/ra_map", ra_map) for ra_map in maps]

    def _state_for(self, beam: RadarBeam) -> VehicleState | None:
        """The newest valid state not younger than the beam; the former keeps that of a scan's first beam for all."""
        state = self._states.at(beam.stamp_ns) if self._params.ego_compensation else None
        return state if state is not None and state.valid else None

    def _say(self, trouble: str) -> None:
        self._refused += 1
        if trouble != self._trouble:
            _LOG.warning("%s (%d beams refused so far)", trouble, self._refused)
        self._trouble = trouble


def create(params: Params) -> RaFormerNode:
    """The node with its parameters."""
    return RaFormerNode(params)
