"""Mapping file: from one car's CAN signals to the vehicle state."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Literal

import msgspec

from models.vehicle.end_to_end import ChecksumRule, CounterRule
from models.vehicle.signal_units import Dimension, known_units, parse_unit
from msgs.values.units import ns_from_s

if TYPE_CHECKING:
    from cantools.database.can import Message


#: No bus sends frames faster than each microsecond; the longest period is a day.
SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 1e-6, 86_400.0


class DbcRange(StrEnum):
    """Interpretation of the range that a DBC gives a signal."""

    #: In the signal's unit, or in raw counts if it can only be that.
    AUTO = "auto"
    #: In the signal's unit, as the format defines it.
    PHYSICAL = "physical"
    #: In raw counts, before scale and offset of the DBC.
    RAW = "raw"
    #: Ignored: `low` and `high` of the mapping alone hold.
    IGNORE = "ignore"


class SignRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The signal of the DBC that states when a quantity is negative."""

    message: str
    signal: str
    #: Numbers of the signal that mean negative; empty: every number but zero.
    values: tuple[int, ...] = ()

    def is_negative(self, value: float | None) -> bool:
        """Return whether the signal's number means negative."""
        return value is not None and (value in self.values if self.values else bool(value))

    @property
    def negative_value(self) -> int:
        """A number of the signal that means negative."""
        return self.values[0] if self.values else 1


class QuantityRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Conversion of signals to a quantity in SI units: sign * (scale * mean or sum of the signals + offset)."""

    message: str
    signals: tuple[str, ...]
    #: Several signals are averaged, like the speeds of four wheels, or summed, like an angle and its fraction.
    combine: Literal["mean", "sum"] = "mean"
    #: Unit of the signals, such as km/h or deg/s; None: the DBC's.
    unit: str | None = None
    #: Factor to SI units, within 10 % of that of the unit; None: that of the unit.
    scale: float | None = None
    #: In SI units.
    offset: float = 0.0
    #: -1 if the car counts in the other direction: forward and to the left (counter-clockwise) are positive here.
    sign: Literal[1, -1] = 1
    #: The sign of the quantity is reversed while this signal says so: a reverse gear, a separate sign bit.
    negative_while: SignRule | None = None
    dbc_range: DbcRange = DbcRange.AUTO
    #: Range in SI units beyond which a value is invalid; the DBC's own range holds as well.
    low: float
    high: float

    def __post_init__(self) -> None:
        require_signals("signals", self.signals)
        require_conversion(self.unit, self.scale)
        if not math.isfinite(self.offset):
            raise ValueError(f"offset must be finite, got {self.offset!r}")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"low must be below high, both finite, got {self.low!r} and {self.high!r}")


class WheelSpeedsRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Speeds of the wheels of the left and of the right side, one message: they show the bias of the yaw rate."""

    message: str
    #: Several of a side are averaged.
    left: tuple[str, ...]
    right: tuple[str, ...]
    unit: str | None = None
    scale: float | None = None
    #: As of a quantity: the reverse gear, for wheels whose speed has no sign.
    negative_while: SignRule | None = None
    dbc_range: DbcRange = DbcRange.AUTO
    low: float = -100.0
    high: float = 100.0

    def __post_init__(self) -> None:
        require_signals("left", self.left)
        require_signals("right", self.right)
        # the other rules are those of a quantity
        self.side(self.left)

    def side(self, signals: tuple[str, ...]) -> QuantityRule:
        """Return the rule of one side's speed."""
        return QuantityRule(
            message=self.message, signals=signals, unit=self.unit, scale=self.scale,
            negative_while=self.negative_while, dbc_range=self.dbc_range, low=self.low, high=self.high,
        )  # fmt: skip


def require_signals(name: str, signals: tuple[str, ...]) -> None:
    """Raise `ValueError` unless a field names signals, each once."""
    if not signals:
        raise ValueError(f"{name} must name at least one signal")
    if len(set(signals)) != len(signals):
        raise ValueError(f"{name} must name each signal once, got {', '.join(signals)}")


def require_conversion(unit: str | None, scale: float | None) -> None:
    """Raise `ValueError` for an unknown unit and for an invalid scale."""
    if unit is not None and parse_unit(unit) is None:
        units = ", ".join(known_units(dimension) for dimension in Dimension)
        raise ValueError(f"unit must be one of {units}, got {unit!r}")
    if scale is not None and not (math.isfinite(scale) and scale != 0.0):
        raise ValueError(f"scale must be finite and not zero, got {scale!r}")


class MessageRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Properties of a message that its DBC does not state."""

    #: None: the DBC's cycle time.
    period_s: float | None = None
    checksum: ChecksumRule | None = None
    counter: CounterRule | None = None

    def __post_init__(self) -> None:
        if self.period_s is not None and not SHORTEST_PERIOD_S <= self.period_s <= LONGEST_PERIOD_S:
            minimum, maximum = SHORTEST_PERIOD_S, LONGEST_PERIOD_S
            raise ValueError(f"period_s must be {minimum:g}..{maximum:g} s, got {self.period_s!r}")


class CanMapping(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Mapping of one car's signals to the vehicle state."""

    speed: QuantityRule
    yaw_rate: QuantityRule
    steering: QuantityRule | None = None
    wheel_speeds: WheelSpeedsRule | None = None
    messages: dict[str, MessageRule] = {}

    @property
    def quantities(self) -> dict[str, QuantityRule]:
        """Rules by the name of their quantity."""
        steering = {} if self.steering is None else {"steering": self.steering}
        return {"speed": self.speed, "yaw rate": self.yaw_rate, **steering}


def period_ns(message: Message, rule: MessageRule) -> int:
    """Return a message's period; `ValueError` if neither mapping nor DBC states it."""
    if rule.period_s is not None:
        return ns_from_s(rule.period_s)
    # a DBC whose attribute has another type gives text
    if not (isinstance(message.cycle_time, int | float) and 0 < message.cycle_time <= 1e3 * LONGEST_PERIOD_S):
        raise ValueError(f"messages.{message.name}.period_s: must be given, the DBC states no cycle time")
    return round(1_000_000 * message.cycle_time)
