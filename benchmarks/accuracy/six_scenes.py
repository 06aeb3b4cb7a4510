"""Every committed scene through the whole chain: hidden vehicles found within 1 m, objects that are nothing, flags.

Cases: at rest over noise seeds (the seed also draws the speckle of walls and vehicles), hidden objects moving, the
radar moving, beams with random phases. A moving object is compared with where it was when its beams were measured.
Usage: python -m benchmarks.accuracy.six_scenes [--profile NAME] [--seeds 10] [--first-seed 0] [--scans 1] [--effects
basic]
       [--json]
The places are a development set: thresholds were chosen while looking at them. For places never seen:
`mirrorwave eval --objects`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from mirrorwave.node_chain import SharedParts
from mirrorwave.profiles import DEFAULT, read_profile
from models.scores.object_matching import match_objects
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import BevFrame, SceneTruth
from nodes.player import Params, scene_player
from sim_player.player import ScenePlayer

_FOLDER = CHECKOUT / "launch" / "scenes"
#: Those of the X-band radar that figures were taken on.
SCENES = [
    _FOLDER / f"{name}.yaml"
    for name in (
        "corner",
        "facade_across_lane",
        "nothing_hidden",
        "oblique_container",
        "parallel_street_wall",
        "two_hidden_vehicles",
    )
]
CASES: dict[str, dict[str, float]] = {
    "at rest": {},
    "objects 0.6 m/s": {"object_speed_mps": 0.6},
    "objects 5 m/s": {"object_speed_mps": 5.0},
    "objects 15 m/s": {"object_speed_mps": 15.0},
    "ego 8 m/s": {"ego_speed_mps": 8.0},
    "random beam phases": {"phase_jitter_rad": 10.0},
}


class Row(msgspec.Struct, kw_only=True):
    """One scene in one case, summed over seeds and scans."""

    case: str
    scene: str
    scans: int = 0
    matched: int = 0
    missed: int = 0
    unmatched: int = 0
    errors_m: list[float] = []
    #: The same pairs by the distance of centres.
    centre_m: list[float] = []
    flagged: int = 0


def views(player: ScenePlayer, way: argparse.Namespace, scans: int) -> Iterator[tuple[BevFrame, SceneTruth]]:
    chain = SharedParts.of(read_profile(way.profile), player.setup).chain()
    for scan in range(scans):
        for index in range(len(player.setup.beams)):
            beam = player.beam(scan, index)
            for view in chain.add(beam, player.vehicle_state(player.stamp_ns(scan))):
                yield view.frame, player.truth(scan)


def run(scene: Path, case: str, way: argparse.Namespace) -> Row:
    row = Row(case=case, scene=scene.stem)
    for seed in range(way.first_seed, way.first_seed + way.seeds):
        player = scene_player(Params(scene=str(scene), seed=seed, effects=way.effects, **CASES[case]))  # type: ignore[arg-type]
        for frame, truth in views(player, way, way.scans):
            match = match_objects(frame.objects, truth)
            row.scans += 1
            row.matched += len(match.matched)
            row.missed += len(match.missed_truths)
            row.unmatched += len(match.unmatched_objects)
            row.errors_m += [error_m for _, _, error_m in match.matched]
            row.centre_m += match.centre_m
            row.flagged += "incoherent" in frame.flags
    return row


def line(row: Row) -> str:
    worst_m, median_m = (max(row.errors_m), np.median(row.errors_m)) if row.errors_m else (0.0, 0.0)
    centre_m = float(np.median(row.centre_m)) if row.centre_m else 0.0
    return (
        f"{row.case:20s} {row.scene:22s} scans {row.scans:3d}  found {row.matched:3d}  missed {row.missed:3d}  "
        f"nothing there {row.unmatched:3d}  error median {median_m:.2f} worst {worst_m:.2f} m  "
        f"to centre median {centre_m:.2f} m  flagged {row.flagged}/{row.scans}"
    )


def total(rows: list[Row]) -> str:
    found, missed, unmatched, scans = (sum(getattr(row, name) for row in rows) for name in
                                       ("matched", "missed", "unmatched", "scans"))  # fmt: skip
    return f"all: found {found} of {found + missed}, nothing there {unmatched} in {scans} scans"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profile", default=DEFAULT, help="all node parameters of a profile")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--scans", type=int, default=1)
    parser.add_argument("--effects", default="basic")
    parser.add_argument("--cases", nargs="*", choices=list(CASES), default=list(CASES))
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for case in arguments.cases:
        for scene in SCENES:
            row = run(scene, case, arguments)
            rows.append(row)
            if not arguments.json:
                print(line(row), flush=True)
    if not arguments.json:
        print(total(rows))
    else:
        machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.platform()}"
        print(json.dumps({"machine": machine, "method": arguments.profile, "rows": msgspec.to_builtins(rows)}))


if __name__ == "__main__":
    main()
