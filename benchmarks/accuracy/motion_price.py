"""What motion costs: the first scan of random drives as they are, with the vehicle or the others at rest, with both.

Usage: python -m benchmarks.accuracy.motion_price [--drives 200] [--seed 6210] [--profile NAME] [--workers 2]
       [--out DIR]
Raw beams with all effects through the whole chain, and once more with azimuths from the beams' magnitudes alone, which
is all that is left of them where beams are incoherent. The places are the same in all cases; what motion does to the
images changes the number of objects that one mirror shows at 25 dB.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from lab.evaluate.labelled_beams import LabelledPlace
from lab.evaluate.place_runs import ObjectPlan, ObjectSet, run_objects
from lab.measures.object_metrics import ObjectScores, object_report
from lab.measures.object_rows import ScanRow
from lab.tradeoff.rows import Setting, profile_setting
from mirrorwave.profiles import DEFAULT
from nodes.process.validation import merged
from sim_player.scene.description import Ego, Scene

#: Nobody runs into anything for so many scans, as in the data sets of drives.
DRIVE_SCANS = 8
#: Whether the vehicle moves, and whether the others do.
CASES = {
    "nothing moves": (False, False),
    "the vehicle moves": (True, False),
    "the others move": (False, True),
    "all move": (True, True),
}


@dataclass(frozen=True)
class PartlyStillPlace(LabelledPlace):
    """The first scan of a drive of which a part stands still."""

    vehicle_moves: bool = True
    others_move: bool = True

    @property
    def scene(self) -> Scene:
        """The scene of the drive without the motion left out."""
        scene = LabelledPlace(self.seed, self.index, scans=DRIVE_SCANS).scene
        objects = scene.objects if self.others_move else tuple(replace(item, speed_mps=0.0) for item in scene.objects)
        return replace(scene, ego=scene.ego if self.vehicle_moves else Ego(), objects=objects)


class PartlyStillSet(ObjectSet, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """First scans of the drives of a seed."""

    vehicle_moves: bool
    others_move: bool

    def place(self, index: int) -> LabelledPlace:
        """Return one drive of the set."""
        return PartlyStillPlace(
            self.seed, index, self.effects, vehicle_moves=self.vehicle_moves, others_move=self.others_move
        )


def looks(profile: str) -> list[Setting]:
    """Return a profile, and the same with azimuths from magnitudes."""
    setting = profile_setting(profile)
    params = merged(setting.params, {"ra_former": {"mode": "magnitude"}})
    return [setting, replace(setting, value="magnitudes", params=params)]


def line(case: str, rows: Sequence[ScanRow]) -> str:
    """Return what was found of the objects that one mirror shows at 25 dB, and the false reports a scan."""
    scores = ObjectScores(rows)
    report = object_report(scores, np.ones((1, len(scores.places))), false_cost=1.0)
    strong, false = report.recall_single_25_db, report.false_per_scan
    share = f"found {strong.part:.0f} of {strong.whole:.0f} ({strong.value:.2f})"
    return f"{case:30s} {share}, false reports a scan {false.value:.3f}"


def main() -> None:
    """Print two lines a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--seed", type=int, default=6210)
    parser.add_argument("--profile", default=DEFAULT)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/motion_price"), help="a file a place; goes on in it")
    way = parser.parse_args()
    for case, (vehicle_moves, others_move) in CASES.items():
        drives = PartlyStillSet(seed=way.seed, places=way.drives, vehicle_moves=vehicle_moves, others_move=others_move)
        plan = ObjectPlan(set=drives, profiles=looks(way.profile))
        results = run_objects(plan, way.out / case.replace(" ", "_"), way.workers)
        for name in (setting.value for setting in plan.profiles):
            print(line(f"{case}, {name}", [row for result in results for row in result.rows[name]]), flush=True)


if __name__ == "__main__":
    main()
