"""The last stage: peaks of successive scans in, bird's-eye views out, with what earlier scans have shown."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING

import msgspec

from models.perception.mirrors.peaks_to_view import GeometryParams, ObjectJudge, recover_bev, warm
from models.perception.mirrors.recovery import Residual
from models.perception.state_history import StateHistory
from models.perception.target_lists.list_map import list_map
from models.perception.target_lists.two_witnesses import WITNESS_THRESHOLD
from models.perception.timing import Timed
from models.perception.track.scan_state import MemoryParams, ScanMemory
from models.perception.track.yaw_rate_bias import BiasEstimate
from models.perception.trained_radar import SetupCheck
from msgs.values.environment import WallPriors
from msgs.values.perception import UNTRAINED_SETUP, BevFrame, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState

if TYPE_CHECKING:
    # its runtime is loaded where a network is in use
    from models.perception.see.evidence_predictor import EvidencePredictor

#: A vehicle that is slower stands.
MOVING_MPS = 0.5


class ViewStage:
    """Views of one radar: peaks folded back through the walls of this scan and of earlier ones, objects followed."""

    def __init__(
        self,
        params: GeometryParams | None = None,
        residual: Residual | None = None,
        memory: MemoryParams | None = None,
        timed: Timed = nullcontext,
        predictor: EvidencePredictor | None = None,
        detections: GeometryParams | None = None,
    ) -> None:
        self.predictor = predictor
        self._params, self._residual = params or GeometryParams(), residual
        #: For peaks of a radar that gives detections.
        self._detections = detections or self._params
        #: For scans that the network judges.
        self._judged = judged_params(self._params, predictor)
        self._memory, self._states = ScanMemory(memory or MemoryParams()), StateHistory()
        self._timed = timed
        self._setup: RadarSetup | None = None
        self._check: SetupCheck | None = None
        #: In what the radar of the last scan differs from the one that the network was trained for; empty: in nothing.
        self.doubt = ""
        for used in {self._params, self._detections}:
            warm(used)

    @property
    def yaw_rate_bias(self) -> BiasEstimate:
        """The bias that is taken off the yaw rate."""
        return self._memory.yaw_rate_bias

    def take_over(self, earlier: ViewStage) -> None:
        """Go on where another stage of the same `memory` is: with its tracks, walls and vehicle states."""
        self._memory, self._states = earlier._memory, earlier._states
        if earlier._setup is not None:
            self.set_up(earlier._setup)

    def set_up(self, setup: RadarSetup) -> None:
        """Compare the radar of the maps to come with the one that the evidence network was trained for."""
        self._setup = setup
        if self.predictor is not None:
            self._check = SetupCheck(self.predictor.card.name, self.predictor.card.radar, setup)

    def add_state(self, state: VehicleState) -> None:
        """Take in a state of the vehicle."""
        self._states.add(state)
        self._memory.add(state)

    def add_walls(self, message: WallPriors) -> None:
        """Take in walls from a map or another sensor; a scan uses those stamped at or before it."""
        self._memory.add_walls(message)

    def view(self, peaks: Peaks, ra_map: RangeAzimuthMap | None = None) -> BevFrame:
        """Return the view of one scan, with tracks and the vehicle's motion; `ValueError` for too many peaks.

        Objects are those that the network sees in the scan's map, which of a list of detections is made here; without
        either, or with peaks that no network has detected, they are clusters of places.
        """
        ego = self._states.at(peaks.stamp_ns)
        with self._timed("geometry"):
            earlier_walls = self._memory.walls_at(peaks)
            if peaks.sensor and self.predictor is not None:
                ra_map = list_map(peaks)
            judge = self._judge(peaks, ra_map, ego)
            params = self._detections if peaks.sensor else self._judged if judge else self._params
            # a residual corrects the walls that it was trained on
            residual = self._residual if params.back_end == self._params.back_end else None
            frame = recover_bev(peaks, params, residual, earlier_walls, judge)
        with self._timed("tracking"):
            frame = self._memory.tracked(frame, peaks.vehicle_from_radar, peaks.ego_compensated)
        self.doubt = self._check.doubt(ra_map.unused_beams) if self._check and judge and ra_map else ""
        flags = frame.flags
        if self.doubt and UNTRAINED_SETUP not in flags:
            flags = (*flags, UNTRAINED_SETUP)
        return msgspec.structs.replace(frame, ego=ego, flags=flags)

    def _judge(self, peaks: Peaks, ra_map: RangeAzimuthMap | None, ego: VehicleState | None) -> ObjectJudge | None:
        """Return what sees the objects of a scan; None: no network does, as of peaks that CFAR has detected."""
        if self.predictor is None or ra_map is None or not self.predictor.suits(ra_map):
            return None
        if not peaks.detector and not peaks.sensor:
            return None
        moving = ego is not None and ego.valid and abs(ego.speed_mps) >= MOVING_MPS
        memory = self._memory.wall_elements_at(peaks)
        threshold = WITNESS_THRESHOLD if peaks.sensor else None
        return partial(self.predictor.judge, ra_map, moving=moving, memory=memory, threshold=threshold)


def judged_params(params: GeometryParams, predictor: EvidencePredictor | None) -> GeometryParams:
    """Return the parameters of scans that a network judges: with the walls that it was trained on."""
    return params if predictor is None else msgspec.structs.replace(params, walls=predictor.walls)
