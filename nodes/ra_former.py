"""Forming of the range-azimuth map of each scan, beam by beam as they arrive.

Where beams come faster than they can be folded, whole scans are left out (`nodes.inputs.beam_queue`): never single
beams of a scan that was begun. A scan of which the bus lost too many beams is left out as well. All are counted.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import ClassVar

from models.perception.form.background import load_background
from models.perception.form.beams_to_maps import FormingStage
from models.perception.form.ra_forming import FormingParams
from models.perception.timing import Timed
from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.radar import WIRING_FAULTS, RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.inputs.beam_queue import BeamQueue
from nodes.inputs.refusals import Refusals
from nodes.node import Node

_LOG = logging.getLogger(__name__)

#: A scan whose next beam has not come for this long is given up and published with what is there.
PATIENCE_NS = 500_000_000
#: A scan is not begun where beams have piled up so high that, at the pace of late, its last would be folded more than
#: this many scans after it came: half the deadline, and the other half belongs to what follows.
BEHIND = 0.5
#: A scan of which the bus lost beams is left out when a larger share of its beams is missing: 25 beams carry 15
#: unknowns, with fewer than these the azimuths are guesses.
MISSING_LIMIT = 0.4


class Params(FormingParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the forming stage."""

    formerly: ClassVar[dict[str, str]] = {
        "": "models.perception.form.ra_forming",
        "coherence": "models.perception.form.coarray",
        "subtract_background": "models.perception.form.ra_forming",
        "ego_compensation": "models.perception.form.beams_to_maps",
    }

    #: Open-field background (.npy of `mirrorwave calibrate background`) in place of the set-up's own.
    background: str | None = None


class RaFormerNode(Node):
    """radar/beam -> radar/ra_map."""

    inputs = ("radar/setup", "radar/beam", "vehicle/state")
    outputs = ("radar/ra_map",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        # compiles the folding kernel while the graph still waits for this node, not when the first beam does
        FormingStage(params).set_up(RadarSetup())
        self._stage = forming_stage(params, self.stages)
        #: Takes the other's place before the next scan.
        self._next_stage: FormingStage | None = None
        self._queue = BeamQueue(BEHIND)
        #: Durations of the last folds, about a scan; a test puts another clock in.
        self._folds_ns: deque[int] = deque(maxlen=32)
        self._clock_ns: Callable[[], int] = time.perf_counter_ns
        self._give_up_ns: int | None = None
        self._refusals = Refusals(_LOG, self.shed, "beam")
        #: Why scans were left out lately; empty once two successive ones came through.
        self._behind = ""
        self._published_scan: int | None = None
        #: What is wrong with the receiver's wiring according to the last map.
        self._wiring = ""

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Fold one beam; the last of a scan brings its map, a long silence that of an unfinished one."""
        # set-up and vehicle state first: what they say holds for the beams that came with them
        for received in sorted(inputs, key=lambda item: item.topic == "radar/beam"):
            match received.message:
                case RadarSetup() as setup:
                    self._set_up(setup)
                case VehicleState() as state:
                    self._stage.add_state(state)
                case RadarBeam():
                    self._put(received)
                    self._give_up_ns = now_ns + PATIENCE_NS
        maps = self._fold_next()
        if self._queue:
            # what waits here is not missing, however long folding takes
            self._give_up_ns = now_ns + PATIENCE_NS
        elif self._give_up_ns is not None and now_ns >= self._give_up_ns:
            maps += self._close_scan()
            self._give_up_ns = None
        return [Outgoing("radar/ra_map", ra_map) for ra_map in maps if self._is_sound(ra_map)]

    def pending(self) -> bool:
        """Return whether beams wait."""
        return len(self._queue) > 0

    def due_ns(self, now_ns: int) -> int | None:
        """Return when to stop waiting for the rest of a scan."""
        return self._give_up_ns

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while beams are refused, no set-up has come, scans are left out or the wiring is wrong."""
        reason = self._refusals.reason or self._behind or self._wiring
        return (NodeState.DEGRADED, reason) if reason else (NodeState.READY, "")

    def change_params(self, params: Params) -> None:
        """Form by other parameters from the next scan on; the scan under way is formed by those that it began with."""
        stage = forming_stage(params, self.stages)
        stage.take_over(self._stage)
        self._next_stage = stage

    def _set_up(self, setup: RadarSetup) -> None:
        """Form by another set-up; one that cannot be used changes nothing, and its beams are refused as they come."""
        try:
            self._stage.set_up(setup)
            if self._next_stage is not None:
                self._next_stage.set_up(setup)
        except ValueError as error:
            self._refusals.refuse("setup", error)
            return
        self._queue.at_once = setup.array.digital

    def _put(self, received: Received) -> None:
        scans, beams = self._queue.shed_scans, self._queue.shed_beams
        self._queue.put(received)
        self._count("of a scan left out", self._queue.shed_beams - beams)
        for _ in range(self._queue.shed_scans - scans):
            self._leave_out("behind")

    def _fold_next(self) -> list[RangeAzimuthMap]:
        """Return the maps of the next beam: the bus is read between two beams, so that it loses none meanwhile."""
        if not self._queue:
            return []
        # a scan that another follows gets no more beams
        maps = self._close_scan() if self._queue.ends_scan() else []
        if self._next_stage is not None and self._stage.is_between_scans:
            self._stage, self._next_stage = self._next_stage, None
        start_ns = self._clock_ns()
        maps += self._fold(self._queue.take())
        self._folds_ns.append(self._clock_ns() - start_ns)
        if self._stage.former is not None:
            # none where more beams are to come than a scan has nanoseconds
            share_ns = max(self._stage.former.folder.setup.beam_share_ns, 1)
            self._queue.load = sum(self._folds_ns) / len(self._folds_ns) / share_ns
        return maps

    def _leave_out(self, reason: str) -> None:
        self.shed.add("scan", reason)
        left_out = sum(count.count for count in self.shed.counts() if count.what == "scan")
        self._behind = f"{reason}: {counted(left_out, 'scan')} left out so far"

    def _is_sound(self, ra_map: RangeAzimuthMap) -> bool:
        """Return whether a map is to be published: not one of which the bus lost too many beams."""
        assert self._stage.former is not None
        used = len(self._stage.former.folder.setup.beams) - len(ra_map.unused_beams)
        is_torn = self._queue.torn(ra_map.scan_id)
        if is_torn and len(ra_map.missing_beams) > MISSING_LIMIT * used:
            self._leave_out("torn")
            return False
        if self._published_scan is not None and ra_map.scan_id == self._published_scan + 1:
            self._behind = ""
        self._published_scan = ra_map.scan_id
        wiring = " and ".join(text for name, text in WIRING_FAULTS.items() if name in ra_map.faults)
        if wiring and not self._wiring:
            _LOG.warning("scan %d: %s", ra_map.scan_id, wiring)
        self._wiring = wiring
        return True

    def _close_scan(self) -> list[RangeAzimuthMap]:
        try:
            return self._stage.flush()
        except ValueError as error:
            self._refusals.refuse("scan", error)
            return []

    def _fold(self, beam: RadarBeam) -> list[RangeAzimuthMap]:
        former = self._stage.former
        late, repeated = (0, 0) if former is None else (former.late_beams, former.repeated_beams)
        try:
            maps = self._stage.add(beam)
        except ValueError as error:
            self._refusals.refuse("beam", error)
            return []
        assert former is not None
        self._count("late", former.late_beams - late)
        self._count("repeated", former.repeated_beams - repeated)
        if maps:
            self._refusals.accept()
        return maps

    def _count(self, reason: str, beams: int) -> None:
        if beams:
            self.shed.add("beam", reason, beams)


def forming_stage(params: Params, timed: Timed = nullcontext) -> FormingStage:
    """Return the stage that parameters name; `ValueError` or `OSError` names a background that cannot be read."""
    background = None if params.background is None else load_background(Path(params.background))
    return FormingStage(params, background, timed)


def create(params: Params) -> RaFormerNode:
    """Return the node with its parameters."""
    return RaFormerNode(params)
