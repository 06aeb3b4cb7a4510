"""A view of hidden objects as the messages of a DBC, which states ids, bits, ranges, cycle times and delays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from models.vehicle.can_mapping import MessageRule, period_ns
from models.vehicle.end_to_end import ChecksumRule, CounterRule, checksum_byte, checksum_of, counter_modulus, signal_of
from msgs.values.frames import wrap_angle
from msgs.values.perception import BevFrame, HiddenObject, Visibility
from msgs.values.radar import MAP_FAULTS, WIRING_FAULTS

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message, Signal

STATUS_MESSAGE = "MW_OBJECT_LIST"
POSITION_MESSAGE, SHAPE_MESSAGE = "MW_OBJECT_{:02d}_POSITION", "MW_OBJECT_{:02d}_SHAPE"
#: Attributes of a message: the data id of its checksum, and its delay after the status of its list [ms].
DATA_ID, START_DELAY = "E2EDataID", "GenMsgStartDelayTime"
#: Signal of each flag of a view that has a bit of its own; those of the wiring share `OTHER_FAULT`.
FAULT_SIGNALS = {
    "incoherent": "FAULT_INCOHERENT",
    "missing_beams": "FAULT_MISSING_BEAMS",
    "saturated": "FAULT_SATURATED_INPUT",
    **{name: f"FAULT_{name.upper()}" for name in MAP_FAULTS if name not in WIRING_FAULTS},
}
OTHER_FAULT = "FAULT_OTHER"

_HEAD = ("CHECKSUM", "COUNTER", "VALID", "SATURATED")
_STATUS = ("TRUNCATED", "EGO_VALID", "SCAN_COUNTER", "OBJECT_COUNT", "AGE", "OBSERVABLE_SHARE")
_POSITION = ("ID", "X", "Y", "POSITION_STD")
_SHAPE = ("ID", "LENGTH", "WIDTH", "YAW", "SCORE")
_COUNTER = CounterRule(signal="COUNTER", max_step=2)
#: Cycle times and delays are whole milliseconds.
_NS_PER_MS = 1_000_000

#: Physical values of a message's signals.
Values = Mapping[str, float]


class ListFrame(NamedTuple):
    """One frame of a list, to be sent `delay_ns` after the list's status."""

    message: str
    arbitration_id: int
    extended: bool
    data: bytes
    delay_ns: int


class Fitted(NamedTuple):
    """Values within the ranges of their signals, and whether any was clipped."""

    values: dict[str, float]
    saturated: bool


class HiddenObjectList:
    """Makes the frames of one list after the other; `ValueError` names what the DBC lacks of one."""

    def __init__(self, database: Database) -> None:
        self._messages = {message.name: message for message in database.messages}
        #: Object slots of a list.
        self.slots = _slot_count(self._messages)
        status = _checked(self._messages, STATUS_MESSAGE, (*_STATUS, *FAULT_SIGNALS.values(), OTHER_FAULT))
        for slot in range(1, self.slots + 1):
            for name, signals in ((POSITION_MESSAGE, _POSITION), (SHAPE_MESSAGE, _SHAPE)):
                _require_within(_checked(self._messages, name.format(slot), signals), status)
        #: Time from one list to the next.
        self.period_ns = period_ns(status, MessageRule())
        #: The maximum age that a list can state, in milliseconds.
        self.max_age_ms = int(signal_of(status, "AGE", STATUS_MESSAGE).maximum or 0)
        self._modulus = counter_modulus(status, _COUNTER)

    def frames(self, view: BevFrame | None, age_ns: int | None, max_age_ns: int, counter: int) -> list[ListFrame]:
        """Return all frames of list number `counter` in order; valid while `age_ns` (None: unknown) is in its range."""
        fresh = view is not None and age_ns is not None and 0 <= age_ns <= max_age_ns
        objects = listed_objects(view.objects, self.slots) if view is not None and fresh else ()
        frames, saturated = [], False
        for slot in range(1, self.slots + 1):
            hidden_object = objects[slot - 1] if slot <= len(objects) else None
            for name, values_of in ((POSITION_MESSAGE, position_values), (SHAPE_MESSAGE, shape_values)):
                message = self._messages[name.format(slot)]
                fitted = fit(message, {} if hidden_object is None else values_of(hidden_object))
                saturated = saturated or fitted.saturated
                values = {**fitted.values, "VALID": hidden_object is not None}
                frames.append(self._frame(message, values, fitted.saturated, counter))
        status = self._messages[STATUS_MESSAGE]
        values = {**fit(status, status_values(view, age_ns, self.slots)).values, "VALID": fresh}
        frames.append(self._frame(status, values, saturated, counter))
        return sorted(frames, key=lambda frame: (frame.delay_ns, frame.arbitration_id))

    def _frame(self, message: Message, values: Values, saturated: bool, counter: int) -> ListFrame:
        data = protected(message, {**values, "SATURATED": saturated, "COUNTER": counter % self._modulus})
        delay_ns = _NS_PER_MS * _attribute(message, START_DELAY)
        return ListFrame(message.name, message.frame_id, message.is_extended_frame, data, delay_ns)


def listed_objects(objects: tuple[HiddenObject, ...], slots: int) -> tuple[HiddenObject, ...]:
    """Return the objects that get a slot, the highest scores first."""
    return tuple(sorted(objects, key=lambda item: -item.score)[:slots])


def position_values(hidden_object: HiddenObject) -> dict[str, float]:
    """Return the values of a position message for an object, before they are fitted to bits: its box's centre."""
    x_m, y_m = hidden_object.box_centre_m
    return {
        "ID": hidden_object.id,
        "X": x_m,
        "Y": y_m,
        "POSITION_STD": worst_std_m(hidden_object),
    }


def shape_values(hidden_object: HiddenObject) -> dict[str, float]:
    """Return the values of a shape message for an object; the heading is ambiguous by half a turn."""
    return {
        "ID": hidden_object.id,
        "LENGTH": hidden_object.length_m,
        "WIDTH": hidden_object.width_m,
        "YAW": wrap_angle(hidden_object.yaw_rad),
        "SCORE": hidden_object.score,
    }


def status_values(view: BevFrame | None, age_ns: int | None, slots: int) -> dict[str, float]:
    """Return the values of the status for a view; an unknown age is reported as the maximum."""
    age_ms = math.inf if age_ns is None or age_ns < 0 else age_ns / _NS_PER_MS
    # a large number instead of none: the signal is then clipped to its maximum, which means "or more"
    values = {"AGE": min(age_ms, 1e12)}
    if view is None:
        return values
    flags = set(view.flags)
    return {
        **values,
        "TRUNCATED": len(view.objects) > slots,
        "EGO_VALID": view.ego is not None and view.ego.valid,
        # the one value that is meant to wrap
        "SCAN_COUNTER": view.scan_id % 256,
        "OBJECT_COUNT": len(view.objects),
        "OBSERVABLE_SHARE": 100.0 * observable_share(view),
        **{signal: flag in flags for flag, signal in FAULT_SIGNALS.items()},
        OTHER_FAULT: bool(flags - set(FAULT_SIGNALS)),
    }


def worst_std_m(hidden_object: HiddenObject) -> float:
    """Return the standard deviation of the centre along its worst direction, metres."""
    (xx, xy), (yx, yy) = hidden_object.cov_m2
    mean, cross = 0.5 * (xx + yy), 0.5 * (xy + yx)
    return math.sqrt(mean + math.hypot(0.5 * (xx - yy), cross))


def observable_share(view: BevFrame) -> float:
    """Return the share of cells out of sight where a mirror would have shown an object; 1 without such cells."""
    mirrored = int(np.count_nonzero(view.visibility == Visibility.MIRRORED))
    unknown = int(np.count_nonzero(view.visibility == Visibility.UNKNOWN))
    return mirrored / (mirrored + unknown) if mirrored + unknown else 1.0


def fit(message: Message, values: Values) -> Fitted:
    """Return every signal of a message within its range; zero for missing values."""
    fitted, saturated = {}, False
    for signal in message.signals:
        value = float(values.get(signal.name, 0.0))
        fitted[signal.name] = min(max(value, float(signal.minimum or 0)), float(signal.maximum or 0))
        # half a step beyond the end is rounding
        saturated = saturated or abs(fitted[signal.name] - value) > 0.5 * abs(float(signal.scale))
    return Fitted(fitted, saturated)


def protected(message: Message, values: Values) -> bytes:
    """Return the payload of a message whose values fit, with its checksum."""
    rule = checksum_rule(message)
    data = bytearray(message.encode(dict(values), strict=False))
    position = checksum_byte(message, rule)
    data[position] = checksum_of(rule, bytes(data), position)
    return bytes(data)


def checksum_rule(message: Message) -> ChecksumRule:
    """Return the checksum rule of a message of the list; its data id is in the DBC."""
    return ChecksumRule(signal="CHECKSUM", data_id=_attribute(message, DATA_ID))


def message_rule(message: Message) -> MessageRule:
    """Return the rule by which a receiver checks a message of the list."""
    return MessageRule(checksum=checksum_rule(message), counter=_COUNTER)


def is_protected(message: Message) -> bool:
    """Return whether a message of any DBC is protected like those of this list."""
    names = {signal.name for signal in message.signals}
    return {"CHECKSUM", "COUNTER"} <= names and message.dbc is not None and DATA_ID in message.dbc.attributes


def _slot_count(messages: Mapping[str, Message]) -> int:
    count = 0
    while POSITION_MESSAGE.format(count + 1) in messages:
        count += 1
    return count


def _checked(messages: Mapping[str, Message], name: str, signals: tuple[str, ...]) -> Message:
    """Return a message that has all its signals, each with a range that its bits hold."""
    if name not in messages:
        raise ValueError(f"messages.{name}: the DBC has no such message")
    message = messages[name]
    for signal in (*_HEAD, *signals):
        _require_range(signal_of(message, signal, f"messages.{name}"), f"messages.{name}.{signal}")
    checksum_byte(message, checksum_rule(message))
    counter_modulus(message, _COUNTER)
    return message


def _require_range(signal: Signal, field: str) -> None:
    low, high = signal.minimum, signal.maximum
    bits = signal.length - signal.is_signed
    minimum, maximum = (-(1 << bits) if signal.is_signed else 0), (1 << bits) - 1
    ends = sorted(float(signal.offset + signal.scale * raw) for raw in (minimum, maximum))
    # both sides are decimal numbers
    slack = 1e-6 * abs(float(signal.scale))
    if low is None or high is None or not ends[0] - slack <= low < high <= ends[1] + slack:
        raise ValueError(f"{field}: range must be within {ends[0]:g}..{ends[1]:g}, which the bits hold: {low}..{high}")


def _require_within(message: Message, status: Message) -> None:
    if message.cycle_time != status.cycle_time or not isinstance(status.cycle_time, int):
        rule = f"must be that of {STATUS_MESSAGE}, {status.cycle_time} ms"
        raise ValueError(f"messages.{message.name}.GenMsgCycleTime: {rule}, got {message.cycle_time}")
    if counter_modulus(message, _COUNTER) != counter_modulus(status, _COUNTER):
        raise ValueError(f"messages.{message.name}.COUNTER: must have the bits of {STATUS_MESSAGE}.COUNTER")
    if not _attribute(status, START_DELAY) <= (delay := _attribute(message, START_DELAY)) < status.cycle_time:
        rule = f"must be from {STATUS_MESSAGE}'s to below the cycle time"
        raise ValueError(f"messages.{message.name}.{START_DELAY}: {rule}, got {delay} ms")


def _attribute(message: Message, name: str) -> int:
    """Return a numeric attribute of a message in the DBC, or its default."""
    attributes = {} if message.dbc is None else message.dbc.attributes
    if name in attributes:
        return int(attributes[name].value)
    if name == START_DELAY:
        return 0
    raise ValueError(f"messages.{message.name}: the DBC has no attribute {name} of it")
