"""A node that can start only with a file that is there."""

from __future__ import annotations

from pathlib import Path

import msgspec

from msgs.bus.interface import Outgoing, Received
from nodes.node import Node


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    path: str = "/dev/null"
    rate_hz: float = 1.0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0.0:
            raise ValueError(f"rate_hz must be above zero, got {self.rate_hz!r}")


class FileReader(Node):
    outputs = ("vehicle/state",)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        return []


def create(params: Params) -> FileReader:
    Path(params.path).read_bytes()
    return FileReader()
