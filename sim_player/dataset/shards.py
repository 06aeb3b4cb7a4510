"""Shards of a data set: the scenes of a series, one npz file for some of them, written whole or not at all."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from msgs.files.array_files import load_arrays
from msgs.files.whole_files import whole
from msgs.values.environment import PriorWall
from msgs.values.frames import Pose2
from msgs.values.radar import speed_codes
from msgs.values.units import ratio_from_db
from msgs.values.wording import counted
from sim_player.dataset.domain_shift import HARD, SHIFTS, Shift, domain_shifted_scene, draw_faults, faulty_profiles
from sim_player.dataset.labelled_drive import DriveScan, LabelledDrive
from sim_player.dataset.labelled_scan import (
    LABELS,
    EffectChoice,
    LabelledScan,
    Labels,
    labelled_scan,
    noise_power_mw,
    stronger,
)
from sim_player.effects.table import check_effects
from sim_player.generate.drives import STREET_MIX, draw_drive
from sim_player.generate.layouts import PlaceKind
from sim_player.generate.places import draw_place
from sim_player.generate.wall_kinds import Preset
from sim_player.planner.purposes import Purpose, purpose_of
from sim_player.scene.description import PRESETS, Scene, scene_to_yaml
from sim_player.scene.wall_priors import POOR, scene_walls
from sim_player.signal.levels import RANGE_BINS

#: Any type of place or one of them.
Places = Literal["any", "street", "parking_lot", "residential_block", "mixed_intersection"]
PLACES: tuple[Places, ...] = get_args(Places)
SCENES_PER_SHARD = 50
#: Half a minute at the default radar: a longer drive hardly fits a place.
MAX_SCANS = 100
#: Grows whenever the same series would give other scenes, signals or labels than before.
FORMAT = 5
#: Spread of the radar's gain from scene to scene (ageing, temperature, radome), uniform within.
GAIN_DB = 3.0
#: Scene, facts and plan in a shard, as text in UTF-32.
_SCENE_TEXT_BYTES = 50_000
#: Errors of reading a file that is not a whole shard.
UNREADABLE = (OSError, ValueError, KeyError)


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters that fix the bytes of a data set beside its seed and length; ValueError names an invalid one.

    effects: "auto" (planned per scene for a `purpose` under `budget_db`), "all", "basic" (the chain of
    `sim_player.signal.fmcw`), or names; None: "auto". purpose: a word of `sim_player.planner.purposes`, for plans
    alone, None: "objects"; labels are those of all effects. shift: "hard" makes the places rougher and fuller, and the
    board faulty (`sim_player.dataset.domain_shift`), whose faults are those of steered beams. scans: a scene is one of
    so many consecutive scans of a drive (`sim_player.generate.drives`) at its true pace; None: a place at rest. truth:
    the facts list all objects, as those of drives always do.
    """

    places: Places = "any"
    preset: Preset = "xband"
    effects: str | tuple[str, ...] | None = None
    budget_db: float = -20.0
    purpose: str | None = None
    shift: Shift = "none"
    scans: int | None = None
    truth: bool = False
    scenes_per_shard: int = SCENES_PER_SHARD
    format: int = FORMAT

    def __post_init__(self) -> None:
        for name, words in (("places", PLACES), ("preset", tuple(PRESETS)), ("shift", SHIFTS)):
            if getattr(self, name) not in words:
                raise ValueError(f"{name} must be one of {', '.join(words)}, got {getattr(self, name)!r}")
        if self.shift == "hard" and PRESETS[self.preset].array.digital:
            raise ValueError(
                f"shift must be none for preset {self.preset}: a digital array has no beams that fail one by one, "
                f"got {self.shift!r}"
            )
        if not -200.0 <= self.budget_db < 0.0:
            raise ValueError(f"budget_db must be negative and at least -200, got {self.budget_db!r}")
        if self.scenes_per_shard < 1:
            raise ValueError(f"scenes_per_shard must be at least 1, got {self.scenes_per_shard!r}")
        if isinstance(self.effects, tuple) and self.effects:
            check_effects(frozenset(self.effects))
        elif self.effects not in (None, "auto", "all", "basic"):
            got = repr(self.effects) if self.effects else "nothing"
            raise ValueError(f"effects must be auto, all, basic or a list of names, got {got}")
        if self.purpose is not None and purpose_of(self.purpose) is not Purpose.SAMPLES and self.choice != "auto":
            raise ValueError(f"purpose must be samples unless effects are auto, got {self.purpose!r}")
        if self.scans is None:
            return
        if not 1 <= self.scans <= MAX_SCANS:
            raise ValueError(f"scans must be 1..{MAX_SCANS}, got {self.scans!r}")
        if self.shift != "none":
            raise ValueError(f"shift must be none for drives, got {self.shift!r}")
        if self.truth:
            raise ValueError("truth must not be asked of drives: they always have it, got True")

    @property
    def choice(self) -> EffectChoice:
        """The effects as `labelled_scan` takes them."""
        if isinstance(self.effects, tuple):
            return frozenset(self.effects)
        return self.effects or "auto"  # type: ignore[return-value]

    @property
    def planned_for(self) -> str:
        """The purpose of planned effects, by default what perception needs."""
        return self.purpose or (Purpose.OBJECTS if self.choice == "auto" else Purpose.SAMPLES).value

    @property
    def kind(self) -> PlaceKind | None:
        """The type of place, None for any."""
        return None if self.places == "any" else self.places

    @property
    def shard_scenes(self) -> int:
        """Scenes of a full shard: whole drives."""
        scans = self.scans or 1
        return max(self.scenes_per_shard // scans, 1) * scans

    @property
    def scene_bytes(self) -> int:
        """Approximate size of a scene in a shard: its profiles, its YAML, its plan."""
        setup = PRESETS[self.preset]
        return len(setup.beams) * RANGE_BINS * np.dtype(np.complex64).itemsize + _SCENE_TEXT_BYTES

    def described(self, seed: int) -> dict[str, Any]:
        """Return a series as `series.json` states it: the generator by name, effects resolved, a budget if used."""
        choice = self.choice
        plain = msgspec.to_builtins(self) | {"seed": seed}
        plain["effects"] = sorted(choice) if isinstance(choice, frozenset) else choice
        plain["budget_db"] = self.budget_db if choice == "auto" else None
        plain["generator"] = "random_place"
        # series older than the shift have no such field, nor than drives, their truth or purposes (samples)
        del plain["shift"], plain["scans"], plain["truth"], plain["purpose"]
        if choice == "auto":
            plain["purpose"] = self.planned_for
        if self.truth:
            plain |= {"truth": True, "walls": True}
        if self.scans is not None:
            plain |= {"generator": "random_drive", "motion": True, "scans": self.scans, "class_mix": STREET_MIX}
            plain["radial_speeds"] = True
        if self.shift == "hard":
            # as JSON gives it back: lists, no tuples
            plain["shift"] = {"name": self.shift} | msgspec.json.decode(msgspec.json.encode(HARD))
        return dict(sorted(plain.items()))


class ShardJob(msgspec.Struct, frozen=True, kw_only=True):
    """Job of one shard: folder, recipe and seed, first scene and count; the reason to make it again."""

    folder: Path
    recipe: Recipe
    seed: int
    first: int
    count: int
    fault: str = ""

    @property
    def path(self) -> Path:
        """The shard's file."""
        return self.folder / f"shard-{self.first // self.recipe.shard_scenes:05d}.npz"


class ShardDone(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one shard: kept, made, or made again with the reason."""

    shard: str
    first_scene: int
    scenes: int
    sha256: str
    state: Literal["kept", "made", "rewritten"]
    reason: str = ""

    @property
    def manifest_line(self) -> dict[str, Any]:
        """Its line of the manifest, which leaves out its state."""
        return {"shard": self.shard, "first_scene": self.first_scene, "scenes": self.scenes, "sha256": self.sha256}


def make_shard(job: ShardJob) -> ShardDone:
    """Simulate and write one shard; OSError names the file."""
    # sums split among threads round differently: the bytes would depend on the number of threads
    with threadpool_limits(limits=1, user_api="blas"):
        arrays = shard_arrays(job.recipe, job.seed, job.first, job.count)
    with whole(job.path) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())
    return shard_done(job, "rewritten" if job.fault else "made")


def shard_done(job: ShardJob, state: Literal["kept", "made", "rewritten"]) -> ShardDone:
    """Return the result of a shard on disk."""
    return ShardDone(
        shard=job.path.name,
        first_scene=job.first,
        scenes=job.count,
        sha256=file_sha256(job.path),
        state=state,
        reason=job.fault,
    )


def shard_fault(job: ShardJob, sha256: str | None) -> str | None:
    """Return why to make a shard: "" where it is missing, else its fault by checksum and reading; None: no reason."""
    if not job.path.exists():
        return ""
    try:
        scenes = len(read_shard(job.path)["noise_power_mw"])
    except UNREADABLE as error:
        return f"cannot be read: {' '.join(str(error).split())}"
    if scenes != job.count:
        return "" if scenes < job.count else f"holds {counted(scenes, 'scene')} instead of {job.count}"
    if sha256 not in (None, file_sha256(job.path)):
        return "differs from its checksum in the manifest"
    return None


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_shard(path: Path) -> dict[str, np.ndarray]:
    """Return all arrays of a shard; raises `ValueError` where it is none, `OSError` where it cannot be read."""
    return load_arrays(path)


def shard_arrays(recipe: Recipe, seed: int, first: int, count: int) -> dict[str, np.ndarray]:
    """Return the arrays of scenes first..first+count-1 of a series, as listed in `sim_player.dataset.writer`."""
    columns: dict[str, list[Any]] = {}
    labels: list[Labels] = []
    rows = _place_rows(recipe, seed, first, count) if recipe.scans is None else _drive_rows(recipe, seed, first, count)
    for points, row in rows:
        labels.append(points)
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    by_point = {name: np.concatenate(columns.pop(name)) for name in ("velocity_mps", "elapsed_s") if name in columns}
    board = {name: np.array(columns.pop(name)) for name in ("missing_beams", "beam_gain") if name in columns}
    offset = np.concatenate([[0], np.cumsum([len(points.range_m) for points in labels])]).astype(np.int64)
    joined = {name: np.concatenate([getattr(points, name) for points in labels]) for name in LABELS}
    by_scene = {name: np.array(values) for name, values in columns.items()}
    return by_scene | by_point | {"offset": offset, **joined} | board


def _place_rows(recipe: Recipe, seed: int, first: int, count: int) -> Iterator[tuple[Labels, dict[str, Any]]]:
    """Yield the labels and the other columns of scenes at rest."""
    for index in range(first, first + count):
        scene, place = draw_scene(recipe, seed, index)
        gain_db, scan_seed = draw_gain_db(seed, index), scene_seed(seed, index)
        scan = labelled_scan(scene, scan_seed, recipe.choice, recipe.budget_db, gain_db, recipe.planned_for)
        listed = {"truth": scan.objects} | _walls(scene, scan_seed) if recipe.truth else {}
        row = {
            "profiles": scan.profiles,
            "noise_power_mw": noise_power_mw(scene.setup),
            "gain_db": gain_db,
            "scene_yaml": scene_to_yaml(scene),
            "facts": msgspec.json.encode(place | {"hidden": scan.hidden} | scene_facts(scene) | listed),
            "plan": _plan_line(recipe, scan),
        }
        if recipe.shift == "hard":
            board = draw_faults(shift_rng(seed, index, 1), len(scan.profiles))
            row["profiles"] = faulty_profiles(scan.profiles, board, scene.setup, scan_seed)
            row |= {"missing_beams": board.dead, "beam_gain": board.gain}
        yield scan.labels, row


def _walls(scene: Scene, seed: int, start_from_radar: Pose2 | None = None) -> dict[str, tuple[PriorWall, ...]]:
    """Return the walls of a place in the radar's frame (None: at rest): exact, and as a poor map has them."""
    return {
        name: scene_walls(scene, start_from_radar or Pose2(), 0, seed, errors).walls
        for name, errors in (("walls", None), ("map_walls", POOR))
    }


def _drive_rows(recipe: Recipe, seed: int, first: int, count: int) -> Iterator[tuple[Labels, dict[str, Any]]]:
    """Yield the labels and the other columns of scans, all scans of a drive together."""
    scans = recipe.scans or 1
    duration_s = scans * PRESETS[recipe.preset].radar.scan_period_s
    effects = ",".join(sorted(recipe.choice)) if isinstance(recipe.choice, frozenset) else recipe.choice
    for index in range(first // scans, (first + count) // scans):
        place, gain_db = draw_drive(seed, index, recipe.preset, duration_s, recipe.kind), draw_gain_db(seed, index)
        scene, setup = place.scene, stronger(place.scene.setup, ratio_from_db(gain_db))
        drive = LabelledDrive(scene, scene_seed(seed, index), setup, effects, recipe.budget_db, recipe.planned_for)
        for number in range(scans):
            scan = drive.scan(number)
            facts = {"place": place.kind, "relays": place.relays, "hidden": scan.hidden} | scene_facts(scene)
            walls = _walls(scene, scene_seed(seed, index), scan.start_from_radar)
            yield (
                scan.labels,
                {
                    "profiles": scan.profiles,
                    "radial_speed_cmps": speed_codes(scan.radial_speed_mps),
                    "noise_power_mw": noise_power_mw(setup),
                    "gain_db": gain_db,
                    "scene_yaml": scene_to_yaml(scene),
                    "facts": msgspec.json.encode(facts | {"truth": scan.objects} | walls),
                    "plan": _plan_line(recipe, scan),
                    "velocity_mps": scan.velocity_mps,
                    "elapsed_s": scan.elapsed_s,
                    "sequence": f"drive_{seed}_{index}",
                    "scan": number,
                    "stamp_ns": scan.stamp_ns,
                    "pose": (scan.start_from_radar.x_m, scan.start_from_radar.y_m, scan.start_from_radar.yaw_rad),
                    "motion": (scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps)),
                    "odometry": scan.odometry,
                },
            )


def draw_scene(recipe: Recipe, seed: int, index: int) -> tuple[Scene, dict[str, Any]]:
    """Return the scene number `index` of a series, with its type of place and the kinds of its walls."""
    place = draw_place(seed, index, recipe.preset, recipe.kind)
    scene, facts = place.scene, {"place": place.kind, "relays": place.relays}
    if recipe.shift == "hard":
        scene = domain_shifted_scene(scene, shift_rng(seed, index, 0))
    return scene, facts


def scene_facts(scene: Scene) -> dict[str, Any]:
    """Return the facts of a scene, so that its YAML need not be read."""
    names = ("role", "material", "roughness_mm", "curvature_per_m")
    return {
        "objects": [scene_object.object_class for scene_object in scene.objects],
        "surfaces": [{name: getattr(surface, name) for name in names} for surface in scene.surfaces],
    }


def draw_gain_db(seed: int, index: int) -> float:
    """Return the radar's gain in a scene."""
    return float(np.random.default_rng([seed, index, 7]).uniform(-GAIN_DB, GAIN_DB))


def scene_seed(seed: int, index: int) -> int:
    """Return one integer that names a scene's speckle and noise."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0])


def _plan_line(recipe: Recipe, scan: LabelledScan | DriveScan) -> bytes:
    """Return the effects of a scan and, where they were planned, the reasons."""
    line: dict[str, Any] = {"used": sorted(scan.used), "paths": scan.paths}
    plan = scan.plan
    if plan is not None:
        line |= {"traced": plan.traced, "plan": msgspec.to_builtins(plan.effects)}
    if plan is not None and recipe.choice == "auto":
        line |= {"budget_db": plan.budget_db, "spent_db": plan.spent_db, "purpose": plan.purpose}
    return msgspec.json.encode(line)


def shift_rng(seed: int, index: int, part: int) -> np.random.Generator:
    """Return the generator of a scene's shift, apart from those of the scene: part 0 its place, 1 its board."""
    return np.random.default_rng([seed, index, 11, part])
