"""Signals in the frames of a bus or a log, for any DBC: `mirrorwave can decode|monitor --signals`."""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from models.vehicle.can_frame import FrameCheck, Verdict
from models.vehicle.can_mapping import MessageRule
from models.vehicle.hidden_object_list import is_protected, message_rule

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message

    from nodes.can.bus import LogFrame


class SignalReport:
    """Counts, periods and values of each message of a DBC; checksum and counter where the DBC has `E2EDataID`.

    `every_s` spaces the samples, None keeps none; `kept_gaps` bounds what the median period is taken over (the newest),
    so that a live bus may be watched for days.
    """

    def __init__(self, database: Database, every_s: float | None, kept_gaps: int | None = None) -> None:
        self._watches = {
            (message.frame_id, message.is_extended_frame): _Watch(message, kept_gaps) for message in database.messages
        }
        self._every_s = every_s
        self._start_ns: int | None = None
        self.frames = self.known = 0
        self.duration_s = 0.0
        #: Why the log could not be read on; empty if it could.
        self.loss = ""
        #: Values over time: the first frame of each message in each interval.
        self.samples: list[dict[str, Any]] = []

    def read(self, frames: Iterable[LogFrame]) -> None:
        """Take in a log."""
        for frame, stamp_ns in frames:
            self.frames += 1
            if stamp_ns < 0 or frame.is_error_frame or frame.is_remote_frame:
                continue
            self._start_ns = stamp_ns if self._start_ns is None else self._start_ns
            time_s = 1e-9 * (stamp_ns - self._start_ns)
            self.duration_s = max(self.duration_s, time_s)
            watch = self._watches.get((frame.arbitration_id, frame.is_extended_id))
            if watch is not None:
                self.known += 1
                verdict = watch.take(bytes(frame.data), time_s)
                if self._every_s is not None:
                    slot = math.floor(time_s / self._every_s) if self._every_s else watch.frames
                    if slot != watch.slot:
                        watch.slot = slot
                        row = {
                            "time_s": time_s,
                            "message": watch.message.name,
                            "verdict": verdict,
                            "signals": watch.values,
                        }
                        self.samples.append(row)

    def messages(self) -> list[dict[str, Any]]:
        """Messages that came, in the order of the DBC."""
        return [watch.as_dict() for watch in self._watches.values() if watch.frames]

    def as_dict(self) -> dict[str, Any]:
        """Everything, as JSON has it."""
        return {
            "frames": self.frames,
            "known_frames": self.known,
            "duration_s": self.duration_s,
            "messages": self.messages(),
            "samples": self.samples,
            "loss": self.loss or None,
        }


class _Watch:
    """One message: how often it came, whether its frames are whole, what the last whole one said."""

    def __init__(self, message: Message, kept_gaps: int | None) -> None:
        self.message = message
        self._check = FrameCheck(message, message_rule(message) if is_protected(message) else MessageRule())
        self.frames = 0
        self.slot: int | None = None
        self.values: dict[str, Any] = {}
        self._verdicts: Counter[str] = Counter()
        self._gaps_s: deque[float] = deque(maxlen=kept_gaps)
        self._longest_gap_s = 0.0
        self._last_s: float | None = None

    def take(self, data: bytes, time_s: float) -> str:
        """Take in a frame; what is wrong with it, or "ok"."""
        self.frames += 1
        # a log whose time goes back says nothing of the period there
        if self._last_s is not None and time_s >= self._last_s:
            self._gaps_s.append(time_s - self._last_s)
            self._longest_gap_s = max(self._longest_gap_s, time_s - self._last_s)
        self._last_s = time_s
        check, _, values = self._check.check(data)
        if values is not None:
            self.values = values
        verdict = "ok" if check in (Verdict.COUNTED, Verdict.FIRST) else str(check)
        self._verdicts[verdict] += 1
        return verdict

    def as_dict(self) -> dict[str, Any]:
        """The message's row."""
        return {
            "message": self.message.name,
            "id": self.message.frame_id,
            "frames": self.frames,
            "period_ms": round(1e3 * statistics.median(self._gaps_s), 3) if self._gaps_s else None,
            "longest_gap_ms": round(1e3 * self._longest_gap_s, 3) if self._gaps_s else None,
            "frames_by_verdict": dict(sorted(self._verdicts.items())),
            "signals": self.values,
        }
