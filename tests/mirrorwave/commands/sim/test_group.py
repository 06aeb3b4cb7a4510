"""`sim run --walls`: the walls of a scene beside its beams, where the format has room for them."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from mirrorwave.cli import command_line
from msgs.recording.mcap import RecordingReader

SCENE = "launch/scenes/facade_across_lane.yaml"
SHORT = ["--scans", "2", "--chirps-per-beam", "2", "--effects", "basic"]


@pytest.mark.parametrize(("walls", "messages"), [("none", 0), ("true", 2), ("noisy", 2)])
def test_walls_are_recorded_once_a_scan_where_asked(tmp_path: Path, walls: str, messages: int) -> None:
    out = tmp_path / "walls.mcap"
    result = CliRunner().invoke(command_line("sim"), ["sim", "run", SCENE, "--out", str(out), "--walls", walls, *SHORT])
    assert result.exit_code == 0, result.output
    with RecordingReader(out) as reader:
        recorded = [item.message for item in reader.messages(("environment/walls",))]
    assert len(recorded) == messages
    # those of an exact map say so
    assert all((message.walls[0].offset_std_m < 0.05) == (walls == "true") for message in recorded)


def test_sigmf_has_no_place_for_walls(tmp_path: Path) -> None:
    out = tmp_path / "walls"
    result = CliRunner().invoke(
        command_line("sim"), ["sim", "run", SCENE, "--out", str(out), "--walls", "true", *SHORT]
    )
    assert isinstance(result.exception, ValueError)
    assert str(result.exception) == f"--out {out}: SigMF has no place for --walls true, they are recorded as NAME.mcap"
    assert list(tmp_path.iterdir()) == []
