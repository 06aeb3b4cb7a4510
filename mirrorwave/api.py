"""Scan -> bird's-eye view in Python: the perception chain with the nodes' parameters, without a bus or a clock.

    from mirrorwave.api import views

    for view in views("corner.mcap"):
        for hidden in view.frame.objects:
            print(f"scan {view.scan_id}: {hidden.length_m:.1f} m long at {hidden.x_m:.1f}, {hidden.y_m:.1f} m")

`Perception` does the same for beams of your own. Parameters are those of the nodes (docs/reference/parameters.md). In a
notebook views, maps and scenes show themselves as pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np

from mirrorwave.pipeline import Pipeline, for_sensors, played
from mirrorwave.plots.notebook import show_values_as_pictures
from mirrorwave.profiles import checked_profile, with_profile
from mirrorwave.raw_data import require_raw, sensors_in
from models.perception.chain import ScanView
from msgs.files.shipped import LAUNCH
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import PRESETS, RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.player import capture_events
from nodes.process.launch_file import read_launch_file, with_overrides


class View(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """One scan: what is hidden, what it was found in, and the truth where the capture holds it."""

    frame: BevFrame
    #: None of a radar that gives detections, and of several radars.
    ra_map: RangeAzimuthMap | None
    peaks: Peaks | None
    truth: SceneTruth | None = None

    @property
    def scan_id(self) -> int:
        """Number of the scan."""
        return self.frame.scan_id

    def draw(self, path: str | PathLike[str]) -> None:
        """Write the picture of map and view; the suffix decides the format."""
        from mirrorwave.plots.bird_eye_view import draw_bev

        draw_bev(self.frame, Path(path), truth=self.truth, ra_map=self.ra_map)

    def __repr__(self) -> str:
        counts = ((self.frame.objects, "hidden object"), (self.frame.tracks, "track"), (self.frame.walls, "wall"))
        parts = [f"scan {self.scan_id}", *(counted(len(items), name) for items, name in counts)]
        if self.peaks is not None:
            parts.append(counted(len(self.peaks.range_m), "peak"))
        return f"View({', '.join([*parts, *(['truth'] if self.truth is not None else [])])})"

    def _repr_png_(self) -> bytes:
        """Return the picture that a notebook shows."""
        from mirrorwave.plots.bird_eye_view import bev_figure
        from mirrorwave.plots.style import png

        return png(bev_figure(self.frame, truth=self.truth, ra_map=self.ra_map))


class Perception:
    """Beams in, views out.

    `setup`: the radar; the specification's where None. `profile`: a name in `launch/profiles`, or a file. `overrides`:
    parameters as "dense_predictor.method=cfar". Raises `ValueError` naming what is unknown or does not fit.
    """

    def __init__(
        self, setup: RadarSetup | None = None, profile: str = "default", overrides: Sequence[str] = ()
    ) -> None:
        self._pipeline = _pipeline(profile, overrides)
        self._scans = 0
        self.setup = setup or PRESETS["xband"]
        self.feed(self.setup)
        if self._pipeline.refusal:
            raise ValueError(self._pipeline.refusal)

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> list[View]:
        """Fold a beam; the last one of a scan brings its view. Raises `ValueError` where the beam does not fit."""
        if state is not None:
            self.feed(state)
        refused = self._pipeline.refused_beams
        views = self.feed(beam)
        if self._pipeline.refused_beams > refused:
            raise ValueError(self._pipeline.refusal)
        return views

    def see(self, samples: np.ndarray, stamp_ns: int | None = None, state: VehicleState | None = None) -> View:
        """The view of one whole scan.

        `samples`: int16 I and Q codes [beams, chirps, samples, 2] in the order of the set-up's beams; `stamp_ns`: when
        the first was measured, one scan period after the last scan's where None. Raises `ValueError` for another shape,
        and for a scan that a stage refuses.
        """
        beams = scan_beams(samples, self.setup, scan_id=self._scans, stamp_ns=stamp_ns)
        self._scans += 1
        views = [view for beam in beams for view in self.add(beam, state)]
        if not views:
            raise ValueError(
                self._pipeline.refusal or "samples must bring a view: the last beam of the scan was refused"
            )
        return views[-1]

    def feed(self, message: msgspec.Struct, offset_ns: int = 0) -> list[View]:
        """Take in anything that sensors and the vehicle say; return the views that it brings (`Pipeline.feed`)."""
        return _as_views(self._pipeline.feed(message, offset_ns))

    def finish(self) -> list[View]:
        """Return the view of a scan whose last beams never came, if one was begun."""
        return _as_views(self._pipeline.finish())


show_values_as_pictures()


def views(capture: str | PathLike[str], profile: str = "default", overrides: Sequence[str] = ()) -> Iterator[View]:
    """The view of every scan of a capture, MCAP or SigMF: what `mirrorwave process` writes, as values.

    Raises `ValueError` naming the file where it is no capture, holds no set-up, no beam, or beams of one direction.
    """
    pipeline = _pipeline(profile, overrides, sensors_in(Path(capture)))
    truth: dict[int, SceneTruth] = {}
    waiting: ScanView | None = None
    # truth stands behind the beams it belongs to: a view goes out when the next one comes
    require_raw(Path(capture))
    for completed in played(capture_events(Path(capture)), pipeline):
        if isinstance(completed, SceneTruth):
            truth[completed.scan_id] = completed
            continue
        if waiting is not None:
            yield _as_view(waiting, truth)
        waiting = completed
    if waiting is not None:
        yield _as_view(waiting, truth)


def scan_beams(
    samples: np.ndarray, setup: RadarSetup, scan_id: int = 0, stamp_ns: int | None = None
) -> list[RadarBeam]:
    """A scan's int16 codes [beams, chirps, samples, 2] as beams, evenly spaced from `stamp_ns` on.

    `stamp_ns` None: `scan_id` scan periods. Raises `ValueError` where the number of beams is not the set-up's.
    """
    if samples.ndim != 4 or len(samples) != len(setup.beams):
        raise ValueError(f"samples must be [{len(setup.beams)} beams, chirps, samples, 2], got {samples.shape}")
    first_ns = ns_from_s(scan_id * setup.radar.scan_period_s) if stamp_ns is None else stamp_ns
    return [
        RadarBeam(
            stamp_ns=first_ns + index * setup.beam_interval_ns,
            scan_id=scan_id,
            beam_index=index,
            beam_count=len(setup.beams),
            azimuth_rad=float(azimuth_rad),
            samples=codes,
            full_scale_dbm=setup.full_scale_dbm,
        )
        for index, (azimuth_rad, codes) in enumerate(zip(setup.beams.azimuth_rad, samples, strict=True))
    ]


def _pipeline(profile: str, overrides: Sequence[str], sensors: Sequence[str] = ()) -> Pipeline:
    checked_profile(profile)
    launch = with_profile(for_sensors(read_launch_file(LAUNCH / "process.yaml"), sensors), profile)
    return Pipeline(with_overrides(launch, overrides))


def _as_view(scan_view: ScanView, truth: dict[int, SceneTruth]) -> View:
    return View(
        frame=scan_view.frame,
        ra_map=scan_view.ra_map,
        peaks=scan_view.peaks,
        truth=truth.pop(scan_view.frame.scan_id, None),
    )


def _as_views(scan_view: Iterable[ScanView]) -> list[View]:
    return [_as_view(item, {}) for item in scan_view]
