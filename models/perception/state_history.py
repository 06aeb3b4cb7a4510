"""Vehicle states joined to scans by stamp: the result does not depend on the delay of messages."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from operator import attrgetter

from msgs.values.vehicle import VehicleState

#: A vehicle state older than this is not used for a scan.
MAX_AGE_NS = 500_000_000
#: A scan of a LiDAR takes 8 s with the defaults and is looked up after its end, by the stamp of its start.
KEPT_NS = 30_000_000_000
#: Maximum number: 30 s at 200 Hz are fewer.
KEPT_STATES = 8192

_stamp = attrgetter("stamp_ns")


class StateHistory:
    """The vehicle states of the last `KEPT_NS`, looked up by time."""

    def __init__(self) -> None:
        #: In order of stamp, each stamp once.
        self._states: list[VehicleState] = []

    def add(self, state: VehicleState) -> None:
        """Add a state; one far before the others is of a restarted source."""
        if self._states and state.stamp_ns < self._states[-1].stamp_ns - KEPT_NS:
            self._states.clear()
        at = bisect_left(self._states, state.stamp_ns, key=_stamp)
        is_known = at < len(self._states) and self._states[at].stamp_ns == state.stamp_ns
        self._states[at : at + is_known] = [state]
        oldest = bisect_left(self._states, self._states[-1].stamp_ns - KEPT_NS, key=_stamp)
        del self._states[: max(oldest, len(self._states) - KEPT_STATES)]

    def at(self, stamp_ns: int) -> VehicleState | None:
        """Return the newest state not younger than `stamp_ns`, None if it is too old or there is none."""
        # by stamp, not by arrival: a delayed message must not count as the newest
        count = bisect_right(self._states, stamp_ns, key=_stamp)
        state = self._states[count - 1] if count else None
        return state if state is not None and stamp_ns - state.stamp_ns <= MAX_AGE_NS else None
