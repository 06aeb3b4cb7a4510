"""A capture through the whole graph in one process: what `mirrorwave process` does."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from mirrorwave.plots.bird_eye_view import draw_bev
from mirrorwave.plots.scoreboard import Scoreboard
from mirrorwave.profiles import with_profile
from mirrorwave.raw_data import require_raw
from models.perception.geometry.objects import bev_to_json
from models.perception.tracking.tracker import track_to_json
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.files.shipped import LAUNCH
from msgs.files.whole_files import named, whole
from msgs.recording.mcap import RecordingReader
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import RangeAzimuthMap
from nodes.node import InProcessGraph, Node, load_node
from nodes.process.launch_file import LaunchFile, read_launch_file, with_overrides, with_params

#: What a run writes, and the keys by which the first line of a file tells that it is one.
LINES = {
    "objects": {"scan_id", "stamp_ns", "frame", "objects"},
    "tracks": {"scan_id", "stamp_ns", "frame", "tracks"},
    "timing": {"scan_id", "stages"},
}
PICTURE = "bev.png"
#: The first line of a file of ours is shorter.
_MOST_LINE_BYTES = 1 << 26


class Results(Node):
    """Writes what comes out, line by line: objects, tracks, times; keeps the last scan for picture and score."""

    inputs = ("radar/ra_map", "perception/peaks", "perception/hidden_objects", "sim/truth")

    def __init__(self, files: Sequence[_LineFile], timed: Mapping[str, Node], on_scan: Callable[[], None]) -> None:
        super().__init__()
        self._objects, self._tracks, self._timing = files
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
    launch = with_profile(read_launch_file(LAUNCH / "process.yaml"), profile)
    launch = with_params(launch, {"player": {"capture": str(capture), **player}}, "process")
    return with_overrides(launch, overrides)


def run_capture(
    capture: Path, out: Path, profile: str = "default", overrides: list[str] | None = None,
    on_scan: Callable[[], None] = lambda: None,
) -> Results:  # fmt: skip
    """Process `capture`; writes `objects.jsonl`, `tracks.jsonl`, `timing.jsonl` and `bev.png` into `out`.

    All four are there afterwards, or what was there before. Returns what was seen. Raises `FileExistsError` where a
    file is in the way that was not written so, `ValueError` for a symbolic link and where the capture is none, or holds
    nothing to process, `OSError` with the name of what a full disk does not take.
    """
    require_own_results(out)
    require_raw(capture)
    launch = launch_for(capture, profile, overrides or [])
    nodes = {name: load_node(entry.module, entry.params, name) for name, entry in launch.nodes.items()}
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        paths = [out / f"{name}.jsonl" for name in LINES]
        # all are closed before the first of them takes its name
        parts = [stack.enter_context(whole(path)) for path in paths]
        picture = stack.enter_context(whole(out / PICTURE, ".png"))
        files = [stack.enter_context(_LineFile(path, part)) for path, part in zip(paths, parts, strict=True)]
        results = Results(files, nodes, on_scan)
        graph = InProcessGraph(LocalNetwork(), {**nodes, "results": results})
        try:
            graph.run()
        finally:
            graph.close()
        results.capture_loss = _loss_of(capture)
        if results.frame is None:
            raise ValueError(f"{capture}: holds no complete scan")
        truth = results.scoreboard.truth_of(results.frame.scan_id)
        with named(out / PICTURE):
            draw_bev(results.frame, picture, truth=truth, ra_map=results.ra_map)
    return results


def require_own_results(out: Path) -> None:
    """Raise rather than write over what `run_capture` did not write; errors as that says."""
    files = {out / f"{name}.jsonl": keys for name, keys in LINES.items()}
    for path in (out, *files, out / PICTURE):
        if path.is_symlink():
            raise ValueError(f"{path}: must not be a symbolic link; name what it leads to with --out")
    strange = [path for path, keys in files.items() if path.exists() and not _is_ours(path, keys)]
    if (out / PICTURE).exists() and not any(path.exists() for path in files):
        strange.append(out / PICTURE)
    if strange:
        raise FileExistsError(17, "was not written by `mirrorwave process`; choose another --out", str(strange[0]))


def _is_ours(path: Path, keys: set[str]) -> bool:
    """Whether a file's first line is one of a run's; one without a line is nobody's loss."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        line = file.readline(_MOST_LINE_BYTES)
    try:
        found = json.loads(line) if line else dict.fromkeys(keys)
    except (ValueError, RecursionError):
        return False
    return isinstance(found, dict) and keys <= found.keys()


class _LineFile:
    """Lines for a file that has not its name yet; what the disk does not take is said of that name."""

    def __init__(self, path: Path, part: Path) -> None:
        self._path = path
        self._file = part.open("x", encoding="utf-8")

    def write(self, line: str) -> None:
        """Append a line."""
        with named(self._path):
            self._file.write(line)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with named(self._path):
            self._file.close()


def _loss_of(capture: Path) -> str | None:
    """What is missing or damaged in a recording; a SigMF capture is refused unless it is whole."""
    if capture.suffix != ".mcap":
        return None
    with RecordingReader(capture) as reader:
        return reader.loss
