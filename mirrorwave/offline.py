"""A capture through the whole graph in one process: what `mirrorwave process` does."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from mirrorwave.bev_picture import draw_bev
from mirrorwave.profiles import LAUNCH_DIR, with_profile
from mirrorwave.raw_data import require_raw
from mirrorwave.scoreboard import Scoreboard
from models.perception.objects import bev_to_json
from models.perception.tracking import track_to_json
from msgs.bus import Outgoing, Received
from msgs.local_bus import LocalNetwork
from msgs.perception import BevFrame, Peaks, SceneTruth
from msgs.radar import RangeAzimuthMap
from msgs.recording import RecordingReader
from nodes.launch_file import LaunchFile, read_launch_file, with_overrides, with_params
from nodes.node import InProcessGraph, Node, load_node


class Results(Node):
    """Writes what comes out, line by line: objects, tracks, times; keeps the last scan for picture and score."""

    inputs = ("radar/ra_map", "perception/peaks", "perception/hidden_objects", "sim/truth")

    def __init__(
        self, objects: TextIO, tracks: TextIO, timing: TextIO, timed: Mapping[str, Node], on_scan: Callable[[], None]
    ) -> None:
        super().__init__()
        self._objects, self._tracks, self._timing = objects, tracks, timing
        self._timed, self._on_scan = timed, on_scan
        self.scoreboard = Scoreboard()
        self.ra_map: RangeAzimuthMap | None = None
        self.peaks: Peaks | None = None
        self.frame: BevFrame | None = None
        self.scans = self.scans_with_loss = 0
        #: What the capture itself lacks, None where it is whole.
        self.capture_loss: str | None = None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Take in what came; a view ends its scan."""
        for received in inputs:
            match received.message:
                case RangeAzimuthMap() as ra_map:
                    self.ra_map = ra_map
                    self.scans += 1
                    self.scans_with_loss += bool(ra_map.missing_beams)
                case Peaks() as peaks:
                    self.peaks = peaks
                case SceneTruth() as truth:
                    self.scoreboard.add_truth(truth)
                case BevFrame() as frame:
                    self._end_scan(frame)
        return []

    def _end_scan(self, frame: BevFrame) -> None:
        self.frame = frame
        self.scoreboard.add_frame(frame)
        self._objects.write(json.dumps(bev_to_json(frame)) + "\n")
        scan = {"scan_id": frame.scan_id, "stamp_ns": frame.stamp_ns, "frame": "radar"}
        self._tracks.write(json.dumps({**scan, "tracks": [track_to_json(one) for one in frame.tracks]}) + "\n")
        stages = {
            f"{name}.{stage.name}": {"count": stage.count, "mean_ms": stage.mean_ms, "max_ms": stage.max_ms}
            for name, node in self._timed.items()
            for stage in node.stages.drain()
        }
        self._timing.write(json.dumps({"scan_id": frame.scan_id, "stages": stages}) + "\n")
        self._on_scan()


def launch_for(capture: Path, profile: str, overrides: list[str], **player: Any) -> LaunchFile:
    """The offline graph with a profile and overrides; ValueError names what is unknown."""
    launch = with_profile(read_launch_file(LAUNCH_DIR / "process.yaml"), profile)
    launch = with_params(launch, {"player": {"capture": str(capture), **player}}, "process")
    return with_overrides(launch, overrides)


def run_capture(
    capture: Path, out: Path, profile: str = "default", overrides: list[str] | None = None,
    on_scan: Callable[[], None] = lambda: None,
) -> Results:  # fmt: skip
    """Process `capture`; writes `objects.jsonl`, `tracks.jsonl`, `timing.jsonl` and `bev.png` into `out`.

    Returns what was seen. Raises `ValueError` where the capture is none, or holds nothing to process.
    """
    require_raw(capture)
    launch = launch_for(capture, profile, overrides or [])
    nodes = {name: load_node(entry.module, entry.params, name) for name, entry in launch.nodes.items()}
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as files:
        objects, tracks, timing = (
            files.enter_context((out / f"{name}.jsonl").open("w", encoding="utf-8"))
            for name in ("objects", "tracks", "timing")
        )
        results = Results(objects, tracks, timing, nodes, on_scan)
        graph = InProcessGraph(LocalNetwork(), {**nodes, "results": results})
        try:
            graph.run()
        finally:
            graph.close()
    results.capture_loss = _loss_of(capture)
    if results.frame is None:
        raise ValueError(f"{capture}: holds no complete scan")
    truth = results.scoreboard.truth_of(results.frame.scan_id)
    draw_bev(results.frame, out / "bev.png", truth=truth, ra_map=results.ra_map)
    return results


def _loss_of(capture: Path) -> str | None:
    """What is missing or damaged in a recording; a SigMF capture is refused unless it is whole."""
    if capture.suffix != ".mcap":
        return None
    with RecordingReader(capture) as reader:
        return reader.loss
