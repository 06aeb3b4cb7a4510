"""Scan -> bird's-eye view in Python: the graph's own nodes in this process, without a bus, a clock or a socket.

    from mirrorwave.api import views

    for view in views("corner.mcap"):
        for thing in view.frame.objects:
            print(f"scan {view.scan_id}: {thing.length_m:.1f} m long at {thing.x_m:.1f}, {thing.y_m:.1f} m")

`Perception` does the same for beams of your own. Parameters are those of the nodes (docs/reference/parameters.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np

from mirrorwave.profiles import with_profile
from mirrorwave.raw_data import require_raw
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.files.shipped import LAUNCH
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from nodes.node import InProcessGraph, Node, load_node
from nodes.player import capture_events
from nodes.process.launch_file import read_launch_file, with_overrides


class View(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """One scan: what is hidden, what it was found in, and the truth where the capture holds it."""

    frame: BevFrame
    ra_map: RangeAzimuthMap
    peaks: Peaks
    truth: SceneTruth | None = None

    @property
    def scan_id(self) -> int:
        """Number of the scan."""
        return self.frame.scan_id

    def draw(self, path: str | PathLike[str]) -> None:
        """Write the picture of map and view; the suffix decides the format."""
        from mirrorwave.plots.bird_eye_view import draw_bev

        draw_bev(self.frame, Path(path), truth=self.truth, ra_map=self.ra_map)


class Perception:
    """Beams in, views out.

    `setup`: the radar; the specification's where None. `profile`: a name in `launch/profiles`. `overrides`: parameters
    as "dense_predictor.method=cfar". Raises `ValueError` naming what is unknown or does not fit.
    """

    def __init__(
        self, setup: RadarSetup | None = None, profile: str = "default", overrides: Sequence[str] = ()
    ) -> None:
        launch = with_profile(read_launch_file(LAUNCH / "process.yaml"), profile)
        launch = with_overrides(launch, overrides)
        nodes = {name: entry for name, entry in launch.nodes.items() if name != "player"}
        self._network = LocalNetwork()
        self._nodes = {name: load_node(entry.module, entry.params, name) for name, entry in nodes.items()}
        self._outlet = _Outlet()
        self._graph = InProcessGraph(self._network, {**self._nodes, "outlet": self._outlet})
        self._bus = self._network.bus("api")
        self._refused = 0
        self._scans = 0
        self.setup = setup or RadarSetup()
        self.feed(Outgoing("radar/setup", self.setup))

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> list[View]:
        """Fold a beam; the last one of a scan brings its view. Raises `ValueError` where the beam does not fit."""
        if state is not None:
            self.feed(Outgoing("vehicle/state", state))
        found = self.feed(Outgoing("radar/beam", beam))
        refused = _refused_beams(self._nodes["ra_former"])
        if refused > self._refused:
            self._refused = refused
            raise ValueError(self._nodes["ra_former"].health()[1])
        return found

    def see(self, samples: np.ndarray, stamp_ns: int | None = None, state: VehicleState | None = None) -> View:
        """The view of one whole scan.

        `samples`: int16 I and Q codes [beams, chirps, samples, 2] in the order of the set-up's beams; `stamp_ns`: when
        the first was measured, one scan period after the last scan's where None. Raises `ValueError` for another shape.
        """
        beams = scan_beams(samples, self.setup, scan_id=self._scans, stamp_ns=stamp_ns)
        self._scans += 1
        return [view for beam in beams for view in self.add(beam, state)][-1]

    def feed(self, outgoing: Outgoing, offset_ns: int = 0) -> list[View]:
        """Take in any message that sensors send, `offset_ns` after the first; what views it brings."""
        self._network.advance(max(0, offset_ns - self._network.now_ns))
        self._bus.publish(*outgoing)
        self._graph.run(until_ns=self._network.now_ns)
        return self._outlet.drain()

    def finish(self) -> list[View]:
        """The view of a scan whose last beams never came, if one was begun."""
        self._graph.run()
        return self._outlet.drain()


def views(capture: str | PathLike[str], profile: str = "default", overrides: Sequence[str] = ()) -> Iterator[View]:
    """The view of every scan of a capture, MCAP or SigMF: what `mirrorwave process` writes, as values.

    Raises `ValueError` naming the file where it is no capture, holds no set-up, no beam, or beams of one direction.
    """
    perception = Perception(None, profile, overrides)
    truth: dict[int, SceneTruth] = {}
    waiting: list[View] = []
    # truth stands behind the beams it belongs to: a view goes out when the next one comes
    require_raw(Path(capture))
    for event in capture_events(Path(capture)):
        message = event.outgoing.message
        if isinstance(message, SceneTruth):
            truth[message.scan_id] = message
            continue
        found = perception.feed(event.outgoing, event.offset_ns)
        if found:
            yield from _with_truth(waiting, truth)
            waiting = found
    yield from _with_truth([*waiting, *perception.finish()], truth)


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


class _Outlet(Node):
    """Gathers the parts of each scan."""

    inputs = ("radar/ra_map", "perception/peaks", "perception/hidden_objects")

    def __init__(self) -> None:
        super().__init__()
        self._maps: dict[int, RangeAzimuthMap] = {}
        self._peaks: dict[int, Peaks] = {}
        self._views: list[View] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Keep maps and peaks until their view comes."""
        for received in sorted(inputs, key=lambda item: item.topic == "perception/hidden_objects"):
            match received.message:
                case RangeAzimuthMap() as ra_map:
                    self._maps[ra_map.scan_id] = ra_map
                case Peaks() as peaks:
                    self._peaks[peaks.scan_id] = peaks
                case BevFrame() as frame:
                    scan = frame.scan_id
                    self._views.append(View(frame=frame, ra_map=self._maps.pop(scan), peaks=self._peaks.pop(scan)))
        return []

    def drain(self) -> list[View]:
        """Views since the last call."""
        found, self._views = self._views, []
        return found


def _with_truth(found: list[View], truth: dict[int, SceneTruth]) -> Iterator[View]:
    for view in found:
        yield msgspec.structs.replace(view, truth=truth.pop(view.scan_id, None))


def _refused_beams(former: Node) -> int:
    return sum(count.count for count in former.shed.counts() if (count.what, count.reason) == ("beam", "refused"))
