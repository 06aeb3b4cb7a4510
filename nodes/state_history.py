"""Vehicle states joined to scans by stamp: the same answer however late a message comes."""

from __future__ import annotations

from collections import deque

from msgs.vehicle import VehicleState

#: A vehicle state older than this says nothing about a scan.
MAX_AGE_NS = 500_000_000
#: Some seconds at the rate of a vehicle's bus.
KEPT_STATES = 256


class StateHistory:
    """The last vehicle states, asked by time."""

    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque(maxlen=KEPT_STATES)

    def add(self, state: VehicleState) -> None:
        """Remember a state."""
        self._states.append(state)

    def at(self, stamp_ns: int) -> VehicleState | None:
        """The newest state not younger than `stamp_ns`, None where it is too old or there is none."""
        # by stamp, not by arrival: what was held up on its way must not pass for the newest
        known = (state for state in reversed(self._states) if state.stamp_ns <= stamp_ns)
        state = max(known, key=lambda state: state.stamp_ns, default=None)
        return state if state is not None and stamp_ns - state.stamp_ns <= MAX_AGE_NS else None
