"""The default profile: what every command runs where none is named, and the outside capture under it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from msgspec.structs import replace
from typer.testing import CliRunner

import mirrorwave.commands.graph.launch as launch_verb
from lab.evaluate.labelled_beams import LabelledPlace
from mirrorwave.cli import main
from mirrorwave.node_chain import SharedParts
from mirrorwave.offline import launch_for
from mirrorwave.profiles import over_default, profile_names, read_profile
from models.perception.find.detectors import CfarDetector
from msgs.files.shipped import LAUNCH
from msgs.values.perception import HiddenObject
from msgs.values.radar import RadarBeam, RadarSetup
from nodes.process.launch_file import LaunchFile, read_launch_file
from sim_player.player import ScenePlayer
from sim_player.scene.description import load_scene
from tests.captures import DATA, needs

ALLEY = DATA / "sigmf_alley"


def run_launch(monkeypatch: pytest.MonkeyPatch, *words: str) -> LaunchFile:
    """What `mirrorwave launch` would supervise."""
    graphs: list[LaunchFile] = []

    def hear(graph: LaunchFile, *_: Any, **__: Any) -> int:
        graphs.append(graph)
        return 0

    monkeypatch.setattr(launch_verb, "run_graph", hear)
    result = CliRunner().invoke(_app(), list(words), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return graphs[0]


def _app() -> Any:
    app = typer.Typer()
    app.command()(launch_verb.launch)
    return app


def test_launch_runs_the_default_profile_where_none_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Live and offline run the same parameters, or a replay would not give the bytes of `process`."""
    live = run_launch(monkeypatch, str(LAUNCH / "corner.yaml"))
    offline = launch_for(Path("capture.mcap"), "default", [])
    for name in ("ra_former", "dense_predictor", "geometry"):
        assert live.nodes[name].params == offline.nodes[name].params == read_profile("default").get(name, {})


def test_a_named_profile_an_override_and_the_file_itself_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    file = str(LAUNCH / "corner.yaml")
    named = run_launch(monkeypatch, file, "--profile", "accurate")
    assert named.nodes["dense_predictor"].params == read_profile("accurate")["dense_predictor"]
    overridden = run_launch(monkeypatch, file, "-p", "geometry.object_network=none")
    assert overridden.nodes["geometry"].params == read_profile("default")["geometry"] | {"object_network": "none"}
    millimetre = over_default(read_launch_file(LAUNCH / "corner_77ghz.yaml")).nodes
    assert millimetre["dense_predictor"].params["method"] == "cfar"
    assert over_default(read_launch_file(LAUNCH / "two_hosts_sensor.yaml")).nodes.keys()


def test_default_is_what_was_chosen() -> None:
    default = SharedParts.of(read_profile("default"), RadarSetup())
    objects = objects_of(default, LabelledPlace(5, 1, "basic").beams())
    assert objects
    assert all(item.object_class for item in objects)
    assert default.predictor is not None
    assert isinstance(SharedParts.of(read_profile("cfar"), RadarSetup()).detector, CfarDetector)


def objects_of(parts: SharedParts, beams: Iterable[RadarBeam]) -> list[HiddenObject]:
    chain = parts.chain()
    return [item for beam in beams for view in chain.add(beam) for item in view.frame.objects]


def test_what_is_kept_over_scans_follows_the_parameters() -> None:
    player = ScenePlayer(load_scene(LAUNCH / "scenes/corner.yaml"), 0, chirps_per_beam=8)
    tracks = {}
    for tracking in (True, False):
        profile = dict(read_profile("default"))
        profile["geometry"] = profile["geometry"] | {"memory": {"tracking": tracking}}
        chain = SharedParts.of(profile, player.setup).chain()
        views = [view for index in range(25) for view in chain.add(player.beam(0, index))]
        tracks[tracking] = [track for view in views for track in view.frame.tracks]
    assert tracks[True]
    assert not tracks[False]


@pytest.mark.parametrize("profile", ["accurate", "default"])
def test_left_and_right_are_equal(profile: str) -> None:
    """Phases that are rounded from the middle of the array make samples in mirrored order the mirrored scene: what is
    left is the order of sums of float32, and with whole numbers which way a cell is rounded.
    """
    player = ScenePlayer(load_scene(LAUNCH / "scenes/corner.yaml"), 0, chirps_per_beam=8)
    beams = [player.beam(0, index) for index in range(25)]
    mirrored = [replace(beam, samples=other.samples) for beam, other in zip(beams, reversed(beams), strict=True)]
    parts = SharedParts.of(read_profile(profile), player.setup)
    here, there = objects_of(parts, beams), objects_of(parts, mirrored)
    assert here
    assert len(here) == len(there)
    tolerance = 1e-3 if profile == "accurate" else 0.02
    for item, other in zip(here, there, strict=True):
        assert (other.x_m, -other.y_m, other.score) == pytest.approx((item.x_m, item.y_m, item.score), abs=tolerance)


def test_a_former_profile_is_read_as_the_one_that_replaced_it() -> None:
    for former in ("balanced", "fast", "unfiltered"):
        assert read_profile(former) == read_profile("default")
        assert former not in profile_names()


def in_the_alley(folder: Path, *words: str) -> tuple[dict[str, Any], float]:
    """The one object that is reported of the outside capture, and its distance [m] from the car's visible points."""
    assert main(["process", str(ALLEY / "alley.sigmf-meta"), "--out", str(folder), *words]) == 0
    (found,) = json.loads((folder / "objects.jsonl").read_text())["objects"]
    truth = json.loads((ALLEY / "alley.truth.json").read_text())
    to_visible_m = np.hypot(*(np.array(truth["visible_hidden_points"]) - [found["x_m"], found["y_m"]]).T)
    return found, float(to_visible_m.min())


@pytest.mark.slow
@needs(ALLEY)
@pytest.mark.parametrize("profile", ["accurate", "default"])
def test_one_car_is_seen_in_the_alley_of_another_simulator(tmp_path: Path, profile: str) -> None:
    """The outside capture: one hidden car, reported alone, 0.10 and 0.12 m off its visible points."""
    _, away_m = in_the_alley(tmp_path, "--profile", profile)
    assert away_m < 0.15
