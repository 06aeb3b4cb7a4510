"""A node that can be told to tick, pause, echo, crash or hang: stands in for every node of a graph."""

from __future__ import annotations

import os
import time

import msgspec

from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.vehicle import VehicleState
from nodes.node import Node


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    kind: str = "tick"
    period_s: float = 0.02
    ticks: int = 0
    after_s: float = 0.0
    start_s: float = 0.0
    text: str = ""


class Tick(Node):
    """Publishes `vehicle/state` every `period_s`; after `ticks` of them, if given, it is finished."""

    outputs = ("vehicle/state",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self.params = params
        self.count = 0
        self.next_ns: int | None = None

    def due_ns(self, now_ns: int) -> int | None:
        if self.next_ns is None:
            self.next_ns = now_ns
        return self.next_ns

    def finished(self) -> bool:
        return 0 < self.params.ticks <= self.count

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        assert self.next_ns is not None
        with self.stages("tick"):
            self.next_ns += int(1e9 * self.params.period_s)
            self.count += 1
        return [Outgoing("vehicle/state", VehicleState(stamp_ns=now_ns, speed_mps=float(self.count % 1000)))]


class Crash(Tick):
    """Raises after `after_s`."""

    outputs = ()

    def due_ns(self, now_ns: int) -> int | None:
        if self.next_ns is None:
            self.next_ns = now_ns + int(1e9 * self.params.after_s)
        return self.next_ns

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        raise RuntimeError("the toy is broken")


class Hang(Crash):
    """Stops turning after `after_s` and takes no notice of SIGINT or SIGTERM."""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        while True:
            time.sleep(3600.0)


class Busy(Crash):
    """Works without end after `after_s` and takes no notice of SIGINT or SIGTERM."""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        while True:
            pass


class Pause(Tick):
    """Does nothing for `after_s` in every step."""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        time.sleep(self.params.after_s)
        return super().step(inputs, now_ns)


class Echo(Node):
    """Answers each `vehicle/state` that is not its own with the doubled speed."""

    inputs = ("vehicle/state",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self.total = 0.0

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.total += sum(received.message.speed_mps for received in inputs)
        return []

    def health(self) -> tuple[NodeState, str]:
        return NodeState.DEGRADED, f"sum {self.total:g}"


class Undeclared(Tick):
    """Publishes what it did not announce."""

    outputs = ()


KINDS = {
    "tick": Tick,
    "pause": Pause,
    "echo": Echo,
    "crash": Crash,
    "hang": Hang,
    "busy": Busy,
    "undeclared": Undeclared,
}


def create(params: Params) -> Node:
    if params.kind not in KINDS:
        raise ValueError(f"toy.kind must be one of {', '.join(KINDS)}, got {params.kind!r}")
    time.sleep(params.start_s)
    if params.text:
        os.write(1, params.text.encode())
    return KINDS[params.kind](params)
