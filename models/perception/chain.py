"""The whole algorithm as one sentence: raw beams in, hidden objects out."""

from __future__ import annotations

from models.perception.detection.detectors import Detector
from models.perception.forming.ra_forming import FormingParams, RaFormer
from models.perception.geometry.confidence import Confidence
from models.perception.geometry.stage import GeometryParams, recover_bev, warm
from models.perception.tracking.scan_state import MemoryParams, ScanMemory
from msgs.values.perception import BevFrame, Peaks
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.vehicle import VehicleState


class Chain:
    """Scan -> bird's-eye view. The nodes are this sentence cut at the topics; both give the same bytes."""

    def __init__(
        self,
        setup: RadarSetup,
        detector: Detector,
        forming: FormingParams | None = None,
        geometry: GeometryParams | None = None,
        confidence: Confidence | None = None,
        memory: MemoryParams | None = None,
    ) -> None:
        self._former = RaFormer(setup, forming or FormingParams())
        self._detector = detector
        self._geometry, self._confidence = geometry or GeometryParams(), confidence
        self._memory = ScanMemory(memory or MemoryParams())
        warm(self._geometry)

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> list[BevFrame]:
        """Fold a beam; the last one of a scan brings its view."""
        if state is not None:
            self._memory.add(state)
        # beams become a map, the map becomes peaks
        return [self._view(self._detector.detect(one)) for one in self._former.add(beam, state)]

    def _view(self, peaks: Peaks) -> BevFrame:
        # peaks are folded back through the walls they and those before them show, objects followed over scans
        remembered = self._memory.walls_at(peaks)
        view = recover_bev(peaks, self._geometry, confidence=self._confidence, remembered=remembered)
        return self._memory.tracked(view, peaks.vehicle_from_radar)
