"""The clock of another host: its lead over ours, measured by asking, and message stamps converted to our clock.

Stamps are the monotonic clock of a host and count from its start: those of two hosts have nothing in common. A
question leaves at `asked_ns`, is answered with the peer's `peer_ns` and is back at `answered_ns`. Whatever the two
directions took, the peer is ahead by peer_ns - (asked_ns + answered_ns)/2 to within half the round trip.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

StructType = TypeVar("StructType", bound=msgspec.Struct)

#: Maximum drift of one clock against the other: the largest slew of a kernel (adjtimex), 500 ppm.
MAX_DRIFT = 500e-6
_SAMPLES_KEPT = 64


class ClockSample(NamedTuple):
    """One question and its answer."""

    asked_ns: int
    peer_ns: int
    answered_ns: int

    @property
    def round_trip_ns(self) -> int:
        """Time from question to answer."""
        return self.answered_ns - self.asked_ns

    @property
    def offset_ns(self) -> int:
        """Lead of the peer's clock over ours at the time of the answer."""
        return self.peer_ns - (self.asked_ns + self.answered_ns) // 2

    def error_ns(self, now_ns: int) -> int:
        """Return a bound of the error of `offset_ns` now; +1 for the division."""
        return self.round_trip_ns // 2 + 1 + round(MAX_DRIFT * max(0, now_ns - self.answered_ns))


class PeerClock:
    """Offset of a peer's clock from the best of the last answers.

    The offset in use starts at zero, which is right on one host, and moves only when an answer excludes it: stamps of
    two clocks that agree are never changed.
    """

    def __init__(self) -> None:
        self._samples: deque[ClockSample] = deque(maxlen=_SAMPLES_KEPT)
        #: Added to our clock it gives the peer's; subtracted from the peer's stamps it gives ours.
        self.offset_ns = 0

    def add(self, sample: ClockSample) -> bool:
        """Add an answer; True if it contradicts all before it: the peer has restarted, or slept."""
        now_ns = sample.answered_ns
        best = self.best(now_ns)
        restarted = best is not None and abs(sample.offset_ns - best.offset_ns) > (
            sample.error_ns(now_ns) + best.error_ns(now_ns)
        )
        if restarted:
            self._samples.clear()
        self._samples.append(sample)
        best = self.best(now_ns)
        assert best is not None
        if abs(best.offset_ns - self.offset_ns) > best.error_ns(now_ns):
            self.offset_ns = best.offset_ns
        return restarted

    def best(self, now_ns: int) -> ClockSample | None:
        """Return the most informative answer at `now_ns`: short round trips age too."""
        return min(self._samples, key=lambda sample: sample.error_ns(now_ns), default=None)

    def error_ns(self, now_ns: int) -> int | None:
        """Return a bound of the error of `offset_ns`; None before the first answer."""
        best = self.best(now_ns)
        return None if best is None else abs(best.offset_ns - self.offset_ns) + best.error_ns(now_ns)


def shift_stamps(message: StructType, by_ns: int) -> StructType:
    """Return `message` with all its `*stamp_ns`, nested values and arrays included, later by `by_ns`; 0 is "none"."""
    changes: dict[str, Any] = {}
    for name in message.__struct_fields__ if by_ns else ():
        value = getattr(message, name)
        moved = _moved(value, by_ns) if name.endswith("stamp_ns") else _moved_inside(value, by_ns)
        if moved is not value:
            changes[name] = moved
    return msgspec.structs.replace(message, **changes) if changes else message


def _moved(stamps: int | np.ndarray, by_ns: int) -> int | np.ndarray:
    if isinstance(stamps, np.ndarray):
        # a stamp near the end of int64 comes from nobody's clock and may wrap
        moved: np.ndarray = np.where(stamps == 0, stamps, stamps + np.int64(by_ns))
        return moved
    return stamps + by_ns if stamps else stamps


def _moved_inside(value: Any, by_ns: int) -> Any:
    if isinstance(value, msgspec.Struct):
        return shift_stamps(value, by_ns)
    if isinstance(value, tuple):
        moved = tuple(_moved_inside(item, by_ns) for item in value)
        return moved if any(new is not old for new, old in zip(moved, value, strict=True)) else value
    return value
