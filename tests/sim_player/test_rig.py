"""Several radars in one scene: one world, one motion, a mounting and noise each."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.form.beams_to_maps import FormingStage
from msgs.files.shipped import LAUNCH
from msgs.values.frames import Pose2
from sim_player.player import ScenePlayer
from sim_player.rig import RadarRig
from sim_player.scene.clear_path import ego_meeting
from sim_player.scene.description import load_scene, scene_from_yaml, scene_sha256, scene_to_yaml
from sim_player.scene.world import radar_pose, scene_radar, vehicle_pose

SCENE = LAUNCH / "scenes" / "two_front_corners.yaml"
CORNER = """
name: corner
ego: {speed_mps: 5.0, yaw_rate_dps: 20.0}
radars: {left: {x_m: 3.0, y_m: 1.0, yaw_deg: 40.0}, right: {x_m: 3.0, y_m: -1.0, yaw_deg: -40.0}}
surfaces: [{role: relay, material: concrete, polyline_m: [[20.0, -20.0], [20.0, 20.0]]}]
"""


def test_each_radar_moves_as_its_mounting_does() -> None:
    """Pose and velocity are those of a point of the vehicle."""
    scene = scene_from_yaml(CORNER).of_radar("left")
    step_s = 1e-6
    for time_s in (0.0, 0.7):
        before, after = radar_pose(scene, time_s - step_s), radar_pose(scene, time_s + step_s)
        state = scene_radar(scene, time_s)
        velocity = np.array([after.x_m - before.x_m, after.y_m - before.y_m]) / (2.0 * step_s)
        assert state.velocity == pytest.approx(velocity, abs=1e-6)
        assert state.pose == vehicle_pose(scene, time_s) @ Pose2(3.0, 1.0, math.radians(40.0))


def test_a_corner_may_meet_a_wall_first() -> None:
    """The left corner is nearer to a wall on the left than the vehicle's origin."""
    scene = scene_from_yaml(CORNER.replace("yaw_rate_dps: 20.0", "yaw_rate_dps: 0.0"))
    meeting = ego_meeting(scene.of_radar("left"))
    assert meeting is not None
    assert meeting[0] == pytest.approx((20.0 - 3.0) / 5.0)


@pytest.fixture(scope="module")
def rig() -> RadarRig:
    """The shipped scene, simply simulated."""
    return RadarRig(load_scene(SCENE), seed=3, effects="basic", chirps_per_beam=16)


def test_both_see_one_world(rig: RadarRig) -> None:
    """A wall of the map of each lies where it stands, in the frame of the vehicle; noise is drawn for each."""
    for name, player in rig.players.items():
        stage = FormingStage()
        stage.set_up(player.setup)
        stage.add_state(rig.vehicle_state(0))
        (ra_map,) = [item for index in range(25) for item in stage.add(player.beam(0, index))]
        assert ra_map.vehicle_from_radar == rig.scene.radars[name].vehicle_from_radar == player.setup.vehicle_from_radar
        strong = np.argwhere(np.abs(ra_map.values) > 0.3 * np.abs(ra_map.values[80:130]).max())
        strong = strong[(strong[:, 0] > 80) & (strong[:, 0] < 130)]
        range_m, azimuth_rad = ra_map.grid.range_m[strong[:, 0]], ra_map.grid.azimuth_rad[strong[:, 1]]
        at_m = np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)], axis=1)
        x_m = ra_map.vehicle_from_radar.apply(at_m)[:, 0]
        assert np.median(np.abs(x_m - 27.0)) < 1.0
    left, right = (player.beam(0, 0).samples for player in rig.players.values())
    assert not np.array_equal(left, right)


def test_truth_is_of_the_vehicle(rig: RadarRig) -> None:
    """Points, objects and walls stand where the scene has them; what a mirror shows to one of them is hidden."""
    truth = rig.truth(0)
    assert [(item.x_m, item.y_m) for item in truth.objects] == [
        pytest.approx((16.5, 16.0)), pytest.approx((19.5, -17.0))
    ]  # fmt: skip
    assert [item.velocity_y_mps for item in truth.objects] == pytest.approx([-2.0, 2.0])
    assert np.array(truth.surfaces[0].polyline_m) == pytest.approx(np.array([[27.0, -18.0], [27.0, 18.0]]))
    assert all(item.hidden for item in truth.objects)
    own = [player.truth(0) for player in rig.players.values()]
    assert len(truth.hidden_points_m) == sum(len(item.hidden_points_m) for item in own)
    for index in range(len(truth.objects)):
        points_m = truth.hidden_points_m[truth.hidden_object == index, :2]
        off_m = points_m - np.array([truth.objects[index].x_m, truth.objects[index].y_m])
        assert (np.abs(off_m) < 3.5).all()


def test_the_same_seed_gives_the_same_bytes(rig: RadarRig) -> None:
    """Beams of another rig of the seed are equal, and the first radar alone is the player of its scene."""
    again = RadarRig(load_scene(SCENE), seed=3, effects="basic", chirps_per_beam=16)
    alone = ScenePlayer(load_scene(SCENE).of_radar("left"), seed=3, effects="basic", chirps_per_beam=16)
    for name in ("left", "right"):
        assert np.array_equal(rig.players[name].beam(0, 5).samples, again.players[name].beam(0, 5).samples)
    assert np.array_equal(rig.players["left"].beam(0, 5).samples, alone.beam(0, 5).samples)


def test_a_scene_without_radars_keeps_its_text_and_hash() -> None:
    """The field is written where it says something."""
    plain = load_scene(LAUNCH / "scenes" / "corner.yaml")
    assert "radars" not in scene_to_yaml(plain)
    assert "mounting" not in scene_to_yaml(plain)
    scene = load_scene(SCENE)
    assert scene_from_yaml(scene_to_yaml(scene)) == scene
    assert scene_sha256(scene) != scene_sha256(scene.of_radar("left")) != scene_sha256(scene.of_radar("right"))


@pytest.mark.parametrize(
    ("radars", "refusal"),
    [
        ("{Left: {}}", "radars.Left: a sensor's name must be"),
        ("{left: {x_m: 30.0}}", "radars.left: radar.mounting.x_m: must lie in -20..20, got 30.0"),
        ("{left: {yaw_deg: 400.0}}", "radars.left: radar.mounting.yaw_deg: must lie in -360..360, got 400.0"),
        ("{left: {x_m: 20.0}}", r"radars.left: surfaces\[0\].polyline_m\[0\]: the radar at \(20, 0\) must stand"),
        ("{left: {z_m: 1.0}}", r"radars\[...\]: object contains unknown field `z_m`"),
        (str({f"r{number}": {"x_m": 0.5} for number in range(9)}), "radars: must be at most 8, got 9"),
        ("{a: {x_m: 1.0}, a: {x_m: 2.0}}", "duplicate key"),
    ],
)  # fmt: skip
def test_bad_radars_are_one_line(radars: str, refusal: str) -> None:
    """The field, the rule and the value."""
    lines = [f"radars: {radars}" if line.startswith("radars") else line for line in CORNER.splitlines()]
    with pytest.raises(ValueError, match=refusal) as caught:
        scene_from_yaml("\n".join(lines))
    assert "\n" not in str(caught.value)


def test_what_simulates_one_radar_says_so() -> None:
    """A plan, paths and effects are of one radar."""
    with pytest.raises(ValueError, match=r"radars: must be none where one is simulated, .* got left, right"):
        ScenePlayer(scene_from_yaml(CORNER))


def test_the_first_corner_that_meets_a_wall_ends_the_drive() -> None:
    """Of all radars, whatever the vehicle's origin does."""
    scene = scene_from_yaml(CORNER.replace("yaw_rate_dps: 20.0", "yaw_rate_dps: 5.0"))
    left, right = (ego_meeting(scene.of_radar(name)) for name in scene.radars)
    assert left is not None
    assert right is not None
    assert left[0] > right[0]
    assert ego_meeting(scene) == right


def test_a_lidar_has_no_radars() -> None:
    """Its preset is one of a LiDAR."""
    with pytest.raises(ValueError, match="radars: must be radars, and preset 'spad' is a LiDAR"):
        scene_from_yaml(CORNER + "radar: {preset: spad}\n")
