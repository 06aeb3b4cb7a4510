"""`mirrorwave sim effects` and `sim paths`, as a user calls them."""

from __future__ import annotations

import inspect
import json
import re
from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from mirrorwave.cli import main
from mirrorwave.commands.sim.effects import effects
from mirrorwave.commands.sim.group import run
from mirrorwave.plots import plan as picture_of_plans
from nodes.player import Params, scene_player
from sim_player.dataset.labelled_scan import labelled_scan
from sim_player.dataset.shards import Recipe
from sim_player.effects.table import ALL_EFFECTS
from sim_player.planner.plan import resolve_plan
from sim_player.planner.purposes import Purpose
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Weather, load_scene
from sim_player.scene.world import prepare
from tests.figures import assert_readable_at_page_width

SCENE = "launch/scenes/corner.yaml"


def test_effects_as_the_contract_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "effects", SCENE, "--budget-db", "-10", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["budget_db"] == -10.0
    assert {row["name"] for row in found["effects"]} == set(ALL_EFFECTS)
    for row in found["effects"]:
        assert set(row) == {"name", "used", "bound_db", "cost_s", "reason"}
        assert row["reason"]
        if not row["used"] and row["bound_db"] is not None:
            assert row["bound_db"] <= -10.0
    assert 0 < found["paths"] <= found["traced"]


@pytest.mark.parametrize("purpose", Purpose)
def test_what_is_shown_is_what_runs(purpose: Purpose, capsys: pytest.CaptureFixture[str]) -> None:
    """The plan that `sim effects` prints, that of `sim run`, of the player, of a data set's scan, and of the API."""
    assert main(["sim", "effects", SCENE, "--for", purpose.value, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    loaded = load_scene(Path(SCENE))
    played = scene_player(Params(scene=SCENE, purpose=purpose.value))
    assert isinstance(played, ScenePlayer)
    stored = labelled_scan(loaded, 0, purpose=purpose.value)
    called = resolve_plan(prepare(loaded), loaded.setup, "auto", purpose=purpose)
    used = {row["name"] for row in shown["effects"] if row["used"]}
    for plan in (played.plan, stored.plan, called):
        assert plan is not None
        assert plan.used == used
        assert (len(plan.echoes), plan.traced) == (shown["paths"], shown["traced"])
        assert [effect.reason for effect in plan.effects] == [row["reason"] for row in shown["effects"]]


def test_purposes_by_use() -> None:
    """Perception is fed with `objects`: live play and data sets; a record of what a radar measures holds `samples`."""
    assert Params(scene=SCENE).purpose == "objects"
    assert Recipe().described(0)["purpose"] == "objects"
    assert Recipe(scans=2).described(0)["purpose"] == "objects"
    assert [inspect.signature(verb).parameters["purpose"].default for verb in (effects, run)] == ["samples", "samples"]


def test_effects_as_a_picture(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    assert main(["sim", "effects", SCENE, "--for", "objects", "--plot", str(picture)]) == 0
    assert f"picture: {picture}" in capsys.readouterr().out
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize("speed_mps", [0.0, 4.0])
def test_a_picture_shows_the_rain_on_both_maps(speed_mps: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """In rain of 25 mm/h what a plan changes stays under its budget at rest and in motion: -20 dB, not +25."""
    shown: list[str] = []
    monkeypatch.setattr(picture_of_plans, "save", lambda figure, out: shown.extend(title_of(figure)))
    rain = msgspec.structs.replace(
        load_scene(Path(SCENE)), weather=Weather(rain_mm_per_h=25.0), ego=Ego(speed_mps=speed_mps)
    )
    plan = resolve_plan(prepare(rain), rain.setup, "auto", purpose=Purpose.OBJECTS)
    assert plan is not None
    picture_of_plans.write_plan(Path("unused.png"), plan)
    worst_db = next(int(match[1]) for title in shown if (match := re.search(r"worst (-?\d+), budget -20", title)))
    assert worst_db <= -20
    assert {effect.name for effect in plan.effects if effect.cost_s >= 6e-3} >= {"rain_clutter"}


def title_of(figure: Figure) -> list[str]:
    """Return the titles of a figure's panels."""
    return [axis.get_title() for axis in figure.axes]


def test_effects_for_people_say_why(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "effects", SCENE]) == 0
    out = capsys.readouterr().out
    assert "ground_bounce" in out
    assert "the scene has no ground" in out
    assert "what was left out changes" in out


def test_effects_by_hand(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "effects", SCENE, "--effects", "specular_relay,thermal_noise", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["effects"]
    assert {row["name"] for row in rows if row["used"]} == {"specular_relay", "thermal_noise"}


@pytest.mark.slow
def test_paths_as_the_contract_says(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Lengths follow the points of the way where out and back are one way: twice the polyline, to 1e-9 m."""
    picture = tmp_path / "paths.png"
    assert main(["sim", "paths", SCENE, "--effects", "basic", "--plot", str(picture), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert picture.stat().st_size > 10_000
    assert {row["kind"] for row in rows} == {"los", "mnlos"}
    for row in rows:
        points = np.array(row["points_m"])
        assert len(points) == row["order"] + 2
        assert 2.0 * np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(row["length_m"], abs=1e-9)
        assert 2.0 * np.linalg.norm(row["virtual_m"]) == pytest.approx(row["length_m"], abs=1e-9)


@pytest.mark.slow
def test_the_picture_of_paths_says_what_its_lines_mean(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], saved_figures: list[Figure]
) -> None:
    """Counts in the legend are those of `--json`; every line that is drawn has its sign."""
    assert main(["sim", "paths", SCENE, "--plot", str(tmp_path / "a.png"), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    (figure,) = saved_figures
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("y, left [m]", "x, forward [m]")
    (legend,) = figure.legends
    signs = {text.get_text(): line for text, line in zip(legend.get_texts(), legend.legend_handles, strict=True)}
    mirrors = ("direct", "by one mirror", "by two mirrors or more")
    kinds = Counter((min(row["order"], 2) * (row["kind"] == "mnlos"), _passage(row["effects"])) for row in rows)
    expected = {f"{mirrors[mirror]}{passage}: {count}": mirror for (mirror, passage), count in kinds.items()}
    assert set(expected) <= set(signs)
    assert sum(kinds.values()) == len(rows)
    # as many lines have the colour of a sign as there are paths by so many mirrors
    for mirror in range(3):
        (colour,) = {signs[words].get_color() for words, of in expected.items() if of == mirror}
        count = sum(number for (of, _), number in kinds.items() if of == mirror)
        assert sum(line.get_color() == colour for line in axes.lines) == count
    others = {words for words in signs if words not in expected}
    assert {words.split(":")[0] for words in others} == {
        "dark", "pale", "wall of brick, relay", "wall of concrete, relay", "wall of concrete, occluder", "object",
        "radar",
    }  # fmt: skip
    assert_readable_at_page_width(figure)


def _passage(effects: list[str]) -> str:
    """How a path passes walls, in the picture's words."""
    if {"edge_diffraction", "mirrored_diffraction"} & set(effects):
        return ", bent at a wall's end (drawn straight)"
    return ", through a wall" if "wall_transmission" in effects else ""


def test_ways_by_two_walls_are_followed(capsys: pytest.CaptureFixture[str]) -> None:
    """Objects seen in two mirrors: the polyline is as long as half the path, to 1e-6 m (1e-9 a bounce, slopes add)."""
    assert main(["sim", "paths", SCENE, "--effects", "los_objects,specular_relay,second_relay", "--json"]) == 0
    rows = [row for row in json.loads(capsys.readouterr().out) if row["order"] == 2 and row["object"] >= 0]
    assert rows
    for row in rows:
        points = np.array(row["points_m"])
        assert len(points) == 4
        assert 2.0 * np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(row["length_m"], abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["effects", "nowhere.yaml"], "nowhere.yaml"),
        (["effects", SCENE, "--budget-db", "3"], "budget_db must be finite and negative"),
        (["effects", SCENE, "--effects", "magic"], "unknown magic"),
        (["paths", SCENE, "--effects", ","], "got nothing"),
        (["run", SCENE, "--out", "x.mcap", "--effects", "magic"], "unknown magic"),
    ],
)
def test_bad_questions_are_one_line(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    arguments = [str(tmp_path / item) if item == "x.mcap" else item for item in arguments]
    assert main(["sim", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert complaint in error
    assert len(error.splitlines()) == 1
