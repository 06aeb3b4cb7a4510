"""CAN input: a bus that is reopened whenever it fails, frames and their stamps, a car's DBC and mapping."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import can
import cantools
import msgspec
from cantools.database import Database

from models.vehicle.can_decoder import CanDecoder, Judged, Verdict
from models.vehicle.can_mapping import CanMapping, MessageRule
from msgs.files.text_files import AS_CP1252, read_text
from msgs.values.known_names import refuse_unknown
from msgs.values.units import NANOSECONDS_PER_SECOND, ns_from_s
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at

_LOG = logging.getLogger(__name__)

#: Files named in launch files are also searched for here.
#: Larger files are no DBC; cantools would take minutes and all memory to find out.
MAX_DBC_BYTES = 1 << 24
#: Longest message of CAN, sent in many frames (J1939).
MAX_MESSAGE_BYTES = 1785
_DBC_MESSAGE = re.compile(r"\bBO_\s+\d+\s+\w+\s*:\s*([-+]?\d+)")
_DBC_SIGNAL = re.compile(r":\s*([-+]?\d+)\s*\|\s*([-+]?\d+)\s*@")
#: The part of a mapping whose keys are names of messages.
MESSAGES = "messages"
RETRY_S, MAX_RETRY_S = 0.2, 5.0
#: A single unreadable frame is no broken bus; this many without a good one between them are.
MAX_UNREADABLE = 3
#: Maximum frames taken at once, so that heartbeats and a stop come between.
BURST = 256
_CAN_ERROR_BUS_OFF = 0x40
_NO_STAMP_NS = -1


class BusParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """CAN bus to open, in python-can's terms."""

    #: socketcan, udp_multicast (between processes), virtual (within one process) or a maker's name.
    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int | None = None
    #: Further arguments of the interface, such as `port` and `hop_limit` of udp_multicast.
    options: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if self.interface not in can.VALID_INTERFACES:
            raise ValueError(f"interface must be one of {', '.join(sorted(can.VALID_INTERFACES))}: {self.interface!r}")

    @property
    def name(self) -> str:
        """Display name of the bus."""
        return f"{self.interface} {self.channel}"


def open_bus(params: BusParams) -> can.BusABC:
    """Return the bus of `params` alone: configuration files and variables of the machine are not read."""
    bitrate = {} if params.bitrate is None else {"bitrate": params.bitrate}
    options = {**bitrate, **params.options}
    return can.Bus(channel=params.channel, interface=params.interface, ignore_config=True, **options)


class CanLink:
    """A CAN bus that may fail: its error becomes `trouble`, and it is reopened after a growing delay.

    python-can's Notifier is not used because its thread ends with the first error of a bus.
    """

    def __init__(self, params: BusParams, opener: Callable[[BusParams], can.BusABC] = open_bus) -> None:
        self._params, self._opener = params, opener
        self._bus: can.BusABC | None = None
        self._retry_ns: int | None = None
        self._retry_s = RETRY_S
        self._in_a_row = 0
        #: Reason for missing frames; empty while the bus works.
        self.trouble = ""
        #: Frames that the interface could not read, since the start.
        self.unreadable = 0

    def receive(self, now_ns: int) -> list[can.Message]:
        """Return the waiting frames, without blocking."""
        frames: list[can.Message] = []
        error = self._attempt(lambda bus: _drain(bus, frames), now_ns)
        for frame in frames:
            if frame.is_error_frame:
                if frame.arbitration_id & _CAN_ERROR_BUS_OFF:
                    self._say("bus-off")
            else:
                self._is_well()
        self._judge(error, now_ns)
        return frames

    def send(self, frame: can.Message, now_ns: int) -> bool:
        """Send a frame; False if the bus did not take it."""
        error = self._attempt(lambda bus: bus.send(frame), now_ns)
        if error is None and self._bus is not None:
            self._is_well()
            return True
        self._judge(error, now_ns)
        return False

    def close(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except (can.CanError, OSError) as error:
                _LOG.debug("%s: %s while closing", self._params.name, error)

    def _is_open(self, now_ns: int) -> bool:
        if self._bus is not None:
            return True
        if self._retry_ns is not None and now_ns < self._retry_ns:
            return False
        try:
            self._bus = self._opener(self._params)
        except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
            self._fail(f"cannot be opened: {error}", now_ns)
            return False
        return True

    def _attempt(self, action: Callable[[can.BusABC], None], now_ns: int) -> Exception | None:
        """Run an action on the bus, if it is open; return its exception."""
        if not self._is_open(now_ns):
            return None
        assert self._bus is not None
        try:
            action(self._bus)
        except (can.CanError, OSError, ValueError) as error:
            return error
        return None

    def _judge(self, error: Exception | None, now_ns: int) -> None:
        """Close the bus, or tolerate a single unreadable frame."""
        if error is None:
            if self._bus is not None and _is_off(self._bus):
                self._say("bus-off")
            return
        self.unreadable += 1
        self._in_a_row += 1
        # an error of the system has a number; without one it may be a single frame
        is_numbered = getattr(error, "error_code", None) is not None or getattr(error, "errno", None) is not None
        if is_numbered or self._in_a_row >= MAX_UNREADABLE:
            self._fail(str(error) or type(error).__name__, now_ns)

    def _is_well(self) -> None:
        self._in_a_row, self._retry_s = 0, RETRY_S
        if self.trouble:
            _LOG.info("%s: frames again", self._params.name)
        self.trouble = ""

    def _fail(self, reason: str, now_ns: int) -> None:
        self.close()
        self._in_a_row = 0
        self._retry_ns = now_ns + ns_from_s(self._retry_s)
        self._retry_s = min(MAX_RETRY_S, 2.0 * self._retry_s)
        self._say(reason)

    def _say(self, reason: str) -> None:
        text = " ".join(f"{self._params.name}: {reason}".split())
        if text != self.trouble:
            _LOG.warning("%s", text)
        self.trouble = text


def _is_off(bus: can.BusABC) -> bool:
    try:
        return bus.state is can.BusState.ERROR
    except (can.CanError, NotImplementedError):
        # not every interface reports it
        return False


def _drain(bus: can.BusABC, frames: list[can.Message]) -> None:
    """Collect frames that wait in the interface; those read before it fails are kept."""
    while len(frames) < BURST and (frame := bus.recv(0.0)) is not None:
        frames.append(frame)


def decode_frame(decoder: CanDecoder, frame: can.Message, stamp_ns: int) -> Judged:
    """Pass one frame of python-can to the decoder and return its verdict."""
    if frame.is_error_frame:
        return decoder.skip(Verdict.ERROR_FRAME)
    if frame.is_remote_frame:
        return decoder.skip(Verdict.REMOTE_FRAME)
    return decoder.add(frame.arbitration_id, bytes(frame.data), stamp_ns, frame.is_extended_id)


def bus_frame(arbitration_id: int, data: bytes, extended: bool, now_ns: int) -> can.Message:
    """Return a frame to send; interfaces that do not stamp it themselves keep this stamp of the bus clock."""
    return can.Message(
        timestamp=now_ns / NANOSECONDS_PER_SECOND, arbitration_id=arbitration_id, data=data, is_extended_id=extended
    )


def frame_stamp_ns(frame: can.Message) -> int:
    """Return the frame's own stamp; negative, which no decoder accepts, without a valid time."""
    # it may be infinite in nanoseconds though finite in seconds
    return ns_from_s(frame.timestamp) if math.isfinite(frame.timestamp * NANOSECONDS_PER_SECOND) else _NO_STAMP_NS


class LogFrame(NamedTuple):
    """A recorded frame and its own stamp."""

    frame: can.Message
    stamp_ns: int


def load_dbc(path: Path) -> Database:
    """Return a car's DBC; one that breaks rules of the format is read nevertheless, with a warning.

    Raises `ValueError` naming the file if it is no DBC at all, `OSError` if it cannot be read.
    """
    try:
        return _load_database(path, strict=True)
    except (cantools.Error, ValueError) as error:
        reason = " ".join(str(error).split())
        try:
            database = _load_database(path, strict=False)
        except (cantools.Error, ValueError):
            raise ValueError(f"{path}: no DBC: {reason}") from None
        _LOG.warning("%s: not a clean DBC, read all the same: %s", path, reason)
        return database


def _load_database(path: Path, strict: bool) -> Database:
    if path.stat().st_size > MAX_DBC_BYTES:
        raise ValueError(f"at most {MAX_DBC_BYTES} bytes are read, got {path.stat().st_size}")
    dbc = read_text(path, AS_CP1252)
    _refuse_long_messages(dbc)
    database = cantools.database.load_string(dbc, database_format="dbc", strict=strict)
    assert isinstance(database, Database)
    return database


def _refuse_long_messages(dbc: str) -> None:
    """Raise `ValueError` for messages that no bus carries: cantools takes memory and time for every bit of them."""
    plain = re.sub(r"//[^\n]*", "", dbc)
    lengths = [int(match[1]) for match in _DBC_MESSAGE.finditer(plain)]
    spans = [(int(match[1]), int(match[2])) for match in _DBC_SIGNAL.finditer(plain)]
    longest = max([*lengths, *(-(-(start + length) // 8) for start, length in spans)], default=0)
    minimum = min([*lengths, *(number for span in spans for number in span)], default=0)
    if longest > MAX_MESSAGE_BYTES or minimum < 0:
        raise ValueError(f"messages must be of 0..{MAX_MESSAGE_BYTES} bytes, got {minimum if minimum < 0 else longest}")


def load_mapping(path: Path) -> CanMapping:
    """Return a car's mapping from YAML; `ValueError` names file, field, value and rule."""
    value = read_yaml_mapping(path)
    try:
        refuse_unknown(value, CanMapping, "")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # part by part, because msgspec's path writes the key of a mapping as [...]
    types = {field.encode_name: field.type for field in msgspec.structs.fields(CanMapping)}
    parts = {name: convert_at(part, types[name], f"{path}: {name}") for name, part in value.items() if name != MESSAGES}
    messages = convert_at(value.get(MESSAGES, {}), dict[str, Any], f"{path}: {MESSAGES}")
    rules = {name: convert_at(rule, MessageRule, f"{path}: {MESSAGES}.{name}") for name, rule in messages.items()}
    return convert_at({**parts, MESSAGES: rules}, CanMapping, str(path))


def load_decoder(dbc: Path, mapping: Path) -> CanDecoder:
    """Return a decoder for one car; `ValueError` names the mapping's file and the field that the DBC does not match.

    Ranges and units of the DBC that were reinterpreted are logged.
    """
    database = load_dbc(dbc)
    rules = load_mapping(mapping)
    try:
        decoder = CanDecoder(database, rules)
    except ValueError as error:
        raise ValueError(f"{mapping}: {error}") from None
    for text in decoder.warnings:
        _LOG.warning("%s: %s", mapping, text)
    return decoder
