"""A simulated car: the frames on its CAN bus while it moves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from models.vehicle.can_decoder import DIMENSIONS
from models.vehicle.can_mapping import CanMapping, MessageRule, QuantityRule, period_ns
from models.vehicle.end_to_end import checksum_byte, checksum_of, counter_modulus
from models.vehicle.quantity import Quantity
from models.vehicle.signal_units import Dimension
from msgs.values.vehicle import VehicleState

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message


#: A passenger car: wheelbase, and from the left to the right wheels.
WHEELBASE_M, TRACK_M = 2.7, 1.55
#: Angle of the steering wheel by angle of the front wheels, and the steering wheel's stop.
STEERING_RATIO, MAX_STEERING_RAD = 15.0, 9.0


def steering_rad(speed_mps: float, yaw_rate_rps: float) -> float:
    """Return the steering wheel's angle of a car that rolls without slip, left positive; straight at standstill."""
    if speed_mps == 0.0:
        return 0.0
    angle_rad = STEERING_RATIO * math.atan(WHEELBASE_M * yaw_rate_rps / speed_mps)
    return max(-MAX_STEERING_RAD, min(MAX_STEERING_RAD, angle_rad))


class CarFrame(NamedTuple):
    """One frame on the car's bus."""

    arbitration_id: int
    data: bytes
    extended: bool


class SimulatedCar:
    """Sender of every message of a mapping at its period, with counters and checksums; `ValueError` as it disagrees."""

    def __init__(self, database: Database, mapping: CanMapping, start_ns: int = 0) -> None:
        by_name = {message.name: message for message in database.messages}
        quantities = _rules(mapping)
        signs = [rule.negative_while.message for rule in quantities.values() if rule.negative_while is not None]
        # in the order in which the mapping names them
        names = dict.fromkeys([rule.message for rule in quantities.values()] + signs)
        for name in names:
            if name not in by_name:
                raise ValueError(f"messages.{name}: the DBC has no message {name!r}")
        rules = mapping.messages
        self._quantities = [
            (name, Quantity(name.replace(" ", "_"), rule, by_name[rule.message], _DIMENSIONS[name]))
            for name, rule in quantities.items()
        ]
        self._senders = [_Sender(by_name[name], rules.get(name, MessageRule()), start_ns) for name in names]

    def due_ns(self) -> int:
        """Return when the next frame is to be sent."""
        return min(sender.due_ns for sender in self._senders)

    def frames(self, state: VehicleState) -> list[CarFrame]:
        """Return the frames whose time has come at the state's stamp; `ValueError` beyond the DBC's bits."""
        due = [sender for sender in self._senders if sender.due_ns <= state.stamp_ns]
        values = self._values(state) if due else {}
        return [sender.frame(values, state.stamp_ns) for sender in due]

    def _values(self, state: VehicleState) -> dict[tuple[str, str], float]:
        """Return the value of each signal of the mapping, by message and signal."""
        half_mps = 0.5 * (state.wheel_speed_difference_mps or 0.0)
        si = {
            "speed": state.speed_mps, "yaw rate": state.yaw_rate_rps, "steering": state.steering_rad,
            "left wheels": state.speed_mps - half_mps, "right wheels": state.speed_mps + half_mps,
        }  # fmt: skip
        values: dict[tuple[str, str], float] = {}
        # a speed that is the mean of the wheels stays the same when each side has its own
        for name, quantity in self._quantities:
            rule = quantity.rule
            said, negative = quantity.from_si(si[name])
            values.update({(rule.message, signal): value for signal, value in zip(rule.signals, said, strict=True)})
            if rule.negative_while is not None:
                sign = rule.negative_while
                values[sign.message, sign.signal] = float(sign.negative_value if negative else 0)
        return values


class _Sender:
    """Sender of one message: its next time and its counter."""

    def __init__(self, message: Message, rule: MessageRule, start_ns: int) -> None:
        self._message, self._rule = message, rule
        self._period_ns = period_ns(message, rule)
        self._counter = 0
        self.due_ns = start_ns

    def frame(self, values: dict[tuple[str, str], float], now_ns: int) -> CarFrame:
        """Return the frame at `now_ns`; missed frames are not sent later."""
        on_time_ns = self.due_ns + self._period_ns
        self.due_ns = on_time_ns if on_time_ns > now_ns else now_ns + self._period_ns
        return CarFrame(self._message.frame_id, self._data(values), self._message.is_extended_frame)

    def _data(self, values: dict[tuple[str, str], float]) -> bytes:
        name, rule = self._message.name, self._rule
        # raw zero where nothing else is said
        signals: dict[str, Any] = {
            signal.name: values.get((name, signal.name), signal.conversion.raw_to_scaled(0, decode_choices=False))
            for signal in self._message.signals
        }
        if rule.counter is not None:
            signals[rule.counter.signal] = self._counter
            self._counter = (self._counter + 1) % counter_modulus(self._message, rule.counter)
        try:
            data = bytearray(self._message.encode(signals, strict=False))
        except OverflowError as error:
            said = ", ".join(f"{signal} = {value:g}" for signal, value in signals.items())
            raise ValueError(f"{name} cannot hold {said}: {error}") from None
        if rule.checksum is not None:
            position = checksum_byte(self._message, rule.checksum)
            data[position] = checksum_of(rule.checksum, bytes(data), position)
        return bytes(data)


def _rules(mapping: CanMapping) -> dict[str, QuantityRule]:
    """Return the rules by the name of what they give, the sides of the wheels last."""
    wheels = mapping.wheel_speeds
    if wheels is None:
        return mapping.quantities
    sides = {"left wheels": wheels.side(wheels.left), "right wheels": wheels.side(wheels.right)}
    return {**mapping.quantities, **sides}


_DIMENSIONS = {**DIMENSIONS, "left wheels": Dimension.SPEED, "right wheels": Dimension.SPEED}
