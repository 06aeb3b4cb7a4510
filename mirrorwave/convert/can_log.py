"""A CAN log as vehicle states: what `mirrorwave can decode` reports and `mirrorwave import can` records."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from models.vehicle.can_decoder import CanDecoder, Judged
    from msgs.values.vehicle import VehicleState
    from nodes.can.bus import LogFrame


class LogStep(NamedTuple):
    """One frame of a log: what became of it, and the states that were due with it."""

    stamp_ns: int
    judged: Judged
    states: list[VehicleState]


def log_states(decoder: CanDecoder, frames: Iterable[LogFrame]) -> Iterator[LogStep]:
    """Judge the frames of a log in order; a frame without a time gives no state."""
    from models.vehicle.can_decoder import StateReporter
    from nodes.can.bus import decode_frame

    reporter: StateReporter | None = None
    for frame, stamp_ns in frames:
        judged = decode_frame(decoder, frame, stamp_ns)
        if stamp_ns < 0:
            yield LogStep(stamp_ns, judged, [])
            continue
        reporter = reporter or StateReporter(decoder, stamp_ns)
        due = (reporter.tick(stamp_ns), reporter.frame(judged, stamp_ns))
        yield LogStep(stamp_ns, judged, [state for state in due if state is not None])
