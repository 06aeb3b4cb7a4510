"""Node `vehicle_can`: the car's CAN bus, or a log of it, as the vehicle's state.

Stamps: frames of a live bus are converted from the interface's clock to the bus clock; those of a log keep their
distances and start when its replay starts, or at `log_start_ns`. Ages are measured on stamps alone.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import can
import msgspec

from models.vehicle.can_decoder import CanDecoder, StampMapper, StateReporter
from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import shipped_path
from msgs.values.diagnostics import NodeState
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from nodes.can.bus import BURST, BusParams, CanLink, LogFrame, decode_frame, frame_stamp_ns, load_decoder
from nodes.can.log_file import on_one_clock, read_log
from nodes.node import Node
from nodes.process.validation import require_clock_offset

_LOG = logging.getLogger(__name__)

#: Interval between reads of a live bus: a quarter of the shortest period that cars use.
POLL_NS = 5_000_000


class Params(BusParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Bus or log, and the meaning of its frames."""

    formerly: ClassVar[dict[str, str]] = {"log_channel": "nodes.vehicle_can"}

    dbc: str = "launch/can/mirrorwave.dbc"
    mapping: str = "launch/can/mirrorwave.yaml"
    #: A candump (.log), ASC, BLF, CSV or TRC log that is played instead of the bus.
    log: str | None = None
    #: Speed of play; 1 is real time.
    rate: float = 1.0
    #: Stamp of the log's first frame; None: the time at which its replay starts.
    log_start_ns: int | None = None
    #: Added to the states' stamps: the result of `mirrorwave calibrate clock`.
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.rate < float("inf"):
            raise ValueError(f"rate must be finite and positive, got {self.rate!r}")
        require_clock_offset("clock_offset_s", self.clock_offset_s)


class LiveSource:
    """Frames of a bus; their stamps are on the bus clock, its fault is `trouble`, and they never end."""

    ended = False

    def __init__(self, link: CanLink) -> None:
        self._link = link
        self._stamps = StampMapper()
        self._next_ns: int | None = None

    @property
    def trouble(self) -> str:
        """Fault of the bus."""
        return self._link.trouble

    def stamp_ns(self, now_ns: int) -> int:
        """Return the time unchanged: there is one clock."""
        return now_ns

    def due_ns(self, now_ns: int, stamp_ns: int) -> int:
        """Return the next poll, or earlier."""
        return min(stamp_ns, now_ns if self._next_ns is None else self._next_ns)

    def frames(self, now_ns: int) -> list[LogFrame]:
        """Return the frames that wait in the interface."""
        self._next_ns = now_ns + POLL_NS
        return [LogFrame(frame, self._bus_stamp_ns(frame, now_ns)) for frame in self._link.receive(now_ns)]

    def close(self) -> None:
        """Close the bus."""
        self._link.close()

    def _bus_stamp_ns(self, frame: can.Message, now_ns: int) -> int:
        stamp_ns = frame_stamp_ns(frame)
        # an interface without a clock stamps with zero
        return self._stamps.map(stamp_ns, now_ns) if stamp_ns > 0 else now_ns


class LogSource:
    """Frames of a log, each when its time has come; an unreadable rest counts as its end.

    Steps of the log's clock are taken out.
    """

    def __init__(self, frames: Iterator[LogFrame], rate: float = 1.0, start_ns: int | None = None) -> None:
        # a frame without a time cannot be played
        self._frames = on_one_clock(frame for frame in frames if frame.stamp_ns >= 0)
        self._rate, self._start_ns = rate, start_ns
        self._next = next(self._frames, None)
        self._first_ns = 0 if self._next is None else self._next.stamp_ns
        self._play_ns: int | None = None
        self.trouble = ""

    @property
    def ended(self) -> bool:
        """Return whether the last frame was read."""
        return self._next is None

    def stamp_ns(self, now_ns: int) -> int:
        """Return the time of the log; its replay starts with the first call."""
        if self._play_ns is None:
            self._play_ns = now_ns
        start_ns = self._play_ns if self._start_ns is None else self._start_ns
        return start_ns + round((now_ns - self._play_ns) * self._rate)

    def due_ns(self, now_ns: int, stamp_ns: int) -> int:
        """Return when the next frame is due, or earlier."""
        if self._next is not None:
            stamp_ns = min(stamp_ns, self._restamped(self._next).stamp_ns)
        ahead_ns = stamp_ns - self.stamp_ns(now_ns)
        # rounded up: a step a nanosecond early would have no work
        return now_ns if ahead_ns <= 0 else now_ns + int(ahead_ns / self._rate) + 1

    def frames(self, now_ns: int) -> list[LogFrame]:
        """Return the frames whose time has come."""
        until_ns = self.stamp_ns(now_ns)
        due: list[LogFrame] = []
        while len(due) < BURST and self._next is not None:
            frame = self._restamped(self._next)
            if frame.stamp_ns > until_ns:
                break
            due.append(frame)
            self._next = None
            try:
                self._next = next(self._frames, None)
            except (ValueError, OSError) as error:
                self.trouble = str(error)
                _LOG.error("%s", error)
        return due

    def close(self) -> None:
        """Close the file with its reader."""
        self._next = None
        self._frames.close()

    def _restamped(self, frame: LogFrame) -> LogFrame:
        start_ns = self._start_ns if self._start_ns is not None else self._play_ns or 0
        return frame._replace(stamp_ns=start_ns + frame.stamp_ns - self._first_ns)


#: Source of frames.
FrameSource = LiveSource | LogSource


class VehicleCanNode(Node):
    """CAN -> vehicle/state at the rate of the speed message; not valid, with the reason, when it fails."""

    outputs = ("vehicle/state",)

    def __init__(self, decoder: CanDecoder, source: FrameSource, clock_offset_s: float = 0.0) -> None:
        super().__init__()
        self._decoder, self._source = decoder, source
        self._clock_offset_ns = ns_from_s(clock_offset_s)
        self._reporter: StateReporter | None = None
        self._last: VehicleState | None = None

    def due_ns(self, now_ns: int) -> int:
        """Return when frames are to be polled or a state is due."""
        if self._reporter is None:
            return now_ns
        return self._source.due_ns(now_ns, self._reporter.due_ns(self._source.trouble))

    def finished(self) -> bool:
        """Return true after the last frame of a log."""
        return self._source.ended

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the states of all received frames, and the one that is due without any."""
        if self._reporter is None:
            self._reporter = StateReporter(self._decoder, self._source.stamp_ns(now_ns))
        states: list[VehicleState | None] = []
        with self.stages("frames"):
            for frame, stamp_ns in self._source.frames(now_ns):
                states.append(self._reporter.frame(decode_frame(self._decoder, frame, stamp_ns), stamp_ns))
        states.append(self._reporter.tick(self._source.stamp_ns(now_ns), self._source.trouble))
        return [
            Outgoing("vehicle/state", moved)
            for state in states
            if state is not None and (moved := self._on_radar_clock(state)) is not None
        ]

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED with the reason of the last state."""
        if self._last is not None and not self._last.valid:
            return NodeState.DEGRADED, self._last.reason
        return NodeState.READY, ""

    def close(self) -> None:
        """Close the bus."""
        self._source.close()

    def _on_radar_clock(self, state: VehicleState) -> VehicleState | None:
        """Return a state with its stamp on the radar's clock, None from before that began."""
        was_valid = self._last is not None and self._last.valid
        if was_valid and not state.valid:
            _LOG.warning("vehicle state is not valid: %s", state.reason)
        elif state.valid and not was_valid:
            _LOG.info("vehicle state is valid")
        self._last = state
        stamp_ns = state.stamp_ns + self._clock_offset_ns
        return None if stamp_ns < 0 else msgspec.structs.replace(state, stamp_ns=stamp_ns)


def create(params: Params) -> VehicleCanNode:
    """Return the node; `ValueError` for an unreadable DBC, mapping or log. An absent bus may appear later."""
    decoder = load_decoder(shipped_path(params.dbc), shipped_path(params.mapping))
    if params.log is None:
        return VehicleCanNode(decoder, LiveSource(CanLink(params)), params.clock_offset_s)
    source = LogSource(read_log(Path(params.log)), params.rate, params.log_start_ns)
    if source.ended:
        raise ValueError(f"{params.log}: holds no frames")
    return VehicleCanNode(decoder, source, params.clock_offset_s)
