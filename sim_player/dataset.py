"""Data sets at the kernel level: a scene's beams as range profiles in one matrix product, in resumable shards.

Same signal as the beats of `sim_player.fmcw` after folding, window and FFT (for scenes at rest; scenes here are), at a
thousandth of the work: noise is drawn per range bin, with the window's correlation.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from models.physics.waveform import WINDOW_TAPS, range_profile, window_noise_gain
from msgs.perception import SceneTruth
from msgs.radar import RadarSetup
from msgs.units import ratio_from_db
from sim_player.fmcw import beam_weights
from sim_player.ray_tracing import Paths, prepare, trace
from sim_player.scene import Scene, scene_to_yaml
from sim_player.streets import random_street
from sim_player.truth import best_power_mw, scene_truth, visible_paths

RANGE_BINS = 512
SCENES_PER_SHARD = 50
WINDOW = "hann"
#: Spread of the radar's gain from scene to scene (ageing, temperature, radome), uniform within.
GAIN_DB = 3.0
#: Folder, seed of the series, first scene, number of scenes.
ShardJob = tuple[Path, int, int, int]


@dataclass(frozen=True)
class Labels:
    """Truth points of one scene, strongest first, N of them."""

    range_m: np.ndarray
    azimuth_rad: np.ndarray
    #: `PathClass` values, uint8.
    path_class: np.ndarray
    #: True place of each point in the radar's frame, [N, 2]; a direct point's own.
    hidden_xy_m: np.ndarray
    #: Power in the beam that sees it best.
    power_mw: np.ndarray


def clean_profiles(setup: RadarSetup, paths: Paths, range_bins: int = RANGE_BINS) -> np.ndarray:
    """Windowed range profiles of all beams without noise, sqrt(mW), complex128 [beams, bins]."""
    return beam_weights(setup, paths) @ range_profile(setup.radar, paths.length_m, range_bins, WINDOW)


def profile_noise(setup: RadarSetup, seed: int, range_bins: int = RANGE_BINS) -> np.ndarray:
    """Receiver noise of all beams as the profiles see it: white per bin, then the window's taps; [beams, bins]."""
    radar, taps = setup.radar, WINDOW_TAPS[WINDOW]
    power = radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam)
    rng = np.random.default_rng([seed, 6])
    draws = rng.standard_normal((2, len(setup.beams), range_bins + len(taps) - 1)) * np.sqrt(0.5 * power)
    white = draws[0] + 1j * draws[1]
    return sum(tap * white[:, i : i + range_bins] for i, tap in enumerate(taps))


def noise_power_mw(setup: RadarSetup) -> float:
    """Mean noise power of one profile bin, mW."""
    radar = setup.radar
    return radar.noise_power_mw * window_noise_gain(WINDOW) / (radar.samples_per_chirp * radar.chirps_per_beam)


def simulate_profiles(scene: Scene, seed: int, gain_db: float = 0.0) -> tuple[np.ndarray, float, SceneTruth]:
    """One scan of a scene at rest: (profiles complex64 [beams, 512], noise power a bin in mW, truth).

    `gain_db` scales the echoes, not the noise. Raises ValueError for a scene that moves.
    """
    profiles, _, truth = _simulate(scene, seed, gain_db)
    return profiles, noise_power_mw(scene.setup), truth


def _simulate(scene: Scene, seed: int, gain_db: float) -> tuple[np.ndarray, Labels, SceneTruth]:
    """Profiles, labels and truth of one scan."""
    if scene.moves:
        raise ValueError(f"scene {scene.name!r} must be at rest for the kernel level, got one that moves")
    setup, world = scene.setup, prepare(scene, seed)
    paths = trace(world)
    gain = ratio_from_db(gain_db)
    profiles = np.sqrt(gain) * clean_profiles(setup, paths) + profile_noise(setup, seed)
    truth = scene_truth(world, setup, paths, 0.0, 0, 0)
    return profiles.astype(np.complex64), label_points(setup, paths, gain), truth


def label_points(setup: RadarSetup, paths: Paths, gain: float = 1.0) -> Labels:
    """The truth points of traced paths as training labels."""
    chosen = paths.take(visible_paths(setup, paths))
    return Labels(
        range_m=(0.5 * chosen.length_m).astype(np.float32),
        azimuth_rad=chosen.azimuth_rad.astype(np.float32),
        path_class=chosen.kind,
        hidden_xy_m=chosen.point_m[:, :2].astype(np.float32),
        power_mw=(gain * best_power_mw(setup, chosen)).astype(np.float32),
    )


def write_dataset(
    out_dir: Path,
    count: int,
    seed: int,
    workers: int = 1,
    on_progress: Callable[[int], None] | None = None,
) -> Path:
    """Write `count` random street scenes as npz shards and a manifest; returns the manifest's path.

    Shards already there are kept (an interrupted run goes on); bytes do not depend on `workers`. `on_progress` hears
    how many scenes are done after each shard. Raises ValueError for a bad count, or a folder that holds another
    data set. Arrays of a shard: profiles c8 [n, 25, 512], noise_power_mw [n], gain_db [n], scene_yaml [n],
    offset int64 [n + 1] into the points' range_m, azimuth_rad, path_class, hidden_xy_m, power_mw.
    """
    for name, value in (("count", count), ("workers", workers)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value!r}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed!r}")
    out_dir.mkdir(parents=True, exist_ok=True)
    _claim(out_dir, seed)
    firsts = range(0, count, SCENES_PER_SHARD)
    jobs = [(out_dir, seed, first, min(SCENES_PER_SHARD, count - first)) for first in firsts]
    lines, done = [], 0
    for line in _run(jobs, workers):
        lines.append(line)
        done += line["scenes"]
        if on_progress is not None:
            on_progress(done)
    manifest = out_dir / "manifest.jsonl"
    _write_whole(manifest, b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
    return manifest


def read_shard(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a shard."""
    with np.load(path, allow_pickle=False) as shard:
        return {name: shard[name] for name in shard.files}


def _run(jobs: list[ShardJob], workers: int) -> Iterator[dict[str, Any]]:
    """Manifest lines of all shards, in order."""
    if workers == 1:
        yield from map(_write_shard, jobs)
        return
    # fresh processes: a fork would copy the locks of threads it does not copy
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_write_shard, jobs)


def _write_shard(job: ShardJob) -> dict[str, Any]:
    """Simulate one shard unless it is there; its manifest line."""
    out_dir, seed, first, count = job
    path = out_dir / f"shard-{first // SCENES_PER_SHARD:05d}.npz"
    if not path.exists() or len(read_shard(path)["noise_power_mw"]) != count:
        arrays = _shard_arrays(seed, first, count)
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"shard": path.name, "seed": seed, "first_scene": first, "scenes": count, "sha256": digest}


def _shard_arrays(seed: int, first: int, count: int) -> dict[str, np.ndarray]:
    """Arrays of scenes first..first+count-1 of a series."""
    profiles, labels, texts, gains, noise = [], [], [], [], []
    for index in range(first, first + count):
        scene = random_street(seed, index)
        gain_db = float(np.random.default_rng([seed, index, 7]).uniform(-GAIN_DB, GAIN_DB))
        sample, points, _ = _simulate(scene, _scene_seed(seed, index), gain_db)
        profiles.append(sample)
        labels.append(points)
        texts.append(scene_to_yaml(scene))
        gains.append(gain_db)
        noise.append(noise_power_mw(scene.setup))
    return {
        "profiles": np.stack(profiles),
        "noise_power_mw": np.array(noise),
        "gain_db": np.array(gains),
        "scene_yaml": np.array(texts),
        "offset": np.concatenate([[0], np.cumsum([len(points.range_m) for points in labels])]).astype(np.int64),
        **{name: np.concatenate([getattr(points, name) for points in labels]) for name in Labels.__dataclass_fields__},
    }


def _scene_seed(seed: int, index: int) -> int:
    """One integer that names a scene's speckle and noise."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0])


def _claim(out_dir: Path, seed: int) -> None:
    """Write down whose folder this is; ValueError where it is another series'."""
    path = out_dir / "series.json"
    wanted = {"seed": seed, "scenes_per_shard": SCENES_PER_SHARD}
    if path.exists():
        found = msgspec.json.decode(path.read_bytes())
        if found != wanted:
            raise ValueError(f"{out_dir} holds another data set ({found}), wanted {wanted}")
    _write_whole(path, msgspec.json.encode(wanted))


def _write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    part = path.with_suffix(".part")
    part.write_bytes(content)
    part.replace(path)
