"""A node that publishes small views, ten a second: stands in for a whole graph before the viewer."""

from __future__ import annotations

import msgspec

from msgs.bus.interface import Outgoing, Received
from nodes.node import Node
from tests.builders import example_view

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
        return [Outgoing("perception/hidden_objects", example_view(stamp_ns=now_ns, scan_id=self._scan))]


def create(params: Params) -> Views:
    return Views()
