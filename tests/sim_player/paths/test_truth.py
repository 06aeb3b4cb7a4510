"""Truth points: thinning, visibility, the true place behind an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.physics.mirror import reflect
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import SEPARATION_CELLS, best_power_mw, hidden_objects, object_images, thin, visible_paths
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface
from sim_player.scene.world import prepare

RELAY = Surface(role="relay", material="concrete", polyline_m=((22.0, -9.0), (22.0, 14.0)), height_m=6.0)
CORNER = Surface(role="occluder", material="brick", polyline_m=((1.0, 3.5), (8.0, 3.5), (8.0, 20.0)), height_m=6.0)
HIDDEN = SceneObject(class_="car", x_m=11.0, y_m=9.3, yaw_deg=-90.0, speed_mps=5.0)
OPEN = SceneObject(class_="pedestrian", x_m=12.0, y_m=-2.0)
SCENE = Scene(name="t", surfaces=(RELAY, CORNER), objects=(HIDDEN, OPEN))


def test_thinning_keeps_the_first_and_parts_the_rest() -> None:
    rng = np.random.default_rng(0)
    row, column = rng.uniform(0, 60, (2, 500))
    kept = thin(row, column)
    assert kept[0] == 0
    apart = np.maximum(np.abs(row[kept, None] - row[kept]), np.abs(column[kept, None] - column[kept]))
    assert (apart + 100.0 * np.eye(len(kept))).min() >= SEPARATION_CELLS
    # nothing was dropped without a kept point near it
    near = np.maximum(np.abs(row[:, None] - row[kept]), np.abs(column[:, None] - column[kept])) < SEPARATION_CELLS
    assert near.any(axis=1).all()
    assert len(thin(np.zeros(0), np.zeros(0))) == 0


def test_truth_points_are_apart_on_the_grid_and_strongest_first() -> None:
    player = ScenePlayer(SCENE, chirps_per_beam=1)
    paths = player.paths(0.0)
    manual_plan = paths.take(visible_paths(player.setup, paths))
    power = best_power_mw(player.setup, manual_plan)
    assert (np.diff(power) <= 0.0).all()
    grid = RangeAzimuthGrid()
    row, column = grid.range_index(0.5 * manual_plan.length_m), grid.azimuth_index(manual_plan.azimuth_rad)
    apart = np.maximum(np.abs(row[:, None] - row), np.abs(column[:, None] - column)) + 100.0 * np.eye(len(row))
    assert apart.min() >= SEPARATION_CELLS
    assert column.min() >= 0.0
    assert column.max() <= 255.0


def test_images_and_true_places_belong_together() -> None:
    """Mirroring each hidden point in the relay wall gives its image; float32 rounds 40 m to 2e-6 m."""
    truth = ScenePlayer(SCENE, chirps_per_beam=1).truth(0)
    assert len(truth.mirrored_points_m) >= 2
    image = reflect(truth.hidden_points_m, np.array([-1.0, 0.0]), 22.0)
    relayed = truth.hidden_object == 0
    np.testing.assert_allclose(truth.mirrored_points_m[relayed], image[relayed], atol=1e-5)
    for index, point in zip(truth.hidden_object, truth.hidden_points_m, strict=True):
        thing = truth.objects[index]
        reach = 0.5 * np.hypot(thing.length_m, thing.width_m) + 1e-3
        assert np.hypot(point[0] - thing.x_m, point[1] - thing.y_m) <= reach


def test_hidden_means_mirrored_and_out_of_sight() -> None:
    truth = ScenePlayer(SCENE, chirps_per_beam=1).truth(0)
    assert [thing.hidden for thing in truth.objects] == [True, False]
    paths = trace(prepare(SCENE))
    assert hidden_objects(paths) == {0}
    # an object in the open keeps its mirror images
    assert ((paths.kind == PathClass.MIRRORED) & (paths.object_index == 1)).any()


def test_objects_carry_their_motion_into_the_radars_frame() -> None:
    """After 0.3 s the car has gone 1.5 m along its heading; the radar 2.4 m ahead with a turn of 3 degrees."""
    scene = Scene(name="t", surfaces=(RELAY,), objects=(HIDDEN,), ego=Ego(speed_mps=8.0, yaw_rate_dps=10.0))
    player = ScenePlayer(scene, chirps_per_beam=1, start_ns=5)
    truth = player.truth(1)
    thing = truth.objects[0]
    turn = np.radians(3.0)
    centre = 2.4 * np.sin(turn / 2) / (turn / 2) * np.array([np.cos(turn / 2), np.sin(turn / 2)])
    ahead = np.array([11.0, 9.3 - 1.5]) - centre
    expected = [np.cos(turn) * ahead[0] + np.sin(turn) * ahead[1], -np.sin(turn) * ahead[0] + np.cos(turn) * ahead[1]]
    np.testing.assert_allclose([thing.x_m, thing.y_m], expected, atol=1e-12)
    np.testing.assert_allclose(np.hypot(thing.velocity_x_mps, thing.velocity_y_mps), 5.0)
    assert thing.yaw_rad == pytest.approx(-np.pi / 2 - turn)
    assert truth.stamp_ns == 300_000_005
    assert truth.surfaces[0].polyline_m[0][0] < 22.0


def test_weak_points_are_no_truth() -> None:
    """A pedestrian at 109 m in one chirp is lost in noise; in 128 chirps it is not."""
    scene = Scene(name="t", objects=(SceneObject(class_="pedestrian", x_m=108.0, y_m=0.0),))
    assert len(ScenePlayer(scene, chirps_per_beam=1).truth(0).los_points_m) == 0
    assert len(ScenePlayer(scene).truth(0).los_points_m) == 1


def test_object_images_are_those_of_geometry_and_power() -> None:
    """The car behind the corner is seen by the facade alone, the pedestrian directly; ten times the power is 10 dB."""
    player = ScenePlayer(SCENE, chirps_per_beam=1)
    paths = player.paths(0.0)
    images = object_images(player.setup, paths, 3)
    assert images.direct.tolist() == [False, True, False]
    assert images.mirrored[0]
    # a third object that nothing comes from
    assert (images.mirrored[2], images.snr_db[2]) == (False, -np.inf)
    single = paths.take((paths.kind == PathClass.MIRRORED) & (paths.object_index == 0) & (paths.order == 1))
    radar = player.setup.radar
    noise_mw = radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam)
    wanted_db = 10.0 * np.log10(best_power_mw(player.setup, single).max() / noise_mw)
    assert images.single_snr_db[0] == pytest.approx(wanted_db, abs=1e-9)
    louder = replace(paths, amplitude=np.sqrt(10.0) * paths.amplitude)
    np.testing.assert_allclose(object_images(player.setup, louder, 3).snr_db[0], images.snr_db[0] + 10.0)


def test_an_image_outside_the_map_is_none_in_it() -> None:
    """Beyond 109 m, or to the side of +-60 degrees: a mirror shows the object, the map does not."""
    player = ScenePlayer(SCENE, chirps_per_beam=1)
    paths = player.paths(0.0)
    for far in (
        replace(paths, length_m=paths.length_m + 300.0),
        replace(paths, azimuth_rad=np.full(len(paths), 1.2)),
    ):
        images = object_images(player.setup, far, 2)
        assert (images.mirrored[0], images.snr_db[0]) == (True, -np.inf)
