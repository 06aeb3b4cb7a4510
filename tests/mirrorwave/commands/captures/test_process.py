"""`mirrorwave sim run` and `mirrorwave process`, as a user calls them."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mirrorwave.api import views
from mirrorwave.cli import main
from mirrorwave.console import ExitCode, _cell
from mirrorwave.convert.result_lines import bev_to_json, track_to_json
from mirrorwave.replay.playback import Playback
from msgs.files.shipped import CHECKOUT, SAMPLE
from msgs.recording.mcap import RecordingReader, RecordingWriter, info
from msgs.values.radar import ArrayParams, BeamGrid
from msgs.values.vehicle import VehicleState
from nodes.player import Params, scene_player, truth_beside
from tests.builders import cfar_chain
from tests.models.perception.target_lists.street import detections, street_points

SCENE = "launch/scenes/corner.yaml"
CHIRPS = 4


@pytest.fixture(scope="module")
def processed(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `process` leaves of the capture."""
    folder = tmp_path_factory.mktemp("processed")
    assert main(["process", str(capture), "--out", str(folder), "--profile", "cfar"]) == 0
    return folder


def test_process_takes_detections_and_states_what_did_not_arrive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A hidden car in each of two scans, a picture without a map, code 3 for the scan that lacks detections."""
    scans = [detections(street_points(), scan, scan_id=scan, stamp_ns=scan * 10**8, lost=scan) for scan in range(2)]
    path = recording_of(tmp_path / "street.mcap", [("radar/detections", scan) for scan in scans])
    assert main(["process", str(path), "--out", str(tmp_path / "out")]) == ExitCode.DONE_WITH_LOSS
    lines = [json.loads(line) for line in (tmp_path / "out" / "objects.jsonl").read_text().splitlines()]
    assert [len(line["objects"]) for line in lines] == [1, 1]
    assert (tmp_path / "out" / "bev.png").stat().st_size > 10_000
    assert "detection_peaks.classify" in (tmp_path / "out" / "timing.jsonl").read_text()
    assert [view.ra_map for view in views(path)] == [None, None]
    assert "missing or silent in 1 of 2 scans" in capsys.readouterr().out


@pytest.mark.slow
def test_process_writes_objects_times_and_a_picture(processed: Path) -> None:
    lines = [json.loads(line) for line in (processed / "objects.jsonl").read_text().splitlines()]
    assert [line["scan_id"] for line in lines] == [0, 1]
    assert set(lines[0]) == {"scan_id", "stamp_ns", "frame", "walls", "points", "objects"}
    assert set(lines[0]["walls"][0]) == {"normal", "offset_m", "ends_m", "inliers"}
    times = [json.loads(line) for line in (processed / "timing.jsonl").read_text().splitlines()]
    assert {"ra_former.last beam", "dense_predictor.detect", "geometry.geometry"} <= set(times[0]["stages"])
    assert (processed / "bev.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_tracks_are_those_of_the_chain(tmp_path: Path) -> None:
    """A drive with vehicle states: a line a scan, by `process` and by `chain.py` the same."""
    drive, chirps = "launch/drives/side_street.yaml", 4
    recording = tmp_path / "drive.mcap"
    command = ["sim", "run", drive, "--out", str(recording), "--scans", "5", "--chirps-per-beam", str(chirps)]
    assert main([*command, "--effects", "basic"]) == 0
    assert main(["process", str(recording), "--out", str(tmp_path), "--profile", "cfar"]) == 0
    lines = [json.loads(line) for line in (tmp_path / "tracks.jsonl").read_text().splitlines()]
    assert [line["scan_id"] for line in lines] == [0, 1, 2, 3, 4]
    player = scene_player(Params(scene=drive, chirps_per_beam=chirps, effects="basic"))
    chain = cfar_chain(player.setup)
    with RecordingReader(recording) as reader:
        beams = [item.message for item in reader.messages(topics=["radar/beam"])]
    assert len(beams) == 5 * 25
    views = [view for beam in beams for view in chain.add(beam, player.vehicle_state(beam.stamp_ns))]
    assert lines[-1]["tracks"]
    expected = [json.dumps([track_to_json(one) for one in view.frame.tracks]) for view in views]
    assert [json.dumps(line["tracks"]) for line in lines] == expected


@pytest.mark.slow
def test_json_summary_and_the_same_bytes_again(
    capture: Path, processed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["process", str(capture), "--out", str(tmp_path), "--profile", "cfar", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["score"]["scans"] == 2
    assert summary["scans_with_loss"] == 0
    assert (tmp_path / "objects.jsonl").read_bytes() == (processed / "objects.jsonl").read_bytes()


@pytest.mark.slow
def test_sigmf_gives_the_same_objects(processed: Path, tmp_path: Path) -> None:
    sigmf = tmp_path / "corner.sigmf-meta"
    command = ["sim", "run", SCENE, "--out", str(sigmf), "--scans", "2", "--chirps-per-beam", str(CHIRPS)]
    command += ["--effects", "basic"]
    assert main(command) == 0
    assert main(["process", str(sigmf), "--out", str(tmp_path), "--profile", "cfar"]) == 0
    assert (tmp_path / "objects.jsonl").read_bytes() == (processed / "objects.jsonl").read_bytes()


@pytest.mark.slow
def test_a_cut_recording_is_processed_as_far_as_it_goes_and_said(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cut in the second scan: two lines, the second from the beams that are there; exit code 3."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(capture.read_bytes()[: capture.stat().st_size * 3 // 4])
    assert main(["process", str(cut), "--out", str(tmp_path), "--profile", "cfar", "--json"]) == 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["score"]["scans"] == 2
    assert summary["scans_with_loss"] == 1
    assert "cut" in summary["capture_loss"]
    assert len((tmp_path / "objects.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["process", "nowhere.mcap"], "nowhere.mcap"),
        (
            ["process", "{capture}", "--profile", "magic"],
            "unknown profile 'magic'; known are default, accurate, cfar, specification, or FILE.yaml",
        ),
        (["process", "{capture}", "-p", "geometry.grid.magic=1"], "geometry.params.grid"),
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
    assert not (tmp_path / "out").exists()


def recording_of(path: Path, messages: list[tuple[str, Any]]) -> Path:
    with RecordingWriter(path, {}) as writer:
        for number, (topic, message) in enumerate(messages):
            writer.write(topic, message, publisher="player", sequence=number, sent_ns=message.stamp_ns)
    return path


@pytest.mark.slow
def test_a_file_without_raw_data_is_told_what_it_holds_and_what_takes_it(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line each, and nothing is written; results of a graph are for `view`."""
    player = scene_player(Params(scene=SCENE, chirps_per_beam=CHIRPS, effects="basic"))
    setup, beams = player.setup, [player.beam(0, index) for index in range(3)]
    one = msgspec.structs.replace(setup, beams=BeamGrid(azimuth_deg=(0.0,)))
    column = msgspec.structs.replace(setup, array=ArrayParams(columns=1))
    view = next(iter(views(capture, "cfar"))).frame
    other = tmp_path / "capture.bin"
    other.write_bytes(capture.read_bytes()[:100])
    wrong = {
        recording_of(tmp_path / "view.mcap", [("radar/setup", setup), ("perception/hidden_objects", view)]): (
            "holds no radar/beam, no lidar/histograms and no radar/detections to process; "
            "it holds perception/hidden_objects, radar/setup: "
            f"`mirrorwave view {tmp_path / 'view.mcap'}` shows it. Raw data are recorded with --raw"
        ),
        recording_of(tmp_path / "car.mcap", [("vehicle/state", VehicleState(stamp_ns=0))]): (
            "it holds vehicle/state. Raw data are recorded with --raw"
        ),
        recording_of(tmp_path / "alone.mcap", [("radar/beam", beam) for beam in beams]): (
            "holds no radar/setup, which says how to read its radar/beam"
        ),
        recording_of(tmp_path / "one.mcap", [("radar/setup", one), ("radar/beam", beams[0])]): (
            "its radar: beams.azimuth_deg must name at least 2 directions to tell echoes apart, got (0.0,)"
        ),
        recording_of(tmp_path / "column.mcap", [("radar/setup", column), ("radar/beam", beams[0])]): (
            "its radar: array.columns must be at least 2 to tell directions apart, got 1"
        ),
        other: "must be a recording NAME.mcap or a SigMF capture NAME.sigmf-meta",
        tmp_path: "is a folder, must be a recording NAME.mcap or a SigMF capture NAME.sigmf-meta",
    }
    for path, rule in wrong.items():
        assert main(["process", str(path), "--out", str(tmp_path / "out")]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith(f"mirrorwave: {path}: ")
        assert said.err.endswith(f"{rule}\n")
        assert said.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_beams_that_are_missing_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 3 has its reason; a scan of which one beam came is still looked at."""
    player = scene_player(Params(scene=SCENE, chirps_per_beam=CHIRPS, effects="basic"))
    path = recording_of(tmp_path / "first.mcap", [("radar/setup", player.setup), ("radar/beam", player.beam(0, 0))])
    assert main(["process", str(path), "--out", str(tmp_path / "out"), "--profile", "cfar"]) == 3
    assert "beams or detections are missing or silent in 1 of 1 scan\n" in capsys.readouterr().out


@pytest.mark.slow
def test_beams_out_of_order_and_twice_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As two radars of one name are in a recording, or scans that came in another order."""
    player = scene_player(Params(scene=SCENE, chirps_per_beam=CHIRPS, effects="basic"))
    path = tmp_path / "mixed.mcap"
    with RecordingWriter(path, {}) as writer:
        writer.write("radar/setup", player.setup, publisher="player", sent_ns=0)
        for number, scan in enumerate((1, 0, 1)):
            writer.write("radar/beam", player.beam(scan, 0), publisher="player", sent_ns=number)
    assert main(["process", str(path), "--out", str(tmp_path / "out"), "--profile", "cfar"]) == 3
    assert f"{path}: left out: 1 beam late, 1 beam repeated\n" in capsys.readouterr().out


@pytest.mark.parametrize("ending", ["mcap", "sigmf-meta"])
def test_a_scene_goes_by_its_name(ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On the terminal and in the recording, or in the truth beside a capture; not by the name of its file."""
    scene, out = tmp_path / "file.yaml", tmp_path / f"capture.{ending}"
    scene.write_text(Path(SCENE).read_text(encoding="utf-8").replace("name: bend", "name: bend in the road"))
    command = ["sim", "run", str(scene), "--out", str(out), "--seed", "3", "--chirps-per-beam", "1"]
    assert main([*command, "--effects", "basic"]) == 0
    assert capsys.readouterr().out == f"{out}: 1 scan of bend in the road, seed 3\n"
    recording = out if ending == "mcap" else truth_beside(out)
    found = info(recording).metadata
    assert (found["scene"], found["seed"]) == ("bend in the road", "3")
    assert main(["bag", "info", str(recording)]) == 0
    assert "scene: bend in the road\nseed: 3\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["sim", "run", SCENE, "--out", "x.xyz"], "--out x.xyz: a capture's name must end in .mcap or .sigmf-meta or "),
        (["sim", "dataset", "--out", "file", "--count", "1", "--seed", "1"], "file: File exists"),
        (["process", "x.mcap", "-p", "dense_predictor.model=x.onnx"], "x.mcap: no such file"),
    ],
)
def test_wrong_files_are_one_line(
    words: list[str], rule: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(Path(SCENE).absolute()) if word == SCENE else word for word in words]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert main(words) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert rule in said.err


# the page at once, and the sample


def interrupted(playback: Playback) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_process_view_records_what_the_page_shows_and_serves_it(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recording holds the very views, no raw data, in the times of the capture; a second run takes its place."""
    monkeypatch.setattr(Playback, "run", interrupted)
    command = ["process", str(capture), "--out", str(tmp_path), "--profile", "cfar"]
    for _ in range(2):
        assert main([*command, "--view", "--no-browser", "--port", "0"]) == 0
    assert "view.mcap: 2 scans; open http://127.0.0.1:" in capsys.readouterr().out
    with RecordingReader(tmp_path / "view.mcap") as reader:
        recorded = list(reader.messages())
    topics = Counter(item.topic for item in recorded)
    assert topics == {
        "radar/setup": 1, "vehicle/state": 50, "radar/ra_map": 2, "perception/peaks": 2,
        "perception/hidden_objects": 2, "sim/truth": 2,
    }  # fmt: skip
    views = [item for item in recorded if item.topic == "perception/hidden_objects"]
    lines = "".join(json.dumps(bev_to_json(item.message)) + "\n" for item in views)
    assert lines == (tmp_path / "objects.jsonl").read_text()
    # the view stands at the time of its scan's last beam
    assert [item.log_time_ns - item.message.stamp_ns for item in views] == [24 * 12_000_000] * 2


def test_process_view_of_detections_has_no_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Playback, "run", interrupted)
    scans = [detections(street_points(), scan, scan_id=scan, stamp_ns=scan * 10**8) for scan in range(2)]
    path = recording_of(tmp_path / "street.mcap", [("radar/detections", scan) for scan in scans])
    out = tmp_path / "out"
    assert main(["process", str(path), "--out", str(out), "--view", "--no-browser", "--port", "0"]) == 0
    with RecordingReader(out / "view.mcap") as reader:
        assert [item.topic for item in reader.messages()] == ["perception/peaks", "perception/hidden_objects"] * 2


@pytest.mark.slow
def test_the_sample_holds_two_hidden_cars_that_are_recovered(tmp_path: Path) -> None:
    """Twelve scans, none with loss; the errors are those that docs/guides/first-look.md states.

    By the matrix products that it names: those of each processor round a map in a way of their own.
    """
    command = [sys.executable, "-m", "mirrorwave", "process", "--sample", "--out", tmp_path, "--json"]
    environment = os.environ | {"OPENBLAS_CORETYPE": "Haswell"}
    result = json.loads(subprocess.run(command, env=environment, check=True, capture_output=True).stdout)
    assert (result["scans_with_loss"], result["capture_loss"]) == (0, None)
    score = result["score"]
    errors = ("mean_centre_error_m", "mean_error_m", "worst_error_m")
    names = ("scans", "objects", "matched", "missed", "unmatched", *errors)
    guide = (CHECKOUT / "docs/guides/first-look.md").read_text().splitlines()
    assert [_cell(score[name]) for name in names] in [line.split() for line in guide]
    assert score["scans"] == 12
    # of 24; a report may stand beside a car that has one
    assert score["matched"] >= 20
    assert score["unmatched"] <= 6
    last = json.loads((tmp_path / "objects.jsonl").read_text().splitlines()[-1])
    for car_m, one in zip(((10.3, 5.65), (18.9, 13.9)), last["objects"], strict=True):
        assert math.dist(car_m, (one["x_m"], one["y_m"])) < 1.35
    tracks = json.loads((tmp_path / "tracks.jsonl").read_text().splitlines()[-1])["tracks"]
    assert min(math.dist((18.9, 13.9), (one["x_m"], one["y_m"])) for one in tracks) < 2.0
    assert SAMPLE.stat().st_size < 4_500_000


@pytest.mark.slow
def test_view_of_the_sample_processes_it_first(
    capture: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Playback, "run", interrupted)
    monkeypatch.setattr("msgs.files.shipped.SAMPLE", capture)
    assert main(["view", "--sample", "--no-browser", "--port", "0"]) == 0
    out = capsys.readouterr().out
    assert "2 scans; open http://127.0.0.1:" in out
    # nothing is left behind
    assert not Path(out.splitlines()[-1].split("view.mcap")[0]).exists()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["process", "a.mcap", "--sample"], "give RECORDING or --sample, not both"),
        (["process"], "give RECORDING or --sample"),
        (["process", "--sample", "--view", "--json"], "--json and --view exclude each other"),
        (["view", "a.mcap", "--sample"], "give RECORDING or --sample, not both"),
        (["view"], "give RECORDING or --sample"),
    ],
)
def test_a_file_or_the_sample(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == ExitCode.BAD_INPUT
    error = capsys.readouterr().err
    assert line in error
    assert len(error.splitlines()) == 1


def test_somebody_elses_view_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with RecordingWriter(out / "view.mcap", {"made_by": "somebody"}):
        pass
    before = (out / "view.mcap").read_bytes()
    assert main(["process", "--sample", "--out", str(out), "--view"]) == ExitCode.BAD_INPUT
    assert f"{out / 'view.mcap'}: was not written by `mirrorwave process`" in capsys.readouterr().err
    assert (out / "view.mcap").read_bytes() == before
