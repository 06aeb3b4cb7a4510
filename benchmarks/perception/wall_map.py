"""Walls gathered over scans against those of each scan alone, on the same peaks: what is found, what is made up, time.

Cases: the six committed scenes at rest, with moving objects, and driving; a street whose walls are rough and seen
edge-on (`weak`); one with traffic in direct sight and nothing hidden (`traffic`): whatever is said there is made up.
`kept` leaves each direct return out of a scan with the rest of the chance, as a weaker radar would; these losses are
independent from scan to scan, which is the best case of gathering. Odometry is exact but for white noise and a
gyroscope's bias of 0.2 deg/s. A wall's errors are those against the nearest true wall within 1.5 m and 10 degrees; a
wall with none so near is `wrong`: most of those are sides of vehicles.
Usage: python -m benchmarks.perception.wall_map [--seeds 5] [--scans 8] [--method network|cfar] [--chirps 16] [--kept 1
0.5 0.3]
       [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise

import msgspec
import numpy as np

from benchmarks.accuracy.side_street_drives import street
from benchmarks.accuracy.six_scenes import SCENES
from benchmarks.perception.geometry_switches import machine
from models.evaluation.metrics import match_objects
from models.perception.forming.ra_former import RaFormer
from models.perception.geometry.stage import GeometryParams
from models.perception.tracking.scan_state import MemoryParams
from models.perception.tracking.stage import ViewStage
from msgs.values.perception import BevFrame, PathClass, Peaks, SceneTruth, TruthSurface, Wall
from msgs.values.vehicle import VehicleState
from nodes import dense_predictor
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface, load_scene

SPEED_STD_MPS, YAW_RATE_STD_RPS, BIAS_RPS = 0.03, math.radians(0.2), math.radians(0.2)
STATES_PER_SCAN = 15
GATE_M, GATE_RAD = 1.5, math.radians(10.0)
ALONE, GATHERED = "each scan alone", "gathered"


class Scan(msgspec.Struct, kw_only=True):
    """One scan: its peaks, the truth, the vehicle states stamped since the scan before."""

    peaks: Peaks
    truth: SceneTruth
    states: list[VehicleState]


class Row(msgspec.Struct, kw_only=True):
    """One way in one case, summed over scenes, seeds and scans."""

    case: str
    kept: float
    way: str
    found: int = 0
    missed: int = 0
    nothing_there: int = 0
    walls: int = 0
    wrong_walls: int = 0
    angle_errors_rad: list[float] = []
    offset_errors_m: list[float] = []
    times_ms: list[float] = []


def weak() -> Scene:
    """The side street with walls so rough that little of them answers, the radar driving past."""
    scene = street()
    rough = tuple(msgspec.structs.replace(one, roughness_mm=2.5) for one in scene.surfaces)
    return msgspec.structs.replace(scene, name="weak", surfaces=rough)


def traffic() -> Scene:
    """Cars and a truck in direct sight, along and across, before one wall; nothing is hidden."""
    wall = Surface(role="relay", material="concrete", polyline_m=((38.0, -14.0), (38.0, 14.0)), height_m=6.0)
    objects = (
        SceneObject(class_="car", x_m=12.0, y_m=-4.0, yaw_deg=0.0, speed_mps=8.0),
        SceneObject(class_="car", x_m=30.0, y_m=4.0, yaw_deg=180.0, speed_mps=6.0),
        SceneObject(class_="truck", x_m=22.0, y_m=-12.0, yaw_deg=90.0, speed_mps=5.0),
    )
    return Scene(name="traffic", surfaces=(wall,), objects=objects, ego=Ego(speed_mps=3.0))


def cases() -> dict[str, list[Scene]]:
    """Scenes of each case."""
    six = [load_scene(path) for path in SCENES]
    moving = [
        msgspec.structs.replace(
            one, objects=tuple(msgspec.structs.replace(thing, speed_mps=3.0) for thing in one.objects)
        )
        for one in six
    ]
    driving = [msgspec.structs.replace(one, ego=Ego(speed_mps=4.0)) for one in six]
    return {
        "six scenes, at rest": six,
        "six scenes, objects 3 m/s": moving,
        "six scenes, ego 4 m/s": driving,
        "weak walls, ego 4 m/s": [weak()],
        "traffic, ego 3 m/s": [traffic()],
    }


def scans_of(scene: Scene, seed: int, arguments: argparse.Namespace) -> list[Scan]:
    """A scene through forming and detection."""
    player = ScenePlayer(scene, seed, start_ns=1_000_000_000, chirps_per_beam=arguments.chirps)
    former = RaFormer(player.setup)
    detector = dense_predictor.detector_for(dense_predictor.Params(method=arguments.method), player.setup)
    rng = np.random.default_rng([seed, 8])
    found = []
    for number in range(arguments.scans):
        exact = player.vehicle_state(player.stamp_ns(number))
        beams = [player.beam(number, index) for index in range(len(player.setup.beams))]
        (ra_map,) = [one for beam in beams for one in former.add(beam, exact)]
        states = list(measured(player, number, rng))
        found.append(Scan(peaks=detector.detect(ra_map), truth=player.truth(number), states=states))
    return found


def measured(player: ScenePlayer, number: int, rng: np.random.Generator) -> Iterator[VehicleState]:
    """States as a bus says them, up to the stamp of a scan."""
    period_ns = player.stamp_ns(1) - player.stamp_ns(0)
    for index in range(STATES_PER_SCAN):
        stamp_ns = player.stamp_ns(number) - (STATES_PER_SCAN - 1 - index) * period_ns // STATES_PER_SCAN
        exact = player.vehicle_state(stamp_ns)
        drives = exact.speed_mps != 0.0
        yield msgspec.structs.replace(
            exact,
            speed_mps=exact.speed_mps + drives * SPEED_STD_MPS * float(rng.standard_normal()),
            yaw_rate_rps=exact.yaw_rate_rps + BIAS_RPS + YAW_RATE_STD_RPS * float(rng.standard_normal()),
        )


def thinned(peaks: Peaks, kept: float, rng: np.random.Generator) -> Peaks:
    """Peaks without some of the direct returns."""
    keep = (peaks.path_class != PathClass.LOS) | (rng.random(len(peaks)) < kept)
    return peaks.take(keep)


def wall_error(wall: Wall, surfaces: Sequence[TruthSurface]) -> tuple[float, float] | None:
    """Angle [rad] and offset [m] between a wall's middle and the nearest true wall, None where none is near."""
    middle = np.mean(wall.ends_m, axis=0)
    best: tuple[float, float] | None = None
    for surface in surfaces:
        corners = np.array(surface.polyline_m)
        for a, b in pairwise(corners):
            length_m = float(np.hypot(*(b - a)))
            tangent = (b - a) / length_m
            normal = np.array([-tangent[1], tangent[0]])
            offset_m = abs(float((middle - a) @ normal))
            angle_rad = math.acos(min(abs(float(normal @ np.array(wall.normal))), 1.0))
            inside = -1.0 < (middle - a) @ tangent < length_m + 1.0
            if inside and angle_rad < GATE_RAD and offset_m < (best[1] if best else GATE_M):
                best = angle_rad, offset_m
    return best


def add(row: Row, frame: BevFrame, truth: SceneTruth) -> None:
    """Count a scan in."""
    match = match_objects(frame.objects, truth)
    row.found += len(match.matched)
    row.missed += len(match.missed_truths)
    row.nothing_there += len(match.unmatched_objects)
    errors = [wall_error(wall, truth.surfaces) for wall in frame.walls]
    row.walls += len(errors)
    row.wrong_walls += errors.count(None)
    row.angle_errors_rad += [one[0] for one in errors if one]
    row.offset_errors_m += [one[1] for one in errors if one]


def run(row: Row, drives: Sequence[Sequence[Scan]]) -> Row:
    """One way over all drives."""
    params = GeometryParams()
    for number, scans in enumerate(drives):
        rng = np.random.default_rng([number, 9])
        stage = ViewStage(params, memory=MemoryParams(tracking=False, wall_map=row.way == GATHERED))
        for scan in scans:
            for state in scan.states:
                stage.add_state(state)
            peaks = thinned(scan.peaks, row.kept, rng)
            start_s = time.perf_counter()
            frame = stage.view(peaks)
            row.times_ms.append(1e3 * (time.perf_counter() - start_s))
            add(row, frame, scan.truth)
    return row


def rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan


def line(row: Row) -> str:
    return (
        f"{row.case:26s} kept {row.kept:.2f}  {row.way:15s}  found {row.found:4d} of {row.found + row.missed:4d}  "
        f"nothing there {row.nothing_there:3d}  walls {row.walls:4d}, wrong {row.wrong_walls:3d}, "
        f"rms {math.degrees(rms(row.angle_errors_rad)):.2f} deg {100.0 * rms(row.offset_errors_m):4.1f} cm  "
        f"median {np.median(row.times_ms):.1f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scans", type=int, default=8)
    parser.add_argument("--method", choices=("network", "cfar"), default="network")
    parser.add_argument("--chirps", type=int, default=16)
    parser.add_argument("--kept", type=float, nargs="+", default=[1.0, 0.5, 0.3])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for case, scenes in cases().items():
        drives = [scans_of(scene, seed, arguments) for scene in scenes for seed in range(arguments.seeds)]
        for kept in arguments.kept:
            for way in (ALONE, GATHERED):
                rows.append(run(Row(case=case, kept=kept, way=way), drives))
                if not arguments.json:
                    print(line(rows[-1]), flush=True)
    command = "python -m benchmarks.perception.wall_map " + " ".join(sys.argv[1:])
    if arguments.json:
        print(json.dumps({"machine": machine(), "command": command, "rows": msgspec.to_builtins(rows)}))
        return
    print("\n".join([command, machine()]))


if __name__ == "__main__":
    main()
