"""Runs profiles over seeded random places, beam by beam as the graph does: one file a place, so that a run goes on."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from lab.evaluate.labelled_beams import LabelledPlace, TracedBy
from lab.measures.object_rows import ImageTruth, ScanRow, scan_row
from lab.studies.resumable import ResumableRun
from lab.tradeoff.rows import Setting
from mirrorwave.node_chain import SharedParts
from models.perception.chain import Chain
from models.perception.mirrors.observability import visibility_at
from msgs.files.shipped import LAUNCH
from msgs.values.environment import WallPriors
from msgs.values.perception import BevFrame, SceneTruth, Visibility
from msgs.values.radar import PRESETS
from msgs.values.units import s_from_ns
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at
from sim_player.dataset.domain_shift import Shift
from sim_player.dataset.executors import map_jobs
from sim_player.dataset.shards import MAX_SCANS, scene_seed
from sim_player.paths.truth import object_images
from sim_player.player import ScenePlayer
from sim_player.scene.description import scene_sha256
from sim_player.scene.wall_priors import WallKnowledge, known_walls

#: Committed sets, and what their choices minimise.
SETS = LAUNCH / "evaluation" / "object_sets.yaml"


class ObjectSet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Places 0..places-1 of the series of a seed, one scan each, or drives."""

    seed: int
    places: int
    #: Radar and road users move.
    moving: bool = False
    effects: str = "all"
    #: More than one: drives of so many scans, in motion.
    scans: int = 1
    #: As of `sim dataset --shift`.
    shift: Shift = "none"
    #: "foreign": traced by the foreign tracer (extra `foreign`), at rest and not shifted.
    world: TracedBy = "own"
    #: Over the SHA-256 of each scene (`scene_sha256`); empty: not checked.
    scenes_sha256: str = ""

    def __post_init__(self) -> None:
        if self.places < 1:
            raise ValueError(f"places must be at least 1, got {self.places}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if not 1 <= self.scans <= MAX_SCANS:
            raise ValueError(f"scans must be 1..{MAX_SCANS}, got {self.scans}")
        if self.world == "foreign" and (self.moving or self.scans > 1 or self.shift != "none"):
            raise ValueError("world: foreign needs places at rest without a shift, got others")

    def place(self, index: int) -> LabelledPlace:
        """Return one place of the set."""
        return LabelledPlace(self.seed, index, self.effects, self.moving, self.scans, self.shift, self.world)


class ObjectSets(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The committed sets by name; a false report costs so many missed objects."""

    false_cost: float
    sets: dict[str, ObjectSet]


class ObjectPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Plan that fixes the rows of a run."""

    set: ObjectSet
    profiles: list[Setting]
    #: Walls of a map that the profiles are given.
    walls: WallKnowledge = "none"


class PlaceResult(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Results of all profiles at one place, a row a scan."""

    place: int
    scene_sha256: str
    rows: dict[str, list[ScanRow]]


def read_sets(path: Path = SETS) -> ObjectSets:
    """Read the committed sets; `ValueError` names the file and the field."""
    return convert_at(read_yaml_mapping(path), ObjectSets, str(path))


def run_objects(
    plan: ObjectPlan, out: Path, workers: int = 1, on_place: Callable[[], None] = lambda: None
) -> list[PlaceResult]:
    """Measure the places that `out` does not hold yet; the results of all, in order, whatever the workers.

    Raises `ValueError` where `out` holds another run or the places are not those of the set.
    """
    run = ResumableRun(
        plan, out, PlaceResult, {index: f"places/place-{index:05d}.json" for index in range(plan.set.places)}
    )
    missing = [(plan, index) for index in run.missing(on_place)]
    for result in map_jobs(measure_place, missing, workers=workers):
        run.keep(result.place, result)
        on_place()
    results = run.results()
    wanted, got = plan.set.scenes_sha256, scenes_sha256(results)
    if wanted not in ("", got):
        raise ValueError(f"{out}: scenes_sha256 of the places must be {wanted} as the set says, got {got}")
    return results


def scenes_sha256(results: Sequence[PlaceResult]) -> str:
    """Hash of all scenes, in order."""
    return hashlib.sha256(b"".join(bytes.fromhex(result.scene_sha256) for result in results)).hexdigest()


def measure_place(job: tuple[ObjectPlan, int]) -> PlaceResult:
    """Play the scans of a place and let every profile look at the same beams."""
    plan, index = job
    place = plan.set.place(index)
    # sums split among threads round in another way: rows would tell how many there were
    with threadpool_limits(1, "blas"):
        player = place.player
        truths = [(player.truth(scan), image_truth(player, scan)) for scan in range(place.scans)]
        views = _views(place, plan.profiles, plan.walls)
    return PlaceResult(
        place=index,
        scene_sha256=scene_sha256(player.scene),
        rows={
            name: [_row(index, frames.get(truth.scan_id), truth, images) for truth, images in truths]
            for name, frames in views.items()
        },
    )


def _row(place: int, frame: BevFrame | None, truth: SceneTruth, images: Sequence[ImageTruth]) -> ScanRow:
    """Result of one scan; without a view nothing is reported."""
    if frame is None:
        return scan_row(place, (), truth, images)
    return scan_row(place, frame.objects, truth, images, frame.tracks, _promised(frame, truth))


def _promised(frame: BevFrame, truth: SceneTruth) -> list[bool]:
    """Whether the view calls the place of each object observable by a mirror."""
    at_m = np.array([(item.x_m, item.y_m) for item in truth.objects], np.float64).reshape(-1, 2)
    states = visibility_at(frame.visibility, frame.grid, at_m)
    return [bool(state == Visibility.MIRRORED) for state in states]


def _views(place: LabelledPlace, settings: Sequence[Setting], walls: WallKnowledge) -> dict[str, dict[int, BevFrame]]:
    """Views that each profile has of the scans; the vehicle's states are the true ones."""
    chains: dict[str, Chain] = {setting.value: _parts(msgspec.json.encode(setting)).chain() for setting in settings}
    views: dict[str, dict[int, BevFrame]] = {name: {} for name in chains}
    for scan in range(place.scans):
        if walls != "none":
            message = _map_walls(place, scan, walls)
            for chain in chains.values():
                chain.views.add_walls(message)
        for beam in place.beams(scan):
            state = place.player.vehicle_state(beam.stamp_ns)
            for name, chain in chains.items():
                views[name] |= {view.frame.scan_id: view.frame for view in chain.add(beam, state)}
    for name, chain in chains.items():
        views[name] |= {view.frame.scan_id: view.frame for view in chain.flush()}
    return views


def _map_walls(place: LabelledPlace, scan: int, walls: WallKnowledge) -> WallPriors:
    """Walls that a map tells the vehicle when a scan begins."""
    player, stamp_ns = place.player, place.player.stamp_ns(scan)
    time_s = s_from_ns(stamp_ns - player.stamp_ns(0))
    return known_walls(player.scene, time_s, stamp_ns, scene_seed(place.seed, place.index), walls)


@lru_cache(maxsize=64)
def _parts(setting: bytes) -> SharedParts:
    """Parts of a profile, loaded once a process; they know the nominal power, not how far off this radar's is."""
    return SharedParts.of(msgspec.json.decode(setting, type=Setting).params, PRESETS["xband"])


def image_truth(player: ScenePlayer, scan: int = 0, stamp_ns: int | None = None) -> list[ImageTruth]:
    """Return the visible truth of each object of a scene at a time; None: when a scan begins."""
    at_ns = player.stamp_ns(scan) if stamp_ns is None else stamp_ns
    paths = player.paths(s_from_ns(at_ns - player.setup.stamp_ns))
    images = object_images(player.setup, paths, len(player.scene.objects))
    return [
        ImageTruth(direct=bool(direct), mirrored=bool(mirrored), snr_db=_known(snr_db), single_snr_db=_known(single))
        for direct, mirrored, snr_db, single in zip(
            images.direct, images.mirrored, images.snr_db, images.single_snr_db, strict=True
        )
    ]


def _known(snr_db: float) -> float | None:
    return float(snr_db) if math.isfinite(snr_db) else None
