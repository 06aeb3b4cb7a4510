"""Data sets of drives: profiles as the former has them, labels where its map shows an echo, truth, odometry, bytes."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from lab.training.data.frames import DataSet, fixed_splits
from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import (
    BeamFolder,
    FormingParams,
    ScanProfiles,
    beam_middle_s,
    ego_correction,
    form_map,
    look_azimuths,
)
from msgs.values.frames import Pose2
from msgs.values.perception import TruthObject
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.vehicle import ego_motion
from sim_player.dataset.labelled_drive import LabelledDrive, carried, state_of
from sim_player.dataset.labelled_scan import label_points, labelled_scan, noise_power_mw
from sim_player.dataset.shards import ShardDone, draw_gain_db, read_shard, shard_arrays
from sim_player.dataset.statistics import dataset_statistics
from sim_player.dataset.writer import Recipe, write_dataset
from sim_player.generate.drives import draw_drive
from sim_player.generate.places import random_place
from sim_player.paths.ray_tracing import trace
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface, scene_from_yaml
from sim_player.scene.world import prepare

#: Two scans a drive, one drive a shard; few effects are quickest.
DRIVES = Recipe(scans=2, scenes_per_shard=3, effects=("los_objects", "specular_relay", "motion", "thermal_noise"))
#: A car that closes in ahead, before a wall; nothing else.
AHEAD = Scene(
    name="ahead",
    surfaces=(Surface(role="relay", material="concrete", polyline_m=((30.0, -12.0), (30.0, 14.0)), height_m=5.0),),
    objects=(SceneObject(class_="car", x_m=20.0, y_m=0.0, yaw_deg=180.0, speed_mps=10.0),),
    ego=Ego(speed_mps=5.0, yaw_rate_dps=10.0),
)
QUIET = "los_objects,specular_relay,motion"


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drives of two scans in four shards, made in one process."""
    return write_dataset(tmp_path_factory.mktemp("drives"), 4, 3, DRIVES).parent


# --- the signal


def test_a_drive_at_rest_has_the_profiles_of_places_at_rest() -> None:
    """No noise, all effects of the echoes: slow-time sums in single precision against one profile a beam, 1e-4."""
    scene = random_place(3, 1)
    effects = frozenset({"los_objects", "los_surfaces", "specular_relay", "squint", "chirp_overlap"})
    rest = labelled_scan(scene, 4, effects)
    drive = LabelledDrive(scene, 4, scene.setup, ",".join(sorted(effects)))
    drive._odometry = lambda scan: np.zeros((15, 3))  # type: ignore[method-assign]
    scan = drive.scan(0)
    assert np.abs(scan.profiles - rest.profiles).max() < 1e-4 * np.abs(rest.profiles).max()
    assert scan.labels.range_m.tolist() == pytest.approx(rest.labels.range_m.tolist(), abs=1e-5)
    assert scan.labels.object_index.tolist() == rest.labels.object_index.tolist()
    assert not scan.velocity_mps.any()


def test_a_planned_drive_keeps_its_purpose() -> None:
    recipe = Recipe(scans=1, effects="auto", purpose="peaks")
    assert recipe.described(3)["purpose"] == "peaks"
    line = msgspec.json.decode(bytes(shard_arrays(recipe, 3, 0, 1)["plan"][0]))
    assert line["purpose"] == "peaks"


def test_maps_and_speeds_are_those_of_the_drive_s_beats() -> None:
    """A drive's scan against the former on all its codes, the same odometry, other noise: cells that stand 40 dB over
    the noise agree to 2 % in 99 of 100 cases, and such bins' speeds to 0.2 m/s in 9 of 10 (each has its own noise, at
    most 0.08 m/s rms there).
    """
    scene = draw_drive(7, 2, "xband", 1.2).scene
    effects = "los_objects,los_surfaces,specular_relay,motion,chirp_overlap,thermal_noise,adc"
    scan = LabelledDrive(scene, 9, scene.setup, effects).scan(1)
    state = state_of(scan.odometry)
    player = ScenePlayer(scene, 9, effects=effects)
    former = RaFormer(scene.setup)
    (wanted,) = (ra_map for beam in range(25) for ra_map in former.add(player.beam(1, beam), state))
    noise_mw = noise_power_mw(scene.setup)
    looks = look_azimuths(scene.setup, wanted.grid, state)
    profiles = ScanProfiles(0, 1, scan.profiles, noise_mw, np.zeros(25, np.int64), look_azimuth_rad=looks)
    got = form_map(profiles, AzimuthInterpolator(scene.setup))
    strong = np.abs(wanted.values) ** 2 > 1e4 * noise_mw
    assert strong.sum() > 1000
    # a bin whose coherence noise decides is no error of the level
    strong &= (got.incoherent == wanted.incoherent)[:, None]
    error = np.abs(np.abs(got.values) - np.abs(wanted.values))[strong] / np.abs(wanted.values)[strong]
    assert np.quantile(error, 0.99) < 0.02
    folder = BeamFolder(scene.setup, FormingParams(), RangeAzimuthGrid())
    off_mps = []
    for beam in range(0, 25, 3):
        ego = ego_correction(folder, beam, beam_middle_s(scene.setup, beam), state)
        wanted = folder.fold(player.beam(1, beam), ego)
        assert wanted.radial_speed_mps is not None
        loud = np.abs(scan.profiles[beam]) ** 2 > 1e4 * noise_mw
        off_mps.append((scan.radial_speed_mps[beam] - wanted.radial_speed_mps)[loud])
    assert len(np.concatenate(off_mps)) > 100
    assert np.quantile(np.abs(np.concatenate(off_mps)), 0.9) < 0.2


def test_noise_stays_that_of_a_beam() -> None:
    """Nothing but noise: the former takes no Doppler bin for an echo, so a bin's power is kT0B / (N N_c) x 1.5."""
    scene = msgspec.structs.replace(AHEAD, objects=(SceneObject(class_="car", x_m=-20.0, y_m=0.0, speed_mps=1.0),))
    scan = LabelledDrive(scene, 1, scene.setup, "los_objects,thermal_noise,motion").scan(0)
    assert np.mean(np.abs(scan.profiles) ** 2) / noise_power_mw(scene.setup) == pytest.approx(1.0, rel=0.03)


# --- labels and truth


def test_labels_stand_where_the_map_shows_the_car() -> None:
    """A car 20 m ahead closes in at 10 m/s, the radar at 5 m/s: the beam ahead looks at 0.144 s, so from the scan's
    first pose the front of the car (2.25 m before its middle) is 17.75 - 1.44 = 16.3 m away. No other bin is stronger.
    """
    drive = LabelledDrive(AHEAD, 1, AHEAD.setup, QUIET)
    drive._odometry = lambda scan: np.array([[0.0, 5.0, math.radians(10.0)]])  # type: ignore[method-assign]
    scan = drive.scan(0)
    car = (scan.labels.object_index == 0) & (scan.labels.order == 0)
    nearest = int(np.argmin(np.where(car, scan.labels.range_m, np.inf)))
    elapsed_s = float(scan.elapsed_s[nearest])
    assert elapsed_s == pytest.approx(12 * 0.012, abs=0.013)
    assert scan.labels.range_m[nearest] == pytest.approx(17.75 - 10.0 * elapsed_s, abs=0.15)
    np.testing.assert_allclose(scan.velocity_mps[nearest], [-10.0, 0.0], atol=1e-4)
    power = np.abs(scan.profiles[12]) ** 2
    assert abs(int(np.argmax(power[:120])) - scan.labels.range_bin[nearest]) <= 2


def test_paths_are_carried_to_the_first_pose() -> None:
    """A radar 2 m ahead and turned by 90 deg to the left: a point 5 m ahead of it lies at (2, 5), and its mirror image
    with it.
    """
    paths = trace(prepare(msgspec.structs.replace(AHEAD, ego=Ego()), 1))
    moved = carried(paths, Pose2(2.0, 0.0, math.pi / 2.0))
    np.testing.assert_allclose(moved.point_m[:, 0], 2.0 - paths.point_m[:, 1], atol=1e-9)
    np.testing.assert_allclose(moved.point_m[:, 1], paths.point_m[:, 0], atol=1e-9)
    np.testing.assert_allclose(
        moved.length_m - paths.length_m,
        2.0 * (np.linalg.norm(moved.virtual_m, axis=1) - np.linalg.norm(paths.virtual_m, axis=1)),
        atol=1e-9,
    )
    np.testing.assert_allclose(moved.azimuth_rad, np.arctan2(moved.virtual_m[:, 1], moved.virtual_m[:, 0]), atol=1e-12)
    setup = AHEAD.setup
    assert carried(paths, Pose2()).length_m.tolist() == paths.length_m.tolist()
    assert len(label_points(setup, paths).range_m) > 0


def test_shards_of_drives_hold_what_they_say(drives: Path) -> None:
    shard = read_shard(drives / "shard-00001.npz")
    assert shard["profiles"].shape == (2, 25, 512)
    assert shard["profiles"].dtype == np.complex64
    assert shard["sequence"].tolist() == ["drive_3_1", "drive_3_1"]
    assert shard["scan"].tolist() == [0, 1]
    assert shard["stamp_ns"].tolist() == [0, 300_000_000]
    scene = scene_from_yaml(str(shard["scene_yaml"][1]))
    assert scene == draw_drive(3, 1, "xband", 0.6).scene
    motion = scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps)
    np.testing.assert_allclose(shard["motion"], [motion, motion])
    pose = ego_motion(*motion, 0.3)
    np.testing.assert_allclose(shard["pose"], [[0.0, 0.0, 0.0], [pose.x_m, pose.y_m, pose.yaw_rad]], atol=1e-12)
    assert shard["offset"][-1] == len(shard["range_m"]) == len(shard["velocity_mps"]) == len(shard["elapsed_s"])
    assert shard["gain_db"][0] == draw_gain_db(3, 1)
    series = msgspec.json.decode((drives / "series.json").read_bytes())
    assert (series["generator"], series["motion"], series["scans"]) == ("random_drive", True, 2)
    assert series["class_mix"]["pedestrian"] == 0.12


def test_objects_keep_their_numbers_and_velocities(drives: Path) -> None:
    """Truth of a drive's scans: the same objects, moved by their velocity over ground."""
    for path in sorted(drives.glob("shard-*.npz")):
        shard = read_shard(path)
        first, second = (
            msgspec.convert(msgspec.json.decode(bytes(facts))["truth"], tuple[TruthObject, ...])
            for facts in shard["facts"]
        )
        start_from_radar = Pose2(*shard["pose"][1])
        assert [user.id for user in first] == [user.id for user in second] == list(range(len(first)))
        for before, after in zip(first, second, strict=True):
            there = start_from_radar.apply(np.array([after.x_m, after.y_m]))
            way_m = 0.3 * np.array([before.velocity_x_mps, before.velocity_y_mps])
            np.testing.assert_allclose(there, np.array([before.x_m, before.y_m]) + way_m, atol=1e-9)
        velocity = {user.id: (user.velocity_x_mps, user.velocity_y_mps) for user in second} | {-1: (0.0, 0.0)}
        own = slice(*shard["offset"][1:3])
        wanted = [velocity[int(index)] for index in shard["object_index"][own]]
        np.testing.assert_allclose(shard["velocity_mps"][own], np.reshape(wanted, (-1, 2)), atol=1e-4)


def test_odometry_is_the_true_motion_with_the_errors_of_a_bus() -> None:
    """One drive by 200 seeds: 1 % of the speed and 0.3 deg/s of a whole drive, 0.03 m/s and 0.2 deg/s of a state."""
    scene = AHEAD
    states = np.stack([LabelledDrive(scene, seed, scene.setup, "los_objects")._odometry(0) for seed in range(60)])
    assert states.shape == (60, 15, 3)
    np.testing.assert_allclose(states[0, :, 0], np.arange(15) * 0.02, atol=1e-12)
    of_drives = states[:, :, 1:].mean(axis=1)
    assert of_drives[:, 0].std() == pytest.approx(math.hypot(0.05, 0.03 / math.sqrt(15.0)), rel=0.35)
    assert np.degrees(of_drives[:, 1]).std() == pytest.approx(math.hypot(0.3, 0.2 / math.sqrt(15.0)), rel=0.35)
    within = (states[:, :, 1:] - of_drives[:, None]).std(axis=(0, 1))
    np.testing.assert_allclose(within, [0.03, math.radians(0.2)], rtol=0.15)
    assert of_drives[:, 0].mean() == pytest.approx(5.0, abs=0.03)


# --- however they are made


def test_interrupted_drives_go_on_to_the_same_bytes(tmp_path: Path, drives: Path) -> None:
    write_dataset(tmp_path, 2, 3, DRIVES)
    shard = tmp_path / "shard-00001.npz"
    shard.write_bytes(shard.read_bytes()[:5000])
    heard: list[ShardDone] = []
    write_dataset(tmp_path, 4, 3, DRIVES, on_shard=heard.append)
    assert sorted(one.state for one in heard) == ["kept", "made", "made", "rewritten"]
    assert files(tmp_path) == files(drives)


@pytest.mark.slow
def test_drives_with_all_effects_of_both_radars() -> None:
    """A drive of one scan each; 77 GHz has one time for all its beams."""
    for preset, beams in (("xband", 25), ("77ghz", 57)):
        arrays = shard_arrays(Recipe(preset=preset, scans=1), 3, 0, 1)  # type: ignore[arg-type]
        assert arrays["profiles"].shape == (1, beams, 512)
        assert np.isfinite(arrays["profiles"]).all()
        plan = msgspec.json.decode(bytes(arrays["plan"][0]))
        assert {"motion", "squint", "chirp_overlap"} <= set(plan["used"])


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"scans": 0}, r"scans must be 1\.\.100, got 0"),
        ({"scans": 2, "truth": True}, "truth must not be asked of drives: they always have it"),
        ({"scans": 101}, r"scans must be 1\.\.100, got 101"),
        ({"scans": 3, "shift": "hard"}, "shift must be none for drives, got 'hard'"),
    ],
)
def test_bad_recipes_of_drives_are_named(values: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        msgspec.convert({**values}, Recipe)


# --- readers


def test_drives_are_read_scan_by_scan(drives: Path) -> None:
    """Each scan is a map, formed with the looks of a moving radar; a split never divides a drive."""
    data = DataSet(drives)
    assert len(data) == 8
    odometry = read_shard(drives / "shard-00001.npz")["odometry"]
    scan, frame = data.scan(3), data.frame(3)
    assert scan.ego == state_of(odometry[1])
    assert frame.ra_map.ego_compensated
    assert frame.sequence == "drive_3_1"
    splits = fixed_splits(drives)
    for name in ("train", "validation", "test"):
        for index in splits.of(name):
            assert {int(index), int(index) ^ 1} <= set(splits.of(name).tolist())
    assert dataset_statistics(drives).scenes == 8


def test_odometry_that_is_none_is_refused(tmp_path: Path, drives: Path) -> None:
    arrays = read_shard(drives / "shard-00000.npz")
    for changed, rule in (
        (arrays["odometry"][:, :, :2], "odometry of a scene must have rows of 3 numbers"),
        (np.full_like(arrays["odometry"], np.nan), "odometry of scene 0: vehicle.speed_mps must be within"),
        (arrays["odometry"][:1], "odometry must have length 2, got 1"),
        (arrays["odometry"][0], "odometry must have 3 axes"),
    ):
        np.savez(tmp_path / "shard-00000.npz", **arrays | {"odometry": changed})
        with pytest.raises(ValueError, match=rule):
            DataSet(tmp_path).scan(0)


# --- the series at rest


def test_series_at_rest_keep_their_scenes_and_signals() -> None:
    """Three places: their scenes, gains and labelled classes by hash, their profiles by power and by a fixed
    projection to 1e-4 (machines round differently).
    """
    recipe = Recipe(effects="basic")
    arrays = shard_arrays(recipe, 3, 0, 3)
    hashed = hashlib.sha256(msgspec.json.encode(recipe.described(3)))
    for name in ("scene_yaml", "gain_db", "facts", "object_class"):
        hashed.update(np.ascontiguousarray(arrays[name]).tobytes())
    assert hashed.hexdigest() == "483492bc9b34bd06722335bf2ac4488fe87708dadb0cf4a5d8652b368eb2aa5e"
    profiles = arrays["profiles"].reshape(3, -1).astype(np.complex128)
    turns = np.exp(2j * np.pi * 0.618 * np.arange(profiles.shape[1]))
    got = [*np.linalg.norm(profiles, axis=1), *np.abs(profiles @ turns)]
    figures = [0.00553081, 0.000892052, 0.00452406, 0.000476495, 0.000152798, 0.000158972]
    np.testing.assert_allclose(got, figures, rtol=1e-4)
