"""Data sets at the kernel level: scenes of a series as range profiles with labels, in resumable shards.

A new data set has all four types of place (`sim_player.generate.places.random_place`), and for each scene the effects
that its map calls for under -20 dB. `shift="hard"` is the second test set: the same places rougher and fuller, seen by
a faulty board (`sim_player.dataset.domain_shift`).

A folder holds `series.json` (generator, preset, effects, budget, purpose, shift: another series is refused), shards,
and `manifest.jsonl` (a line a shard, with its SHA-256). Arrays of a shard of n scenes:

- profiles c8 [n, beams, 512], noise_power_mw [n] (thermal, a bin), gain_db [n] of the echoes, scene_yaml [n];
- facts [n]: JSON with place, relays, objects (classes), hidden (indices of those seen in mirrors alone), surfaces, and
  where asked (`Recipe.truth`) truth, all objects with their boxes, walls and map_walls (`environment/walls`), those of
  the scene as they are and as a poor map has them;
- plan [n]: JSON with the effects used, the number of paths and, for planned scenes, bound and reason of every effect;
- offset int64 [n + 1] into the points of all scenes: range_m, azimuth_rad, path_class, hidden_xy_m, power_mw, order,
  range_bin, azimuth_bin, point_m, image_m, object_index, object_class (`sim_player.dataset.labelled_scan.Labels`);
- of drives alone (`Recipe.scans`): a scene is a scan. sequence names its drive, scan its number there, stamp_ns the
  time of its first beam; pose [n, 3] is the radar's (x, y, yaw) in its frame at the drive's start, motion [n, 2] speed
  and yaw rate, both true; odometry [n, 15, 3] the states (time after the stamp, speed, yaw rate) of its noisy bus. The
  first of them took the vehicle's motion out of the profiles. `truth` in the facts lists all objects at the stamp with
  their velocities; object_index is their number in every scan. Labels say where the scan's map shows an echo, at the
  time of the beam that looks at it: elapsed_s after the stamp, velocity_mps [.., 2] over ground in the radar's frame.
  radial_speed_cmps int16 [n, beams, 512] is what the former measures of each bin (`msgs.values.radar.speed_codes`);
- of a shifted series alone: missing_beams bool [n, beams], whose profiles hold zeros; beam_gain c16 [n, beams], the
  board's errors, which a receiver does not know.

Bytes depend neither on the executor nor on the number of workers nor on interruptions.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from msgs.files.whole_files import require_room, write_whole
from sim_player.dataset.executors import Executor, map_jobs
from sim_player.dataset.shards import Recipe, ShardDone, ShardJob, make_shard, shard_done, shard_fault

DEFAULT = Recipe()


def write_dataset(
    out_dir: Path,
    count: int,
    seed: int,
    recipe: Recipe = DEFAULT,
    workers: int = 1,
    on_shard: Callable[[ShardDone], None] | None = None,
    executor: Executor = "local",
    slurm: dict[str, Any] | None = None,
) -> Path:
    """Write the first `count` scenes or drives of a series as npz shards and a manifest, whose path it returns.

    Whole shards are kept, others made again. ValueError for a bad count or seed, and a folder of another series or of
    more scenes; OSError with the file's name; what `executors.map_jobs` raises.
    """
    for name, value, least in (("count", count, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value!r}")
    out_dir = out_dir.resolve()
    out_dir.mkdir(parents=True, exist_ok=True)
    _claim(out_dir, recipe.described(seed))
    for part in out_dir.glob("*shard-*.part"):
        # of a run that was killed
        part.unlink(missing_ok=True)
    manifest = _Manifest(out_dir / "manifest.jsonl")
    size, scenes = recipe.shard_scenes, count * (recipe.scans or 1)
    jobs = [
        ShardJob(folder=out_dir, recipe=recipe, seed=seed, first=first, count=min(size, scenes - first))
        for first in range(0, scenes, size)
    ]
    # training would read scenes beyond those requested too
    counts = {job.path.name: job.count for job in jobs}
    beyond = {path.name for path in out_dir.glob("shard-*.npz")} - counts.keys()
    beyond |= {shard for shard, line in manifest.lines.items() if line["scenes"] > counts.get(shard, 0)}
    if beyond:
        raise ValueError(f"count must not be below what {out_dir} holds ({max(beyond)}), got {count}")
    missing = []
    for job in jobs:
        fault = shard_fault(job, manifest.sha256(job))
        if fault is not None:
            missing.append(msgspec.structs.replace(job, fault=fault))
            continue
        manifest.add(shard_done(job, "kept"), on_shard)
    require_room(manifest.path, sum(job.count for job in missing) * recipe.scene_bytes)
    for done in map_jobs(make_shard, missing, executor, workers, out_dir / ".slurm", slurm):
        manifest.add(done, on_shard)
        # at once: a run resumed after a kill checks against it
        manifest.write()
    manifest.write()
    return manifest.path


class _Manifest:
    """Lines of the manifest by shard, those of an earlier run until they are replaced."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines = path, _read_manifest(path)

    def sha256(self, job: ShardJob) -> str | None:
        """Return the checksum of a shard as long as it should be, if it is known."""
        line = self.lines.get(job.path.name, {})
        return line["sha256"] if line.get("scenes") == job.count else None

    def add(self, done: ShardDone, on_shard: Callable[[ShardDone], None] | None) -> None:
        """Add one shard."""
        self.lines[done.shard] = done.manifest_line
        if on_shard is not None:
            on_shard(done)

    def write(self) -> None:
        """Write all lines, whole or not at all."""
        ordered = sorted(self.lines.values(), key=lambda line: line["first_scene"])
        write_whole(self.path, b"".join(msgspec.json.encode(line) + b"\n" for line in ordered))


def _read_manifest(manifest: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of a manifest by shard; none where it cannot be read."""
    names = ("shard", "first_scene", "scenes", "sha256")
    try:
        lines = [msgspec.json.decode(line) for line in manifest.read_bytes().splitlines()]
        return {line["shard"]: {name: line[name] for name in names} for line in lines}
    except (OSError, msgspec.DecodeError, UnicodeError, RecursionError, KeyError, TypeError):
        return {}


def _claim(out_dir: Path, series: dict[str, Any]) -> None:
    """Write the series of this folder; ValueError where it belongs to another series."""
    path = out_dir / "series.json"
    if not path.exists():
        if any(out_dir.glob("shard-*.npz")):
            raise ValueError(f"{out_dir} holds shards but no series.json that says of which data set")
        write_whole(path, msgspec.json.encode(series))
        return
    try:
        existing = msgspec.json.decode(path.read_bytes(), type=dict)
    except msgspec.DecodeError:
        raise ValueError(f"{path} must say which data set the folder holds, cannot be read") from None
    names = sorted(name for name in existing.keys() | series.keys() if existing.get(name) != series.get(name))
    if names:
        differs = "; ".join(f"{name} {existing.get(name)!r}, wanted {series.get(name)!r}" for name in names)
        raise ValueError(f"{out_dir} holds another data set: {differs}")
