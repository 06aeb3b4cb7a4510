"""The Python API: the same bytes as the command line, and plain words for what does not fit."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mirrorwave.api import Perception, View, scan_beams, views
from mirrorwave.cli import main
from mirrorwave.convert.result_lines import bev_to_json
from mirrorwave.profiles import profile_names
from msgs.files.shipped import SAMPLE
from msgs.recording.mcap import RecordingWriter
from msgs.values.radar import PRESETS, RadarBeam, RadarParams, RadarSetup
from nodes.player import Params, scene_player

SCENE = "launch/scenes/corner.yaml"
CHIRPS = 4


@pytest.fixture(scope="module")
def beams() -> tuple[RadarSetup, list[RadarBeam]]:
    player = scene_player(Params(scene=SCENE, chirps_per_beam=CHIRPS, effects="all"))
    return player.setup, [player.beam(0, index) for index in range(25)]


def lines_of(found: list[View]) -> str:
    return "".join(json.dumps(bev_to_json(view.frame)) + "\n" for view in found)


@pytest.mark.slow
def test_views_are_what_process_writes(capture: Path, tmp_path: Path) -> None:
    assert main(["process", str(capture), "--out", str(tmp_path)]) == 0
    found = list(views(capture))
    assert lines_of(found) == (tmp_path / "objects.jsonl").read_text()
    assert [view.scan_id for view in found] == [0, 1]
    assert all(view.truth is not None and view.truth.scan_id == view.scan_id for view in found)
    assert all(view.ra_map.scan_id == view.peaks.scan_id == view.scan_id for view in found)


@pytest.mark.slow
def test_profile_and_overrides_reach_the_nodes(capture: Path, tmp_path: Path) -> None:
    assert main(["process", str(capture), "--out", str(tmp_path), "--profile", "cfar"]) == 0
    assert lines_of(list(views(capture, "cfar"))) == (tmp_path / "objects.jsonl").read_text()
    assert lines_of(list(views(capture, overrides=["dense_predictor.method=cfar"]))) == lines_of(
        list(views(capture, "cfar"))
    )


@pytest.mark.parametrize("profile", profile_names())
def test_every_profile_sees_the_sample(profile: str) -> None:
    """Chirps of 1,024 samples, of which `fast` takes every one."""
    assert len(next(views(SAMPLE, profile=profile)).peaks)


def test_a_scan_as_one_array_is_a_scan_of_beams(beams: tuple[RadarSetup, list[RadarBeam]]) -> None:
    setup, one_scan = beams
    whole = Perception(setup, "cfar").see(np.stack([beam.samples for beam in one_scan]), stamp_ns=0)
    perception = Perception(setup, "cfar")
    single = [view for beam in one_scan for view in perception.add(beam)]
    assert lines_of([whole]) == lines_of(single)
    assert whole.frame.objects


def test_beams_in_mirrored_order_are_the_mirrored_scene() -> None:
    """Of 84 objects of 60 places 78 are so to the bit, all within 0.14 m and 0.02 of score: an activation of the
    whole-number networks may fall to another step.
    """
    player = scene_player(Params(scene="launch/scenes/two_hidden_vehicles.yaml", chirps_per_beam=CHIRPS, effects="all"))
    samples = np.stack([player.beam(0, index).samples for index in range(25)])
    seen = [Perception(player.setup).see(turned).frame.objects for turned in (samples, samples[::-1].copy())]
    here, there = ([(item.x_m, item.y_m, item.score) for item in objects] for objects in seen)
    assert len(here) == len(there) >= 2
    apart = np.abs(there * np.array([1.0, -1.0, 1.0]) - here)
    assert (apart.max(axis=0) <= (0.14, 0.14, 0.02)).all()


def test_scans_follow_each_other_in_time(beams: tuple[RadarSetup, list[RadarBeam]]) -> None:
    setup, one_scan = beams
    perception = Perception(setup, "cfar")
    samples = np.stack([beam.samples for beam in one_scan])
    first, second = perception.see(samples), perception.see(samples)
    assert (first.scan_id, second.scan_id) == (0, 1)
    assert second.frame.stamp_ns - first.frame.stamp_ns == round(1e9 * setup.radar.scan_period_s)


def test_a_scan_without_its_end_is_finished_with_what_there_is(beams: tuple[RadarSetup, list[RadarBeam]]) -> None:
    setup, one_scan = beams
    perception = Perception(setup, "cfar")
    assert [view for beam in one_scan[:20] for view in perception.add(beam)] == []
    (view,) = perception.finish()
    assert "missing_beams" in view.frame.flags


def test_what_does_not_fit_is_refused_in_one_line(beams: tuple[RadarSetup, list[RadarBeam]], tmp_path: Path) -> None:
    setup, one_scan = beams
    with pytest.raises(ValueError, match=r"samples must be \[25 beams, chirps, samples, 2\], got \(3, 4, 8192, 2\)"):
        scan_beams(np.zeros((3, 4, 8192, 2), np.int16), setup)
    with pytest.raises(ValueError, match="dtype <i2"):
        Perception(setup, "cfar").see(np.zeros((25, 4, 8192, 2)))
    foreign = msgspec.structs.replace(one_scan[0], samples=np.zeros((4, 100, 2), np.int16))
    with pytest.raises(ValueError, match="100"):
        Perception(setup, "cfar").add(foreign)
    other = RadarSetup(radar=RadarParams(bandwidth_hz=500e6, chirps_per_beam=1))
    rule = (
        r"^map\.grid\.range_bin_m \(c over twice the bandwidth\) must be 0\.2141375, as compact_unet\.int8 was trained"
    )
    with pytest.raises(ValueError, match=rule):
        Perception(other).see(np.zeros((25, 1, 8192, 2), np.int16))
    with pytest.raises(ValueError, match=r"encoding\.columns must be at least .* for an array of 57 columns"):
        Perception(PRESETS["77ghz"])
    with pytest.raises(ValueError, match="unknown profile 'best'"):
        Perception(setup, "best")
    with pytest.raises(ValueError, match=r"nothing\.mcap: no such file"):
        next(views(tmp_path / "nothing.mcap"))
    for topic, held in (("radar/setup", "radar/beam"), ("radar/beam", "radar/setup")):
        path = tmp_path / f"no_{topic.replace('/', '_')}.mcap"
        with RecordingWriter(path, {}) as writer:
            message = setup if held == "radar/setup" else one_scan[0]
            writer.write(held, message, publisher="radar", sequence=0, sent_ns=0)
        with pytest.raises(ValueError, match=rf"{path.name}: holds no {topic}"):
            list(views(path, "cfar"))
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(ValueError, match="is empty"):
        next(views(tmp_path / "empty.mcap"))


@pytest.mark.slow
def test_a_view_draws_itself(beams: tuple[RadarSetup, list[RadarBeam]], tmp_path: Path) -> None:
    setup, one_scan = beams
    view = Perception(setup, "cfar").see(np.stack([beam.samples for beam in one_scan]))
    view.draw(tmp_path / "view.png")
    assert (tmp_path / "view.png").read_bytes().startswith(b"\x89PNG")
