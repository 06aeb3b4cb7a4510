"""From one car's CAN signals to the vehicle state: what a mapping file says."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import msgspec

from models.vehicle.end_to_end import ChecksumRule, CounterRule
from msgs.arrays import require_positive
from msgs.units import ns_from_s

if TYPE_CHECKING:
    from cantools.database.can import Message


#: A day.
LONGEST_PERIOD_MS = 86_400_000


class SignalName(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One signal of the DBC."""

    message: str
    signal: str


class QuantityRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How signals become a quantity in SI units: sign * (scale * mean of the signals + offset)."""

    message: str
    #: Several, like the speeds of four wheels, are averaged.
    signals: tuple[str, ...]
    scale: float = 1.0
    offset: float = 0.0
    #: -1 where the car counts the other way: forward and to the left (counter-clockwise) are positive here.
    sign: Literal[1, -1] = 1
    #: The quantity is turned round while this signal is not zero: a reverse gear, a separate sign bit.
    negative_while: SignalName | None = None
    #: Range in SI units beyond which a value is no measurement; the DBC's own range holds as well.
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.signals:
            raise ValueError("signals must name at least one signal")
        if not (math.isfinite(self.scale) and self.scale != 0.0):
            raise ValueError(f"scale must be finite and not zero, got {self.scale!r}")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset must be finite, got {self.offset!r}")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"low must be below high, both finite, got {self.low!r} and {self.high!r}")

    def to_si(self, values: list[float], negative: bool) -> float:
        """The quantity from the values of its signals."""
        value = self.sign * (self.scale * (sum(values) / len(values)) + self.offset)
        # adding zero makes a standing car stand at 0, not at -0
        return (-value if negative else value) + 0.0

    def from_si(self, value: float) -> tuple[float, bool]:
        """What each signal must say for a quantity, and whether its `negative_while` must be set."""
        negative = self.negative_while is not None and value < 0.0
        return (self.sign * (-value if negative else value) - self.offset) / self.scale, negative


class MessageRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known of a message beside its DBC."""

    #: None: the DBC's cycle time.
    period_s: float | None = None
    checksum: ChecksumRule | None = None
    counter: CounterRule | None = None

    def __post_init__(self) -> None:
        if self.period_s is not None:
            require_positive("period_s", self.period_s)


class CanMapping(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """From one car's signals to the vehicle state."""

    speed: QuantityRule
    yaw_rate: QuantityRule
    steering: QuantityRule | None = None
    messages: dict[str, MessageRule] = {}

    @property
    def quantities(self) -> dict[str, QuantityRule]:
        """Rules by the name of what they give."""
        steering = {} if self.steering is None else {"steering": self.steering}
        return {"speed": self.speed, "yaw rate": self.yaw_rate, **steering}


def period_ns(message: Message, rule: MessageRule) -> int:
    """A message's period; `ValueError` where neither mapping nor DBC has it."""
    if rule.period_s is not None:
        return ns_from_s(rule.period_s)
    # a DBC whose attribute is of another kind gives text
    if not (isinstance(message.cycle_time, int | float) and 0 < message.cycle_time <= LONGEST_PERIOD_MS):
        raise ValueError(f"messages.{message.name}.period_s: must be given, the DBC states no cycle time")
    return round(1_000_000 * message.cycle_time)
