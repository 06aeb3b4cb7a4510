"""A capture through the whole pipeline in one process: what `mirrorwave process` does."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Self

from mirrorwave.convert.result_lines import bev_to_json, track_to_json
from mirrorwave.pipeline import Pipeline, for_sensors, played
from mirrorwave.plots.bird_eye_view import draw_bev
from mirrorwave.plots.scoreboard import Scoreboard
from mirrorwave.profiles import checked_profile, with_profile
from mirrorwave.raw_data import require_raw, sensors_in
from mirrorwave.replay.result_recording import ResultRecording
from models.perception.chain import ScanView
from msgs.files.shipped import LAUNCH
from msgs.files.whole_files import named_errors, whole
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.values.perception import SceneTruth
from nodes.node import StageClock
from nodes.player import Event, Params, events_of
from nodes.process.launch_file import LaunchFile, read_launch_file, with_overrides, with_params
from nodes.process.validation import convert_at

#: What a run writes, and the keys by which the first line of a file tells that it is one.
LINES = {
    "objects": {"scan_id", "stamp_ns", "frame", "objects"},
    "tracks": {"scan_id", "stamp_ns", "frame", "tracks"},
    "timing": {"scan_id", "stages"},
}
PICTURE = "bev.png"
#: A recording of what came out, for the page of `mirrorwave view`; written where it is asked for.
RECORDING = "view.mcap"
#: Metadata of that recording.
_ORIGIN = {"made_by": "mirrorwave process"}
#: The first line of a file of ours is shorter.
_MAX_LINE_BYTES = 1 << 26


class Results:
    """Writes what comes out, line by line: objects, tracks, times; keeps the last scan for picture and score."""

    def __init__(
        self, files: Sequence[_LineFile], pipeline: Pipeline, on_scan: Callable[[], None],
        recording: ResultRecording | None,
    ) -> None:  # fmt: skip
        self._objects, self._tracks, self._timing = files
        self._pipeline, self._on_scan, self._recording = pipeline, on_scan, recording
        self._axes = "vehicle" if pipeline.sensors else "radar"
        self.scoreboard = Scoreboard()
        self.last: ScanView | None = None
        #: Maps, and those that lack beams.
        self.scans = self.scans_with_loss = 0
        #: What the capture lacks, or has out of order or twice; None where it is whole.
        self.capture_loss: str | None = None

    def add(self, result: ScanView | SceneTruth) -> None:
        """Write the lines of a scan; note the truth."""
        if isinstance(result, SceneTruth):
            self.scoreboard.add_truth(result)
            return
        self.last = result
        if self._recording is not None:
            self._recording.add_view(result)
        frame = result.frame
        self.scoreboard.add_frame(frame)
        self._objects.write(json.dumps(bev_to_json(frame, self._axes)) + "\n")
        scan = {"scan_id": frame.scan_id, "stamp_ns": frame.stamp_ns, "frame": self._axes}
        self._tracks.write(json.dumps({**scan, "tracks": [track_to_json(track) for track in frame.tracks]}) + "\n")
        stages = {
            name: {"count": stage.count, "mean_ms": stage.mean_ms, "max_ms": stage.max_ms}
            for name, stage in self._pipeline.stage_times().items()
        }
        self._timing.write(json.dumps({"scan_id": frame.scan_id, "stages": stages}) + "\n")
        self._on_scan()


def launch_for(capture: Path, profile: str, overrides: list[str], **player: Any) -> LaunchFile:
    """The offline graph with a profile and overrides; ValueError names what is unknown."""
    checked_profile(profile)
    launch = with_profile(for_sensors(read_launch_file(LAUNCH / "process.yaml"), sensors_in(capture)), profile)
    launch = with_params(launch, {"player": {"capture": str(capture), **player}}, "process")
    return with_overrides(launch, overrides)


def run_capture(
    capture: Path, out: Path, profile: str = "default", overrides: list[str] | None = None,
    on_scan: Callable[[], None] = lambda: None, records: bool = False,
) -> Results:  # fmt: skip
    """Process `capture`; writes `objects.jsonl`, `tracks.jsonl`, `timing.jsonl` and `bev.png` into `out`.

    With `records`, `view.mcap` too. All are there afterwards, or what was there before. Returns what was seen. Raises
    `FileExistsError` where a file is in the way that was not written so, `ValueError` for a symbolic link and where the
    capture is none, or holds nothing to process, `OSError` with the name of what a full disk does not take.
    """
    require_own_results(out)
    require_raw(capture)
    launch = launch_for(capture, profile, overrides or [])
    events = events_of(convert_at(launch.nodes["player"].params, Params, "player.params"))
    pipeline = Pipeline(launch)
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        paths = [out / f"{name}.jsonl" for name in LINES]
        # all are closed before the first of them takes its name
        parts = [stack.enter_context(whole(path)) for path in paths]
        picture = stack.enter_context(whole(out / PICTURE, ".png"))
        files = [stack.enter_context(_LineFile(path, part)) for path, part in zip(paths, parts, strict=True)]
        recording = stack.enter_context(_recording(out / RECORDING)) if records else None
        results = Results(files, pipeline, on_scan, recording)
        timed = _timed(events, pipeline.reading)
        for result in played(timed if recording is None else recording.passed(timed), pipeline):
            results.add(result)
        results.scans, results.scans_with_loss = pipeline.scans, pipeline.scans_with_loss
        left_out = pipeline.left_out and f"left out: {pipeline.left_out}"
        results.capture_loss = "; ".join(filter(None, (_loss_of(capture), left_out))) or None
        if results.last is None:
            raise ValueError(f"{capture}: holds no complete scan")
        frame, ra_map, _ = results.last
        with named_errors(out / PICTURE):
            draw_bev(frame, picture, truth=results.scoreboard.truth_of(frame.scan_id), ra_map=ra_map)
    return results


@contextmanager
def _recording(path: Path) -> Iterator[ResultRecording]:
    """Yield the recording of results that takes its name at the end."""
    with whole(path) as part, RecordingWriter(part, _ORIGIN) as writer:
        yield ResultRecording(writer)


def _timed(events: Iterator[Event], clock: StageClock) -> Iterator[Event]:
    """Yield events, the time to read or make each one measured."""
    while True:
        with clock("synthesise"):
            event = next(events, None)
        if event is None:
            return
        yield event


def require_own_results(out: Path) -> None:
    """Raise rather than write over what `run_capture` did not write; errors as that says."""
    files = {out / f"{name}.jsonl": keys for name, keys in LINES.items()}
    for path in (out, *files, out / PICTURE, out / RECORDING):
        if path.is_symlink():
            raise ValueError(f"{path}: must not be a symbolic link; name what it leads to with --out")
    strange = [path for path, keys in files.items() if path.exists() and not _is_ours(path, keys)]
    if (out / PICTURE).exists() and not any(path.exists() for path in files):
        strange.append(out / PICTURE)
    if (out / RECORDING).exists() and not _is_own_recording(out / RECORDING):
        strange.append(out / RECORDING)
    if strange:
        raise FileExistsError(17, "was not written by `mirrorwave process`; choose another --out", str(strange[0]))


def _is_ours(path: Path, keys: set[str]) -> bool:
    """Return whether a file's first line is one of a run's; an empty file counts as one."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        line = file.readline(_MAX_LINE_BYTES)
    try:
        first_row = json.loads(line) if line else dict.fromkeys(keys)
    except (ValueError, RecursionError):
        return False
    return isinstance(first_row, dict) and keys <= first_row.keys()


def _is_own_recording(path: Path) -> bool:
    try:
        with RecordingReader(path) as reader:
            return reader.metadata.items() >= _ORIGIN.items()
    except (ValueError, OSError):
        return False


class _LineFile:
    """Lines for a file that has not its name yet; what the disk does not take is said of that name."""

    def __init__(self, path: Path, part: Path) -> None:
        self._path = path
        self._file = part.open("x", encoding="utf-8")

    def write(self, line: str) -> None:
        """Append a line."""
        with named_errors(self._path):
            self._file.write(line)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with named_errors(self._path):
            self._file.close()


def _loss_of(capture: Path) -> str | None:
    """Describe what is missing or damaged in a recording; a SigMF capture is refused unless it is whole."""
    if capture.suffix != ".mcap":
        return None
    with RecordingReader(capture) as reader:
        return reader.loss
