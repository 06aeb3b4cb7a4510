"""Node `ra_former`: folds beams as they arrive and publishes the range-azimuth map of each scan.

If beams arrive faster than they can be folded, whole scans are dropped (`nodes.inputs.beam_queue`): never single
beams of a begun scan. A scan of which the bus lost too many beams is dropped as well. All are counted.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import msgspec

from models.perception.forming.background import load_background
from models.perception.forming.ra_forming import FormingParams, RaFormer
from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.inputs.beam_queue import BeamQueue
from nodes.inputs.state_history import StateHistory
from nodes.node import Node

_LOG = logging.getLogger(__name__)

#: A scan whose next beam has not arrived for this long is closed and published with its present beams.
PATIENCE_NS = 500_000_000
#: Beams of a scan are no further apart; larger steps mean that the clock was set meanwhile.
LONGEST_SCAN_NS = 2_000_000_000


class Params(FormingParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the forming stage; `ego_compensation` compensates the vehicle's own motion."""

    ego_compensation: bool = True
    #: Open-field background (.npy of `mirrorwave calibrate background`) in place of the set-up's own.
    background: str | None = None
    #: A scan is not begun if so many beams are queued that, at the recent pace, its last would be folded more
    #: than this many scans after it came: half the deadline, and the other half belongs to the later stages.
    behind: float = 0.5
    #: A scan of which the bus lost beams is dropped when a larger share of its beams is missing: 25 beams carry 15
    #: unknowns, with fewer than these the azimuths are underdetermined.
    missing_limit: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.behind > 0.0:
            raise ValueError(f"ra_former.behind must be positive, got {self.behind!r}")
        if not 0.0 <= self.missing_limit <= 1.0:
            raise ValueError(f"ra_former.missing_limit must be 0..1, got {self.missing_limit!r}")


class RaFormerNode(Node):
    """radar/beam -> radar/ra_map."""

    inputs = ("radar/setup", "radar/beam", "vehicle/state")
    outputs = ("radar/ra_map",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params
        # compiles the folding kernel while the graph still waits for this node, not at the first beam
        RaFormer(RadarSetup(), params)
        self._background = None if params.background is None else load_background(Path(params.background))
        self._former: RaFormer | None = None
        self._states = StateHistory()
        self._queue = BeamQueue(params.behind)
        #: Durations of the last folds, about a scan; tests replace the clock.
        self._folds_ns: deque[int] = deque(maxlen=32)
        self._clock_ns: Callable[[], int] = time.perf_counter_ns
        self._give_up_ns: int | None = None
        self._refused = 0
        self._trouble = ""
        #: Reason for recently dropped scans; empty once two successive ones passed.
        self._behind = ""
        self._published_scan: int | None = None
        #: Number and stamp of the current scan, as its first beam has them.
        self._scan_begun: tuple[int, int] | None = None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Fold one beam; the last of a scan yields its map, a long silence that of an unfinished one."""
        # set-up and vehicle state first: they apply to the beams that came with them
        for received in sorted(inputs, key=lambda item: item.topic == "radar/beam"):
            match received.message:
                case RadarSetup() as setup:
                    self._set_up(setup)
                case VehicleState() as state:
                    self._states.add(state)
                case RadarBeam():
                    self._put(received)
                    self._give_up_ns = now_ns + PATIENCE_NS
        maps = self._fold_next()
        if self._queue:
            # a beam that waits here is not missing, however long folding takes
            self._give_up_ns = now_ns + PATIENCE_NS
        elif self._give_up_ns is not None and now_ns >= self._give_up_ns:
            maps += self._close_scan()
            self._give_up_ns = None
        return [Outgoing("radar/ra_map", ra_map) for ra_map in maps if self._is_sound(ra_map)]

    def pending(self) -> bool:
        """Return true while beams wait."""
        return len(self._queue) > 0

    def due_ns(self, now_ns: int) -> int | None:
        """Return when to stop waiting for the rest of a scan."""
        return self._give_up_ns

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while beams are refused, no set-up has arrived or scans are dropped."""
        reason = self._trouble or self._behind
        return (NodeState.DEGRADED, reason) if reason else (NodeState.READY, "")

    def _set_up(self, setup: RadarSetup) -> None:
        """Use another set-up; an unsuitable one changes nothing, and its beams are refused."""
        try:
            self._former = RaFormer(self._with_background(setup), self._params)
        except ValueError as error:
            self._warn_refused(str(error), "setup")
            return
        self._queue.at_once = setup.array.digital

    def _with_background(self, setup: RadarSetup) -> RadarSetup:
        """Return the set-up with the background of the parameters, if they name one."""
        return setup if self._background is None else msgspec.structs.replace(setup, background=self._background)

    def _put(self, received: Received) -> None:
        scans, beams = self._queue.shed_scans, self._queue.shed_beams
        self._queue.put(received)
        self._count("of a scan left out", self._queue.shed_beams - beams)
        for _ in range(self._queue.shed_scans - scans):
            self._leave_out("behind")

    def _fold_next(self) -> list[RangeAzimuthMap]:
        """Return the maps of the next beam; the bus is emptied between beams, so that it drops nothing meanwhile."""
        if not self._queue:
            return []
        # a scan that another follows gets no more beams
        maps = self._close_scan() if self._queue.ends_scan() else []
        start_ns = self._clock_ns()
        maps += self._fold(self._queue.take())
        self._folds_ns.append(self._clock_ns() - start_ns)
        if self._former is not None:
            # none if more beams are missing than a scan has nanoseconds
            share_ns = max(self._former.folder.setup.beam_share_ns, 1)
            self._queue.load = sum(self._folds_ns) / len(self._folds_ns) / share_ns
        return maps

    def _leave_out(self, reason: str) -> None:
        self.shed.add("scan", reason)
        left_out = sum(count.count for count in self.shed.counts() if count.what == "scan")
        self._behind = f"{reason}: {counted(left_out, 'scan')} left out so far"

    def _is_sound(self, ra_map: RangeAzimuthMap) -> bool:
        """Return whether a map is to be published: not one of which the bus lost too many beams."""
        assert self._former is not None
        used = len(self._former.folder.setup.beams) - len(ra_map.unused_beams)
        is_torn = self._queue.torn(ra_map.scan_id)
        if is_torn and len(ra_map.missing_beams) > self._params.missing_limit * used:
            self._leave_out("torn")
            return False
        if self._published_scan is not None and ra_map.scan_id == self._published_scan + 1:
            self._behind = ""
        self._published_scan = ra_map.scan_id
        return True

    def _close_scan(self) -> list[RangeAzimuthMap]:
        self._scan_begun = None
        try:
            return [] if self._former is None else self._former.flush()
        except ValueError as error:
            # its first beam, which is missing, would have an impossible stamp
            self._warn_refused(str(error), "scan")
            return []

    def _fold(self, beam: RadarBeam) -> list[RangeAzimuthMap]:
        if self._former is None:
            self._warn_refused(f"beam {beam.beam_index} of scan {beam.scan_id} came before radar/setup")
            return []
        if jump_s := self._clock_jump_s(beam):
            self._warn_refused(f"the radar's clock was set by {jump_s:+.0f} s within scan {beam.scan_id}")
            return []
        late, repeated = self._former.late_beams, self._former.repeated_beams
        try:
            with self.stages("last beam" if beam.beam_index == beam.beam_count - 1 else "beam"):
                maps = self._former.add(beam, self._state_for(beam))
        except ValueError as error:
            self._warn_refused(str(error))
            return []
        self._count("late", self._former.late_beams - late)
        self._count("repeated", self._former.repeated_beams - repeated)
        if maps:
            self._trouble = ""
        if any(ra_map.scan_id == beam.scan_id for ra_map in maps):
            self._scan_begun = None
        return maps

    def _clock_jump_s(self, beam: RadarBeam) -> float:
        """Return how far a beam's stamp is from its scan's if that exceeds a scan; else 0."""
        if self._scan_begun is None or self._scan_begun[0] != beam.scan_id:
            self._scan_begun = (beam.scan_id, beam.stamp_ns)
        away_ns = beam.stamp_ns - self._scan_begun[1]
        return s_from_ns(away_ns) if abs(away_ns) > LONGEST_SCAN_NS else 0.0

    def _count(self, reason: str, beams: int) -> None:
        if beams:
            self.shed.add("beam", reason, beams)

    def _state_for(self, beam: RadarBeam) -> VehicleState | None:
        """Return the newest valid state not younger than the beam; the former keeps a scan's first beam's for all."""
        state = self._states.at(beam.stamp_ns) if self._params.ego_compensation else None
        return state if state is not None and state.valid else None

    def _warn_refused(self, trouble: str, kind: str = "beam") -> None:
        self._refused += kind == "beam"
        self.shed.add(kind, "refused")
        if trouble != self._trouble:
            _LOG.warning("%s (%s refused so far)", trouble, counted(self._refused, "beam"))
        self._trouble = trouble


def create(params: Params) -> RaFormerNode:
    """Return the node with its parameters."""
    return RaFormerNode(params)
