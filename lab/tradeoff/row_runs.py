"""Measures rows of settings on the same raw beams: answers once, times again and again, all rows interleaved.

Rows that share a stage share its samples. Every repetition visits all stages in a new order, so that drift of the
machine hits all rows alike. One file a frame: a run that was stopped goes on, and a row that fails keeps its reason.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from lab.evaluate.labelled_beams import LabelledPlace
from lab.evaluate.method_runs import answer_of, truth_of_points
from lab.evaluate.place_runs import image_truth
from lab.measures.frame_scores import FrameScores, FrameTruth, score_frames
from lab.measures.object_rows import ImageTruth, ScanRow, scan_row
from lab.studies.report import load_per_core
from lab.studies.resumable import ResumableRun, charged
from lab.tradeoff.rows import STAGES, Setting
from mirrorwave.api import scan_beams
from mirrorwave.node_chain import SharedParts, stage_params
from models.perception.find.detectors import Detector
from models.perception.form.ra_former import RaFormer
from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan
from models.perception.mirrors.recovery import Residual
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.track.views_over_scans import ViewStage, judged_params
from msgs.bus.zmq import ZmqBus
from msgs.values.frames import xy_from_polar
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import PRESETS, RadarBeam, RangeAzimuthMap
from msgs.values.units import ns_from_s
from nodes import dense_predictor, geometry

#: What a row's latency is made of, in order: from the arrival of the last beam to that of the view.
PARTS = ("transport", "forming", "detection", "geometry")
#: Beside them, the work on all beams but the last, done while the next one is measured.
BEFORE = "earlier beams"
#: A hop over a socket on one machine that takes longer never comes.
HOP_TIMEOUT_S = 5.0
MS_PER_NS = 1e-6


class Plan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Plan that fixes the accuracy of a run: rows, and the places of a seeded series; and how often each is timed."""

    rows: list[Setting]
    frames: int
    repeats: int
    seed: int = 11
    effects: str = "all"


class FrameResult(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One frame: counts and distances of each row (as `FrameScores`), its objects, milliseconds of each part and
    repetition.
    """

    frame: int
    counts: dict[str, list[list[int]]]
    distances: dict[str, list[list[float]]]
    objects: dict[str, ScanRow]
    times_ms: dict[str, dict[str, list[float]]]
    #: Rows that failed, and why in one line.
    failed: dict[str, str]
    #: Load of the machine before the run, by core, and the share of the timed sections in which others had the cores.
    load_before: float = 0.0
    waited: float = 0.0


@dataclass(frozen=True)
class Variant:
    """A row as keys of the stages it shares with others."""

    name: str
    former: str
    detector: tuple[str, str]
    geometry: tuple[str, str, str]

    @classmethod
    def of(cls, row: Setting) -> Variant:
        """The way of a row: equal parameters, equal keys."""
        former, detector, geometry = (json.dumps(row.of(stage), sort_keys=True) for stage in STAGES)
        return cls(row.name, former, (former, detector), (former, detector, geometry))


class Hop(Protocol):
    """A message from one process of the graph to the next; milliseconds."""

    def __call__(self, topic: str, message: msgspec.Struct) -> float:
        """Send and receive."""


@contextmanager
def socket_hop() -> Iterator[Hop]:
    """Publishes on the graph's own bus and waits for what comes out of another socket: encode, send, decode."""
    with TemporaryDirectory(prefix="mirrorwave-") as folder:
        source, sink = ZmqBus("source", Path(folder)), ZmqBus("sink", Path(folder))
        topics = ("radar/beam", "radar/ra_map", "perception/peaks", "perception/hidden_objects")
        for topic in topics:
            source.advertise(topic)
            sink.subscribe(topic)
        time.sleep(0.5)  # subscriptions settle

        def hop(topic: str, message: msgspec.Struct) -> float:
            start_ns = time.perf_counter_ns()
            source.publish(topic, message)
            if not sink.receive(HOP_TIMEOUT_S):
                raise TimeoutError(f"{topic} must arrive within {HOP_TIMEOUT_S} s")
            return MS_PER_NS * (time.perf_counter_ns() - start_ns)

        try:
            yield hop
        finally:
            sink.close()
            source.close()


@dataclass(frozen=True)
class PlaceTruth:
    """Truth of one place: its points, and its objects with what can be seen of each."""

    points: FrameTruth
    scene: SceneTruth
    images: list[ImageTruth]

    @classmethod
    def of(cls, place: LabelledPlace) -> PlaceTruth:
        """Return the truth of the first scan of a place."""
        labels = place.labels
        points = truth_of_points(labels, xy_from_polar(labels.range_m, labels.azimuth_rad), place.hidden)
        return cls(points, place.player.truth(0), image_truth(place.player))


@dataclass(frozen=True)
class _Geometry:
    """The parts of a geometry stage."""

    params: geometry.Params
    residual: Residual | None
    predictor: EvidencePredictor | None

    @classmethod
    def of(cls, params: geometry.Params) -> _Geometry:
        """Load the parts; errors as the node's."""
        return cls(params, geometry.residual_of(params), geometry.predictor_of(params))

    def stage(self) -> ViewStage:
        """Return a stage that has seen nothing yet."""
        return ViewStage(self.params.geometry, self.residual, self.params.memory, predictor=self.predictor)

    @property
    def folding(self) -> tuple[GeometryParams, Residual | None]:
        """Parts that fold images back: with the walls of the object network, where one judges."""
        return judged_params(self.params.geometry, self.predictor), self.residual


@dataclass
class _Stages:
    """The parts of all rows, built at first use, and why some could not be."""

    former: dict[str, RaFormer] = field(default_factory=dict)
    detector: dict[str, Detector] = field(default_factory=dict)
    geometry: dict[str, _Geometry] = field(default_factory=dict)

    def build(self, row: Setting) -> None:
        """Build what a row needs; raises whatever its parameters raise."""
        keys, setup = Variant.of(row), PRESETS["xband"]
        if keys.former not in self.former:
            self.former[keys.former] = RaFormer(setup, stage_params("ra_former", row.of("ra_former")))
        if keys.detector[1] not in self.detector:
            self.detector[keys.detector[1]] = dense_predictor.detector_for(
                stage_params("dense_predictor", row.of("dense_predictor")), setup
            )
        if keys.geometry[2] not in self.geometry:
            self.geometry[keys.geometry[2]] = _Geometry.of(stage_params("geometry", row.of("geometry")))


class Measuring:
    """All rows on one frame after the other."""

    def __init__(self, plan: Plan, hop: Hop, load_before: float = 0.0) -> None:
        self.plan, self._hop, self._load_before = plan, hop, load_before
        self._stages, self._scan_id = _Stages(), 0
        self.failed: dict[str, str] = {}
        for row in plan.rows:
            with charged(self.failed, row.name):
                self._stages.build(row)
        self._variants = [Variant.of(row) for row in plan.rows]

    def frame(self, index: int) -> FrameResult:
        """Scores and times of all rows on one frame."""
        place = LabelledPlace(self.plan.seed, index, self.plan.effects)
        with threadpool_limits(1, "blas"):
            return self._measured(index, list(place.beams()), PlaceTruth.of(place))

    def _measured(self, index: int, beams: list[RadarBeam], truth: PlaceTruth) -> FrameResult:
        pass_ = _Pass()
        rng = np.random.default_rng([self.plan.seed, index, 1])
        for _ in range(self.plan.repeats):
            self._repeat(pass_, beams, rng)
        variants = [variant for variant in self._variants if variant.name not in self.failed]
        scores = {variant.name: self._scores(pass_, variant, truth.points) for variant in variants}
        views = {variant.name: pass_.views[variant.geometry] for variant in variants}
        return FrameResult(
            frame=index,
            counts={name: frame_scores.counts[0].tolist() for name, frame_scores in scores.items()},
            distances={name: frame_scores.distances[0].tolist() for name, frame_scores in scores.items()},
            objects={name: scan_row(index, view.objects, truth.scene, truth.images) for name, view in views.items()},
            times_ms={variant.name: pass_.times_of(variant) for variant in variants},
            failed=dict(self.failed),
            load_before=self._load_before,
            waited=pass_.waited,
        )

    def _repeat(self, pass_: _Pass, beams: list[RadarBeam], rng: np.random.Generator) -> None:
        """Every stage of every row once, in a drawn order."""
        pass_.add("transport", "beam", self._hop("radar/beam", beams[-1]))
        for former in self._drawn([variant.former for variant in self._live()], rng):
            with charged(self.failed, *self._rows("former", former)):
                self._form(pass_, former, beams)
        for detector in self._drawn([variant.detector for variant in self._live()], rng):
            with charged(self.failed, *self._rows("detector", detector)):
                self._detect(pass_, detector)
        for geometry_key in self._drawn([variant.geometry for variant in self._live()], rng):
            with charged(self.failed, *self._rows("geometry", geometry_key)):
                self._place(pass_, geometry_key)

    def _live(self) -> list[Variant]:
        return [variant for variant in self._variants if variant.name not in self.failed]

    def _rows(self, stage: str, key: Any) -> list[str]:
        return [variant.name for variant in self._variants if getattr(variant, stage) == key]

    @staticmethod
    def _drawn(keys: list[Any], rng: np.random.Generator) -> list[Any]:
        """Different keys, in a drawn order."""
        different = list(dict.fromkeys(keys))
        return [different[index] for index in rng.permutation(len(different))]

    def _form(self, pass_: _Pass, key: str, beams: list[RadarBeam]) -> None:
        former, maps = self._stages.former[key], []
        # every visit is a new scan, or the former would call its beams repeated
        self._scan_id += 1
        period_ns = ns_from_s(former.folder.setup.radar.scan_period_s)
        scan_copies = [
            msgspec.structs.replace(
                beam, scan_id=self._scan_id, stamp_ns=self._scan_id * period_ns + beam.stamp_ns - beams[0].stamp_ns
            )
            for beam in beams
        ]
        last = max(beam.beam_index for beam in beams if beam.beam_index % former.folder.params.beam_step == 0)
        with pass_.timed(BEFORE, key):
            for beam in scan_copies[:last]:
                maps += former.add(beam)
        # what is not looked at after the last beam that is, is measured all the same
        with pass_.timed("forming", key):
            for beam in scan_copies[last:]:
                maps += former.add(beam)
        pass_.maps[key] = msgspec.structs.replace(maps[0], scan_id=0, stamp_ns=0)
        pass_.add("transport", key, self._hop("radar/ra_map", maps[0]))

    def _detect(self, pass_: _Pass, key: tuple[str, str]) -> None:
        detector, ra_map = self._stages.detector[key[1]], pass_.maps[key[0]]
        with pass_.timed("detection", key):
            peaks = detector.detect(ra_map)
        pass_.peaks[key] = peaks
        pass_.add("transport", key, self._hop("perception/peaks", peaks))

    def _place(self, pass_: _Pass, key: tuple[str, str, str]) -> None:
        # as the node's, and without the memory of another place
        stage, peaks = self._stages.geometry[key[2]].stage(), pass_.peaks[key[:2]]
        with pass_.timed("geometry", key):
            view = stage.view(peaks, pass_.maps[key[0]])
        pass_.views[key] = view
        pass_.add("transport", key, self._hop("perception/hidden_objects", view))

    def _scores(self, pass_: _Pass, variant: Variant, truth: FrameTruth) -> FrameScores:
        """Counts of one row, from the geometry's places before objects are formed of them."""
        peaks = pass_.peaks[variant.detector]
        scan = fold_scan(peaks, *self._stages.geometry[variant.geometry[2]].folding)
        return score_frames([(answer_of(peaks, scan.recovered.points_m, scan.hidden), truth)])


class _Pass:
    """Results of one frame's stages: maps, peaks and views by key, milliseconds by part and key."""

    def __init__(self) -> None:
        self.maps: dict[str, RangeAzimuthMap] = {}
        self.peaks: dict[tuple[str, str], Peaks] = {}
        self.views: dict[tuple[str, str, str], BevFrame] = {}
        self._times_ms: dict[tuple[str, Any], list[float]] = {}
        self._timed_ns = self._waited_ns = 0

    @property
    def waited(self) -> float:
        """Share of the timed sections in which this process did not compute."""
        return self._waited_ns / max(self._timed_ns, 1)

    @contextmanager
    def timed(self, part: str, key: Any) -> Iterator[None]:
        """Time the body."""
        start_ns, start_cpu_ns = time.perf_counter_ns(), time.process_time_ns()
        yield
        wall_ns, cpu_ns = time.perf_counter_ns() - start_ns, time.process_time_ns() - start_cpu_ns
        self.add(part, key, MS_PER_NS * wall_ns)
        self._timed_ns += wall_ns
        self._waited_ns += max(0, wall_ns - cpu_ns)

    def add(self, part: str, key: Any, milliseconds: float) -> None:
        """One sample."""
        self._times_ms.setdefault((part, key), []).append(milliseconds)

    def times_of(self, variant: Variant) -> dict[str, list[float]]:
        """The samples of a row by part; transport is the sum of its four hops."""
        hops = [
            self._times_ms["transport", key] for key in ("beam", variant.former, variant.detector, variant.geometry)
        ]
        return {
            "transport": np.sum(hops, axis=0).tolist(),
            "forming": self._times_ms["forming", variant.former],
            "detection": self._times_ms["detection", variant.detector],
            "geometry": self._times_ms["geometry", variant.geometry],
            BEFORE: self._times_ms[BEFORE, variant.former],
        }


def run_plan(plan: Plan, out: Path, on_frame: Callable[[], None] = lambda: None) -> list[FrameResult]:
    """Measure what is not there yet; the results of all frames, in order.

    Raises `ValueError` where `out` holds another run.
    """
    files = {index: f"frames/frame-{index:05d}.msgpack" for index in range(plan.frames)}
    run = ResumableRun(plan, out, FrameResult, files)
    load_before = load_per_core()
    if missing := run.missing(on_frame):
        with socket_hop() as hop:
            measuring = Measuring(plan, hop, load_before)
            # the first call of anything compiles, allocates, reads
            measuring.frame(missing[0])
            for index in missing:
                run.keep(index, measuring.frame(index))
                on_frame()
    return run.results()


def peak_memory_mib(rows: Sequence[Setting], on_row: Callable[[], None] = lambda: None) -> dict[str, float]:
    """Largest resident memory [MiB] of a fresh process that holds a row's whole chain and takes in one scan."""
    peaks = {}
    for row in rows:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            peaks[row.name] = float("nan")
            with charged({}, row.name):  # the run has the reason already
                peaks[row.name] = pool.apply(_row_memory_mib, (row,))
        on_row()
    return peaks


def _row_memory_mib(row: Setting) -> float:
    """Run one empty scan through a row's chain in the calling process."""
    setup = PRESETS["xband"]
    chain = SharedParts.of(row.params, setup).chain()
    beam = np.zeros((setup.radar.chirps_per_beam, setup.radar.samples_per_chirp, 2), np.int16)
    for scan_beam in scan_beams(np.broadcast_to(beam, (len(setup.beams), *beam.shape)), setup):
        chain.add(scan_beam)
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) / 1024.0
