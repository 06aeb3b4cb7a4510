"""`bag record|info|snapshot|recover` and `launch --record`: on a live graph, with processes of their own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from mirrorwave.cli import main
from mirrorwave.commands.captures.bag_options import require_new_recording
from mirrorwave.commands.graph.launch import code_of_recordings
from msgs.bus.zmq import ZmqBus
from msgs.recording.mcap import Losses, RecordingReader, RecordingWriter, TopicLoss, info
from msgs.values.vehicle import VehicleState
from nodes.process.launch_file import launch_from_mapping, parse_yaml
from tests.mirrorwave.endings import TICKING, made_box

#: Nothing is measured against this: it ends a test that would wait for ever.
PATIENCE_S = 120.0


@pytest.fixture
def meeting_place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory of its own for a graph's sockets, its name short enough for them."""
    with made_box(monkeypatch) as box:
        yield box / "t"


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A verb in a process of its own, asked to end afterwards."""
    command = [sys.executable, "-m", "mirrorwave", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        assert process.stdout is not None
        process.stdout.close()


def wait_for(what: object) -> None:
    """Until `what()` is true."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():  # type: ignore[operator]
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.05)


def state(path: Path, losses: Losses) -> Path:
    with RecordingWriter(path, {"command": "mirrorwave launch x.yaml", "machine": "nonsense"}) as writer:
        writer.write("vehicle/state", VehicleState(stamp_ns=0), publisher="car", sequence=0, sent_ns=0)
        writer.write_losses(losses)
    return path


@pytest.mark.parametrize("option", ["split_bytes", "split_s", "snapshot_s"])
def test_what_was_recorded_in_parts_is_not_written_over(tmp_path: Path, option: str) -> None:
    (tmp_path / "out-00007.mcap").touch()
    require_new_recording(tmp_path / "out.mcap", {option: None})
    with pytest.raises(FileExistsError, match=r"exists already.*out-00007"):
        require_new_recording(tmp_path / "out.mcap", {option: 1.0})


def test_what_a_recorder_lost_and_what_it_missed_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = SimpleNamespace(lost=2, missed=3, messages=4, paths=["a.mcap"], refused="no room")
    monkeypatch.setattr("nodes.recorder.Recorder", lambda *_, **__: ended)
    monkeypatch.setattr("nodes.node.run_loop", lambda *_: None)
    monkeypatch.setattr("mirrorwave.commands.captures.bag.require_graph", lambda _: None)
    assert main(["bag", "record", str(tmp_path / "a.mcap")]) == 3
    assert capsys.readouterr().out == "a.mcap\n4 messages, 5 missing\nno room\n"


@pytest.mark.slow
def test_a_running_graph_is_recorded_in_parts_with_its_launch_file(
    meeting_place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the supervisor runs, overrides included, is in the metadata, without what it is recorded with."""
    launch = tmp_path / "ticking.yaml"
    launch.write_text(TICKING)
    out = tmp_path / "out.mcap"
    with running("launch", str(launch), "-p", "tick.period_s=0.02", "--runs-dir", str(tmp_path / "runs")):
        wait_for(lambda: list(meeting_place.glob("vehicle.state@tick")))
        options = ["--topics", "vehicle/state", "--split-duration", "0.5", "--max-parts", "2"]
        with running("bag", "record", str(out), *options) as recorder:
            # a third part: the first had to go
            wait_for(lambda: list(tmp_path.glob("out-00003.mcap")))
        assert recorder.returncode in (0, 3)
    parts = sorted(tmp_path.glob("out*.mcap"))
    numbers = [int(part.stem.removeprefix("out-")) for part in parts]
    assert numbers == [numbers[0], numbers[0] + 1]
    assert numbers[0] >= 2
    for number, part in zip(numbers, parts, strict=True):
        found = info(part)
        assert (found.complete, found.checksums_agree) == (True, True)
        assert found.duration_s <= 0.5
        assert found.metadata["part"] == str(number)
    capsys.readouterr()
    assert main(["bag", "info", str(parts[0]), "--config"]) in (0, 3)
    config = launch_from_mapping(parse_yaml(capsys.readouterr().out, "config"), "config")
    assert config.nodes["tick"].params == {"kind": "tick", "period_s": 0.02}
    assert main(["bag", "record", str(out), "--split-size", "1"]) == 2
    assert f"{parts[0].name}: exists already" in capsys.readouterr().err


@pytest.mark.slow
def test_a_snapshot_of_a_launched_recorder(
    meeting_place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command and the bare signal each write the last seconds, a file a trigger, while the graph runs on.

    How long each is depends on who gets a core when; tests/nodes/test_recorder.py has it on a virtual clock.
    """
    launch = tmp_path / "ticking.yaml"
    launch.write_text(TICKING)
    arguments = ["--record", str(tmp_path / "s.mcap"), "--snapshot", "0.5", "--runs-dir", str(tmp_path / "runs")]
    with running("launch", str(launch), *arguments) as graph:
        wait_for(lambda: list(meeting_place.glob("vehicle.state@tick")) and list(meeting_place.glob("snapshot-*.json")))
        written: list[Path] = []

        def has_forgotten() -> bool:
            """Whether one more snapshot holds messages, but no longer the first of the graph."""
            assert main(["bag", "snapshot", "--json", "--timeout", str(PATIENCE_S)]) in (0, 3)
            (answer,) = json.loads(capsys.readouterr().out)
            written.append(Path(answer["path"]))
            assert (written[-1].name, answer["error"]) == (f"s-{len(written):05d}.mcap", "")
            with RecordingReader(written[-1]) as reader:
                return next((one.sequence > 0 for one in reader.messages(["vehicle/state"])), False)

        wait_for(has_forgotten)
        (door,) = meeting_place.glob("snapshot-*.json")
        os.kill(json.loads(door.read_bytes())["pid"], signal.SIGUSR1)
        wait_for(lambda: json.loads(door.read_bytes() or b"{}").get("answers") == len(written) + 1)
        written.append(tmp_path / f"s-{len(written) + 1:05d}.mcap")
        assert graph.poll() is None
    assert main(["bag", "snapshot"]) == 1
    assert "no graph runs in domain 't'" in capsys.readouterr().err
    assert sorted(tmp_path.glob("s-*.mcap")) == written
    for path in written:
        found = info(path)
        assert (found.complete, found.checksums_agree) == (True, True)
        assert "tests.graph.toy_nodes" in found.metadata["launch"]
    assert "vehicle/state" in {topic.topic for topic in info(written[-2]).topics}


@pytest.mark.slow
def test_a_recording_without_room_ends_with_3(
    meeting_place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`--min-free` above what any disk has: an empty and complete file, one line that says why."""
    bus = ZmqBus("car", meeting_place)
    bus.advertise("vehicle/state")
    with running("bag", "record", str(tmp_path / "a.mcap"), "--min-free", "1e10") as recorder:
        while recorder.poll() is None:
            bus.publish("vehicle/state", VehicleState(stamp_ns=0))
            time.sleep(0.02)
        assert recorder.stdout is not None
        said = recorder.stdout.read()
    bus.close()
    assert recorder.returncode == 3
    assert "10000000000 MB are to stay free" in said
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert reader.complete
        assert reader.losses is not None
        assert reader.losses.ended is not None
    assert main(["bag", "info", str(tmp_path / "a.mcap")]) == 3
    assert "ended early: " in capsys.readouterr().out


def test_info_tells_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = state(tmp_path / "whole.mcap", Losses())
    assert main(["bag", "info", str(whole)]) == 0
    assert "missing messages: none" in capsys.readouterr().out
    lossy = state(tmp_path / "lossy.mcap", Losses(topics=(TopicLoss(topic="radar/beam", lost=7),)))
    assert main(["bag", "info", str(lossy)]) == 3
    said = capsys.readouterr().out
    assert "missing messages: 7" in said
    assert "command: mirrorwave launch x.yaml" in said
    assert main(["bag", "info", str(lossy), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["losses"]["topics"][0]["lost"] == 7
    assert main(["bag", "info", str(whole), "--config"]) == 2
    assert "holds no launch file" in capsys.readouterr().err


@pytest.mark.slow
def test_recover_has_the_exit_codes_of_mcap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0 all, 3 some, 1 nothing; a file that is no recording is bad input, 2."""
    whole = state(tmp_path / "whole.mcap", Losses())
    assert main(["bag", "recover", str(whole), str(tmp_path / "a.mcap")]) == 0
    raw = whole.read_bytes()
    for name, content, code in (("some", raw[:-30], 3), ("nothing", raw[:400], 1), ("none", raw[1:], 2)):
        (tmp_path / f"{name}.mcap").write_bytes(content)
        assert main(["bag", "recover", str(tmp_path / f"{name}.mcap"), str(tmp_path / f"{name}-out.mcap")]) == code
    assert info(tmp_path / "some-out.mcap").loss is None
    assert main(["bag", "info", str(tmp_path / "some.mcap")]) == 3
    assert main(["bag", "recover", str(whole), str(tmp_path / "a.mcap")]) == 2, "nothing is written over"
    assert not (tmp_path / "none-out.mcap").exists()


@pytest.mark.parametrize(
    ("losses", "code", "said"),
    [
        (Losses(), 0, ""),
        (Losses(topics=(TopicLoss(topic="radar/beam", lost=7),)), 3, "a.mcap: 7 messages are missing\n"),
        # closed in good order, so that nothing is missing in what there is
        (Losses(ended="no room"), 3, "a.mcap: no room\n"),
    ],
)
def test_a_launch_tells_what_its_recording_lacks(
    tmp_path: Path, losses: Losses, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    assert code_of_recordings([state(path, losses)]) == code
    assert capsys.readouterr().out == (f"{tmp_path}/{said}" if said else "")
    path.unlink()
    assert code_of_recordings([state(path, Losses(ended=f"{path}: no room"))]) == 3
    assert capsys.readouterr().out == f"{path}: no room\n"


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        (["--start", "inf"], "--start must be 0..1e+09 s, got inf"),
        (["--start", "400"], "--start must be within the recording"),
        (["--end", "1e300"], "--end must be 0..1e+09 s, got 1e+300"),
        (["--topics", "vehicle/stat"], "a.mcap: no topic matches 'vehicle/stat'; it holds vehicle/state"),
        (["--topics", ""], "--topics must name a topic, got ''"),
    ],
)
def test_a_cut_that_does_not_fit_is_one_line(
    tmp_path: Path, options: list[str], rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = state(tmp_path / "a.mcap", Losses())
    assert main(["bag", "trim", str(path), str(tmp_path / "b.mcap"), *options]) == 2
    said = capsys.readouterr().err
    assert rule in said
    assert said.count("\n") == 1
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        (["--split-size", "-1"], "--split-size must be a number of MB from 0"),
        (["--split-size", "nan"], "--split-size must be a number of MB from 0"),
        (["--split-duration", "0"], "split_s must be above zero"),
        (["--max-parts", "2"], "max_parts needs split_bytes or split_s"),
        (["--snapshot", "5", "--split-duration", "1"], "snapshot_s must not stand beside"),
        (["--duration", "1e12"], "--duration must be 0..1e+09 s, got 1e+12"),
        (["--topics", " ,"], "--topics must name a topic, got ' ,'"),
        (["--snapshot", "inf"], "snapshot_s must be above zero and below"),
    ],
)
def test_options_that_do_not_fit_are_one_line(
    meeting_place: Path, tmp_path: Path, options: list[str], rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bag", "record", str(tmp_path / "a.mcap"), *options]) == 2
    said = capsys.readouterr().err
    assert rule in said
    assert said.count("\n") == 1
    assert not list(tmp_path.glob("*.mcap"))
