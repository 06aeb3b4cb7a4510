"""The perception chain fed with messages: what sensors and the vehicle say in, views out, without a bus or a clock.

What the graph does with messages that its nodes cannot take is done here too: they are logged and left out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from functools import partial

import msgspec

from mirrorwave.node_chain import NodeParams
from models.perception.chain import ScanView
from models.perception.forming.photon_map import PhotonFormer
from models.perception.timing import Timed
from msgs.values.detections import RadarDetections
from msgs.values.environment import WallPriors
from msgs.values.lidar import LidarSetup, PhotonHistograms
from msgs.values.perception import SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes import detection_peaks
from nodes.geometry import BiasLog
from nodes.inputs.refusals import Refusals
from nodes.node import ShedTally
from nodes.player import Event
from nodes.process.launch_file import LaunchFile
from nodes.process.validation import convert_at
from nodes.ra_former import PATIENCE_NS

_LOG = logging.getLogger(__name__)


class Pipeline:
    """A chain with the parameters of a launch file's nodes, for a radar or a LiDAR whose set-up comes first."""

    def __init__(self, launch: LaunchFile, timed: Timed = nullcontext) -> None:
        values = {name: entry.params for name, entry in launch.nodes.items()}
        self.chain = NodeParams.of(values, "{node}.params").chain(timed)
        self._photons = PhotonFormer(timed)
        of_detections = convert_at(values.get("detection_peaks", {}), detection_peaks.Params, "detection_peaks.params")
        self._detections = detection_peaks.detections_stage(of_detections, timed)
        shed = ShedTally()
        self._refused_beams = Refusals(_LOG, shed, "beam")
        self._refused_histograms = Refusals(_LOG, shed, "scan")
        self._refused_scans = Refusals(_LOG, shed)
        self._bias_log = BiasLog()
        self._doubt = ""
        #: When the last beam came, while its scan may be unfinished.
        self._last_beam_ns: int | None = None
        #: Maps so far, and those that lack beams.
        self.scans = self.scans_with_loss = 0

    @property
    def refusal(self) -> str:
        """Why the last set-up, beam or scan was refused; empty once another was taken."""
        return self._refused_beams.reason or self._refused_scans.reason

    def feed(self, message: msgspec.Struct, offset_ns: int = 0) -> list[ScanView]:
        """Take in a message that was sent `offset_ns` after the first; return the views that it brings.

        A scan whose next beam is silent for as long as the live graph would wait is closed first.
        """
        is_silent = self._last_beam_ns is not None and offset_ns > self._last_beam_ns + PATIENCE_NS
        views = self.finish() if is_silent else []
        match message:
            case RadarSetup():
                self._set_up(message)
            case LidarSetup():
                self._photons.set_up(message)
            case VehicleState():
                self.chain.add_state(message)
                self._detections.add_state(message)
            case WallPriors():
                self.chain.add_walls(message)
            case RadarBeam():
                self._last_beam_ns = offset_ns
                views += self._of_beam(message)
            case PhotonHistograms():
                views += self._of_histograms(message)
            case RadarDetections():
                views += self._of_detections(message)
        return views

    def finish(self) -> list[ScanView]:
        """Return the view of a scan whose last beams never came, if one was begun."""
        self._last_beam_ns = None
        try:
            maps = self.chain.forming.flush()
        except ValueError as error:
            # its first beam, which never came, would have a stamp that none can have
            self._refused_beams.refuse("scan", error)
            return []
        return self.views(maps)

    def views(self, maps: Iterable[RangeAzimuthMap]) -> list[ScanView]:
        """Return the views of maps but those of maps that a stage cannot take."""
        views = []
        for ra_map in maps:
            self.scans_with_loss += bool(ra_map.missing_beams)
            views += self._viewed(ra_map.scan_id, partial(self.chain.view, ra_map))
        return views

    def _viewed(self, scan_id: int, view: Callable[[], ScanView]) -> list[ScanView]:
        """Return the view of one scan; none where a stage cannot take it."""
        self.scans += 1
        try:
            result = view()
        except ValueError as error:
            self._refused_scans.refuse("scan", error, f"scan {scan_id}")
            return []
        self._refused_scans.accept()
        self._bias_log.note(self.chain.views.yaw_rate_bias)
        if self.chain.doubt not in ("", self._doubt):
            _LOG.warning("%s", self.chain.doubt)
        self._doubt = self.chain.doubt
        return [result]

    def _set_up(self, setup: RadarSetup) -> None:
        """Go on with another set-up; a stage that cannot use it keeps its own."""
        for stage, refusals in (
            (self.chain.forming, self._refused_beams),
            (self.chain.detection, self._refused_scans),
            (self.chain.views, self._refused_scans),
        ):
            try:
                stage.set_up(setup)
            except ValueError as error:
                refusals.refuse("setup", error)

    def _of_beam(self, beam: RadarBeam) -> list[ScanView]:
        try:
            maps = self.chain.forming.add(beam)
        except ValueError as error:
            self._refused_beams.refuse("beam", error)
            return []
        if maps:
            self._refused_beams.accept()
        return self.views(maps)

    def _of_detections(self, detections: RadarDetections) -> list[ScanView]:
        self.scans_with_loss += detections.lost > 0
        return self._viewed(detections.scan_id, partial(self._view_of, detections))

    def _view_of(self, detections: RadarDetections) -> ScanView:
        peaks = self._detections.peaks(detections)
        return ScanView(self.chain.views.view(peaks), None, peaks)

    def _of_histograms(self, histograms: PhotonHistograms) -> list[ScanView]:
        try:
            ra_map = self._photons.add(histograms)
        except ValueError as error:
            self._refused_histograms.refuse("scan", error)
            return []
        self._refused_histograms.accept()
        return self.views([ra_map])


def played(events: Iterable[Event], pipeline: Pipeline) -> Iterator[ScanView | SceneTruth]:
    """Feed a pipeline with all that sensors said; yield views as they come, and the truth as it stands among them."""
    for event in events:
        message = event.outgoing.message
        if isinstance(message, SceneTruth):
            yield message
        else:
            yield from pipeline.feed(message, event.offset_ns)
    yield from pipeline.finish()
