"""A recorded drive into the living graph, at several rates: nothing lost, and the bytes of `mirrorwave process`."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from mirrorwave.cli import main
from mirrorwave.convert.result_lines import bev_to_json
from msgs.bus.zmq import list_publishers, run_dir
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.values.perception import BevFrame
from msgs.values.vehicle import VehicleState

SCANS = 3
LAUNCH = """
name: replay
nodes:
  recorder: {{module: nodes.recorder, params: {{path: {recording}}}}}
  ra_former: {{module: nodes.ra_former}}
  dense_predictor: {{module: nodes.dense_predictor, params: {{method: cfar}}}}
  geometry: {{module: nodes.geometry}}
"""
ANSWER = "perception/hidden_objects"


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A short path: socket names are limited."""
    with tempfile.TemporaryDirectory(prefix="mw") as path:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", path)
        yield "replay"


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Raw beams of a few scans and a vehicle that accelerates into a bend: a wrong state for a scan is another map."""
    capture, path = tmp_path / "capture.mcap", tmp_path / "drive.mcap"
    scene = "launch/scenes/two_hidden_vehicles.yaml"
    short = ["--scans", str(SCANS), "--chirps-per-beam", "8", "--effects", "basic"]
    assert main(["sim", "run", scene, "--out", str(capture), *short]) == 0
    with RecordingReader(capture) as reader, RecordingWriter(path, {}) as writer:
        states = 0
        for one in reader.messages():
            message = one.message
            if isinstance(message, VehicleState):
                message = msgspec.structs.replace(message, speed_mps=2.0 + 0.05 * states, yaw_rate_rps=0.002 * states)
                states += 1
            writer.write(one.topic, message, publisher=one.publisher, sequence=one.sequence, sent_ns=one.log_time_ns)
    return path


@contextmanager
def living_graph(tmp_path: Path, domain: str, recording: Path) -> Iterator[None]:
    """The graph without a source, ready, and stopped in order."""
    launch = tmp_path / "graph.yaml"
    launch.write_text(LAUNCH.format(recording=recording))
    command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--domain", domain]
    graph = subprocess.Popen([*command, "--runs-dir", str(tmp_path / "runs")], stdout=subprocess.DEVNULL)
    try:
        while (ANSWER, "geometry") not in list_publishers(run_dir(domain)):
            assert graph.poll() is None
            time.sleep(0.05)
        yield
    finally:
        graph.terminate()
        graph.wait(timeout=120.0)


def lines_of(frame: BevFrame) -> tuple[str, bytes]:
    """What `process` writes of a view, and the whole of it."""
    plain = msgspec.structs.replace(frame, tracks=())
    return json.dumps(bev_to_json(frame)), msgspec.msgpack.encode(plain, enc_hook=lambda array: array.tobytes())


@pytest.mark.graph
def test_every_rate_gives_the_bytes_of_process(
    tmp_path: Path, domain: str, drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["process", str(drive), "--out", str(tmp_path / "out"), "--profile", "cfar"]) == 0
    processed = (tmp_path / "out" / "objects.jsonl").read_text().splitlines()
    assert len(processed) == SCANS
    recording = tmp_path / "seen.mcap"
    rates = ("1", "10", "0")
    with living_graph(tmp_path, domain, recording):
        for rate in rates:
            capsys.readouterr()
            assert main(["bag", "play", str(drive), "--rate", rate, "--domain", domain, "--json"]) == 0
            told = json.loads(capsys.readouterr().out)
            assert (told["scans"], told["unanswered"], told["lost"]) == (SCANS, 0, [])
            assert told["answered_on"] == ANSWER
            assert {"ra_former", "dense_predictor", "geometry", "recorder"} <= set(told["nodes"])

    with RecordingReader(recording) as reader:
        frames = [item.message for item in reader.messages(topics=[ANSWER])]
        assert reader.loss is None
    lines = [lines_of(frame) for frame in frames if isinstance(frame, BevFrame)]
    passes = [lines[at : at + SCANS] for at in range(0, len(lines), SCANS)]
    assert len(passes) == len(rates)
    assert passes[0] == passes[1] == passes[2]
    assert [line for line, _ in passes[0]] == processed
