"""A disk without room: said before the work, or with the file's name, and nothing is left half done."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mirrorwave import offline
from mirrorwave.cli import main
from msgs.bus.codec import encode_inline
from msgs.files import whole_files
from msgs.files.whole_files import named_errors, whole, write_whole
from msgs.recording import mcap_writer as mcap_file
from msgs.recording.mcap import RecordingReader, RecordingWriter, info, whole_recording
from msgs.recording.mcap_copy import copy_recording
from msgs.values.vehicle import VehicleState
from sim_player.dataset.shards import Recipe, shard_arrays
from sim_player.dataset.writer import write_dataset
from tests.msgs.bus.test_codec import EXAMPLES

SCENE = "launch/scenes/two_hidden_vehicles.yaml"
SHORT = ("--chirps-per-beam", "1", "--effects", "basic")
#: Room on the made-up disk.
ROOM = 1_000_000


@pytest.fixture
def small_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole_files, "free_bytes", lambda folder: ROOM)


def limited(words: list[str], limit_bytes: int) -> subprocess.CompletedProcess[str]:
    """A verb that may make no file larger than that: a disk without room, as far as one file can tell.

    It keeps no compiled modules: Python 3.11 leaves them cut off at the limit, for all that come after.
    """
    command = [sys.executable, "-m", "mirrorwave", *words]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes)),
    )  # fmt: skip


def recorded(path: Path, beams: int = 0, states: int = 0) -> Path:
    """A recording; raw beams do not compress."""
    with RecordingWriter(path, {}) as writer:
        for topic, count in (("radar/setup", bool(beams)), ("radar/beam", beams), ("radar/ra_map", 2 * bool(states))):
            for number in range(count):
                writer.write(topic, EXAMPLES[topic][0], publisher="a", sequence=number, sent_ns=number)
        for number in range(states):
            state = VehicleState(stamp_ns=number, reason=os.urandom(1000).hex())
            writer.write("vehicle/state", state, publisher="car", sequence=number, sent_ns=number)
    return path


# before the work


@pytest.mark.parametrize("name", ["a.mcap", "a.sigmf-meta"])
def test_a_capture_that_will_not_fit_is_not_begun(
    name: str, tmp_path: Path, small_disk: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """25 beams of 128 chirps of 8192 samples of 4 bytes: 100 MiB a scan."""
    out = tmp_path / name
    assert main(["sim", "run", SCENE, "--out", str(out), "--scans", "3"]) == 1
    # whoever is the first to simulate compiles, and says so before
    assert capsys.readouterr().err.endswith(f"mirrorwave: {out}: needs 315 MB, 1 MB are free\n")
    assert list(tmp_path.iterdir()) == []


def test_a_data_set_that_will_not_fit_is_not_begun(tmp_path: Path, small_disk: None) -> None:
    with pytest.raises(OSError, match=r"needs 16 MB, 1 MB are free.*manifest\.jsonl"):
        write_dataset(tmp_path / "set", 100, 1)
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["series.json"]


def test_what_a_scene_takes_is_known(tmp_path: Path) -> None:
    """Of the default series: within a third of the true size, so that the check says neither nonsense nor nothing."""
    recipe = Recipe(effects="basic")
    made = sum(array.nbytes for array in shard_arrays(recipe, 1, 0, 2).values()) / 2
    assert recipe.scene_bytes == pytest.approx(made, rel=0.34)


@pytest.mark.parametrize("verb", ["recover", "trim"])
def test_a_copy_that_will_not_fit_is_not_begun(
    verb: str, tmp_path: Path, small_disk: None, capsys: pytest.CaptureFixture[str]
) -> None:
    source = recorded(tmp_path / "a.mcap", states=1500)
    assert main(["bag", verb, str(source), str(tmp_path / "b.mcap")]) == 1
    assert f"{tmp_path / 'b.mcap'}: needs 2 MB, 1 MB are free" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    # a part of it fits
    assert main(["bag", "trim", str(source), str(tmp_path / "c.mcap"), "--topics", "radar/ra_map"]) == 0


@pytest.mark.parametrize("name", ["b.numpy", "b.sigmf-meta"])
def test_a_conversion_that_will_not_fit_is_not_begun(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(whole_files, "free_bytes", lambda folder: 1000)
    source = recorded(tmp_path / "a.mcap", beams=2)
    size = 2 * len(encode_inline(EXAMPLES["radar/beam"][0]))
    assert main(["bag", "convert", str(source), str(tmp_path / name)]) == 1
    assert f"{tmp_path / name}: needs {-(-size // 1_000_000)} MB, 0 MB are free" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


# in the midst of it


@pytest.mark.graph
@pytest.mark.parametrize(
    ("name", "refused"), [("a.mcap", "a.mcap"), ("a.sigmf-meta", "a.sigmf-data")], ids=["mcap", "sigmf"]
)
def test_a_capture_cut_short_is_named_and_gone(name: str, refused: str, tmp_path: Path) -> None:
    out = tmp_path / name
    found = limited(["sim", "run", SCENE, "--out", str(out), *SHORT], 300_000)
    assert (found.returncode, found.stderr.splitlines()[-1]) == (1, f"mirrorwave: {tmp_path / refused}: File too large")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.graph
@pytest.mark.parametrize("verb", ["recover", "convert"])
def test_a_copy_cut_short_is_named_and_gone(verb: str, tmp_path: Path) -> None:
    source = recorded(tmp_path / "a.mcap", states=300)
    out = tmp_path / ("b.mcap" if verb == "recover" else "b.numpy")
    found = limited(["bag", verb, str(source), str(out)], 200_000)
    assert (found.returncode, found.stderr) == (1, f"mirrorwave: {out}: File too large\n")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.graph
def test_results_cut_short_are_named_and_gone_and_those_of_before_stay(tmp_path: Path) -> None:
    capture, out = tmp_path / "a.mcap", tmp_path / "out"
    assert main(["sim", "run", SCENE, "--out", str(capture), *SHORT]) == 0
    words = ["process", str(capture), "--out", str(out), "--profile", "cfar"]
    assert main(words) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert sorted(before) == ["bev.png", "objects.jsonl", "timing.jsonl", "tracks.jsonl"]
    found = limited(words, 20_000)
    assert found.returncode == 1
    (line,) = [line for line in found.stderr.splitlines() if line.startswith("mirrorwave: ")]
    assert line.removeprefix("mirrorwave: ") in [f"{out / name}: File too large" for name in before]
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_an_interrupted_writer_leaves_nothing(tmp_path: Path) -> None:
    def interrupted(path: Path) -> None:
        with whole_recording(path, {}) as writer:
            writer.write("vehicle/state", VehicleState(stamp_ns=0), publisher="a", sequence=0, sent_ns=0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_writer_s_error_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the recording is for; what was written before stays readable."""

    def refuse(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write("vehicle/state", VehicleState(stamp_ns=0), publisher="a", sequence=0, sent_ns=0)
        writer.flush()
        writer.write("vehicle/state", VehicleState(stamp_ns=1), publisher="a", sequence=1, sent_ns=1)
        with monkeypatch.context() as patch:
            patch.setattr(mcap_file, "_write_all", refuse)
            with pytest.raises(OSError, match="No space left on device") as raised:
                writer.flush()
    assert raised.value.filename == str(tmp_path / "a.mcap")
    found = info(tmp_path / "a.mcap")
    assert (found.complete, found.loss, found.topics[0].messages) == (True, None, 1)


def test_a_copy_over_a_file_leaves_the_old_one_until_it_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = recorded(tmp_path / "a.mcap", states=20), recorded(tmp_path / "b.mcap", states=1)
    before = target.read_bytes()

    def refuse(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(mcap_file.McapFile, "finish", refuse)
        with pytest.raises(OSError, match="No space left on device") as raised:
            copy_recording(source, target, overwrite=True)
    assert raised.value.filename == str(target)
    assert target.read_bytes() == before
    copy_recording(source, target, overwrite=True)
    with RecordingReader(target) as reader:
        assert len(list(reader.messages(["vehicle/state"]))) == 20


# whole files


def test_a_whole_file_takes_the_place_of_a_symbolic_link_and_not_of_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "a").symlink_to(tmp_path / "precious")
    write_whole(tmp_path / "a", b"new")
    assert (tmp_path / "precious").read_text() == "mine"
    assert (tmp_path / "a").read_bytes() == b"new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "precious"]


@pytest.mark.parametrize(
    ("error", "name"),
    [
        (OSError(28, "No space left on device"), "a"),
        (OSError(28, "No space left on device", "elsewhere"), "elsewhere"),
        (OSError(5, "Input/output error"), None),
        (FileNotFoundError(2, "No such file or directory", "b"), "b"),
    ],
)
def test_only_what_is_of_the_file_is_named_after_it(error: OSError, name: str | None, tmp_path: Path) -> None:
    path = tmp_path / "a"
    with pytest.raises(OSError, match=error.strerror) as raised, whole(path):
        raise error
    assert raised.value.filename == (str(path) if name == "a" else name)
    with pytest.raises(ValueError, match="other"), named_errors(path):
        raise ValueError("other")


# results of somebody else


@pytest.fixture
def out(tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


OURS = {"scan_id": 1, "stamp_ns": 1, "frame": "radar", "walls": [], "points": [], "objects": []}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("objects.jsonl", b"my notes\n"),
        ("objects.jsonl", json.dumps([1, 2]).encode()),
        ("objects.jsonl", json.dumps({"objects": []}).encode()),
        ("objects.jsonl", b"\xff\xfe"),
        ("objects.jsonl", b"[" * 100_000),
        ("tracks.jsonl", json.dumps(OURS).encode()),
        ("timing.jsonl", b"{}"),
        ("bev.png", b"a photograph"),
    ],
)
def test_what_somebody_else_wrote_is_not_written_over(
    name: str, content: bytes, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (out / name).write_bytes(content)
    assert main(["process", "docs/nowhere.mcap", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said == f"mirrorwave: {out / name}: was not written by `mirrorwave process`; choose another --out\n"
    assert {path.name: path.read_bytes() for path in out.iterdir()} == {name: content}


@pytest.mark.parametrize("name", ["objects.jsonl", "tracks.jsonl", "timing.jsonl", "bev.png", "."])
def test_no_symbolic_link_is_followed(name: str, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    precious = out.parent / "precious"
    if name == ".":
        out.rename(precious)
        out.symlink_to(precious)
    else:
        (out / name).symlink_to(precious)
    assert main(["process", "docs/nowhere.mcap", "--out", str(out)]) == 2
    assert f"{out / name}: must not be a symbolic link" in capsys.readouterr().err
    assert not precious.exists() or list(precious.iterdir()) == []


@pytest.mark.parametrize("files", [{}, {"objects.jsonl": OURS}, {"objects.jsonl": OURS, "bev.png": None}, {"x": None}])
def test_one_s_own_results_and_strangers_beside_them_are_no_hindrance(files: dict[str, Any], out: Path) -> None:
    for name, content in files.items():
        (out / name).write_bytes(b"" if content is None else json.dumps(content).encode() + b"\n")
    offline.require_own_results(out)
    assert not np.any([path.is_symlink() for path in out.iterdir()])
