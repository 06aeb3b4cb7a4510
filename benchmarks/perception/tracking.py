"""Tracks of random drives, scored over cached views: what a tracker makes of the objects of a profile.

Drives are those of `sim dataset --motion` (`sim_player.generate.drives`) as raw beams with all effects; the vehicle's
states are the true ones. The chain runs once a drive and its views are kept under --out, so that a tracker is scored
again within seconds. `--tracker FILE` scores another module that has `Tracker` beside the one in use.

- Observable: out of direct sight when the scan begins, and a mirror shows it with an echo of 10 dB of SNR or more.
- Asked: road users that are observable in scans that span 1 s or more. From the scan on at which this second is over
  until the last observable one they should be tracked, in each scan. Of the drives of the series those are played in
  which any road user is asked for.
- Hit: a track within 2 m of such a road user (face error, `models.evaluation.object_error`), one to one.
- False: a track farther than 2.5 m from every road user's box. Tracks of road users in plain sight are counted apart.
- Id switch: the track on a road user is another than when it was last hit.
- Existence: share of the tracks, over scans, that stand within 2 m of a road user out of sight, by stated existence.
Usage: python -m benchmarks.perception.tracking --out DIR [--drives 48] [--seed 41907] [--profile default]
       [--workers 1] [--tracker FILE] [--json]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.accuracy.side_street import as_object
from mirrorwave.node_chain import SharedParts
from mirrorwave.studies.evaluate.objects import image_truth
from mirrorwave.studies.resumable import ResumableRun
from mirrorwave.studies.tradeoff.settings import profile_setting
from models.evaluation.metrics import assign_within
from models.evaluation.object_error import ObjectDistances, object_distances
from models.evaluation.object_rows import FALSE_M, NOTHING_M, ImageTruth
from models.perception.tracking import tracker as tracker_in_use
from models.perception.tracking.odometry import OdometryPose, ScanOdometry
from msgs.bus.codec import decode_inline, encode_inline
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, SceneTruth, Track
from msgs.values.radar import RadarSetup
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.dataset.executors import map_jobs
from sim_player.dataset.labelled_beams import LabelledPlace

SCANS = 12
EXISTENCE_EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.01)
OBSERVABLE_SNR_DB, OBSERVABLE_S = 10.0, 1.0


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """What fixes the views of a run."""

    seed: int
    drives: int
    profile: str
    scans: int = SCANS


class SavedScan(msgspec.Struct, frozen=True, kw_only=True):
    """One view with its truth, each as recordings hold it, and what mirrors show of its road users."""

    frame: bytes
    truth: bytes
    images: list[ImageTruth]


class SavedDrive(msgspec.Struct, frozen=True, kw_only=True):
    """All views of a drive at its constant motion."""

    index: int
    speed_mps: float
    yaw_rate_rps: float
    scans: list[SavedScan]


class Steps(Protocol):
    """What a tracker is asked."""

    def step(self, frame: BevFrame, pose: OdometryPose | None, vehicle_from_radar: Pose2 = ...) -> tuple[Track, ...]:
        """Return the tracks after a scan."""


def saved_drive(job: tuple[Plan, int]) -> SavedDrive:
    """Play a drive and keep the views of its scans; none where no road user is asked for."""
    plan, index = job
    place = LabelledPlace(plan.seed, index, "all", scans=plan.scans)
    with threadpool_limits(1):
        player = place.player
        truths = [(player.truth(number), image_truth(player, number)) for number in range(plan.scans)]
        stamps_ns = [truth.stamp_ns for truth, _ in truths]
        users = zip(*(images for _, images in truths), strict=True)
        is_asked = any(asked_scans(stamps_ns, user) for user in users)
        frames = _frames(plan, place) if is_asked else {}
    ego = player.scene.ego
    return SavedDrive(
        index=index,
        speed_mps=ego.speed_mps,
        yaw_rate_rps=math.radians(ego.yaw_rate_dps),
        scans=[
            SavedScan(frame=encode_inline(frames[truth.scan_id]), truth=encode_inline(truth), images=images)
            for truth, images in truths
            if truth.scan_id in frames
        ],
    )


def _frames(plan: Plan, place: LabelledPlace) -> dict[int, BevFrame]:
    """Return the views of a drive by the number of their scan."""
    chain, views = SharedParts.of(profile_setting(plan.profile).params, RadarSetup()).chain(), []
    for number in range(plan.scans):
        for beam in place.beams(number):
            views += chain.add(beam, place.player.vehicle_state(beam.stamp_ns))
    return {view.frame.scan_id: view.frame for view in [*views, *chain.flush()]}


def asked_scans(stamps_ns: Sequence[int], images: Sequence[ImageTruth]) -> range:
    """Return the numbers of the scans in which a road user should be tracked, of which mirrors show `images`."""
    observable = [number for number, image in enumerate(images) if is_observable(image)]
    if not observable:
        return range(0)
    known_ns = stamps_ns[observable[0]] + round(1e9 * OBSERVABLE_S)
    first = next((number for number, stamp_ns in enumerate(stamps_ns) if stamp_ns >= known_ns), len(stamps_ns))
    return range(first, observable[-1] + 1)


def is_observable(image: ImageTruth) -> bool:
    """Return whether a road user is out of sight and a mirror shows it well."""
    return not image.direct and image.mirrored and image.snr_db is not None and image.snr_db >= OBSERVABLE_SNR_DB


def saved_drives(plan: Plan, out: Path, workers: int) -> list[SavedDrive]:
    """Return the views of the drives in which a road user is asked for; what `out` holds is not played again."""
    run = ResumableRun(plan, out, SavedDrive, {index: f"drive-{index:03d}.msgpack" for index in range(plan.drives)})
    for drive in map_jobs(saved_drive, [(plan, index) for index in run.missing()], workers=workers):
        run.keep(drive.index, drive)
    return [drive for drive in run.results() if drive.scans]


class Scan(NamedTuple):
    """A view with its truth, the vehicle's pose and what mirrors show of each road user."""

    frame: BevFrame
    truth: SceneTruth
    pose: OdometryPose | None
    images: list[ImageTruth]


def scans_of(drive: SavedDrive) -> list[Scan]:
    """Return the scans of a saved drive, the vehicle's pose by its true states."""
    odometry, scans = ScanOdometry(), []
    for saved in drive.scans:
        frame, truth = decode_inline(BevFrame, saved.frame), decode_inline(SceneTruth, saved.truth)
        odometry.add(VehicleState(stamp_ns=frame.stamp_ns, speed_mps=drive.speed_mps, yaw_rate_rps=drive.yaw_rate_rps))
        scans.append(Scan(frame, truth, odometry.at(frame.stamp_ns), saved.images))
    return scans


class Hit(NamedTuple):
    """A track on a road user out of sight."""

    id: int
    face_m: float
    velocity_mps: float
    mahalanobis2: float


class DriveScore(NamedTuple):
    """One tracker on one drive."""

    duration_s: float
    #: Of each asked road user its hit in each scan in which it should be tracked.
    asked: list[list[Hit | None]]
    #: Whether each observable road user was hit, of all scans.
    observable: list[bool]
    #: Of each road user out of sight the ids of its tracks, in order of the scans.
    ids: list[list[int]]
    #: Where each track stood, scan by scan: "hidden", "plain sight" or "nothing".
    stands: dict[int, list[str]]
    #: Existence, and whether the track stood on a road user out of sight; of every track and scan.
    stated: list[tuple[float, bool]]


def scored(scans: Sequence[Scan], tracker: Steps) -> DriveScore:
    """Run a tracker over a drive."""
    hits: list[dict[int, Hit]] = []
    stands: dict[int, list[str]] = {}
    stated: list[tuple[float, bool]] = []
    for scan in scans:
        tracks = tracker.step(scan.frame, scan.pose)
        distances = object_distances([as_object(track) for track in tracks], scan.truth, scan.truth.objects)
        hidden = np.array([not image.direct for image in scan.images], bool)
        near = (np.where(hidden, distances.error_m, np.inf) <= FALSE_M).any(axis=1)
        hits.append(_hits(tracks, distances, hidden, scan.truth))
        for track, is_near, box_m in zip(tracks, near.tolist(), distances.box_m, strict=True):
            in_sight = "plain sight" if box_m.min(initial=np.inf) <= NOTHING_M else "nothing"
            stands.setdefault(track.id, []).append("hidden" if is_near else in_sight)
            if (existence := getattr(track, "existence", None)) is not None:
                stated.append((existence, is_near))
    count = len(scans[0].images)
    stamps_ns = [scan.frame.stamp_ns for scan in scans]
    spans = [asked_scans(stamps_ns, [scan.images[index] for scan in scans]) for index in range(count)]
    return DriveScore(
        duration_s=len(scans) * s_from_ns(scans[1].frame.stamp_ns - scans[0].frame.stamp_ns),
        asked=[[hits[number].get(index) for number in span] for index, span in enumerate(spans) if span],
        observable=[
            index in hit
            for scan, hit in zip(scans, hits, strict=True)
            for index, image in enumerate(scan.images)
            if is_observable(image)
        ],
        ids=[[hit[index].id for hit in hits if index in hit] for index in range(count)],
        stands=stands,
        stated=stated,
    )


def _hits(tracks: Sequence[Track], distances: ObjectDistances, hidden: np.ndarray, truth: SceneTruth) -> dict[int, Hit]:
    """Return the track on each road user out of sight, one to one."""
    columns = np.flatnonzero(hidden)
    hits = {}
    for row, column in assign_within(distances.error_m[:, columns], FALSE_M):
        index, track = int(columns[column]), tracks[row]
        user = truth.objects[index]
        off = track.velocity_x_mps - user.velocity_x_mps, track.velocity_y_mps - user.velocity_y_mps
        error_m, mahalanobis2 = float(distances.error_m[row, index]), float(distances.mahalanobis2[row, index])
        hits[index] = Hit(track.id, error_m, math.hypot(*off), mahalanobis2)
    return hits


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One tracker over all drives."""

    tracker: str
    #: Road users asked for, of them those that were hit at all; scans in which they were asked for, of them hits.
    asked: int
    tracked: int
    asked_scans: int
    hits: int
    recall: float
    #: The same of every scan in which a road user is observable, the first second too.
    observable_scans: int
    observable_hits: int
    #: Tracks that stood on nothing, or in plain sight, in most of their scans, a minute; of all tracks and scans the
    #: shares on nothing and in plain sight.
    false_per_min: float
    plain_sight_per_min: float
    false_share: float
    plain_sight_share: float
    id_switches: int
    face_rmse_m: float
    velocity_rmse_mps: float
    velocity_median_mps: float
    #: Mean squared Mahalanobis distance of the nearest visible point of the truth: at most 2 where covariances hold.
    nees: float
    #: Stated existence from, to, how many tracks and scans, its mean, the share on a road user out of sight.
    calibration: list[tuple[float, float, int, float, float]]
    ms_per_scan: float


def summary_of(name: str, scores: Sequence[DriveScore], ms_per_scan: float) -> Summary:
    """Sum up one tracker."""
    asked = [user for score in scores for user in score.asked]
    scans = [hit for user in asked for hit in user]
    hits = [hit for hit in scans if hit is not None]
    minutes = sum(score.duration_s for score in scores) / 60.0
    stands = [stand for score in scores for stand in score.stands.values()]
    most = [max(sorted(set(stand)), key=stand.count) for stand in stands]
    all_stands = [stand for track in stands for stand in track]
    return Summary(
        tracker=name,
        asked=len(asked),
        tracked=sum(any(user) for user in asked),
        asked_scans=len(scans),
        hits=len(hits),
        recall=len(hits) / max(len(scans), 1),
        observable_scans=sum(len(score.observable) for score in scores),
        observable_hits=sum(sum(score.observable) for score in scores),
        false_per_min=most.count("nothing") / minutes,
        plain_sight_per_min=most.count("plain sight") / minutes,
        false_share=all_stands.count("nothing") / max(len(all_stands), 1),
        plain_sight_share=all_stands.count("plain sight") / max(len(all_stands), 1),
        id_switches=sum(a != b for score in scores for ids in score.ids for a, b in pairwise(ids)),
        face_rmse_m=_rms([hit.face_m for hit in hits]),
        velocity_rmse_mps=_rms([hit.velocity_mps for hit in hits]),
        velocity_median_mps=float(np.median([hit.velocity_mps for hit in hits])) if hits else math.nan,
        nees=float(np.mean([hit.mahalanobis2 for hit in hits])) if hits else math.nan,
        calibration=list(_calibration([pair for score in scores for pair in score.stated])),
        ms_per_scan=ms_per_scan,
    )


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(math.fsum(value * value for value in values) / len(values)) if values else math.nan


def _calibration(stated: Sequence[tuple[float, bool]]) -> Iterator[tuple[float, float, int, float, float]]:
    """Yield the bins of stated existence that hold any."""
    for low, high in pairwise(EXISTENCE_EDGES):
        held = [(existence, near) for existence, near in stated if low <= existence < high]
        if held:
            yield low, high, len(held), *(float(np.mean(column)) for column in zip(*held, strict=True))


def measured(name: str, module: Any, drives: Sequence[list[Scan]]) -> Summary:
    """Score the tracker of a module over all drives."""
    scores = [scored(scans, module.Tracker()) for scans in drives]
    return summary_of(name, scores, 1e3 * _step_s(module, drives))


def _step_s(module: Any, drives: Sequence[list[Scan]]) -> float:
    """Return the mean time of a step [s]."""
    start_s, count = time.perf_counter(), 0
    for scans in drives:
        tracker = module.Tracker()
        for scan in scans:
            tracker.step(scan.frame, scan.pose)
            count += 1
    return (time.perf_counter() - start_s) / count


def module_of(path: Path) -> Any:
    """Load a module from a file."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"--tracker must be a Python file, got {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def main(arguments: Sequence[str] | None = None) -> None:
    """Play what is missing, score all trackers, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--drives", type=int, default=48)
    parser.add_argument("--seed", type=int, default=41907)
    parser.add_argument("--profile", default="default")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--tracker", type=Path)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    plan = Plan(seed=options.seed, drives=options.drives, profile=options.profile)
    drives = [scans_of(drive) for drive in saved_drives(plan, options.out, options.workers)]
    modules = {"in use": tracker_in_use}
    if options.tracker is not None:
        modules[options.tracker.stem] = module_of(options.tracker)
    summaries = [msgspec.to_builtins(measured(name, module, drives)) for name, module in modules.items()]
    if options.json:
        print(json.dumps(summaries))
        return
    for summary in summaries:
        print("\n".join(f"{name:>22}  {_text(value)}" for name, value in summary.items()), end="\n\n")


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "; ".join(" ".join(_text(part) for part in row) for row in value)
    return f"{value:.3f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
