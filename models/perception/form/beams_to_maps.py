"""The forming stage: beams and vehicle states in, range-azimuth maps out."""

from __future__ import annotations

from contextlib import nullcontext

import msgspec
import numpy as np

from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from models.perception.state_history import StateHistory
from models.perception.timing import Timed
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState

#: Beams of a scan lie no further apart; stamps that do are of a clock that was set meanwhile.
LONGEST_SCAN_NS = 2_000_000_000


class FormingStage:
    """Maps of one radar, each at the vehicle's pose at the scan's first beam; `former` is None before a set-up.

    `background` [beams, samples] stands in place of the set-up's own.
    """

    def __init__(
        self,
        params: FormingParams | None = None,
        background: np.ndarray | None = None,
        timed: Timed = nullcontext,
    ) -> None:
        self.former: RaFormer | None = None
        self._params = params or FormingParams()
        self._background, self._timed = background, timed
        self._states = StateHistory()
        #: Why the last set-up was refused.
        self._refused = ""
        #: Number and stamp of the scan under way, as its first beam has them.
        self._scan_begun: tuple[int, int] | None = None

    def set_up(self, setup: RadarSetup) -> None:
        """Form by another set-up; `ValueError` for one that cannot be used, which changes nothing."""
        if self._background is not None:
            setup = msgspec.structs.replace(setup, background=self._background)
        try:
            self.former = RaFormer(setup, self._params)
        except ValueError as error:
            self._refused = str(error)
            raise

    @property
    def is_between_scans(self) -> bool:
        """True while no scan is under way."""
        return self.former is None or not self.former.has_begun

    def take_over(self, earlier: FormingStage) -> None:
        """Go on where another stage is: with its radar and the states of its vehicle."""
        self._states = earlier._states
        if earlier.former is not None:
            self.set_up(earlier.former.folder.setup)

    def add_state(self, state: VehicleState) -> None:
        """Take in a state of the vehicle."""
        self._states.add(state)

    def add(self, beam: RadarBeam) -> list[RangeAzimuthMap]:
        """Fold one beam; return the maps that it completes, oldest first; `ValueError` for one of no set-up."""
        if self.former is None:
            raise ValueError(self._refused or f"beam {beam.beam_index} of scan {beam.scan_id} came before radar/setup")
        if jump_s := self._clock_jump_s(beam):
            raise ValueError(f"the radar's clock was set by {jump_s:+.0f} s within scan {beam.scan_id}")
        with self._timed("last beam" if beam.beam_index == beam.beam_count - 1 else "beam"):
            maps = self.former.add(beam, self._state_for(beam))
        if any(ra_map.scan_id == beam.scan_id for ra_map in maps):
            self._scan_begun = None
        return maps

    def flush(self) -> list[RangeAzimuthMap]:
        """Close the scan under way; `ValueError` where its first beam, which never came, would have no stamp."""
        self._scan_begun = None
        return [] if self.former is None else self.former.flush()

    def _clock_jump_s(self, beam: RadarBeam) -> float:
        """Return how far a beam's stamp is from its scan's where that is further than a scan lasts; else 0."""
        if self._scan_begun is None or self._scan_begun[0] != beam.scan_id:
            self._scan_begun = (beam.scan_id, beam.stamp_ns)
        away_ns = beam.stamp_ns - self._scan_begun[1]
        return s_from_ns(away_ns) if abs(away_ns) > LONGEST_SCAN_NS else 0.0

    def _state_for(self, beam: RadarBeam) -> VehicleState | None:
        """Return the newest state not younger than the beam, if valid; the former keeps that of a scan's first beam."""
        state = self._states.at(beam.stamp_ns)
        return state if state is not None and state.valid else None
