"""A driven radar against constant motion, and its poses against arcs."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from msgs.values.frames import Pose2
from msgs.values.vehicle import ego_motion
from sim_player.drive import Drive
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface, Weather
from sim_player.scene.front_end import FrontEnd

SPEED_MPS, YAW_RATE_DPS = 5.0, 12.0
WALL = Surface(role="relay", material="concrete", polyline_m=((20.0, -12.0), (20.0, 14.0)), height_m=5.0)
SCENE = Scene(name="wall", surfaces=(WALL,))
STEADY = Drive(np.array([0.0, 9.0]), np.full(2, SPEED_MPS), np.full(2, math.radians(YAW_RATE_DPS)))


def moved(scene: Scene) -> Scene:
    """The scene whose own radar moves as `STEADY` does."""
    return msgspec.structs.replace(scene, ego=Ego(speed_mps=SPEED_MPS, yaw_rate_dps=YAW_RATE_DPS))


def test_a_steady_drive_is_a_steady_ego() -> None:
    """A car that crosses: same stamps, same noise draws, echoes and truth to the rounding of the pose's integral."""
    car = SceneObject(class_="car", x_m=14.0, y_m=-6.0, yaw_deg=90.0, speed_mps=6.0)
    crossing = msgspec.structs.replace(SCENE, objects=(car,))
    reference = ScenePlayer(moved(crossing), seed=3, chirps_per_beam=2)
    driven = ScenePlayer(crossing, seed=3, chirps_per_beam=2, drive=STEADY)
    for scan, index in ((0, 3), (2, 24), (3, 12)):
        ours, theirs = driven.beam(scan, index), reference.beam(scan, index)
        assert ours.stamp_ns == theirs.stamp_ns
        assert np.abs(ours.samples.astype(int) - theirs.samples.astype(int)).max() <= 1
    assert driven.vehicle_state(5) == reference.vehicle_state(5)
    ours, theirs = driven.truth(3), reference.truth(3)
    assert (ours.stamp_ns, ours.scan_id) == (theirs.stamp_ns, theirs.scan_id)
    np.testing.assert_allclose(ours.los_points_m, theirs.los_points_m, atol=1e-4)
    for name in ("x_m", "y_m", "yaw_rad", "velocity_x_mps", "velocity_y_mps"):
        assert getattr(ours.objects[0], name) == pytest.approx(getattr(theirs.objects[0], name), abs=1e-5)


def everything() -> Scene:
    """A car that crosses before a wall, on a ground, beside another wall, with a faulty front end, in rain."""
    car = SceneObject(class_="car", x_m=14.0, y_m=-6.0, yaw_deg=90.0, speed_mps=6.0)
    side = Surface(role="relay", material="brick", polyline_m=((6.0, 8.0), (18.0, 9.0)), height_m=4.0)
    ground = Surface(role="ground", material="asphalt", roughness_mm=0.5)
    front_end = FrontEnd(coupling_db=-25.0, iq_gain_db=0.2, leakage_dbm=-50.0, adc_bits=14, flicker_corner_hz=2e4)
    return Scene(
        name="everything", surfaces=(WALL, side, ground), objects=(car,), weather=Weather(rain_mm_per_h=10.0),
        radar=SceneRadar(front_end=front_end),
    )  # fmt: skip


def test_a_steady_drive_with_all_effects_is_a_steady_ego() -> None:
    """Second mirrors, ground, edges, squint, overlap, front end: codes differ by rounding alone, one step of 14 bits.

    The basic effects of the same drive differ by more: the effects are there.
    """
    reference = ScenePlayer(moved(everything()), seed=3, chirps_per_beam=2, effects="all")
    driven = ScenePlayer(everything(), seed=3, chirps_per_beam=2, effects="all", drive=STEADY)
    basic = ScenePlayer(everything(), seed=3, chirps_per_beam=2, drive=STEADY)
    ours, theirs = driven.beam(1, 12).samples.astype(int), reference.beam(1, 12).samples.astype(int)
    assert np.abs(ours - theirs).max() <= 4
    assert np.mean(np.abs(ours - theirs) > 0) < 0.02
    assert np.abs(basic.beam(1, 12).samples.astype(int) - theirs).max() > 40
    assert len(driven.paths(0.3)) == len(reference.paths(0.3)) > len(basic.paths(0.3))


def test_echoes_in_float32_are_those_in_float64_to_a_part_in_ten_thousand() -> None:
    """Bias: interpolation along the chirp to 1e-5 of the array's peak, summed over hundreds of paths."""
    ours, theirs = (
        (carrier[:, None] * basis.T) @ beats
        for beats, carrier, basis in (
            ScenePlayer(
                everything(), seed=3, chirps_per_beam=2, effects="all", precision=precision, drive=STEADY
            ).echoes(1, 12)
            for precision in ("float32", "float64")
        )
    )
    assert ours.shape == theirs.shape == (2, 8192)
    assert 0.0 < np.abs(ours - theirs).max() < 1e-4 * np.abs(theirs).max()


@pytest.mark.parametrize(
    ("scene", "choice", "words"),
    [
        (SCENE, {"effects": "auto"}, "on a drive"),
        (SCENE, {"effects": "echo"}, "unknown echo"),
        (SCENE, {"precision": "half"}, "precision"),
        (moved(SCENE), {}, "must stand still"),
    ],
)
def test_what_a_drive_cannot_have_is_refused(scene: Scene, choice: dict[str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ScenePlayer(scene, chirps_per_beam=1, drive=STEADY, **choice)


def test_poses_lie_on_the_arc() -> None:
    pose, arc = STEADY.pose(3.0), ego_motion(SPEED_MPS, math.radians(YAW_RATE_DPS), 3.0)
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((arc.x_m, arc.y_m, arc.yaw_rad), abs=1e-6)


def test_lever_arm_moves_with_the_turn() -> None:
    """2 m ahead of the turning point the radar moves sideways at 2 m times the yaw rate."""
    spinning = Drive(np.array([0.0, 9.0]), np.zeros(2), np.full(2, 0.5), Pose2(2.0, 0.0, 0.0))
    before, after = (spinning.radar(t).pose for t in (1.0, 1.001))
    moved_mps = np.array([after.x_m - before.x_m, after.y_m - before.y_m]) / 1e-3
    np.testing.assert_allclose(spinning.radar(1.0005).velocity, moved_mps, atol=1e-4)


def test_states_are_late_as_told() -> None:
    said = STEADY.states(1.0, 10**10, late_s=0.08)
    assert said[0].stamp_ns == 10**10 - 2_000_000_000 + 80_000_000
    assert {state.speed_mps for state in said} == {SPEED_MPS}
