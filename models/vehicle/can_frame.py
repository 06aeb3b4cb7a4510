"""Validity of a message's frames: length, checksum and rolling counter, and their signals."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple, cast

from cantools.database.errors import DecodeError
from cantools.database.utils import decode_data

from models.vehicle.can_mapping import MessageRule
from models.vehicle.end_to_end import checksum_byte, checksum_of, counter_modulus, counter_step
from msgs.values.wording import counted

if TYPE_CHECKING:
    from cantools.database.can import Message

#: Payload lengths of CAN FD above those of classic CAN: shorter messages are padded up to one of them.
_FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)


class Verdict(StrEnum):
    """Verdict on a frame."""

    COUNTED = "counted"
    #: Sets the counter that the next frame is compared with.
    FIRST = "first of its counter"
    OUT_OF_RANGE = "out of range"
    WRONG_CHECKSUM = "wrong checksum"
    WRONG_COUNTER = "wrong counter"
    WRONG_LENGTH = "wrong length"
    UNDECODABLE = "undecodable"
    LATE = "late"
    BAD_STAMP = "bad stamp"
    UNKNOWN_ID = "unknown id"
    REMOTE_FRAME = "remote frame"
    ERROR_FRAME = "error frame"


class Checked(NamedTuple):
    """The verdict on a frame, the reason if it is not valid, and its signals if they could be decoded."""

    verdict: Verdict
    why: str = ""
    values: dict[str, float] | None = None


class FrameCheck:
    """Checks the frames of one message; `ValueError` names the field of a signal that the message lacks."""

    def __init__(self, message: Message, rule: MessageRule) -> None:
        self._message, self._rule = message, rule
        self._lengths = range(message.length, _padded_length(message.length) + 1)
        self._checksum_byte = 0 if rule.checksum is None else checksum_byte(message, rule.checksum)
        self._modulus = 0 if rule.counter is None else counter_modulus(message, rule.counter)
        self._counter: int | None = None

    def forget(self) -> None:
        """Reset to the state before any frame."""
        self._counter = None

    def length_fault(self, data: bytes) -> str:
        """Return what is wrong with a frame's length; padding up to the next length of CAN FD is valid."""
        if len(data) in self._lengths:
            return ""
        return f"wrong length: {counted(len(data), 'byte')}, expected {self._message.length}"

    def check(self, data: bytes, silent: bool = False) -> Checked:
        """Judge a frame; after a silence its counter has no reference."""
        if why := self.length_fault(data):
            return Checked(Verdict.WRONG_LENGTH, why)
        data = data[: self._message.length]
        if why := self._checksum_fault(data):
            return Checked(Verdict.WRONG_CHECKSUM, why)
        try:
            values = _values(self._message, data)
        except (DecodeError, ValueError, OverflowError) as error:
            return Checked(Verdict.UNDECODABLE, f"undecodable: {error}")
        return Checked(*self._check_counter(values, silent), values)

    def _checksum_fault(self, data: bytes) -> str:
        rule = self._rule.checksum
        if rule is None:
            return ""
        received, expected = data[self._checksum_byte], checksum_of(rule, data, self._checksum_byte)
        return "" if received == expected else f"wrong checksum: {received:#04x}, expected {expected:#04x}"

    def _check_counter(self, values: dict[str, float], silent: bool) -> tuple[Verdict, str]:
        rule = self._rule.counter
        if rule is None:
            return Verdict.COUNTED, ""
        try:
            counter = int(values[rule.signal])
        except (KeyError, ValueError, OverflowError):
            # of another page of the message, or not a number: a DBC may declare either
            return Verdict.UNDECODABLE, "undecodable: without its counter"
        last, self._counter = self._counter, counter
        if last is None or silent:
            # no reference: a sender whose counter is stuck must not count as valid once for each silence
            return Verdict.FIRST, "first of its counter"
        step = counter_step(last, self._counter, self._modulus)
        if step == 0:
            return Verdict.WRONG_COUNTER, f"counter stands at {self._counter}"
        if step > rule.max_step:
            return Verdict.WRONG_COUNTER, f"counter jumped from {last} to {self._counter}"
        return Verdict.COUNTED, ""


def _values(message: Message, data: bytes) -> dict[str, float]:
    """Return the signals of a frame as numbers, without those of a multiplexer's page that the DBC lacks."""
    values: dict[str, float] = {}
    nodes = [message._codecs]
    while nodes:
        if (node := nodes.pop()) is None:
            continue
        signals = decode_data(data, message.length, node["signals"], node["formats"], False, True, False, True)
        values |= cast("dict[str, float]", signals)
        nodes += [pages.get(int(values[name])) for name, pages in node["multiplexers"].items()]
    return values


def _padded_length(length: int) -> int:
    return next((padded for padded in _FD_LENGTHS if padded >= length), length) if length > 8 else length
