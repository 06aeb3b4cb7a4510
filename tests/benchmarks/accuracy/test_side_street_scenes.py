"""Random drives past side streets: legal, varied, repeatable, and what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.accuracy.side_street_scenes import (
    CROSSING,
    LAYOUTS,
    MANNERS,
    SIGHT_S,
    STEP_S,
    WALL_ROOM_M,
    SideStreet,
    direct_sight,
    random_side_street,
)
from msgs.values.frames import Pose2
from sim_player.drive import DrivePlayer
from sim_player.generate.placement import Walls
from sim_player.scene.description import check_scene, scene_to_yaml

#: Drawing the drives that they share takes seconds.
pytestmark = pytest.mark.slow

COUNT = 24


@pytest.fixture(scope="module")
def streets() -> list[SideStreet]:
    return [random_side_street(5, index) for index in range(COUNT)]


def sight_s(street: SideStreet) -> float:
    """First time at which the crossing object is in direct sight."""
    player = DrivePlayer(street.scene, street.drive, Pose2(), chirps_per_beam=1)
    times_s = np.arange(0.0, SIGHT_S[1] + 2.0 * STEP_S, STEP_S)
    return next((float(time_s) for time_s in times_s if direct_sight(player.paths(float(time_s)))), np.inf)


def test_drives_repeat_and_differ(streets: list[SideStreet]) -> None:
    again = random_side_street(5, 3)
    assert again.scene == streets[3].scene
    np.testing.assert_array_equal(again.drive.yaw_rate_rps, streets[3].drive.yaw_rate_rps)
    assert len({scene_to_yaml(street.scene) for street in streets}) == COUNT
    assert random_side_street(6, 3).scene != streets[3].scene


def test_all_layouts_and_manners_come(streets: list[SideStreet]) -> None:
    """24 drives of 3 equally likely: one is missed with a probability of 2e-4."""
    assert {street.layout for street in streets} == set(LAYOUTS)
    assert {street.manner for street in streets} == set(MANNERS)
    speeds_mps = np.array([street.drive.speed_mps[0] for street in streets])
    assert speeds_mps.min() < 5.0
    assert speeds_mps.max() > 8.0
    assert {np.sign(street.scene.objects[CROSSING].y_m) for street in streets} == {-1.0, 1.0}


def test_manners_are_what_they_are_called(streets: list[SideStreet]) -> None:
    for street in streets:
        slowed_mps = street.drive.speed_mps[0] - street.drive.speed_mps[-1]
        turned_dps = np.degrees(np.abs(street.drive.yaw_rate_rps[-40:]).mean())
        assert (slowed_mps > 0.3) == (street.manner == "braking")
        assert (turned_dps > 1.5) == (street.manner == "turning")


@pytest.mark.parametrize("index", range(6))
def test_the_crossing_object_is_hidden_at_first_and_then_in_sight(index: int, streets: list[SideStreet]) -> None:
    assert SIGHT_S[0] <= sight_s(streets[index]) <= SIGHT_S[1]


@pytest.mark.parametrize("index", range(6))
def test_scenes_are_legal_and_the_vehicle_passes(index: int, streets: list[SideStreet]) -> None:
    """Room between the way up to direct sight and every wall, looked at more finely than the generator does."""
    street = streets[index]
    check_scene(street.scene)
    walls = Walls.of(tuple(surface for surface in street.scene.surfaces if surface.role != "ground"))
    for time_s in np.arange(0.0, sight_s(street), 0.1):
        pose = street.drive.pose(float(time_s))
        along = walls.b - walls.a
        share = np.clip(((np.array([pose.x_m, pose.y_m]) - walls.a) * along).sum(1) / (along**2).sum(1), 0.0, 1.0)
        away_m = np.hypot(*(np.array([pose.x_m, pose.y_m]) - walls.a - share[:, None] * along).T)
        # between two of the generator's steps a vehicle at 12 m/s comes nearer by some decimetres at most
        assert away_m.min() > WALL_ROOM_M - 0.5


@pytest.mark.parametrize(("seed", "index"), [(-1, 0), (0, -1)])
def test_negative_numbers_are_refused(seed: int, index: int) -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        random_side_street(seed, index)
