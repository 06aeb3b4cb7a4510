"""The whole algorithm as one sentence: raw beams in, hidden objects out; each node of the graph runs one stage."""

from __future__ import annotations

from typing import NamedTuple

from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.form.beams_to_maps import FormingStage
from models.perception.track.views_over_scans import ViewStage
from msgs.values.perception import BevFrame, Peaks
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState


class ScanView(NamedTuple):
    """One scan: what is hidden, and, of one radar that gives beams, the map and the peaks it was found in."""

    frame: BevFrame
    ra_map: RangeAzimuthMap | None
    peaks: Peaks | None


class Chain:
    """Scan -> bird's-eye view. The nodes are this sentence cut at the topics; both give the same bytes."""

    def __init__(self, forming: FormingStage, detection: DetectionStage, views: ViewStage) -> None:
        self.forming, self.detection, self.views = forming, detection, views

    def set_up(self, setup: RadarSetup) -> None:
        """Go on with another set-up; `ValueError` for one that a stage cannot use."""
        self.forming.set_up(setup)
        self.detection.set_up(setup)
        self.views.set_up(setup)

    def add_state(self, state: VehicleState) -> None:
        """Take in a state of the vehicle: its stamp says which beams and scans it counts for."""
        self.forming.add_state(state)
        self.views.add_state(state)

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> list[ScanView]:
        """Fold a beam; the last one of a scan brings its view. Raises `ValueError` for what a stage cannot take."""
        if state is not None:
            self.add_state(state)
        return [self.view(ra_map) for ra_map in self.forming.add(beam)]

    def flush(self) -> list[ScanView]:
        """Return the view of the scan under way, whatever beams it lacks."""
        return [self.view(ra_map) for ra_map in self.forming.flush()]

    def view(self, ra_map: RangeAzimuthMap) -> ScanView:
        """Return the view of a map, of this radar or of another sensor; maps come in the order of their stamps."""
        peaks = self.detection.detect(ra_map)
        return ScanView(self.views.view(peaks, ra_map), ra_map, peaks)
