"""The whole algorithm as one sentence: raw beams in, hidden objects out."""

from __future__ import annotations

from models.perception.confidence import PlaceConfidence
from models.perception.detectors import Detector
from models.perception.geometry import GeometryParams, recover_bev, warm
from models.perception.ra_forming import FormingParams, RaFormer
from msgs.perception import BevFrame
from msgs.radar import RadarBeam, RadarSetup
from msgs.vehicle import VehicleState


class Chain:
    """Scan -> bird's-eye view. The nodes are this sentence cut at the topics; both give the same bytes."""

    def __init__(
        self,
        setup: RadarSetup,
        detector: Detector,
        forming: FormingParams | None = None,
        geometry: GeometryParams | None = None,
        confidence: PlaceConfidence | None = None,
    ) -> None:
        self._former = RaFormer(setup, forming or FormingParams())
        self._detector = detector
        self._geometry, self._confidence = geometry or GeometryParams(), confidence
        warm(self._geometry)

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> list[BevFrame]:
        """Fold a beam; the last one of a scan brings its view."""
        # beams become a map, the map becomes peaks, peaks are folded back through the walls they themselves show
        maps = self._former.add(beam, state)
        return [recover_bev(self._detector.detect(one), self._geometry, confidence=self._confidence) for one in maps]
