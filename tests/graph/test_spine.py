"""The real graph on a capture, one process for all nodes: the same bytes as `mirrorwave process`."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from mirrorwave.cli import main
from mirrorwave.convert.result_lines import bev_to_json
from msgs.recording.mcap import RecordingReader
from msgs.values.perception import BevFrame

SCANS = 3
#: A graph that is behind sheds whole scans: on a machine with much else to do it is given more time for each.
RATES = (1.0, 0.3, 0.1, 0.02)
LAUNCH = """
name: spine
nodes:
  player:
    module: nodes.player
    params: {{capture: {capture}, settle_s: 1.0, rate: {rate}}}
    after: [ra_former, dense_predictor, geometry, recorder]
    ends_graph: true
  ra_former: {{module: nodes.ra_former}}
  dense_predictor: {{module: nodes.dense_predictor, params: {{method: cfar}}}}
  geometry: {{module: nodes.geometry}}
  recorder:
    module: nodes.recorder
    params: {{path: {recording}}}
"""


@pytest.fixture
def run_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A short path: socket names are limited."""
    with tempfile.TemporaryDirectory(prefix="mw") as path:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", path)
        yield Path(path)


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a capture and what one thread makes of it."""
    folder = tmp_path_factory.mktemp("processed")
    scene, capture = "launch/scenes/two_hidden_vehicles.yaml", str(folder / "capture.mcap")
    short = ["--scans", str(SCANS), "--chirps-per-beam", "8", "--effects", "basic"]
    assert main(["sim", "run", scene, "--out", capture, *short]) == 0
    assert main(["process", capture, "--out", str(folder), "--profile", "cfar"]) == 0
    return folder


@pytest.mark.graph
def test_a_graph_gives_the_bytes_of_one_thread(processed: Path, tmp_path: Path, run_dir: Path) -> None:
    capture, recording = processed / "capture.mcap", tmp_path / "seen.mcap"
    group = ["--group", "chain=player,ra_former,dense_predictor,geometry"]
    for rate in RATES:
        launch = tmp_path / "spine.yaml"
        launch.write_text(LAUNCH.format(capture=capture, recording=recording, rate=rate))
        assert main(["launch", str(launch), "--runs-dir", str(tmp_path / "runs"), "--domain", "spine", *group]) == 0
        with RecordingReader(recording) as reader:
            frames = [item.message for item in reader.messages(topics=["perception/hidden_objects"])]
            assert reader.loss is None
        if len(frames) == SCANS:
            break
        recording.unlink()
    assert len(frames) == SCANS
    assert all(isinstance(frame, BevFrame) for frame in frames)
    seen = "".join(json.dumps(bev_to_json(frame)) + "\n" for frame in frames)
    assert seen == (processed / "objects.jsonl").read_text()
