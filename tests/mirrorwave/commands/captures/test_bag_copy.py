"""`bag filter|merge`: what they copy, what they refuse and their exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from mirrorwave.cli import main
from msgs.recording.mcap import RecordingReader
from tests.msgs.recording.test_mcap import record


def topics(path: Path) -> set[str]:
    with RecordingReader(path) as reader:
        return set(reader.types)


def test_filter_keeps_what_patterns_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = str(record(tmp_path / "a.mcap", count=9)), tmp_path / "b.mcap"
    assert main(["bag", "filter", path, str(out), "--not-topic", "radar/*", "--every", "2"]) == 0
    assert capsys.readouterr().out == f"{out}: 5 messages\n"
    assert topics(out) == {"vehicle/state"}
    assert main(["bag", "filter", path, str(tmp_path / "c.mcap"), "--topic", "*/state", "--topic", "radar/beam"]) == 0
    assert topics(tmp_path / "c.mcap") == {"vehicle/state", "radar/beam"}


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--topic", "sim/*"], "no topic matches 'sim/*'; it holds radar/beam, vehicle/state"),
        (["--not-topic", "sim/*"], "no topic matches 'sim/*'; it holds radar/beam, vehicle/state"),
        (["--topic", "radar/*", "--not-topic", "*"], "--topic and --not-topic leave no topic"),
        (["--every", "0"], "should be greater than or equal to 1"),
    ],
)
def test_filter_refuses_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], line: str
) -> None:
    out = tmp_path / "b.mcap"
    assert main(["bag", "filter", str(record(tmp_path / "a.mcap")), str(out), *options]) == 2
    assert line in capsys.readouterr().err
    assert not out.exists()


def test_merge_says_what_it_wrote_and_what_came_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, half, out = record(tmp_path / "a.mcap"), tmp_path / "half.mcap", tmp_path / "b.mcap"
    assert main(["bag", "filter", str(path), str(half), "--topic", "radar/*"]) == 0
    capsys.readouterr()
    assert main(["bag", "merge", str(path), str(half), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"6 messages in more than one of them\n{out}: 12 messages\n"


def test_merge_refuses_a_single_recording_and_one_that_comes_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = str(record(tmp_path / "a.mcap")), str(tmp_path / "b.mcap")
    assert main(["bag", "merge", path, "--out", out]) == 2
    assert "merge takes two recordings or more, got 1" in capsys.readouterr().err
    assert main(["bag", "merge", path, path, "--out", out]) == 2
    assert "merge takes each recording once" in capsys.readouterr().err


def test_merge_of_a_cut_recording_ends_with_code_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, cut = record(tmp_path / "a.mcap", step_ns=2_000_000_000), tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-3000])
    assert main(["bag", "merge", str(whole), str(cut), "--out", str(tmp_path / "b.mcap")]) == 3
    assert "the source had lost some: cut.mcap: cut off at byte" in capsys.readouterr().out
