"""Node `detections_radar`: a radar of the ARS 408 kind on CAN, its target list as `radar/detections`.

A measurement is stamped with the arrival of its first frame, on the bus clock. One with missing targets is published
and says so. The node only listens: how the sensor is set up, and what of the car it is told, is others' business.
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import ClassVar

import msgspec

from contrib.boards.target_list import TargetListParams, TargetListReader
from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import shipped_path
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import NodeState
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.wording import counted
from nodes.can.bus import BusParams, CanLink, LogFrame, load_dbc
from nodes.node import Node
from nodes.process.validation import require_clock_offset
from nodes.vehicle_can import LiveSource

_LOG = logging.getLogger(__name__)


#: The node is DEGRADED when no measurement came for so long: ten and more cycles.
SILENCE_S = 1.0


class Params(BusParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """CAN bus of the radar, the layout of its frames, and what is known of the radar itself."""

    formerly: ClassVar[dict[str, str]] = {
        "": "contrib.boards.detections_radar",
        "radar": "contrib.boards.target_list",
    }

    dbc: str = "launch/can/target_radar.dbc"
    #: Name of the sensor in its messages.
    sensor: str = "target_radar"
    radar: TargetListParams = TargetListParams()
    #: Added to the stamps: minus the time from measurement to first frame.
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_clock_offset("clock_offset_s", self.clock_offset_s)


class DetectionsRadarNode(Node):
    """CAN frames -> radar/detections, one message a measurement."""

    outputs = ("radar/detections",)

    def __init__(self, reader: TargetListReader, source: LiveSource, params: Params) -> None:
        super().__init__()
        self._reader, self._source, self._params = reader, source, params
        self._offset_ns = ns_from_s(params.clock_offset_s)
        self._counts: Counter[tuple[str, str]] = Counter()
        self._heard_ns: int | None = None
        self._refused_ns: int | None = None
        self._now_ns = 0
        self._last: RadarDetections | None = None

    def due_ns(self, now_ns: int) -> int:
        """Return when frames are to be polled."""
        return self._source.due_ns(now_ns, now_ns + ns_from_s(SILENCE_S))

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the measurements that the received frames end, and one whose time is over."""
        self._heard_ns = now_ns if self._heard_ns is None else self._heard_ns
        self._now_ns = now_ns
        with self.stages("frames"):
            ended = [each for frame in self._source.frames(now_ns) for each in self._add(frame)]
            ended += self._reader.tick(now_ns)
        self._count()
        # on the other clock the first may come from before its begin
        ended = [each for each in ended if each.stamp_ns + self._offset_ns >= 0]
        return [Outgoing("radar/detections", self._stamped(each)) for each in ended]

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED for a bus in trouble, a silent sensor, and while the last measurement lacks targets."""
        if self._source.trouble:
            return NodeState.DEGRADED, self._source.trouble
        limit_ns = ns_from_s(SILENCE_S)
        if (silent_ns := self._now_ns - (self._heard_ns or 0)) > limit_ns:
            return NodeState.DEGRADED, self._silence(silent_ns)
        if self._last is not None and self._last.lost:
            text = f"{counted(self._last.lost, 'target')} of the last measurement did not arrive"
            return NodeState.DEGRADED, f"{text}; {self._reader.lost} so far"
        if self._refused_ns is not None and self._now_ns - self._refused_ns <= limit_ns:
            return NodeState.DEGRADED, f"refused: {self._refusal()}"
        return NodeState.READY, ""

    def close(self) -> None:
        """Close the bus."""
        self._source.close()

    def _add(self, logged: LogFrame) -> list[RadarDetections]:
        frame = logged.frame
        if frame.is_error_frame or frame.is_remote_frame or frame.is_extended_id:
            return []
        return self._reader.add(frame.arbitration_id, bytes(frame.data), logged.stamp_ns)

    def _stamped(self, detections: RadarDetections) -> RadarDetections:
        self._heard_ns, self._last = self._now_ns, detections
        return msgspec.structs.replace(detections, stamp_ns=detections.stamp_ns + self._offset_ns)

    def _silence(self, silent_ns: int) -> str:
        reader, sensor_id = self._reader, self._params.radar.sensor_id
        text = f"no measurement of sensor {sensor_id} for {s_from_ns(silent_ns):.1f} s"
        if reader.refused:
            return f"{text}; refused: {self._refusal()}"
        if reader.strangers:
            return f"{text}; frames of sensor {', '.join(map(str, sorted(reader.strangers)))} arrive"
        return text

    def _refusal(self) -> str:
        reason, count = self._reader.refused.most_common(1)[0]
        return f"{counted(count, 'frame')} ({reason})"

    def _count(self) -> None:
        """Carry the reader's counts into the heartbeat; the first of each kind is logged."""
        reader = self._reader
        totals = Counter({("frame", reason): count for reason, count in reader.refused.items()})
        totals.update({("target", reason): count for reason, count in reader.left_out.items()})
        totals.update({("target", "lost"): reader.lost, ("measurement", "missed"): reader.missed})
        for (kind, reason), count in (totals - self._counts).items():
            self.shed.add(kind, reason, count)
            if kind == "frame":
                self._refused_ns = self._now_ns
            if not self._counts[kind, reason]:
                _LOG.warning("%s: %s", counted(count, kind), reason)
        self._counts = totals


def create(params: Params) -> DetectionsRadarNode:
    """Return the node; `ValueError` for a DBC that cannot be read or lacks the layout. A bus may appear later."""
    path = shipped_path(params.dbc)
    try:
        reader = TargetListReader(load_dbc(path), params.radar, params.sensor)
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None
    return DetectionsRadarNode(reader, LiveSource(CanLink(params)), params)
