"""Two light nodes that stand for the graph's head and tail: peaks ten times a second, and a view for each."""

from __future__ import annotations

import msgspec

from msgs.bus.interface import Outgoing, Received
from msgs.values.perception import BevFrame, Peaks
from nodes.node import Node
from tests.builders import example_view, peaks_at

PERIOD_NS = 100_000_000


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    head: bool = True


def peaks(stamp_ns: int, scan_id: int) -> Peaks:
    return peaks_at((), stamp_ns=stamp_ns, scan_id=scan_id)


class Head(Node):
    outputs = ("perception/peaks",)

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self.next_ns: int | None = None

    def due_ns(self, now_ns: int) -> int:
        self.next_ns = self.next_ns or now_ns
        return self.next_ns

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.next_ns = now_ns + PERIOD_NS
        self.count += 1
        return [Outgoing("perception/peaks", peaks(now_ns, self.count))]


class Tail(Node):
    inputs = ("perception/peaks",)
    outputs = ("perception/hidden_objects",)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        return [Outgoing("perception/hidden_objects", self.view(each.message)) for each in inputs]

    @staticmethod
    def view(found: msgspec.Struct) -> BevFrame:
        assert isinstance(found, Peaks)
        return example_view(stamp_ns=found.stamp_ns, scan_id=found.scan_id)


def create(params: Params) -> Node:
    return Head() if params.head else Tail()
