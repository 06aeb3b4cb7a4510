"""Data sets: noise as stated, labels in place, the same bytes however they are made."""

from __future__ import annotations

import errno
import importlib.util
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import sim_player.dataset.shards as shards
from lab.evaluate.labelled_beams import LabelledPlace
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import PathClass
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from msgs.values.units import ratio_from_db
from sim_player.dataset.executors import Executor, map_jobs
from sim_player.dataset.labelled_scan import clean_profiles, label_points, labelled_scan, noise_power_mw, profile_noise
from sim_player.dataset.shards import Recipe, ShardDone, read_shard
from sim_player.dataset.statistics import dataset_statistics, histogram, read_records
from sim_player.dataset.writer import write_dataset
from sim_player.generate.places import draw_place, random_place
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import labelled, scene_truth
from sim_player.planner.cells import cells_of
from sim_player.planner.purposes import Purpose
from sim_player.scene.description import Ego, Scene, SceneObject, Surface, scene_from_yaml
from sim_player.scene.wall_priors import POOR
from sim_player.scene.world import prepare
from sim_player.signal.levels import noise_rms
from sim_player.trace.effect_names import bit
from sim_player.trace.path_table import Paths

ROOT = CHECKOUT
#: Cheap scenes in small shards.
STREETS = Recipe(effects="basic", scenes_per_shard=2)
PLACES = Recipe(scenes_per_shard=2)
#: A radar before a concrete wall with a car beyond a corner: one object in direct sight, one in the mirror alone.
CORNER = Scene(
    name="corner",
    surfaces=(
        Surface(role="relay", material="concrete", polyline_m=((20.0, -12.0), (20.0, 14.0)), height_m=5.0),
        Surface(role="occluder", material="concrete", polyline_m=((2.0, 3.0), (12.0, 3.0)), height_m=6.0),
    ),
    objects=(
        SceneObject(class_="car", x_m=11.0, y_m=-4.0),
        SceneObject(class_="van", x_m=8.0, y_m=6.0),
    ),
)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five streets in three shards, made in one process."""
    return write_dataset(tmp_path_factory.mktemp("streets"), 5, 2, STREETS).parent


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four planned places in two shards, made in one process."""
    return write_dataset(tmp_path_factory.mktemp("places"), 4, 3, PLACES).parent


# --- signal


def test_noise_power_and_correlation_are_the_windows() -> None:
    """25 x 512 bins, 40 draws: power to 0.2 %; neighbours correlate by -2/3, next ones by 1/6 (taps -1/2, 1, -1/2)."""
    setup = RadarSetup()
    noise = np.stack([profile_noise(setup, seed) for seed in range(40)])
    power = np.mean(np.abs(noise) ** 2)
    assert power == pytest.approx(noise_power_mw(setup), rel=0.01, abs=0.0)
    for lag, expected in ((1, -2.0 / 3.0), (2, 1.0 / 6.0), (3, 0.0)):
        correlation = np.mean(noise[..., lag:] * np.conj(noise[..., :-lag])) / power
        assert abs(correlation - expected) < 0.01


def test_profiles_are_echoes_plus_noise() -> None:
    scene = random_place(5, 1)
    scan = labelled_scan(scene, 9, "basic", gain_db=2.0)
    profiles = scan.profiles
    assert profiles.dtype == np.complex64
    assert profiles.shape == (25, 512)
    paths = trace(prepare(scene, 9))
    rest = profiles - 10.0**0.1 * clean_profiles(scene.setup, paths)
    # 12 800 correlated bins: 2 % rms
    assert np.mean(np.abs(rest) ** 2) == pytest.approx(scan.noise_power_mw, rel=0.08, abs=0.0)


def test_moving_scenes_are_refused() -> None:
    scene = msgspec.structs.replace(random_place(5, 1), ego=Ego(speed_mps=1.0))
    with pytest.raises(ValueError, match="must be at rest for the kernel level"):
        labelled_scan(scene, 0)


def test_choices_of_effects_make_the_signal() -> None:
    """Planned under -20 dB: near the whole in the mean over cells. By name: no more than was asked for."""
    scene = random_place(3, 1)
    whole = labelled_scan(scene, 4, "all").profiles
    planned = labelled_scan(scene, 4, "auto", budget_db=-20.0)
    assert planned.plan is not None
    assert np.linalg.norm(planned.profiles - whole) < 0.1 * np.linalg.norm(whole)
    truth = scene_truth(prepare(scene, 4, scene.setup), scene.setup, planned.plan.paths, 0.0, 0, 0)
    assert int((planned.labels.path_class == PathClass.MIRRORED).sum()) == len(truth.mirrored_points_m)
    names = frozenset({"thermal_noise", "los_objects"})
    few = labelled_scan(scene, 4, names)
    assert few.plan is not None
    assert few.plan.used <= names
    assert (few.labels.object_index >= 0).all()
    assert np.linalg.norm(few.profiles - whole) > 0.5 * np.linalg.norm(whole)


def test_gain_is_the_transmitters_power() -> None:
    """Echoes of planned scenes grow by the gain, labels too; noise does not (compared without rounding of codes)."""
    names = frozenset({"los_objects", "los_surfaces", "specular_relay"})
    quiet, loud = (labelled_scan(CORNER, 1, names, gain_db=gain) for gain in (0.0, 3.0))
    assert np.abs(loud.profiles).max() / np.abs(quiet.profiles).max() == pytest.approx(ratio_from_db(3.0) ** 0.5, 1e-4)
    strongest = loud.labels.power_mw[0] / quiet.labels.power_mw[0]
    assert strongest == pytest.approx(ratio_from_db(3.0), rel=1e-5)
    assert loud.noise_power_mw == quiet.noise_power_mw


# --- labels


def test_labels_point_at_echoes() -> None:
    """At each strong label the best beam's profile holds at least a tenth of the label's power within two bins."""
    for index in range(6):
        scene = random_place(6, index)
        paths = trace(prepare(scene, 1))
        labels = label_points(scene.setup, paths)
        profiles = np.abs(clean_profiles(scene.setup, paths)) ** 2
        strong = labels.power_mw > labels.power_mw.max() * 1e-3
        for range_m in labels.range_m[strong]:
            row = round(range_m / scene.setup.radar.range_bin_m)
            near = profiles[:, max(row - 2, 0) : row + 3].max()
            assert near > 0.1 * labels.power_mw[strong].min()
        assert set(labels.path_class.tolist()) <= {PathClass.LOS, PathClass.MIRRORED}


def test_labels_name_cell_place_image_and_object() -> None:
    """Corner scene: the van shows in the wall x = 20 alone, its image is its place mirrored there: x' = 40 - x."""
    labels = labelled_scan(CORNER, 1, "all").labels
    grid = RangeAzimuthGrid()
    van = labels.object_index == 1
    assert set(labels.object_class[van]) == {"van"}
    assert set(labels.path_class[van].tolist()) == {PathClass.MIRRORED}
    one = van & (labels.order == 1)
    assert one.any()
    np.testing.assert_allclose(labels.image_m[one, 0], 40.0 - labels.point_m[one, 0], atol=1e-3)
    np.testing.assert_allclose(labels.image_m[one, 1:], labels.point_m[one, 1:], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(labels.image_m, axis=1), labels.range_m, rtol=1e-5)
    assert (np.abs(grid.range_index(labels.range_m) - labels.range_bin) <= 0.5).all()
    assert (np.abs(grid.azimuth_index(labels.azimuth_rad) - labels.azimuth_bin) <= 0.5).all()
    assert (labels.object_class[labels.object_index < 0] == "wall").all()


def test_labels_are_of_geometric_ways_alone() -> None:
    """Corner scene, all effects: mixed ways, bends and light of other objects are in the paths, never in the labels."""
    scene = random_place(3, 1)
    scan = labelled_scan(scene, 4, "all")
    assert scan.plan is not None
    paths: Paths = scan.plan.paths
    bends = "edge_diffraction", "mirrored_diffraction"
    refused = sum(map(bit, ("non_cofocal", *bends, "object_interreflection", "ground_bounce")))
    mixed = (paths.needs & np.uint32(refused)) != 0
    assert mixed.any()
    assert not labelled(paths)[mixed].any()
    allowed = set(np.float32(0.5 * paths.length_m[labelled(paths)]).tolist())
    assert set(scan.labels.range_m.tolist()) <= allowed
    mirrored = scan.labels.path_class == PathClass.MIRRORED
    assert (scan.labels.object_index[mirrored] >= 0).all()
    assert set(scan.labels.order[mirrored].tolist()) <= {1, 2}


# --- shards


def test_shards_hold_what_they_say(streets: Path) -> None:
    lines = [msgspec.json.decode(line) for line in (streets / "manifest.jsonl").read_bytes().splitlines()]
    assert [(line["shard"], line["first_scene"], line["scenes"]) for line in lines] == [
        ("shard-00000.npz", 0, 2),
        ("shard-00001.npz", 2, 2),
        ("shard-00002.npz", 4, 1),
    ]
    shard = read_shard(streets / "shard-00001.npz")
    assert shard["profiles"].shape == (2, 25, 512)
    assert shard["profiles"].dtype == np.complex64
    assert shard["offset"][0] == 0
    for name in shards.LABELS:
        assert shard["offset"][-1] == len(shard[name]), name
    assert scene_from_yaml(str(shard["scene_yaml"][1])) == random_place(2, 3)
    series = msgspec.json.decode((streets / "series.json").read_bytes())
    assert (series["generator"], series["effects"], series["budget_db"]) == ("random_place", "basic", None)


def test_basic_effects_are_basic_paths_and_the_plain_chain(streets: Path) -> None:
    """The gain is on the profiles."""
    shard = read_shard(streets / "shard-00000.npz")
    for index in range(2):
        scene = random_place(2, index)
        seed = int(np.random.SeedSequence([2, index]).generate_state(1, np.uint64)[0])
        gain_db = float(np.random.default_rng([2, index, 7]).uniform(-3.0, 3.0))
        paths = trace(prepare(scene, seed))
        clean = np.sqrt(ratio_from_db(gain_db)) * clean_profiles(scene.setup, paths)
        expected = (clean + profile_noise(scene.setup, seed)).astype(np.complex64)
        assert shard["profiles"][index].tobytes() == expected.tobytes()
        here = slice(*shard["offset"][index : index + 2])
        labels = label_points(scene.setup, paths, ratio_from_db(gain_db))
        assert shard["power_mw"][here].tobytes() == labels.power_mw.tobytes()
        assert shard["hidden_xy_m"][here].tobytes() == labels.hidden_xy_m.tobytes()


@pytest.mark.slow
def test_places_carry_their_plans(places: Path) -> None:
    shard = read_shard(places / "shard-00001.npz")
    for index in range(2):
        plan, facts = (msgspec.json.decode(bytes(shard[name][index])) for name in ("plan", "facts"))
        place = draw_place(3, 2 + index)
        assert facts["place"] == place.kind
        assert facts["objects"] == [thing.object_class for thing in place.scene.objects]
        assert plan["budget_db"] == -20.0
        assert plan["used"] == sorted(row["name"] for row in plan["plan"] if row["used"])
        assert all(row["reason"] for row in plan["plan"])
        assert plan["spent_db"] is None or plan["spent_db"] <= -20.0


def test_millimetre_waves_too(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path, 1, 5, Recipe(preset="77ghz", places="parking_lot", effects="basic")).parent
    shard = read_shard(folder / "shard-00000.npz")
    assert shard["profiles"].shape == (1, 57, 512)
    assert scene_from_yaml(str(shard["scene_yaml"][0])).setup.radar.carrier_hz == 77e9


# --- however they are made


def test_raw_beams_of_a_place_are_sent_at_the_gain_of_the_data_set() -> None:
    """A place at -2.95 dB: power of the transmitter over that of its scene, and the gain that the shard states."""
    (gain_db,) = shards.shard_arrays(Recipe(effects="basic"), 3, 1, 1)["gain_db"]
    assert gain_db == pytest.approx(-2.953, abs=1e-3)
    player = LabelledPlace(3, 1, "basic").player
    scene_w, sent_w = (setup.radar.transmit_power_w for setup in (player.scene.setup, player.setup))
    assert sent_w / scene_w == pytest.approx(ratio_from_db(gain_db), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("threads", "workers"), [(1, 1), (2, 2)])
def test_threads_and_workers_do_not_change_bytes(tmp_path: Path, places: Path, threads: int, workers: int) -> None:
    """However many threads of linear algebra the caller has; the one in which nothing is split is among them."""
    with threadpool_limits(limits=threads):
        assert files(write_dataset(tmp_path, 4, 3, PLACES, workers=workers).parent) == files(places)


def test_interrupted_run_goes_on_to_the_same_bytes(tmp_path: Path, streets: Path) -> None:
    """Whole shards of a shorter run stay, the one that has only its beginning and a half-written file are made anew."""
    write_dataset(tmp_path, 3, 2, STREETS)
    (tmp_path / "shard-00002.part").write_bytes(b"PK")
    kept = (tmp_path / "shard-00000.npz").stat().st_mtime_ns
    heard: list[ShardDone] = []
    write_dataset(tmp_path, 5, 2, STREETS, on_shard=heard.append)
    assert [shard.state for shard in heard] == ["kept", "made", "made"]
    assert (tmp_path / "shard-00000.npz").stat().st_mtime_ns == kept
    assert files(tmp_path) == files(streets)


_ORPHANS = """
import sys
sys.path.insert(0, sys.argv[1])
from nap import nap
from sim_player.dataset.executors import Executor, map_jobs
for number in map_jobs(nap, [0.0, 600.0, 600.0, 600.0], workers=2):
    print(number, flush=True)
"""
_NAP = """
import os, time
def nap(seconds):
    time.sleep(seconds)
    return os.getpid()
"""


def test_workers_end_with_their_parent(tmp_path: Path) -> None:
    """SIGKILL of the parent while both workers are busy: the worker that was heard of is gone soon after."""
    (tmp_path / "nap.py").write_text(_NAP)
    with subprocess.Popen([sys.executable, "-c", _ORPHANS, tmp_path], cwd=ROOT, stdout=subprocess.PIPE) as run:
        assert run.stdout is not None
        worker = int(run.stdout.readline())
        assert _alive(worker)
        os.kill(run.pid, signal.SIGKILL)
    deadline_s = time.monotonic() + 120.0
    while _alive(worker) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert not _alive(worker)


def _alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has collected does not."""
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("fault", ["cut", "flipped", "other"])
def test_faulty_shard_is_made_again(tmp_path: Path, streets: Path, fault: str) -> None:
    """Cut short, a byte flipped in the data (CRC-32), or a whole shard of something else (checksum)."""
    for name, content in files(streets).items():
        (tmp_path / name).write_bytes(content)
    shard = tmp_path / "shard-00001.npz"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 0x10
    other = {"cut": content[:1000], "flipped": content, "other": (tmp_path / "shard-00000.npz").read_bytes()}
    shard.write_bytes(other[fault])
    if fault == "flipped":
        # a run that was killed before it could write its manifest
        (tmp_path / "manifest.jsonl").unlink()
    heard: list[ShardDone] = []
    write_dataset(tmp_path, 5, 2, STREETS, on_shard=heard.append)
    assert sorted(one.state for one in heard) == ["kept", "kept", "rewritten"]
    (again,) = (one for one in heard if one.state == "rewritten")
    assert again.shard == "shard-00001.npz"
    assert ("checksum" if fault == "other" else "cannot be read") in again.reason
    assert files(tmp_path) == files(streets)


def test_places_planned_for_a_purpose_are_evaluated_to_what_it_needs(tmp_path: Path) -> None:
    """A series of all effects and one as planned have the same places and labels; maps keep the law of objects."""
    everything, planned = (
        read_shard(write_dataset(tmp_path / effects, 2, 3, recipe).parent / "shard-00000.npz")
        for effects in ("all", "auto")
        for recipe in [msgspec.structs.replace(PLACES, effects=effects)]
    )
    for name in ("scene_yaml", "facts", *shards.LABELS):
        assert np.array_equal(everything[name], planned[name]), name
    lines = [msgspec.json.decode(bytes(line)) for line in planned["plan"]]
    assert all(line["purpose"] == "objects" for line in lines)
    for before, after in zip(everything["profiles"], planned["profiles"], strict=True):
        setup = RadarSetup()
        ratio = cells_of(setup).off(before, after, noise_rms(setup), Purpose.OBJECTS)
        assert 0.0 < ratio.max() <= 0.1
    for_peaks = msgspec.structs.replace(PLACES, purpose="peaks")
    peaks = read_shard(write_dataset(tmp_path / "peaks", 2, 3, for_peaks).parent / "shard-00000.npz")
    for index in range(2):
        scene, gain_db = scene_from_yaml(str(peaks["scene_yaml"][index]), Path()), float(peaks["gain_db"][index])
        scan = labelled_scan(scene, shards.scene_seed(3, index), "auto", -20.0, gain_db, "peaks")
        assert np.array_equal(scan.profiles, peaks["profiles"][index])
        assert scan.plan is not None
        assert scan.plan.purpose == "peaks"


def test_a_series_names_its_purpose_and_a_resumed_run_keeps_it(tmp_path: Path) -> None:
    for_objects = msgspec.structs.replace(PLACES, purpose="objects")
    assert for_objects.described(1) == PLACES.described(1)
    assert PLACES.described(1)["purpose"] == "objects"
    write_dataset(tmp_path, 1, 1, for_objects)
    write_dataset(tmp_path, 1, 1, PLACES)
    with pytest.raises(ValueError, match="holds another data set: purpose 'objects', wanted 'peaks'"):
        write_dataset(tmp_path, 1, 1, msgspec.structs.replace(PLACES, purpose="peaks"))


def test_another_series_folder_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, 3, 1, STREETS)
    with pytest.raises(ValueError, match="holds another data set: seed 1, wanted 2"):
        write_dataset(tmp_path, 3, 2, STREETS)
    with pytest.raises(ValueError, match=r"budget_db None, wanted -20\.0; effects 'basic', wanted 'auto'"):
        write_dataset(tmp_path, 3, 1, msgspec.structs.replace(STREETS, effects="auto"))
    with pytest.raises(ValueError, match=r"count must not be below what .* holds \(shard-00001.npz\), got 1"):
        write_dataset(tmp_path, 1, 1, STREETS)
    (tmp_path / "series.json").write_bytes(b'{"seed":1,"scenes_per_shard":2}')
    with pytest.raises(ValueError, match=r"holds another data set: .*format None, wanted 5"):
        write_dataset(tmp_path, 3, 1, STREETS)
    (tmp_path / "series.json").unlink()
    with pytest.raises(ValueError, match=r"holds shards but no series\.json"):
        write_dataset(tmp_path, 3, 1, STREETS)


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"purpose": "labels"}, "purpose must be one of samples, peaks, objects, got 'labels'"),
        ({"purpose": "peaks", "effects": "all"}, "purpose must be samples unless effects are auto, got 'peaks'"),
        ({"purpose": "peaks", "effects": ("squint",)}, "purpose must be samples unless effects are auto, got 'peaks'"),
        ({"places": "nowhere"}, "places must be one of any, street, .*, got 'nowhere'"),
        ({"preset": "spad"}, "preset must be one of xband, 77ghz, got 'spad'"),
        ({"shift": "soft"}, "shift must be one of none, hard, got 'soft'"),
        ({"preset": "77ghz", "shift": "hard"}, "shift must be none for preset 77ghz: .* got 'hard'"),
        ({"budget_db": 0.0}, "budget_db must be negative"),
        ({"budget_db": float("nan")}, "budget_db must be negative"),
        ({"effects": "some"}, "effects must be auto, all, basic or a list of names, got 'some'"),
        ({"effects": ("fog",)}, "effects: unknown fog"),
        ({"effects": ()}, "effects must be auto, all, basic or a list of names, got nothing"),
    ],
)
def test_recipes_that_cannot_be(values: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        Recipe(**values)


def test_bad_counts(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        write_dataset(tmp_path, 0, 1)
    with pytest.raises(ValueError, match="seed must be at least 0, got -1"):
        write_dataset(tmp_path, 1, -1)
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        write_dataset(tmp_path, 1, 1, STREETS, workers=0)
    with pytest.raises(ValueError, match="executor must be one of local, ray, slurm, got 'moon'"):
        write_dataset(tmp_path, 1, 1, STREETS, executor="moon")  # type: ignore[arg-type]


def test_full_disk_names_the_file_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(shards.os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_dataset(tmp_path, 1, 2, STREETS)
    assert caught.value.filename == str(tmp_path / "shard-00000.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["series.json"]


# --- executors


@pytest.mark.slow
def test_submitit_gives_the_same_bytes(tmp_path: Path, streets: Path) -> None:
    """The way to Slurm without Slurm: a process that reads its job from a file."""
    pytest.importorskip("submitit")
    write_dataset(tmp_path, 2, 2, STREETS, executor="slurm", slurm={"cluster": "local"})
    assert files(tmp_path)["shard-00000.npz"] == files(streets)["shard-00000.npz"]
    assert not (tmp_path / ".slurm").exists()


def test_slurm_without_slurm_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match="executor slurm needs Slurm's commands on this machine, srun is not found"):
        list(map_jobs(math.sqrt, [4.0], "slurm", scratch=tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("executor", "workers", "options"), [("local", 1, {}), ("local", 2, {}), ("slurm", 1, {"cluster": "local"})]
)
def test_errors_of_jobs_come_through(tmp_path: Path, executor: Executor, workers: int, options: dict[str, Any]) -> None:
    if executor == "slurm":
        pytest.importorskip("submitit")
    with pytest.raises(ValueError, match="math domain error"):
        list(map_jobs(math.sqrt, [4.0, -1.0], executor, workers, tmp_path / "scratch", options))


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra: cluster)")
# ray: sockets and files of the processes it starts are closed when they are collected, and it warns of its own plans
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning", "ignore::DeprecationWarning")
def test_ray_gives_the_same_bytes(tmp_path: Path, streets: Path) -> None:
    write_dataset(tmp_path, 5, 2, STREETS, workers=2, executor="ray")
    assert files(tmp_path) == files(streets)


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="ray is installed")
def test_missing_ray_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ImportError, match="ray, which --executor ray needs"):
        write_dataset(tmp_path, 1, 2, STREETS, executor="ray")


# --- statistics


def test_statistics_count_what_is_there(places: Path) -> None:
    found = dataset_statistics(places)
    shard = [read_shard(path) for path in sorted(places.glob("shard-*.npz"))]
    kinds = np.concatenate([one["path_class"] for one in shard])
    scenes = [draw_place(3, index) for index in range(4)]
    assert found.scenes == 4 == sum(found.places.values()) == sum(found.hidden_per_scene.values())
    assert found.points == {"LOS": int((kinds == 0).sum()), "mNLOS": int((kinds == 1).sum())}
    assert sum(found.orders.values()) == len(kinds)
    assert found.orders["direct"] == found.points["LOS"]
    assert sum(map(sum, found.range_m.counts.values())) == sum(map(sum, found.snr_db.counts.values())) == len(kinds)
    objects = sum(len(place.scene.objects) for place in scenes)
    assert sum(one.direct + one.hidden + one.unseen for one in found.objects.values()) == objects
    walls = sum(surface.role != "ground" for place in scenes for surface in place.scene.surfaces)
    assert sum(found.roughness_mm.counts["walls"]) == walls == sum(found.materials.values())
    assert found.relays == Counter(relay for place in scenes for relay in place.relays)
    assert found.effects["thermal_noise"] == 1.0
    assert found.nothing_hidden_share == found.hidden_per_scene.get(0, 0) / 4


def test_histograms_keep_what_lies_outside() -> None:
    found = histogram((0.0, 1.0, 2.0), {"a": np.array([-5.0, 0.5, 1.0, 2.0, 99.0])})
    assert found.counts == {"a": [2, 3]}


def test_statistics_of_no_data_set(tmp_path: Path, streets: Path) -> None:
    with pytest.raises(ValueError, match=r"series\.json: must say which data set the folder holds: No such"):
        dataset_statistics(tmp_path)
    with pytest.raises(ValueError, match="must hold shards"):
        list(read_records(tmp_path))
    (tmp_path / "shard-00000.npz").write_bytes((streets / "shard-00000.npz").read_bytes()[:500])
    with pytest.raises(ValueError, match=r"shard-00000\.npz: not a shard of this format"):
        list(read_records(tmp_path))


def test_truth_lists_all_objects_and_changes_nothing_else() -> None:
    """A place's boxes as its scene has them, hidden where mirrors alone show them, and its walls, as they are and as a
    poor map has them; all other arrays stay.
    """
    plain = shards.shard_arrays(Recipe(effects="basic"), 5, 0, 2)
    listed = shards.shard_arrays(Recipe(effects="basic", truth=True), 5, 0, 2)
    for name in plain.keys() - {"facts"}:
        np.testing.assert_array_equal(plain[name], listed[name])
    for index in range(2):
        facts = msgspec.json.decode(listed["facts"][index])
        scene = draw_place(5, index).scene
        assert [(one["object_class"], one["x_m"], one["y_m"]) for one in facts["truth"]] == [
            (one.object_class, pytest.approx(one.x_m), pytest.approx(one.y_m)) for one in scene.objects
        ]
        assert [one["id"] for one in facts["truth"] if one["hidden"]] == facts["hidden"]
        walls, poor = facts.pop("walls"), facts.pop("map_walls")
        straight = [surface for surface in scene.surfaces if surface.role != "ground" and not surface.curvature_per_m]
        ends_m = [[list(point) for point in surface.polyline_m[:2]] for surface in straight]
        assert len(walls) >= len(straight)
        assert any(wall["ends_m"] in ends_m for wall in walls)
        assert 0 < len(poor) <= len(walls)
        assert poor[0]["offset_std_m"] == POOR.offset_std_m
        assert facts | {"truth": None} == msgspec.json.decode(plain["facts"][index]) | {"truth": None}
