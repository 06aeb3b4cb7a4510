"""Folds mirror images back through their walls and publishes the bird's-eye view."""

from __future__ import annotations

from models.perception.geometry import GeometryParams, recover_bev
from msgs.bus import Outgoing, Received
from msgs.perception import Peaks
from nodes.node import Node


class Params(GeometryParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the geometry stage."""


class GeometryNode(Node):
    """perception/peaks -> perception/hidden_objects."""

    inputs = ("perception/peaks",)
    outputs = ("perception/hidden_objects",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """One view per set of peaks."""
        out = []
        for received in inputs:
            assert isinstance(received.message, Peaks)  # the only input
            with self.stages("geometry"):
                out.append(Outgoing("perception/hidden_objects", recover_bev(received.message, self._params)))
        return out


def create(params: Params) -> GeometryNode:
    """The node with its parameters."""
    return GeometryNode(params)
