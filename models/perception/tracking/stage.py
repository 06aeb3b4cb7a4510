"""The last stage: peaks of successive scans in, bird's-eye views out, with what earlier scans have shown."""

from __future__ import annotations

from contextlib import nullcontext

import msgspec

from models.perception.geometry.confidence import Confidence
from models.perception.geometry.recovery import Residual
from models.perception.geometry.stage import GeometryParams, recover_bev, warm
from models.perception.state_history import StateHistory
from models.perception.timing import Timed
from models.perception.tracking.scan_state import MemoryParams, ScanMemory
from models.perception.tracking.yaw_rate_bias import BiasEstimate
from msgs.values.perception import BevFrame, Peaks
from msgs.values.vehicle import VehicleState


class ViewStage:
    """Views of one radar: peaks folded back through the walls of this scan and of earlier ones, objects followed."""

    def __init__(
        self,
        params: GeometryParams | None = None,
        residual: Residual | None = None,
        confidence: Confidence | None = None,
        memory: MemoryParams | None = None,
        timed: Timed = nullcontext,
    ) -> None:
        self._params, self._residual, self._confidence = params or GeometryParams(), residual, confidence
        self._memory, self._states = ScanMemory(memory or MemoryParams()), StateHistory()
        self._timed = timed
        warm(self._params)

    @property
    def yaw_rate_bias(self) -> BiasEstimate:
        """The bias that is taken off the yaw rate."""
        return self._memory.yaw_rate_bias

    def add_state(self, state: VehicleState) -> None:
        """Take in a state of the vehicle."""
        self._states.add(state)
        self._memory.add(state)

    def view(self, peaks: Peaks) -> BevFrame:
        """Return the view of one scan, with tracks and the vehicle's motion; `ValueError` for too many peaks."""
        with self._timed("geometry"):
            earlier_walls = self._memory.walls_at(peaks)
            frame = recover_bev(peaks, self._params, self._residual, self._confidence, earlier_walls)
        with self._timed("tracking"):
            frame = self._memory.tracked(frame, peaks.vehicle_from_radar)
        return msgspec.structs.replace(frame, ego=self._states.at(peaks.stamp_ns))
