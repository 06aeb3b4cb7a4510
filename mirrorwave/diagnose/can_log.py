"""Report on a log of a CAN bus: states, sampled, and events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from mirrorwave.convert.can_log import log_states
from models.perception.track.odometry import Odometry
from models.vehicle.can_decoder import HARMLESS

if TYPE_CHECKING:
    from mirrorwave.diagnose.can_signals import SignalReport
    from models.vehicle.can_decoder import CanDecoder, Judged
    from msgs.values.vehicle import VehicleState
    from nodes.can.bus import LogFrame


#: Faults of one kind and message closer than this are one event.
_EVENT_GAP_S = 1.0


class LogReport:
    """Report on a log: states, sampled, and events: runs of frames that do not count, spans that are not valid."""

    def __init__(self, decoder: CanDecoder, every_s: float) -> None:
        self._decoder, self._every_s = decoder, every_s
        self.samples: list[dict[str, Any]] = []
        self.events: list[dict[str, Any]] = []
        self.frames = self.states = self.valid_states = 0
        self.start_ns: int | None = None
        self.duration_s = 0.0
        self.loss = ""
        self._slot = -1
        self._invalid: dict[str, Any] | None = None
        self._odometry = Odometry()

    def read(self, frames: Iterable[LogFrame]) -> None:
        """Take in a log; one that cannot be read on leaves its reason in `loss`."""
        for stamp_ns, judged, states in log_states(self._decoder, until_error(frames, self)):
            self.frames += 1
            if stamp_ns < 0:
                continue
            self.start_ns = stamp_ns if self.start_ns is None else self.start_ns
            self.duration_s = max(self.duration_s, self._time_s(stamp_ns))
            self._note_frame(judged, stamp_ns)
            for state in states:
                self._note_state(state)

    def as_dict(self) -> dict[str, Any]:
        """Everything, as JSON has it."""
        return {
            "frames": self.frames,
            "duration_s": self.duration_s,
            "frames_by_verdict": {str(verdict): count for verdict, count in sorted(self._decoder.counts.items())},
            "state_count": self.states,
            "valid_state_count": self.valid_states,
            "states": self.samples,
            "events": self.events,
            "yaw_rate_bias": self._odometry.yaw_rate_bias._asdict(),
            "warnings": list(self._decoder.warnings),
            "loss": self.loss or None,
        }

    @property
    def yaw_rate_bias(self) -> str:
        """Estimate of the gyroscope's bias from the drive."""
        return str(self._odometry.yaw_rate_bias)

    def _time_s(self, stamp_ns: int) -> float:
        return 1e-9 * (stamp_ns - (self.start_ns or 0))

    def _note_frame(self, judged: Judged, stamp_ns: int) -> None:
        if judged.verdict in HARMLESS:
            return
        time_s = self._time_s(stamp_ns)
        for event in reversed(self.events):
            same = event["message"] == judged.message and event["event"] == str(judged.verdict)
            if same and time_s - event["to_s"] <= _EVENT_GAP_S:
                event.update(to_s=time_s, count=event["count"] + 1)
                return
        self.events.append(_event(str(judged.verdict), time_s, judged.message, judged.why))

    def _note_state(self, state: VehicleState) -> None:
        time_s = self._time_s(state.stamp_ns)
        self.states += 1
        self.valid_states += state.valid
        self._odometry.add(state)
        # the first state of each interval; without intervals, every one
        slot = int(time_s / self._every_s) if self._every_s else self.states
        if slot != self._slot:
            self._slot = slot
            self.samples.append({"time_s": time_s, **state_row(state)})
        if state.valid:
            self._invalid = None
        elif self._invalid is None:
            self._invalid = _event("state not valid", time_s, "", state.reason)
            self.events.append(self._invalid)
        else:
            self._invalid.update(to_s=time_s, count=self._invalid["count"] + 1)


def _event(kind: str, time_s: float, message: str, why: str) -> dict[str, Any]:
    return {"event": kind, "from_s": time_s, "to_s": time_s, "count": 1, "message": message, "why": why}


def state_row(state: VehicleState) -> dict[str, Any]:
    """Return a state as JSON has it."""
    return {
        "speed_mps": state.speed_mps,
        "yaw_rate_rps": state.yaw_rate_rps,
        "steering_rad": state.steering_rad,
        "valid": state.valid,
        "reason": state.reason,
        "age_s": state.age_s,
    }


def until_error(frames: Iterable[LogFrame], report: LogReport | SignalReport) -> Iterator[LogFrame]:
    """Yield frames up to an error of the log, which the report keeps as its loss."""
    try:
        yield from frames
    except ValueError as error:
        report.loss = str(error)
