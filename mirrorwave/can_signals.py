"""What a log's frames say, signal by signal, of any DBC: `mirrorwave can decode --signals`."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from cantools.database.errors import DecodeError

from models.vehicle.end_to_end import checksum_byte, checksum_of, counter_modulus, counter_step
from models.vehicle.hidden_object_list import is_protected, message_rule
from models.vehicle.mapping import MessageRule

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message

    from nodes.can_link import LogFrame


class SignalReport:
    """Counts, periods and values of each message of a DBC; checksum and counter where the DBC has `E2EDataID`."""

    def __init__(self, database: Database, every_s: float) -> None:
        self._watches = {
            (message.frame_id, message.is_extended_frame): _Watch(message) for message in database.messages
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
                self._sample(watch, time_s, watch.take(bytes(frame.data), time_s))

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

    def _sample(self, watch: _Watch, time_s: float, verdict: str) -> None:
        slot = math.floor(time_s / self._every_s) if self._every_s else watch.frames
        if slot != watch.slot:
            watch.slot = slot
            row = {"time_s": time_s, "message": watch.message.name, "verdict": verdict, "signals": watch.values}
            self.samples.append(row)


class _Watch:
    """One message: how often it came, whether its frames are whole, what the last whole one said."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self._rule = message_rule(message) if is_protected(message) else MessageRule()
        self.frames = 0
        self.slot: int | None = None
        self.values: dict[str, Any] = {}
        self._verdicts: Counter[str] = Counter()
        self._times_s: list[float] = []
        self._counter: int | None = None

    def take(self, data: bytes, time_s: float) -> str:
        """Take in a frame; what is wrong with it, or "ok"."""
        self.frames += 1
        self._times_s.append(time_s)
        verdict = self._judge(data)
        self._verdicts[verdict] += 1
        return verdict

    def as_dict(self) -> dict[str, Any]:
        """The message's row."""
        gaps_s = [after - before for before, after in zip(self._times_s, self._times_s[1:], strict=False)]
        return {
            "message": self.message.name,
            "id": self.message.frame_id,
            "frames": self.frames,
            "period_ms": round(1e3 * statistics.median(gaps_s), 3) if gaps_s else None,
            "longest_gap_ms": round(1e3 * max(gaps_s), 3) if gaps_s else None,
            "frames_by_verdict": dict(sorted(self._verdicts.items())),
            "signals": self.values,
        }

    def _judge(self, data: bytes) -> str:
        if len(data) < self.message.length:
            return "wrong length"
        data = data[: self.message.length]
        rule = self._rule.checksum
        if rule is not None:
            position = checksum_byte(self.message, rule)
            if data[position] != checksum_of(rule, data, position):
                return "wrong checksum"
        try:
            decoded = self.message.decode(data, decode_choices=False)
        except DecodeError:
            return "undecodable"
        assert isinstance(decoded, dict)
        self.values = decoded
        return self._judge_counter()

    def _judge_counter(self) -> str:
        rule = self._rule.counter
        if rule is None:
            return "ok"
        last, self._counter = self._counter, int(self.values[rule.signal])
        if last is None:
            return "ok"
        step = counter_step(last, self._counter, counter_modulus(self.message, rule))
        return "ok" if 0 < step <= rule.max_step else "wrong counter"
