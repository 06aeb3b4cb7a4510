"""Two radars on a car, live: the objects of the offline run, and what is left when the former of one is killed."""

from __future__ import annotations

import json
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from mirrorwave.cli import main
from mirrorwave.convert.result_lines import bev_to_json
from models.perception.track.view_fusion import RADAR_LOST
from msgs.recording.mcap import RecordingReader
from tests.graph.fault_tools import LiveGraph

LAUNCH, SCENE = "launch/two_radars.yaml", "launch/scenes/two_front_corners.yaml"
SCANS = 3
#: Views, one a second or so, of which one must be without a radar that has been silent since before them.
LATEST = 30
#: Runs of the live graph until each scan was joined from both radars: a busy machine may be late with one.
RUNS, RATE = 5, 0.3


@pytest.fixture
def root(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A short path: socket names are limited."""
    with tempfile.TemporaryDirectory(prefix="mw") as path:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", path)
        yield Path(path)


@pytest.mark.graph
def test_a_recording_gives_live_what_it_gives_offline(tmp_path: Path, root: Path) -> None:
    """Both radars played from one file: the same objects in the vehicle's frame, scan by scan, and what was recorded of
    the live graph names the topics of each.
    """
    capture, out, live = tmp_path / "two.mcap", tmp_path / "out", tmp_path / "live.mcap"
    short = ["--scans", str(SCANS), "--chirps-per-beam", "8", "--effects", "basic"]
    assert main(["sim", "run", SCENE, "--out", str(capture), *short]) == 0
    assert main(["process", str(capture), "--out", str(out), "--profile", "cfar"]) == 0
    lines = (out / "objects.jsonl").read_text().splitlines()
    assert len(lines) == SCANS
    assert {json.loads(line)["frame"] for line in lines} == {"vehicle"}
    played = ["-p", "player.scene=null", "-p", f"player.capture={capture}", "-p", f"player.rate={RATE}"]
    played += ["--profile", "cfar", "--headless", "--record", str(live), "--runs-dir", str(tmp_path / "runs")]
    joined: set[str] = set()
    for _ in range(RUNS):
        live.unlink(missing_ok=True)
        assert main(["launch", LAUNCH, *played, "--domain", "two"]) == 0
        with RecordingReader(live) as reader:
            frames = [item.message for item in reader.messages(("perception/hidden_objects",))]
            assert {f"perception/{name}/hidden_objects" for name in ("left", "right")} <= set(reader.types)
            assert "radar/left/beam" not in reader.types
        for frame in frames:
            line = json.dumps(bev_to_json(frame, "vehicle"))  # type: ignore[arg-type]
            if line in lines:
                joined.add(line)
            else:
                # of one radar, since the other was late
                assert len(frame.walls) < len(json.loads(lines[frame.scan_id])["walls"])  # type: ignore[union-attr]
        if len(joined) == SCANS:
            break
    assert joined == set(lines)


@pytest.mark.graph
def test_a_killed_former_leaves_the_view_of_the_other_radar(root: Path) -> None:
    """Views go on without the left radar and say so; the former is started again, and views are whole again."""
    small = ["player.chirps_per_beam=8", "player.effects=basic", "player.rate=0.3"]
    # at rest the scene has no end, however long a loaded machine takes
    small += ["player.ego_speed_mps=0.0", "player.object_speed_mps=0.0"]
    options = [word for param in small for word in ("-p", param)]
    graph = LiveGraph(Path(LAUNCH), root, "--headless", "--profile", "cfar", *options)
    try:
        graph.await_that("a whole view", lambda: graph.view is not None and RADAR_LOST not in graph.view.flags)
        # silent for longer than a start takes
        graph.fault(signal.SIGSTOP, ["ra_former_left"])
        views = graph.views

        def is_without() -> bool:
            assert graph.views <= views + LATEST, f"{LATEST} views since it stopped, none without it: {graph.said[-9:]}"
            return graph.views > views and graph.view is not None and RADAR_LOST in graph.view.flags

        graph.await_that("a view without it", is_without)
        assert graph.await_text("radar left is silent: the view is that of the others", "view_fusion")
        graph.fault(signal.SIGKILL, ["ra_former_left"])
        graph.await_that("whole views again", lambda: graph.view is not None and RADAR_LOST not in graph.view.flags)
    finally:
        graph.close()
