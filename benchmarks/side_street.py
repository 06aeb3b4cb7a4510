"""A drive past a side street where a hidden car comes nearer: scan by scan, and tracked with and without odometry.

The radar drives along a street that bends to the left, a car comes down the side street on the left, another is parked
there; the wall across the junction mirrors both. Beams are simulated and go through the whole chain once a seed; the
ways differ only in what follows it. Speed and yaw rate come as 50 states a second with noise and a gyroscope's bias,
which the odometry learns in 3 s of rest before.
An object or track is a car where it lies within 2 m of its centre or of its seen faces (the place at the time of
measurement, the track at the scan's stamp). Velocity is that over ground, against the true one. Of the moving car
alone: lead, from the scan that first says it and keeps its id while the car is hidden to the scan in which it first is
in direct sight; and foretold, the tracks' time to appear against what it was. The last line is what tracking costs a
scan: taking in its vehicle states, and odometry and tracker.
Usage: python -m benchmarks.side_street [--seeds 5] [--method network|cfar] [--chirps 128] [--figure FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from benchmarks.geometry_switches import machine
from models.perception.chain import Chain
from models.perception.detectors import CfarDetector, Detector, NetworkDetector
from models.perception.memory import MemoryParams, ScanMemory
from models.perception.metrics import match_objects
from models.perception.odometry import Placed, ScanOdometry, standing
from models.perception.onnx_model import DEFAULT_MODEL
from models.perception.tracking import Tracker
from msgs.frames import Pose2
from msgs.perception import BevFrame, HiddenObject, SceneTruth, Track
from msgs.radar import RadarSetup
from msgs.units import ns_from_s, s_from_ns
from msgs.vehicle import VehicleState
from sim_player.player import ScenePlayer
from sim_player.scene import Scene, load_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Index of the moving car in the scene.
CAR, PARKED = 0, 1
SCANS, GATE_M = 20, 2.0
SCENE = Path(__file__).resolve().parents[1] / "launch" / "drives" / "side_street.yaml"
REST_S, STATE_PERIOD_S, START_NS = 3.0, 0.02, 10_000_000_000
BIAS_RPS, SPEED_STD_MPS, YAW_RATE_STD_RPS = math.radians(1.0), 0.03, math.radians(0.2)
SCAN_BY_SCAN, STANDING, TRACKED = "scan by scan", "tracked, ego taken as standing", "tracked with odometry"


class Said(msgspec.Struct, kw_only=True):
    """What one way says of one car in one scan: nothing where `id` is None."""

    time_s: float
    id: int | None = None
    x_m: float = math.nan
    y_m: float = math.nan
    error_m: float = math.nan
    velocity_error_mps: float = math.nan
    time_to_appear_s: float | None = None
    #: Objects or tracks of the scan that are no hidden car.
    others: int = 0


class Scan(msgspec.Struct, kw_only=True):
    """A scan of the drive: the view, the truth, the place that odometry gives."""

    frame: BevFrame
    truth: SceneTruth
    place: Placed


class Row(msgspec.Struct, kw_only=True):
    """One way over all seeds."""

    way: str
    #: Scans times cars hidden in them.
    hidden: int
    found_share: float
    rmse_m: float | None
    velocity_rmse_mps: float | None
    id_switches: int
    others_per_scan: float
    #: Of each seed, None where the car was in sight before.
    lead_s: list[float | None]
    #: Root mean square of time to appear as told less as it was, and how many were told.
    foretold_rms_s: float | None
    foretold: int


def street() -> Scene:
    """The junction, as `mirrorwave launch launch/side_street.yaml` shows it live."""
    return load_scene(SCENE)


def states(duration_s: float, seed: int) -> list[VehicleState]:
    """What the bus says: at rest for a while before the first scan, then driving; a constant bias and white noise."""
    rng, ego = np.random.default_rng([seed, 21]), street().ego
    found = []
    for time_s in np.arange(-REST_S, duration_s, STATE_PERIOD_S):
        drives = time_s >= -1e-9
        speed_mps = ego.speed_mps + SPEED_STD_MPS * rng.standard_normal() if drives else 0.0
        turning_rps = math.radians(ego.yaw_rate_dps) if drives else 0.0
        yaw_rate_rps = turning_rps + BIAS_RPS + YAW_RATE_STD_RPS * rng.standard_normal()
        stamp_ns = START_NS + ns_from_s(float(time_s))
        found.append(VehicleState(stamp_ns=stamp_ns, speed_mps=float(speed_mps), yaw_rate_rps=float(yaw_rate_rps)))
    return found


def detector_of(method: str, setup: RadarSetup) -> Detector:
    return CfarDetector(setup) if method == "cfar" else NetworkDetector(setup, DEFAULT_MODEL)


def drive(seed: int, method: str, chirps: int) -> list[Scan]:
    """Every scan until the car is in direct sight, and that one."""
    player = ScenePlayer(street(), seed, start_ns=START_NS, chirps_per_beam=chirps)
    gathering = MemoryParams(tracking=False, wall_map=True)
    chain, odometry = Chain(player.setup, detector_of(method, player.setup), memory=gathering), ScanOdometry()
    for state in states(SCANS * player.setup.radar.scan_period_s, seed):
        odometry.add(state)
    scans = []
    for number in range(SCANS):
        stamp_ns = player.stamp_ns(number)
        place = odometry.at(stamp_ns)
        assert place is not None
        scans.append(Scan(frame=view(chain, player, number, place), truth=player.truth(number), place=place))
        if not scans[-1].truth.objects[CAR].hidden:
            break
    return scans


def view(chain: Chain, player: ScenePlayer, number: int, place: Placed) -> BevFrame:
    """One scan through the chain, its beams freed from the motion that odometry gives."""
    stamp_ns = player.stamp_ns(number)
    state = VehicleState(stamp_ns=stamp_ns, speed_mps=place.speed_mps, yaw_rate_rps=place.yaw_rate_rps)
    frames = [one for index in range(len(player.setup.beams)) for one in chain.add(player.beam(number, index), state)]
    return frames[0]


def as_object(track: Track) -> HiddenObject:
    """A track as an object measured at the scan's stamp."""
    return HiddenObject(
        id=track.id,
        x_m=track.x_m,
        y_m=track.y_m,
        length_m=4.0,
        width_m=2.0,
        yaw_rad=0.0,
        score=1.0,
        cov_m2=track.cov_m2,
    )


def said(scan: Scan, objects: Sequence[HiddenObject], car: int, tracks: Sequence[Track] = ()) -> Said:
    """Which of the objects is a car, and how far off."""
    match = match_objects(objects, scan.truth, GATE_M)
    mine = next((pair for pair in match.matched if pair[1] == car), None)
    now = Said(time_s=s_from_ns(scan.frame.stamp_ns - START_NS), others=len(match.unmatched_objects))
    if mine is None:
        return now
    one = next(one for one in objects if one.id == mine[0])
    now = msgspec.structs.replace(now, id=one.id, x_m=one.x_m, y_m=one.y_m, error_m=mine[2])
    track = next((track for track in tracks if track.id == one.id), None)
    if track is None:
        return now
    true = scan.truth.objects[car]
    velocity_error_mps = math.hypot(
        track.velocity_x_mps - true.velocity_x_mps, track.velocity_y_mps - true.velocity_y_mps
    )
    return msgspec.structs.replace(now, velocity_error_mps=velocity_error_mps, time_to_appear_s=track.time_to_appear_s)


#: Of each way, of each car, what is said scan by scan.
Told = dict[str, list[list[Said]]]


def ways(scans: Sequence[Scan]) -> Told:
    """What each way says of both cars in each scan while the moving one is hidden."""
    trackers = {STANDING: Tracker(), TRACKED: Tracker()}
    found: Told = {way: [[], []] for way in (SCAN_BY_SCAN, STANDING, TRACKED)}
    for scan in scans[:-1]:
        views: dict[str, tuple[Sequence[HiddenObject], Sequence[Track]]] = {SCAN_BY_SCAN: (scan.frame.objects, ())}
        for way, tracker in trackers.items():
            tracks = tracker.step(scan.frame, standing() if way == STANDING else scan.place)
            views[way] = [as_object(one) for one in tracks], tracks
        for way, (objects, tracks) in views.items():
            for car in (CAR, PARKED):
                found[way][car].append(said(scan, objects, car, tracks))
    return found


def costs_ms(scans: Sequence[Scan], seed: int) -> list[float]:
    """What states and tracking of each scan take."""
    memory, found = ScanMemory(MemoryParams(wall_map=False)), []
    waiting = states(SCANS * 0.3, seed)
    for scan in scans:
        start_s = time.perf_counter()
        while waiting and waiting[0].stamp_ns <= scan.frame.stamp_ns:
            memory.add(waiting.pop(0))
        memory.tracked(scan.frame, Pose2())
        found.append(1e3 * (time.perf_counter() - start_s))
    # the first takes in the rest before the drive
    return found[1:]


def lead_s(told: Sequence[Said], sight_s: float) -> float | None:
    """From the start of the last unbroken stretch of one id to direct sight."""
    first = None
    for before, now in zip([None, *told], told, strict=False):
        if now.id is None:
            first = None
        elif before is None or before.id != now.id:
            first = now.time_s
    return None if first is None else sight_s - first


def switches(told: Sequence[Said]) -> int:
    """How often the car's id is another than when it was last found."""
    ids = [one.id for one in told if one.id is not None]
    return sum(a != b for a, b in pairwise(ids))


def row(way: str, told: Sequence[Told], sight_s: Sequence[float]) -> Row:
    """One way over all seeds."""
    both = [values for one in told for values in one[way]]
    moving = [(one[way][CAR], sight) for one, sight in zip(told, sight_s, strict=True)]
    all_said = [one for values in both for one in values]
    errors_m = [one.error_m for one in all_said if one.id is not None]
    wrong_s = [
        one.time_to_appear_s - (sight - one.time_s)
        for values, sight in moving
        for one in values
        if one.time_to_appear_s is not None
    ]
    return Row(
        way=way,
        hidden=len(all_said),
        found_share=len(errors_m) / len(all_said),
        rmse_m=_rms(errors_m),
        velocity_rmse_mps=_rms([one.velocity_error_mps for one in all_said if math.isfinite(one.velocity_error_mps)]),
        id_switches=sum(switches(values) for values in both),
        others_per_scan=float(np.mean([one.others for one in all_said])),
        lead_s=[lead_s(values, sight) for values, sight in moving],
        foretold_rms_s=_rms(wrong_s),
        foretold=len(wrong_s),
    )


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def draw_figure(scans: Sequence[Scan], told: Told, sight_s: float, path: Path) -> None:
    """One drive: the plan in the odometry frame, the moving car's error and its time to appear over time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (plan, error, appear) = pyplot.subplots(1, 3, figsize=(15.0, 5.2), layout="constrained")
    colours = dict(zip(told, ("0.55", "tab:orange", "tab:blue"), strict=True))
    _draw_world(plan, scans)
    for way, (moving, parked) in told.items():
        style = {"color": colours[way], "label": way}
        times = [one.time_s for one in moving]
        plan.plot(*_in_odometry(scans, moving).T, "o" if way == SCAN_BY_SCAN else ".-", markersize=5, **style)
        plan.plot(*_in_odometry(scans, parked).T, "o" if way == SCAN_BY_SCAN else ".", markersize=4, color=colours[way])
        error.plot(times, [one.error_m for one in moving], "o-", markersize=4, **style)
        if way != SCAN_BY_SCAN:
            foretold = [math.nan if one.time_to_appear_s is None else one.time_to_appear_s for one in moving]
            appear.plot(times, foretold, "o-", markersize=4, **style)
    appear.plot([0.0, sight_s], [sight_s, 0.0], "k--", label="as it was")
    plan.set(xlabel="x, m", ylabel="y, m", title="Odometry frame", aspect="equal", xlim=(-2.0, 68.0))
    error.set(xlabel="time, s", ylabel="distance, m", title="Moving car: error of the place", ylim=(0.0, 2.0))
    appear.set(xlabel="time, s", ylabel="time, s", title="Moving car: time to direct sight", ylim=(0.0, None))
    for axes in (plan, error, appear):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None} if path.suffix == ".png" else None)
    pyplot.close(figure)


def _draw_world(plan: Axes, scans: Sequence[Scan]) -> None:
    """Walls, the radar's way and the cars' true ways."""
    for surface in street().surfaces:
        plan.plot(*np.array(surface.polyline_m).T, "k-", linewidth=2.5 if surface.role == "occluder" else 1.2)
    poses = [scan.place.odom_from_vehicle for scan in scans]
    plan.plot([pose.x_m for pose in poses], [pose.y_m for pose in poses], "g.-", label="radar, by odometry")
    elapsed_s = np.array([s_from_ns(scan.frame.stamp_ns - START_NS) for scan in scans])
    car, parked = street().objects
    plan.plot(np.full(len(scans), car.x_m), car.y_m - car.speed_mps * elapsed_s, "k:", label="car, true centre")
    plan.plot(parked.x_m, parked.y_m, "k+", label="parked car, true centre")


def _in_odometry(scans: Sequence[Scan], values: Sequence[Said]) -> np.ndarray:
    """Places [N, 2] in the odometry frame; NaN where nothing is said."""
    pairs = zip(scans, values, strict=False)
    return np.array([scan.place.odom_from_vehicle.apply(np.array([one.x_m, one.y_m])) for scan, one in pairs])


def line(one: Row) -> str:
    leads = ", ".join("none" if lead is None else f"{lead:.1f}" for lead in one.lead_s)
    rmse = "none" if one.rmse_m is None else f"{one.rmse_m:.2f} m"
    foretold = "" if one.foretold_rms_s is None else f"  foretold {one.foretold}, rms {one.foretold_rms_s:.2f} s"
    velocity = "" if one.velocity_rmse_mps is None else f"  velocity {one.velocity_rmse_mps:.2f} m/s"
    return (
        f"{one.way:31s} hidden {one.hidden:3d}  found {one.found_share:.2f}  RMSE {rmse}{velocity}  "
        f"id switches {one.id_switches}  others {one.others_per_scan:.2f} a scan  lead {leads} s{foretold}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--method", choices=("network", "cfar"), default="network")
    parser.add_argument("--chirps", type=int, default=128)
    parser.add_argument("--figure", type=Path, help="draws the first seed")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    drives = [drive(seed, arguments.method, arguments.chirps) for seed in range(arguments.seeds)]
    told = [ways(scans) for scans in drives]
    sight_s = [s_from_ns(scans[-1].frame.stamp_ns - START_NS) for scans in drives]
    rows = [row(way, told, sight_s) for way in told[0]]
    if arguments.figure:
        draw_figure(drives[0], told[0], sight_s[0], arguments.figure)
    command = "python -m benchmarks.side_street " + " ".join(sys.argv[1:])
    costs = [cost for seed, scans in enumerate(drives) for cost in costs_ms(scans, seed)]
    if arguments.json:
        rows_json = msgspec.to_builtins(rows)
        print(json.dumps({"machine": machine(), "command": command, "rows": rows_json, "tracking_ms": costs}))
        return
    cost = f"tracking a scan: median {np.median(costs):.1f} ms, largest {max(costs):.1f} ms"
    print("\n".join([*map(line, rows), cost, command, machine()]))


if __name__ == "__main__":
    main()
