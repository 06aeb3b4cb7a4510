"""`mirrorwave sim run` and `mirrorwave process`, as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mirrorwave.cli import main
from models.perception.chain import Chain
from models.perception.detectors import CfarDetector
from models.perception.objects import bev_to_json
from models.perception.tracking import track_to_json
from nodes.player import Params, scene_player

SCENE = "launch/scenes/corner.yaml"
CHIRPS = 4


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("capture") / "corner.mcap"
    command = ["sim", "run", SCENE, "--out", str(path), "--scans", "2", "--chirps-per-beam", str(CHIRPS)]
    command += ["--effects", "basic"]
    assert main(command) == 0
    return path


def test_process_writes_objects_times_and_a_picture(capture: Path, tmp_path: Path) -> None:
    assert main(["process", str(capture), "--out", str(tmp_path), "--profile", "cfar"]) == 0
    lines = [json.loads(line) for line in (tmp_path / "objects.jsonl").read_text().splitlines()]
    assert [line["scan_id"] for line in lines] == [0, 1]
    assert set(lines[0]) == {"scan_id", "stamp_ns", "frame", "walls", "points", "objects"}
    assert set(lines[0]["walls"][0]) == {"normal", "offset_m", "ends_m", "inliers"}
    times = [json.loads(line) for line in (tmp_path / "timing.jsonl").read_text().splitlines()]
    assert {"ra_former.last beam", "dense_predictor.detect", "geometry.geometry"} <= set(times[0]["stages"])
    assert (tmp_path / "bev.png").read_bytes().startswith(b"\x89PNG")


def test_process_is_the_chain_cut_at_the_topics(capture: Path, tmp_path: Path) -> None:
    """Same bytes as `chain.py`, and the same bytes twice."""
    for name in ("once", "twice"):
        assert main(["process", str(capture), "--out", str(tmp_path / name), "--profile", "cfar"]) == 0
    once = (tmp_path / "once" / "objects.jsonl").read_bytes()
    assert once == (tmp_path / "twice" / "objects.jsonl").read_bytes()
    player = scene_player(Params(scene=SCENE, chirps_per_beam=CHIRPS))
    chain = Chain(player.setup, CfarDetector(player.setup))
    state = player.vehicle_state(0)
    frames = [frame for scan in (0, 1) for index in range(25) for frame in chain.add(player.beam(scan, index), state)]
    assert once.decode() == "".join(json.dumps(bev_to_json(frame)) + "\n" for frame in frames)


def test_tracks_are_those_of_the_chain(tmp_path: Path) -> None:
    """A drive with vehicle states: a line a scan, by `process` and by `chain.py` the same."""
    drive, chirps = "launch/drives/side_street.yaml", 4
    recording = tmp_path / "drive.mcap"
    command = ["sim", "run", drive, "--out", str(recording), "--scans", "5", "--chirps-per-beam", str(chirps)]
    assert main([*command, "--effects", "basic"]) == 0
    # in so short beams noise hides the empty ones: some count as silent
    assert main(["process", str(recording), "--out", str(tmp_path), "--profile", "cfar"]) == 3
    lines = [json.loads(line) for line in (tmp_path / "tracks.jsonl").read_text().splitlines()]
    assert [line["scan_id"] for line in lines] == [0, 1, 2, 3, 4]
    player = scene_player(Params(scene=drive, chirps_per_beam=chirps))
    chain = Chain(player.setup, CfarDetector(player.setup))
    views = [
        view
        for scan in range(5)
        for index in range(25)
        for view in chain.add(player.beam(scan, index), player.vehicle_state(player.stamp_ns(scan, index)))
    ]
    assert lines[-1]["tracks"]
    expected = [json.dumps([track_to_json(one) for one in view.tracks]) for view in views]
    assert [json.dumps(line["tracks"]) for line in lines] == expected


def test_json_summary(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["process", str(capture), "--out", str(tmp_path), "--profile", "cfar", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["score"]["scans"] == 2
    assert summary["scans_with_loss"] == 0


def test_sigmf_gives_the_same_objects(capture: Path, tmp_path: Path) -> None:
    sigmf = tmp_path / "corner.sigmf-meta"
    command = ["sim", "run", SCENE, "--out", str(sigmf), "--scans", "2", "--chirps-per-beam", str(CHIRPS)]
    command += ["--effects", "basic"]
    assert main(command) == 0
    for path, name in ((sigmf, "a"), (capture, "b")):
        assert main(["process", str(path), "--out", str(tmp_path / name), "--profile", "cfar"]) == 0
    assert (tmp_path / "a" / "objects.jsonl").read_bytes() == (tmp_path / "b" / "objects.jsonl").read_bytes()


def test_a_cut_recording_is_processed_as_far_as_it_goes_and_said(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cut in the second scan: two lines, the second from the beams that are there; exit code 3."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(capture.read_bytes()[: capture.stat().st_size * 3 // 4])
    assert main(["process", str(cut), "--out", str(tmp_path), "--profile", "cfar", "--json"]) == 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["scans_with_loss"] == 1
    assert "cut" in summary["capture_loss"]
    assert len((tmp_path / "objects.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["process", "nowhere.mcap"], "nowhere.mcap"),
        (
            ["process", "{capture}", "--profile", "magic"],
            "unknown profile 'magic'; known are default, accurate, balanced, cfar, fast, unfiltered",
        ),
        (["process", "{capture}", "-p", "geometry.walls.magic=1"], "geometry.params.walls"),
        (["process", "{capture}", "-p", "nobody.x=1"], "unknown node 'nobody'"),
        (["process", "{garbage}"], "garbage.mcap"),
        (["sim", "run", "nowhere.yaml", "--out", "{out}"], "nowhere.yaml"),
        (["sim", "run", SCENE, "--out", "{capture}"], "exists already"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    garbage = tmp_path / "garbage.mcap"
    garbage.write_bytes(np.random.default_rng(0).bytes(5000))
    places = {"capture": str(capture), "garbage": str(garbage), "out": str(tmp_path / "x.mcap")}
    command = [argument.format(**places) for argument in arguments]
    if command[0] == "process":
        command += ["--out", str(tmp_path / "out")]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
