"""What known walls are worth: hidden objects at random places without priors, with exact ones, with a poor map's.

Places, beams and measures are those of `mirrorwave eval --objects`: at rest, every effect, one scan each. Detection
runs once, geometry once for each kind of prior on the same peaks. `noisy` is a map whose walls err by 0.2 m, 0.5 deg
and, at each end, 0.5 m, and that lacks a fifth of them (`sim_player.wall_priors.MapErrors`); it states those errors.
`misplaced` are exact walls about a vehicle that is 2 m ahead, 1 m to the left and 3 deg off where it believes to be.
Usage: nice -n 2 python -m benchmarks.perception.wall_priors [--places 40] [--seed 8300] [--profile default]
       [--draws 1000] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from mirrorwave.console import progress_bar
from mirrorwave.node_chain import SharedParts
from mirrorwave.studies.evaluate.objects import image_truth, read_sets
from mirrorwave.studies.report import table
from mirrorwave.studies.tradeoff.settings import profile_setting
from models.evaluation.frame_scores import bootstrap_weights
from models.evaluation.object_metrics import ObjectReport, ObjectScores, object_report
from models.evaluation.object_rows import ScanRow, is_false, scan_row
from models.perception.tracking.stage import ViewStage
from msgs.values.environment import WallPriors
from msgs.values.frames import Pose2
from msgs.values.radar import RadarSetup
from sim_player.dataset.labelled_beams import LabelledPlace
from sim_player.wall_priors import POOR, WALL_KNOWLEDGE, scene_walls

KINDS = (*WALL_KNOWLEDGE, "misplaced")
MISPLACED = Pose2(2.0, 1.0, math.radians(3.0))
COLUMNS = ("walls", "hidden objects found", "false a scan", "loss a scan", "found more than without", "false more")


def measured(place: LabelledPlace, parts: SharedParts) -> dict[str, ScanRow]:
    """A row for each kind of prior, on the same peaks."""
    player, chain = place.player, parts.chain()
    maps = [ra_map for beam in place.beams() for ra_map in chain.forming.add(beam)]
    (ra_map,) = maps or chain.forming.flush()
    peaks = chain.detection.detect(ra_map)
    truth, images = player.truth(0), image_truth(player)
    rows = {}
    for kind in KINDS:
        placing = parts.placing
        views = ViewStage(placing, parts.residual, parts.confidence, placing.memory, predictor=parts.predictor)
        if kind != "none":
            views.add_walls(priors(place, kind, ra_map.stamp_ns))
        objects = views.view(peaks, ra_map).objects
        rows[kind] = scan_row(place.index, objects, truth, images)
    return rows


def priors(place: LabelledPlace, kind: str, stamp_ns: int) -> WallPriors:
    """Walls of a place as a kind of map has them, errors drawn by the place's own number."""
    seed = 1000 * place.seed + place.index
    pose = MISPLACED if kind == "misplaced" else Pose2()
    return scene_walls(place.player.scene, pose, stamp_ns, seed, POOR if kind == "noisy" else None)


def difference(part: np.ndarray, other: np.ndarray, whole: np.ndarray, weights: np.ndarray) -> str:
    """A ratio less another one by place, with the interval over shared draws of the places."""
    value = (part.sum() - other.sum()) / whole.sum()
    draws = (weights @ (part - other)) / (weights @ whole)
    low, high = np.percentile(draws, (2.5, 97.5))
    return f"{value:+.2f} [{low:+.2f}, {high:+.2f}]"


def line(kind: str, rows: dict[str, list[ScanRow]], weights: np.ndarray, cost: float) -> tuple[str, ...]:
    """One row of the table."""
    scores, plain = ObjectScores(rows[kind]), ObjectScores(rows["none"])
    report: ObjectReport = object_report(scores, weights, cost)
    own, other = (item.of_objects(lambda row: row.error_m is not None) for item in (scores, plain))
    false, fewer = (item.of_reports(is_false) for item in (scores, plain))
    more = (
        difference(own, other, scores.of_objects(lambda row: True), weights),
        difference(false, fewer, scores.scans_by_place, weights),
    )
    return kind, str(report.recall), str(report.false_per_scan), str(report.loss), *(more if kind != "none" else "--")


def main() -> None:
    """Print the table, or the rows of all scans as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perception.wall_priors", description=__doc__)
    parser.add_argument("--places", type=int, default=40)
    parser.add_argument("--seed", type=int, default=8300)
    parser.add_argument("--profile", default="default")
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    parts = SharedParts.of(profile_setting(options.profile).params, RadarSetup())
    rows: dict[str, list[ScanRow]] = {kind: [] for kind in KINDS}
    with threadpool_limits(1, "blas"), progress_bar("places", options.places) as advance:
        for index in range(options.places):
            for kind, row in measured(LabelledPlace(options.seed, index, "all"), parts).items():
                rows[kind].append(row)
            advance()
    if options.json:
        json.dump(msgspec.to_builtins(rows), sys.stdout, indent=1)
        return
    weights = bootstrap_weights(options.places, options.draws, options.seed)
    cost = read_sets().false_cost
    sys.stdout.write("\n".join(table(COLUMNS, [line(kind, rows, weights, cost) for kind in KINDS])) + "\n")


if __name__ == "__main__":
    main()
