"""Rolling scans against whole ones: how old what is said is, what it costs, and whether it is as true.

Drives of a validation set (radar and road users moving, all effects), the same beams for every setting. Each view is
compared with the truth at its stamp, object by object as `mirrorwave eval --objects` does; a view of rolling scans is
one row like any other. `waits` is the age of a measurement in the first view that says it: from the beams that measured
an object to the newest beam of that view, processing apart. `compute` is wall time of forming, detection and geometry a
second of radar time; compare settings of one run.

    python -m benchmarks.perception.rolling_scans [--set validation_drives] [--places N] [--workers 2] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import cache

import msgspec
import numpy as np

from mirrorwave.console import progress_bar
from mirrorwave.node_chain import SharedParts
from mirrorwave.profiles import read_profile
from mirrorwave.studies.evaluate.objects import ObjectSet, image_truth, read_sets
from mirrorwave.studies.report import table
from models.evaluation.drive_metrics import drive_report
from models.evaluation.frame_scores import bootstrap_weights
from models.evaluation.object_metrics import ObjectScores, object_report
from models.evaluation.object_rows import ImageTruth, ScanRow, scan_row
from msgs.values.perception import SceneTruth
from msgs.values.radar import RadarBeam
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import NewObjects
from sim_player.dataset.executors import map_jobs
from sim_player.player import ScenePlayer

#: Beams from one view to the next; None: whole scans.
SETTINGS: tuple[int | None, ...] = (None, 12, 5)
DRAWS, SEED = 200, 0


class DriveResult(msgspec.Struct, frozen=True, kw_only=True):
    """Views of one drive under one setting."""

    rows: list[ScanRow]
    #: Age of each measurement in the first view that says it.
    waits_s: list[float]
    compute_s: float
    radar_s: float


def measure_drive(job: tuple[ObjectSet, int]) -> dict[str, DriveResult]:
    """Let every setting look at the beams of a drive."""
    place = job[0].place(job[1])
    player = place.player
    followers = {setting_name(every): Follower(job[1], player, every) for every in SETTINGS}

    @cache
    def truth_at(stamp_ns: int, scan: int) -> tuple[SceneTruth, list[ImageTruth]]:
        return player.truth_at(stamp_ns, scan), image_truth(player, scan, stamp_ns)

    for beam in (beam for scan in range(place.scans) for beam in place.beams(scan)):
        for follower in followers.values():
            follower.add(beam, player.vehicle_state(beam.stamp_ns), truth_at)
    radar_s = place.scans * player.setup.radar.scan_period_s
    return {name: follower.result(radar_s) for name, follower in followers.items()}


def setting_name(every: int | None) -> str:
    """Return how a table calls a setting."""
    return "whole scans" if every is None else f"every {every} beams"


class Follower:
    """One setting, and what its views say of a drive."""

    def __init__(self, place: int, player: ScenePlayer, every: int | None) -> None:
        values = read_profile("default")
        forming = {**values.get("ra_former", {}), "rolling_beams": every}
        self._chain = SharedParts.of({**values, "ra_former": forming}, player.setup).chain()
        self._place = place
        self._rows: list[ScanRow] = []
        self._waits_s: list[float] = []
        self._new_objects = NewObjects()
        self._compute_s = 0.0

    def add(
        self, beam: RadarBeam, state: VehicleState, truth_at: Callable[[int, int], tuple[SceneTruth, list[ImageTruth]]]
    ) -> None:
        """Take in a beam, and compare the view that it brings with the truth at its stamp."""
        start_s = time.perf_counter()
        views = self._chain.add(beam, state)
        self._compute_s += time.perf_counter() - start_s
        for frame in (view.frame for view in views):
            truth, images = truth_at(frame.stamp_ns, frame.scan_id)
            row = scan_row(self._place, frame.objects, truth, images, frame.tracks)
            self._rows.append(msgspec.structs.replace(row, scan=len(self._rows)))
            waits_s = [s_from_ns(beam.stamp_ns - item.stamp_ns) for item in self._new_objects.of(frame)]
            # no setting has a view before the first sweep is whole
            self._waits_s += waits_s if len(self._rows) > 1 else []

    def result(self, radar_s: float) -> DriveResult:
        """Return what the drive has given."""
        return DriveResult(rows=self._rows, waits_s=self._waits_s, compute_s=self._compute_s, radar_s=radar_s)


def summary(results: list[DriveResult], false_cost: float) -> dict[str, float | None]:
    """Return the figures of one setting over all drives."""
    scores = ObjectScores([row for result in results for row in result.rows])
    weights = bootstrap_weights(len(scores.places), DRAWS, SEED)
    report, drives = object_report(scores, weights, false_cost), drive_report(scores, weights)
    waits_s = np.concatenate([result.waits_s for result in results])
    return {
        "views": len(scores.scans),
        "found at 25 dB": report.recall_single_25_db.value,
        "found": report.recall.value,
        "loss a view": report.loss.value,
        "track after 1 s": drives.recall_after_1_s.value,
        "at 25 dB": drives.recall_25_db_after_1_s.value,
        "false tracks a minute": drives.false_tracks_per_minute.value,
        "waits p50 [ms]": 1e3 * float(np.quantile(waits_s, 0.5)),
        "p99 [ms]": 1e3 * float(np.quantile(waits_s, 0.99)),
        "compute [s/s]": sum(result.compute_s for result in results) / sum(result.radar_s for result in results),
    }


def main(argv: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", default="validation_drives", dest="name")
    parser.add_argument("--places", type=int, help="only the first so many drives")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(argv)
    sets = read_sets()
    drives = sets.sets[arguments.name]
    count = min(arguments.places or drives.places, drives.places)
    results: dict[str, list[DriveResult]] = {setting_name(every): [] for every in SETTINGS}
    with progress_bar("drives", count) as advance:
        for measured in map_jobs(measure_drive, [(drives, i) for i in range(count)], workers=arguments.workers):
            for name, result in measured.items():
                results[name].append(result)
            advance()
    figures = {name: summary(of_drives, sets.false_cost) for name, of_drives in results.items()}
    if arguments.json:
        sys.stdout.write(json.dumps(figures, indent=1) + "\n")
        return 0
    rows = [[name, *("" if v is None else f"{v:.3g}" for v in each.values())] for name, each in figures.items()]
    sys.stdout.write("\n".join(table(["setting", *next(iter(figures.values()))], rows)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
