"""A node that publishes small views, ten a second: stands in for a whole graph before the viewer."""

from __future__ import annotations

import msgspec
import numpy as np

from msgs.bus.interface import Outgoing, Received
from msgs.values.perception import BevFrame, BevGrid
from nodes.node import Node

PERIOD_NS = 100_000_000


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class Views(Node):
    outputs = ("perception/hidden_objects",)

    def __init__(self) -> None:
        super().__init__()
        self._scan = 0
        self._due_ns = 0

    def due_ns(self, now_ns: int) -> int:
        self._due_ns = self._due_ns or now_ns
        return self._due_ns

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self._due_ns = now_ns + PERIOD_NS
        self._scan += 1
        grid = BevGrid(rows=8, columns=8)
        view = BevFrame(
            stamp_ns=now_ns,
            scan_id=self._scan,
            grid=grid,
            visibility=np.zeros((8, 8), np.uint8),
            los_points_m=np.zeros((0, 2), np.float32),
        )
        return [Outgoing("perception/hidden_objects", view)]


def create(params: Params) -> Views:
    return Views()
