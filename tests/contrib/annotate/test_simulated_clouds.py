"""Clouds of scenes: every hit lies where geometry says, in the frame it says, and the seed alone decides its noise."""

from __future__ import annotations

import numpy as np
import pytest

from contrib.annotate.registration import moved
from contrib.annotate.simulated_clouds import (
    GROUND,
    NOTHING,
    WALL,
    LidarParams,
    Viewpoint,
    choose_viewpoints,
    lidar_cloud,
    nearest_hits,
    ray_directions,
)
from msgs.files.shipped import CHECKOUT
from sim_player.scene.description import load_scene, scene_from_yaml

SCENES = CHECKOUT / "launch" / "scenes"

STREET = """
name: street
radar: {height_m: 1.0}
surfaces:
  - {role: relay, material: concrete, polyline_m: [[10.0, -20.0], [10.0, 20.0]], height_m: 4.0}
objects:
  - {primitive: box, size_m: [2.0, 2.0, 1.5], x_m: 5.0, y_m: 3.0}
"""
FEW = LidarParams(channels=16, azimuths=180, range_noise_m=0.0)


def test_rays_end_where_geometry_says() -> None:
    """Layout: wall 10 m ahead and 4 m high, a 2 m box at (5, 3), ground. From 1.8 m: ahead the wall at 10 m, towards
    the box its side at x = 4, down the ground at 1.8 m, over the wall nothing. Bias: float32 in the caster;
    tolerance 1e-5."""
    scene = scene_from_yaml(STREET)
    towards_box = np.array([4.0, 2.6, -0.8]) / np.linalg.norm([4.0, 2.6, -0.8])
    rays = np.array([[1.0, 0.0, 0.0], towards_box, [0.0, 0.0, -1.0], [0.6, 0.0, 0.8]])
    range_m, surface = nearest_hits(scene, np.array([0.0, 0.0, 1.8]), rays, 100.0)
    assert surface.tolist() == [WALL, 0, GROUND, NOTHING]
    assert range_m[:3] == pytest.approx([10.0, np.linalg.norm([4.0, 2.6, -0.8]), 1.8], abs=1e-5)
    assert np.isinf(range_m[3])


def test_a_tilted_lidar_sees_the_same_street() -> None:
    """A LiDAR turned by 40, tilted by 5 and -3 degrees: its points in the radar's frame lie on the wall (x = 10) and on
    the ground (1 m below the antenna) to 1e-4 m."""
    viewpoint = Viewpoint(x_m=2.0, y_m=-3.0, yaw_deg=40.0, pitch_deg=5.0, roll_deg=-3.0)
    cloud = lidar_cloud(scene_from_yaml(STREET), viewpoint, FEW, seed=0)
    points_m = moved(cloud.radar_from_lidar, cloud.points_m)
    assert points_m[cloud.surface == WALL, 0] == pytest.approx(10.0, abs=1e-4)
    assert points_m[cloud.surface == GROUND, 2] == pytest.approx(-1.0, abs=1e-4)


def test_noise_is_along_the_ray_and_seeded() -> None:
    """3 cm of noise: ranges differ by it (within 10 % over some thousand rays), directions not at all."""
    scene = scene_from_yaml(STREET)
    noisy = LidarParams(channels=16, azimuths=720, range_noise_m=0.03)
    clean = LidarParams(channels=16, azimuths=720, range_noise_m=0.0)
    here = Viewpoint(x_m=0.0, y_m=0.0)
    first, again, other = (lidar_cloud(scene, here, noisy, seed).points_m for seed in (1, 1, 2))
    truth = lidar_cloud(scene, here, clean, 1).points_m
    assert first.tobytes() == again.tobytes() != other.tobytes()
    error_m = np.linalg.norm(first, axis=1) - np.linalg.norm(truth, axis=1)
    assert error_m.std() == pytest.approx(0.03, rel=0.1)
    across = np.linalg.norm(np.cross(first, truth), axis=1) / np.linalg.norm(first, axis=1)
    assert across.max() < 1e-9


def test_directions_are_unit_vectors_over_the_field() -> None:
    rays = ray_directions(FEW)
    assert rays.shape == (16 * 180, 3)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    assert np.degrees(np.arcsin(rays[:, 2].max())) == pytest.approx(22.5)


@pytest.mark.parametrize("name", ["corner", "two_hidden_vehicles", "oblique_container"])
def test_chosen_viewpoints_see_what_the_radar_does_not(name: str) -> None:
    """The first place is the radar's own, and the others bring every object into some cloud."""
    scene = load_scene(SCENES / f"{name}.yaml")
    places = choose_viewpoints(scene)
    assert (places[0].x_m, places[0].y_m) == (0.0, 0.0)
    seen = {
        int(one) for place in places[1:] for one in np.unique(lidar_cloud(scene, place, FEW, 0).surface) if one >= 0
    }
    assert seen == set(range(len(scene.objects)))
