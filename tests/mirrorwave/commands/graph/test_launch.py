"""A launched graph: what is refused before it starts; its terminal, never in its way."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest

from mirrorwave.cli import main
from mirrorwave.commands.graph.launch import LogPrinter
from msgs.files.shipped import LAUNCH


def entry(number: int) -> dict[str, Any]:
    return {"node": "a", "level": "info", "text": f"line {number}"}


def test_a_held_terminal_holds_nothing_up_and_says_what_it_missed() -> None:
    """The first line is under way, two wait, seven are left out."""
    shown: list[str] = []
    held, under_way = threading.Event(), threading.Event()

    def show(entry: dict[str, Any]) -> None:
        under_way.set()
        held.wait()
        shown.append(entry["text"])

    with LogPrinter(show, max_lines=2) as printer:
        printer(entry(0))
        under_way.wait()
        for number in range(1, 10):
            printer(entry(number))
        held.set()
        while len(shown) < 3:
            time.sleep(0.001)
        printer(entry(10))
    assert shown == ["line 0", "line 1", "line 2", "7 lines left out: the terminal did not take them", "line 10"]


def test_a_terminal_that_has_gone_is_not_asked_again() -> None:
    asked: list[str] = []

    def show(entry: dict[str, Any]) -> None:
        asked.append(entry["text"])
        raise BrokenPipeError

    with LogPrinter(show) as printer:
        for number in range(3):
            printer(entry(number))
    assert asked == ["line 0"]


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        (("player.scene=nowhere.yaml",), "nowhere.yaml: no such scene file"),
        (("player.scene=broken.yaml",), "broken.yaml: surfaces[0].material: "),
        (("player.effects=atmosphere,tornado",), "effects: unknown tornado, known are "),
        (("player.effects=','",), "effects: want auto, all, basic or names with commas between them, got nothing"),
        (
            ("player.scene=launch/scenes/hidden_car_spad.yaml", "player.effects=all"),
            "player.effects is for radars, and launch/scenes/hidden_car_spad.yaml has preset 'spad': got 'all'",
        ),
        (("player.scene=null", "player.capture=nowhere.mcap"), "nowhere.mcap: no such file"),
        (("player.scene=null", "player.capture=nowhere.sigmf-meta"), "nowhere.sigmf-meta"),
        (("geometry.object_network=nothing",), "nothing.json: No such file"),
        (("dense_predictor.model=nothing",), "nothing.onnx: No such file"),
    ],
)
def test_values_that_a_node_cannot_use_are_refused_before_anything_starts(
    given: tuple[str, ...],
    rule: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    wall = "{role: relay, material: cheese, polyline_m: [[9, -1], [9, 1]]}"
    Path("broken.yaml").write_text(f"name: t\nsurfaces: [{wall}]\n")
    options = [word for each in given for word in ("-p", each)]
    assert main(["launch", str(LAUNCH / "corner.yaml"), "--headless", *options]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert f"mirrorwave: -p {given[-1]}: " in said.err
    assert rule in " ".join(said.err.split())
    assert not Path("runs").exists()
