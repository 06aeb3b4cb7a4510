"""When a radar meets a wall or an object: straight on, in a turn, at a bend; nothing is simulated beyond."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from lab.evaluate.labelled_beams import LabelledPlace
from mirrorwave.cli import main
from msgs.values.frames import Pose2
from nodes.player import scene_events
from sim_player.drive import Drive
from sim_player.player import ScenePlayer
from sim_player.scene.clear_path import ego_meeting, require_clear_path
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface, scene_to_yaml

CHIRPS = 1


def wall(*points: tuple[float, float], **fields: object) -> Surface:
    return Surface(role="relay", material="concrete", polyline_m=points, **fields)  # type: ignore[arg-type]


def scene(*surfaces: Surface, **ego: float) -> Scene:
    return Scene(name="t", surfaces=surfaces, ego=Ego(**ego))


AHEAD = wall((5.0, -10.0), (5.0, 16.0))
BESIDE = wall((-9.0, 3.0), (40.0, 3.0))


@pytest.mark.parametrize(
    ("met", "time_s", "surface"),
    [
        (scene(AHEAD, speed_mps=8.0), 5.0 / 8.0, 0),
        (scene(BESIDE, AHEAD, speed_mps=2.0), 2.5, 1),
        # backwards
        (scene(AHEAD, wall((-4.0, -9.0), (-4.0, 9.0)), speed_mps=-2.0), 2.0, 1),
        # a circle of 10 m about (0, 10): at y = 3 it has turned by acos(0.7)
        (scene(BESIDE, speed_mps=10.0, yaw_rate_dps=math.degrees(1.0)), math.acos(0.7), 0),
        # a wall that bends away from its chord by 4 - sqrt(16 - 9)
        (scene(wall((5.0, -3.0), (5.0, 3.0), curvature_per_m=0.25), speed_mps=1.0), 5.0 + 4.0 - math.sqrt(7.0), 0),
        (scene(wall((5.0, -3.0), (5.0, 3.0), curvature_per_m=-0.25), speed_mps=1.0), 5.0 - 4.0 + math.sqrt(7.0), 0),
    ],
    ids=["ahead", "second", "backwards", "turning", "bent away", "bent towards"],
)
def test_a_wall_is_met_when_the_path_says(met: Scene, time_s: float, surface: int) -> None:
    """Tolerance: a circle is followed in chords of half a degree, an arc of wall to a millimetre."""
    found = ego_meeting(met)
    assert found is not None
    assert found == (pytest.approx(time_s, abs=2e-3), f"the radar drives into the wall surfaces[{surface}]")
    require_clear_path(met, 0.9 * time_s)
    with pytest.raises(
        ValueError, match=rf"^ego.speed_mps: the radar drives into the wall surfaces\[{surface}\] after"
    ):
        require_clear_path(met, 1.1 * time_s)


@pytest.mark.parametrize(
    "free",
    [
        scene(AHEAD),
        scene(AHEAD, yaw_rate_dps=90.0),
        scene(BESIDE, speed_mps=30.0),
        # a circle of 2 m
        scene(AHEAD, speed_mps=2.0, yaw_rate_dps=math.degrees(1.0)),
        scene(Surface(role="ground", material="asphalt"), wall((9.0, 1.0), (9.0, 9.0)), speed_mps=30.0),
    ],
    ids=["still", "on the spot", "along", "in a circle", "past"],
)
def test_a_path_that_meets_no_wall_is_free(free: Scene) -> None:
    assert ego_meeting(free) is None
    require_clear_path(free, 1e6)


@pytest.mark.parametrize(
    ("speed_mps", "ego", "time_s"),
    [
        # a car of 4.5 m about x = 10: its rear at 7.75 m
        (0.0, {"speed_mps": 5.0}, 7.75 / 5.0),
        # backwards, towards a radar that stands, and towards one that comes
        (-10.0, {}, 0.775),
        (-10.0, {"speed_mps": 5.0}, 7.75 / 15.0),
        # a circle of 10 m about (0, 10) is at y = 3.7 where the car begins
        (0.0, {"speed_mps": 10.0, "yaw_rate_dps": math.degrees(1.0)}, None),
        (5.0, {"speed_mps": 4.0}, None),
    ],
    ids=["parked", "reversing", "both", "turning away", "ahead"],
)
def test_an_object_is_met_too(speed_mps: float, ego: dict[str, float], time_s: float | None) -> None:
    car = SceneObject(class_="car", x_m=10.0, y_m=0.0, speed_mps=speed_mps)
    met = None if time_s is None else (pytest.approx(time_s, abs=2e-3), "the radar and objects[0] (car) meet")
    crowded = Scene(name="t", objects=(car,), ego=Ego(**ego))
    assert ego_meeting(crowded) == met
    if met is not None:
        with pytest.raises(ValueError, match=rf"^{'ego.speed_mps' if ego else 'objects'}: the radar and objects\[0\]"):
            require_clear_path(crowded, 2.0)


def test_no_beam_and_no_truth_is_made_beyond_a_wall() -> None:
    """8 m/s, a wall at 5 m: scans begin at 0, 0.3 and 0.6 s; that of 0.6 s meets it at 0.625 s in its third beam."""
    player = ScenePlayer(scene(AHEAD, speed_mps=8.0), chirps_per_beam=CHIRPS)
    player.beam(2, 1)
    with pytest.raises(ValueError, match=r"drives into the wall surfaces\[0\] after 0.62 s, asked for 0.64 s"):
        player.beam(2, 3)
    with pytest.raises(ValueError, match=r"asked for 0\.90 s"):
        player.truth(3)
    endless = [event.outgoing.message for event in scene_events(player, None)]
    assert max(message.scan_id for message in endless if hasattr(message, "scan_id")) == 1


def test_a_drawn_drive_of_a_committed_set_is_played_to_its_end() -> None:
    """Drive 171 of the seed of `unseen_drives` crosses a wall after 0.97 s: no scan of a set is left out."""
    place = LabelledPlace(92303, 171, effects="basic", scans=12)
    assert ego_meeting(place.scene)
    assert place.player.truth(11).scan_id == 11


def test_a_prescribed_drive_ends_at_a_wall_too() -> None:
    """The radar sits 2 m before the vehicle's origin: 3 m to the wall, 0.3 s at 10 m/s."""
    drive = Drive(np.array([0.0, 2.0]), np.full(2, 10.0), np.zeros(2), Pose2(2.0, 0.0, 0.0))
    player = ScenePlayer(scene(AHEAD), chirps_per_beam=CHIRPS, drive=drive)
    player.beam(0, 0)
    with pytest.raises(ValueError, match=r"drives into the wall surfaces\[0\] after 0.30 s"):
        player.beam(1, 1)


@pytest.mark.parametrize("preset", ["xband", "spad"])
def test_a_recording_that_would_end_behind_a_wall_is_refused(
    preset: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line that names file, field and time, and no recording; a shorter one is made."""
    driving = Scene(name="t", radar=SceneRadar(preset=preset), surfaces=(AHEAD,), ego=Ego(speed_mps=8.0))  # type: ignore[arg-type]
    path, out = tmp_path / "s.yaml", tmp_path / "s.mcap"
    path.write_text(scene_to_yaml(driving))
    assert main(["sim", "run", str(path), "--out", str(out), "--scans", "4", "--effects", "basic"]) == 2
    said = capsys.readouterr().err
    assert f"{path}: ego.speed_mps: the radar drives into the wall surfaces[0] after 0.62 s" in " ".join(said.split())
    assert not out.exists()
