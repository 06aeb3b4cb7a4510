"""`mirrorwave sim run` and `mirrorwave process` on a scene seen by a LiDAR, as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mirrorwave.api import views
from mirrorwave.cli import main
from mirrorwave.convert.result_lines import bev_to_json

SCENE = "launch/scenes/hidden_car_spad.yaml"


@pytest.mark.slow
def test_a_recorded_lidar_gives_the_hidden_car_the_same_every_time(tmp_path: Path) -> None:
    """By `process` twice, and by the Python interface: the car, 4.5 m x 1.8 m about (26, 8)."""
    recording = tmp_path / "spad.mcap"
    assert main(["sim", "run", SCENE, "--out", str(recording), "--scans", "2"]) == 0
    for name in ("once", "twice"):
        assert main(["process", str(recording), "--out", str(tmp_path / name)]) == 0
    once = (tmp_path / "once" / "objects.jsonl").read_text()
    assert once == (tmp_path / "twice" / "objects.jsonl").read_text()
    (thing,) = json.loads(once.splitlines()[0])["objects"]
    assert abs(thing["x_m"] - 26.0) < 1.5
    assert abs(thing["y_m"] - 8.0) < 2.5
    found = list(views(recording))
    assert once == "".join(json.dumps(bev_to_json(view.frame)) + "\n" for view in found)
    assert found[0].truth is not None


def test_sigmf_is_refused_in_a_line_that_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "run", SCENE, "--out", str(tmp_path / "spad.sigmf-meta")]) == 2
    error = capsys.readouterr().err
    assert "a LiDAR is recorded as NAME.mcap" in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_what_a_scene_of_a_lidar_calls_for_is_told_with_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    """The glass mirrors and brings the car; what is scattered thrice brings less than a hundredth of a detection."""
    assert main(["sim", "effects", SCENE, "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["contributions"]}
    assert (rows["mirror"]["used"], rows["diffuse"]["used"]) == (True, False)
    assert rows["diffuse"]["bound"] < 0.01 < rows["mirror"]["bound"]
    assert main(["sim", "effects", SCENE]) == 0
    assert "mirror" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["paths", SCENE], "radar.preset: must be a radar, xband or 77ghz, got 'spad'"),
        (["effects", SCENE, "--effects", "all"], "--effects, --for and --budget-db must stay at their defaults"),
    ],
)
def test_what_is_of_radars_alone_is_refused_in_a_line(
    words: list[str], rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not answered with the echoes of an X-band radar in the LiDAR's place."""
    assert main(["sim", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert f"hidden_car_spad.yaml: {rule}" in captured.err
    assert len(captured.err.strip().splitlines()) == 1
