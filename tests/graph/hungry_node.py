"""A node that asks for a lot of memory again and again, touches none of it and gives it back."""

from __future__ import annotations

import msgspec
import numpy as np

from msgs.bus.interface import Outgoing, Received
from nodes.node import Node

PERIOD_NS = 50_000_000


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """None."""


class Hungry(Node):
    """Nobody hears of it."""

    _next_ns = 0

    def due_ns(self, now_ns: int) -> int | None:
        return self._next_ns

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self._next_ns = now_ns + PERIOD_NS
        np.empty(1 << 30, np.uint8)
        return []


def create(params: Params) -> Node:
    return Hungry()
