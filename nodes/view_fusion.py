"""One view of several radars on a vehicle: what each of them sees, in the vehicle's frame, with tracks."""

from __future__ import annotations

import logging
from collections import deque
from functools import partial

import msgspec

from models.perception.track.scan_state import MemoryParams
from models.perception.track.view_fusion import FusionStage, RadarView
from msgs.bus.interface import Outgoing, Received
from msgs.bus.topics import sensor_of, sensor_topic
from msgs.values.diagnostics import NodeState
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Peaks
from msgs.values.vehicle import VehicleState
from nodes.inputs.refusals import Refusals
from nodes.inputs.view_groups import ViewGroups
from nodes.node import Node

_LOG = logging.getLogger(__name__)

_PEAKS, _VIEW = "perception/peaks", "perception/hidden_objects"
#: Peaks that wait for their view.
_KEPT_PEAKS = 8


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Radars whose views are joined, and their tracks."""

    #: The names of their nodes' `sensor`.
    radars: tuple[str, ...]
    memory: MemoryParams = MemoryParams()

    def __post_init__(self) -> None:
        if len(set(self.radars)) != len(self.radars) or not self.radars:
            raise ValueError(f"radars must be one or more different names, got {', '.join(self.radars) or 'none'}")
        for radar in self.radars:
            sensor_topic(_VIEW, radar)


class ViewFusion(Node):
    """perception/NAME/hidden_objects of each radar -> perception/hidden_objects of the vehicle.

    Peaks of a radar say where it sits on the vehicle. A radar that is silent is not waited for.
    """

    outputs = (_VIEW,)

    def __init__(self, params: Params) -> None:
        super().__init__()
        topics = [sensor_topic(topic, radar) for radar in params.radars for topic in (_PEAKS, _VIEW)]
        self.inputs: tuple[str, ...] = (*topics, "vehicle/state")
        self._params = params
        self._stage = FusionStage(params.memory, timed=self.stages)
        self._groups = ViewGroups(params.radars)
        self._peaks: dict[str, deque[Peaks]] = {radar: deque(maxlen=_KEPT_PEAKS) for radar in params.radars}
        self._refusals = Refusals(_LOG, self.shed)
        self._mountings: dict[str, Pose2] = {}
        #: What is wrong with radars.
        self._trouble = ""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the view of each group that is complete, or whose wait is over."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: isinstance(item.message, BevFrame)):
            sensor, sent_ns = sensor_of(received.topic), received.envelope.sent_ns
            match received.message:
                case VehicleState() as state:
                    self._stage.add_state(state)
                    self._groups.hear_state(state.stamp_ns, sent_ns)
                case Peaks() as peaks:
                    self._peaks[sensor].append(peaks)
                case BevFrame() as frame:
                    view = self._refusals.attempt("view", partial(self._placed, sensor, frame), f"view of {sensor}")
                    if view is not None:
                        self._groups.add(sensor, view, sent_ns, now_ns)
                        out += self._joined(now_ns)
        out += self._joined(now_ns)
        self.shed.note("view", "after its group", self._groups.left_out)
        self._note(self._groups.trouble(now_ns) or self._doubt_of_mountings())
        return out

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the wait for a radar is over."""
        return self._groups.due_ns(now_ns)

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while a radar is silent, its clock differs from that of the others, or views are refused."""
        reason = self._refusals.reason or self._trouble
        return (NodeState.DEGRADED, reason) if reason else (NodeState.READY, "")

    def _joined(self, now_ns: int) -> list[Outgoing]:
        group = self._groups.take(now_ns)
        return [] if group is None else [Outgoing(_VIEW, self._stage.view(*group))]

    def _placed(self, sensor: str, frame: BevFrame) -> RadarView:
        """Return a view with the mounting of its radar, which its peaks say; `ValueError` where none have come."""
        known = self._peaks[sensor]
        if not known:
            raise ValueError(f"{sensor_topic(_VIEW, sensor)} came before its peaks, which say where the radar sits")
        own = next((peaks for peaks in known if peaks.stamp_ns == frame.stamp_ns), known[-1])
        self._mountings[sensor] = own.vehicle_from_radar
        return RadarView(frame, own.vehicle_from_radar, own.ego_compensated)

    def _doubt_of_mountings(self) -> str:
        """Return a warning where two radars are said to sit in one place; empty where not."""
        first: dict[Pose2, str] = {}
        for sensor, pose in self._mountings.items():
            other = first.setdefault(pose, sensor)
            if other != sensor:
                return f"radars {other} and {sensor} have one mounting: set vehicle_from_radar of each ra_former"
        return ""

    def _note(self, trouble: str) -> None:
        """Log a change of what is wrong."""
        if trouble and trouble != self._trouble:
            _LOG.warning("%s", trouble)
        self._trouble = trouble


def create(params: Params) -> ViewFusion:
    """Return the node with its parameters."""
    return ViewFusion(params)
