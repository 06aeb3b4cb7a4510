"""Data sets: noise as stated, labels in place, the same bytes however they are made."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

import sim_player.dataset as dataset
from msgs.perception import PathClass
from msgs.radar import RadarSetup
from sim_player.dataset import (
    clean_profiles,
    label_points,
    noise_power_mw,
    profile_noise,
    read_shard,
    simulate_profiles,
    write_dataset,
)
from sim_player.ray_tracing import prepare, trace
from sim_player.scene import Ego, scene_from_yaml
from sim_player.streets import random_street


@pytest.fixture
def _small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "SCENES_PER_SHARD", 3)


def test_noise_power_and_correlation_are_the_windows() -> None:
    """25 x 512 bins, 40 draws: power to 0.2 %; neighbours correlate by -2/3, next ones by 1/6 (taps -1/2, 1, -1/2)."""
    setup = RadarSetup()
    noise = np.stack([profile_noise(setup, seed) for seed in range(40)])
    power = np.mean(np.abs(noise) ** 2)
    assert power == pytest.approx(noise_power_mw(setup), rel=0.01)
    for lag, expected in ((1, -2.0 / 3.0), (2, 1.0 / 6.0), (3, 0.0)):
        correlation = np.mean(noise[..., lag:] * np.conj(noise[..., :-lag])) / power
        assert abs(correlation - expected) < 0.01


def test_profiles_are_echoes_plus_noise() -> None:
    scene = random_street(5, 1)
    profiles, noise_mw, truth = simulate_profiles(scene, 9, gain_db=2.0)
    assert profiles.dtype == np.complex64
    assert profiles.shape == (25, 512)
    paths = trace(prepare(scene, 9))
    rest = profiles - 10.0**0.1 * clean_profiles(scene.setup, paths)
    # 12 800 correlated bins: 2 % rms
    assert np.mean(np.abs(rest) ** 2) == pytest.approx(noise_mw, rel=0.08)
    assert len(truth.objects) == len(scene.objects)


def test_moving_scenes_are_refused() -> None:
    scene = msgspec.structs.replace(random_street(5, 1), ego=Ego(speed_mps=1.0))
    with pytest.raises(ValueError, match="must be at rest for the kernel level"):
        simulate_profiles(scene, 0)


def test_labels_point_at_echoes() -> None:
    """At each strong label the best beam's profile holds at least a tenth of the label's power within two bins."""
    for index in range(6):
        scene = random_street(6, index)
        paths = trace(prepare(scene, 1))
        labels = label_points(scene.setup, paths)
        profiles = np.abs(clean_profiles(scene.setup, paths)) ** 2
        strong = labels.power_mw > labels.power_mw.max() * 1e-3
        for range_m in labels.range_m[strong]:
            row = round(range_m / scene.setup.radar.range_bin_m)
            near = profiles[:, max(row - 2, 0) : row + 3].max()
            assert near > 0.1 * labels.power_mw[strong].min()
        assert set(labels.path_class.tolist()) <= {PathClass.LOS, PathClass.MIRRORED}


@pytest.mark.usefixtures("_small_shards")
def test_shards_hold_what_they_say(tmp_path: Path) -> None:
    heard: list[int] = []
    manifest = write_dataset(tmp_path, 7, seed=2, on_progress=heard.append)
    assert heard == [3, 6, 7]
    lines = [msgspec.json.decode(line) for line in manifest.read_bytes().splitlines()]
    assert [(line["shard"], line["first_scene"], line["scenes"]) for line in lines] == [
        ("shard-00000.npz", 0, 3),
        ("shard-00001.npz", 3, 3),
        ("shard-00002.npz", 6, 1),
    ]
    shard = read_shard(tmp_path / "shard-00001.npz")
    assert shard["profiles"].shape == (3, 25, 512)
    assert shard["profiles"].dtype == np.complex64
    assert shard["offset"][0] == 0
    assert shard["offset"][-1] == len(shard["range_m"]) == len(shard["hidden_xy_m"]) == len(shard["power_mw"])
    assert scene_from_yaml(str(shard["scene_yaml"][1])) == random_street(2, 4)


@pytest.mark.usefixtures("_small_shards")
def test_interrupted_run_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    whole = write_dataset(tmp_path / "whole", 6, seed=2).parent
    part = write_dataset(tmp_path / "part", 3, seed=2).parent
    kept = (part / "shard-00000.npz").stat().st_mtime_ns
    write_dataset(part, 6, seed=2)
    assert (part / "shard-00000.npz").stat().st_mtime_ns == kept
    for path in sorted(whole.iterdir()):
        assert (part / path.name).read_bytes() == path.read_bytes(), path.name
    assert not list(part.glob("*.part"))


def test_workers_do_not_change_bytes(tmp_path: Path) -> None:
    """Two processes, one shard each way (fresh processes know no patched shard size, so few scenes)."""
    alone = write_dataset(tmp_path / "alone", 2, seed=4, workers=1).parent
    crowd = write_dataset(tmp_path / "crowd", 2, seed=4, workers=2).parent
    for path in sorted(alone.iterdir()):
        assert (crowd / path.name).read_bytes() == path.read_bytes(), path.name


def test_another_series_folder_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, 1, seed=1)
    with pytest.raises(ValueError, match="holds another data set"):
        write_dataset(tmp_path, 1, seed=2)
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        write_dataset(tmp_path, 0, seed=1)
