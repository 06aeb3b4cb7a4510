"""A drive past a side street where a hidden car comes nearer: scan by scan, and tracked with and without odometry.

The radar drives along a street that bends to the left, a car comes down the side street on the left, another is parked
there; the wall across the junction mirrors both. Beams are simulated once a seed. They go through the whole chain with
the vehicle's states, after which three ways differ only in the tracker, and through one that gets no state, as of a
vehicle without any. Speed and yaw rate come as 50 states a second with noise and a gyroscope's bias, which the odometry
learns in 3 s of rest before.
"Ego taken as standing" is no way to run it: its reports lie where the scan began, because the states have taken the
motion out of them, and its tracker takes them to lie where the radar was when it measured them, so that it has each
object further ahead by what the vehicle drove meanwhile.
An object or track is a car where its face error (to the nearest visible face or the centre) is within 2 m; the error of
its centre stands beside it (`models.evaluation.object_error`; the position is that at the time of measurement, of a
track at the scan's stamp). What odometry changes is against the way without states, on the same beams, with its 95 %
interval over seeds. As a measure, the errors of the mean of the true points of each car that a mirror shows: a report
is the mean of such points. Velocity is that over ground, against the true one. Of the moving car alone: lead, from the
scan that first says it and keeps its id while the car is hidden to the scan in which it first is in direct sight; and
foretold, the tracks' time to appear against what it was. The last line is what tracking costs a scan: taking in its
vehicle states, and odometry and tracker.
With --log a recorded CAN log moves the vehicle instead, and its decoded states, with the bias added, are what odometry
gets: the first stretch of it that suits the street, or the one --from so many seconds.
Usage: python -m benchmarks.accuracy.side_street [--seeds 5] [--profile NAME] [--chirps 128] [--figure FILE] [--json]
       [--log FILE --dbc FILE --mapping FILE [--from S]]
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
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from benchmarks.accuracy.side_street_drives import (
    CAR,
    PARKED,
    SCANS,
    Course,
    Stretch,
    in_sight,
    logged,
    read_states,
    scripted,
)
from benchmarks.perception.geometry_switches import machine
from mirrorwave.node_chain import SharedParts
from mirrorwave.profiles import DEFAULT, read_profile
from models.evaluation.frame_scores import bootstrap_weights
from models.evaluation.metrics import match_objects
from models.evaluation.object_error import as_object, object_distances
from models.perception.chain import Chain
from models.perception.tracking.odometry import OdometryPose, ScanOdometry, stationary_pose
from models.perception.tracking.scan_state import MemoryParams, ScanMemory
from models.perception.tracking.tracker import Tracker
from msgs.values.arrays import Covariance
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, HiddenObject, SceneTruth, Track
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from nodes.process.validation import merged
from sim_player.drive import DrivePlayer
from sim_player.player import ScenePlayer

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GATE_M = 2.0
SCAN_BY_SCAN, STANDING, TRACKED = "scan by scan", "tracked, ego taken as standing", "tracked with odometry"
STATELESS = "tracked, no vehicle states"
DRAWS = 2000
#: Covariance of a position whose covariance nothing asks for.
UNUSED_M2: Covariance = ((1.0, 0.0), (0.0, 1.0))


class Said(msgspec.Struct, kw_only=True):
    """What one way says of one car in one scan: nothing where `id` is None."""

    time_s: float
    id: int | None = None
    x_m: float = math.nan
    y_m: float = math.nan
    face_error_m: float = math.nan
    centre_error_m: float = math.nan
    velocity_error_mps: float = math.nan
    time_to_appear_s: float | None = None
    #: Objects or tracks of the scan that are no hidden car.
    others: int = 0


class Scan(msgspec.Struct, kw_only=True):
    """A scan of the drive: its start, the views with and without states, the truth, the place that odometry gives."""

    time_s: float
    frame: BevFrame
    stateless: BevFrame
    truth: SceneTruth
    place: OdometryPose


class Row(msgspec.Struct, kw_only=True):
    """One way over all seeds."""

    way: str
    #: Scans times cars hidden in them.
    hidden: int
    found_share: float
    #: Root mean squares of the errors of what was found.
    face_rmse_m: float | None
    centre_rmse_m: float | None
    velocity_rmse_mps: float | None
    id_switches: int
    others_per_scan: float
    #: Of each seed, None where the car was in sight before.
    lead_s: list[float | None]
    #: Root mean square of time to appear as told less as it was, and how many were told.
    foretold_rms_s: float | None
    foretold: int


def params_of(profile: str, **memory: bool) -> dict[str, dict[str, Any]]:
    """Return node parameters of a profile, with others of what the geometry keeps over scans."""
    return merged(read_profile(profile), {"geometry": {"memory": memory}})


def drive(course: Course, seed: int, profile: str, chirps: int, most: int = SCANS) -> list[Scan]:
    """Every scan until the car is in direct sight, and that one."""
    player = course.player(seed, chirps)
    parts = SharedParts.of(params_of(profile, tracking=False, wall_map=True), player.setup)
    chain, stateless, odometry = parts.chain(), parts.chain(), ScanOdometry()
    for state in course.states(seed):
        odometry.add(state)
    scans: list[Scan] = []
    while len(scans) < most and (not scans or scans[-1].truth.objects[CAR].hidden):
        number = len(scans)
        place = odometry.at(player.stamp_ns(number))
        assert place is not None
        time_s = s_from_ns(player.stamp_ns(number) - player.stamp_ns(0))
        frame, without = views(chain, stateless, player, number, place)
        truth = player.truth(number)
        scans.append(Scan(time_s=time_s, frame=frame, stateless=without, truth=truth, place=place))
    return scans


def sight_s(scans: Sequence[Scan]) -> float:
    """When the car comes into direct sight."""
    assert in_sight(scans[-1].truth)
    return scans[-1].time_s


def views(
    chain: Chain, stateless: Chain, player: ScenePlayer | DrivePlayer, number: int, place: OdometryPose
) -> tuple[BevFrame, BevFrame]:
    """One scan through both chains: its beams freed from the motion that odometry gives, and as they are."""
    state = VehicleState(stamp_ns=player.stamp_ns(number), speed_mps=place.speed_mps, yaw_rate_rps=place.yaw_rate_rps)
    found, plain = [], []
    for index in range(len(player.setup.beams)):
        beam = player.beam(number, index)
        found += chain.add(beam, state)
        plain += stateless.add(beam)
    return found[0].frame, plain[0].frame


def said(scan: Scan, objects: Sequence[HiddenObject], car: int, tracks: Sequence[Track] = ()) -> Said:
    """Which of the objects is a car, and how far off."""
    match = match_objects(objects, scan.truth, GATE_M)
    now = Said(time_s=scan.time_s, others=len(match.unmatched_objects))
    mine = next((index for index, pair in enumerate(match.matched) if pair[1] == car), None)
    if mine is None:
        return now
    one = next(one for one in objects if one.id == match.matched[mine][0])
    errors = {"face_error_m": match.matched[mine][2], "centre_error_m": match.centre_m[mine]}
    now = msgspec.structs.replace(now, id=one.id, x_m=one.x_m, y_m=one.y_m, **errors)
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
    trackers = {STANDING: Tracker(), STATELESS: Tracker(), TRACKED: Tracker()}
    found: Told = {way: [[], []] for way in (SCAN_BY_SCAN, *trackers)}
    for scan in scans[:-1]:
        seen: dict[str, tuple[Sequence[HiddenObject], Sequence[Track]]] = {SCAN_BY_SCAN: (scan.frame.objects, ())}
        for way, tracker in trackers.items():
            frame = scan.stateless if way == STATELESS else scan.frame
            tracks = tracker.step(frame, scan.place if way == TRACKED else stationary_pose())
            seen[way] = [as_object(one) for one in tracks], tracks
        for way, (objects, tracks) in seen.items():
            for car in (CAR, PARKED):
                found[way][car].append(said(scan, objects, car, tracks))
    return found


def costs_ms(course: Course, scans: Sequence[Scan], seed: int) -> list[float]:
    """What states and tracking of each scan take."""
    memory, found = ScanMemory(MemoryParams(wall_map=False)), []
    waiting = course.states(seed)
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
    found = [one for one in all_said if one.id is not None]
    wrong_s = [
        one.time_to_appear_s - (sight - one.time_s)
        for values, sight in moving
        for one in values
        if one.time_to_appear_s is not None
    ]
    return Row(
        way=way,
        hidden=len(all_said),
        found_share=len(found) / len(all_said),
        face_rmse_m=_rms([one.face_error_m for one in found]),
        centre_rmse_m=_rms([one.centre_error_m for one in found]),
        velocity_rmse_mps=_rms([one.velocity_error_mps for one in all_said if math.isfinite(one.velocity_error_mps)]),
        id_switches=sum(switches(values) for values in both),
        others_per_scan=float(np.mean([one.others for one in all_said])),
        lead_s=[lead_s(values, sight) for values, sight in moving],
        foretold_rms_s=_rms(wrong_s),
        foretold=len(wrong_s),
    )


class Difference(msgspec.Struct, kw_only=True):
    """What odometry changes of root mean squares of errors, against no state at all; 95 % intervals over seeds."""

    face_m: float
    face_interval_m: tuple[float, float]
    centre_m: float
    centre_interval_m: tuple[float, float]


def difference(told: Sequence[Told]) -> Difference:
    """Errors with odometry less those without vehicle states, on the same draws of seeds."""
    weights = np.concatenate([np.ones((1, len(told))), bootstrap_weights(len(told), DRAWS, 0)])
    face_m, centre_m = (
        _drawn_rms(told, TRACKED, name, weights) - _drawn_rms(told, STATELESS, name, weights)
        for name in ("face_error_m", "centre_error_m")
    )
    return Difference(
        face_m=float(face_m[0]),
        face_interval_m=_interval(face_m[1:]),
        centre_m=float(centre_m[0]),
        centre_interval_m=_interval(centre_m[1:]),
    )


def _drawn_rms(told: Sequence[Told], way: str, name: str, weights: np.ndarray) -> np.ndarray:
    """Root mean squares [draws] of an error of what a way found, by the weights [draws, seeds]; NaN where nothing."""
    errors = [np.array([getattr(one, name) for car in seed[way] for one in car if one.id is not None]) for seed in told]
    squares, counts = (np.array([float(fold(one)) for one in errors]) for fold in (lambda one: one @ one, len))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((weights @ squares) / (weights @ counts)))


def _interval(values: np.ndarray) -> tuple[float, float]:
    low, high = np.nanpercentile(values, [2.5, 97.5]) if np.isfinite(values).any() else (math.nan, math.nan)
    return float(low), float(high)


def visible_means(scans: Sequence[Scan]) -> list[tuple[float, float]]:
    """Face and centre error of the mean of the visible points of each hidden car in each scan, by truth."""
    found = []
    for truth in (scan.truth for scan in scans[:-1]):
        for car in (CAR, PARKED):
            points_m = truth.hidden_points_m[truth.hidden_object == car, :2]
            if len(points_m):
                x_m, y_m = points_m.mean(axis=0).tolist()
                there = HiddenObject(
                    id=0, x_m=x_m, y_m=y_m, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=1.0, cov_m2=UNUSED_M2
                )
                error = object_distances([there], truth, [truth.objects[car]])
                found.append((float(error.error_m[0, 0]), float(error.centre_m[0, 0])))
    return found


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


class Drift(msgspec.Struct, kw_only=True):
    """How far odometry is off after a drive."""

    time_s: float
    away_m: float
    turned_deg: float


def drift(course: Course, scans: Sequence[Scan]) -> Drift:
    """Odometry against the true motion, from the first scan to the last."""
    time_s = scans[-1].time_s
    off = course.motion.pose(time_s).inverse() @ _start_from_radar(scans, scans[-1])
    return Drift(time_s=time_s, away_m=math.hypot(off.x_m, off.y_m), turned_deg=abs(math.degrees(off.yaw_rad)))


def _start_from_radar(scans: Sequence[Scan], scan: Scan) -> Pose2:
    """Where odometry has the radar, in the frame of the first scan."""
    return scans[0].place.odom_from_vehicle.inverse() @ scan.place.odom_from_vehicle


def draw_figure(course: Course, scans: Sequence[Scan], told: Told, path: Path) -> None:
    """Draw one drive: the plan; of the moving car what is reported under which id, errors, time to direct sight."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = 3 if course.stretch else 2
    figure = pyplot.figure(figsize=(16.5, 4.1 * rows + 0.5), layout="constrained")
    grid = figure.add_gridspec(rows, 3, width_ratios=(1.15, 1.0, 1.0))
    plan = figure.add_subplot(grid[:2, 0])
    reports, error, velocity, appear = (figure.add_subplot(grid[place]) for place in ((0, 1), (0, 2), (1, 1), (1, 2)))
    _draw_plan(plan, course, scans, told)
    _draw_reports(reports, scans, told)
    _draw_errors(error, velocity, told)
    _draw_time_to_sight(appear, scans, told)
    panels = [reports, error, velocity, appear]
    for axes in panels:
        axes.axvline(sight_s(scans), color="k", linewidth=1.0, linestyle=":")
        axes.set(xlabel="time, s", xlim=(-0.2, sight_s(scans) + 0.3))
    if course.stretch:
        panels.append(figure.add_subplot(grid[2, :]))
        _draw_motion(panels[-1], course, scans)
    for axes in [plan, *panels]:
        axes.grid(alpha=0.3)
        if axes is not reports:
            axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None} if path.suffix == ".png" else None)
    pyplot.close(figure)


#: Colour of each way.
COLOURS = {SCAN_BY_SCAN: "0.55", STANDING: "tab:orange", STATELESS: "tab:red", TRACKED: "tab:blue"}


def _draw_plan(plan: Axes, course: Course, scans: Sequence[Scan], told: Told) -> None:
    """Draw the street from above, and where each way has both cars."""
    _draw_world(plan, course, scans)
    for way, (moving, parked) in told.items():
        marker = "o" if way == SCAN_BY_SCAN else "."
        plan.plot(*_in_start(scans, moving).T, marker, markersize=5, color=COLOURS[way], label=way)
        plan.plot(*_in_start(scans, parked).T, marker, markersize=4, color=COLOURS[way])
    plan.set(xlabel="x, m", ylabel="y, m", title="From above, by odometry from the first scan", aspect="equal")


def _draw_reports(axes: Axes, scans: Sequence[Scan], told: Told) -> None:
    """Draw a row of scans for each way: a dot where the car is reported, a line as long as one id stays on it."""
    for row, (way, (moving, _)) in enumerate(told.items()):
        for before, now in pairwise(moving):
            if now.id is not None and now.id == before.id:
                axes.plot((before.time_s, now.time_s), (-row, -row), color=COLOURS[way], linewidth=4)
        reported = [one.time_s for one in moving if one.id is not None]
        axes.plot(reported, [-row] * len(reported), "o", color=COLOURS[way], markersize=6)
        lead = lead_s(moving, sight_s(scans))
        text = f"{way}: lead {'none' if lead is None else f'{lead:.1f} s'}, {switches(moving)} id switches"
        axes.text(0.0, 0.25 - row, text, fontsize=9)
    axes.text(sight_s(scans) - 0.05, 0.35 - len(told), "direct sight", fontsize=8, ha="right")
    axes.set(title="Moving car: reported; a line where the id stays", yticks=(), ylim=(0.2 - len(told), 0.7))


def _draw_errors(error: Axes, velocity: Axes, told: Told) -> None:
    """Draw the errors of position, to the face and to the centre, and of velocity."""
    for way, (moving, _) in told.items():
        times = [one.time_s for one in moving]
        style = {"color": COLOURS[way], "markersize": 4}
        error.plot(times, [one.face_error_m for one in moving], "o-", label=f"face, {way}", **style)
        error.plot(times, [one.centre_error_m for one in moving], "s:", label=f"centre, {way}", **style)
        if way != SCAN_BY_SCAN:
            velocity.plot(times, [one.velocity_error_mps for one in moving], "o-", label=way, **style)
    error.set(ylabel="m", title="Moving car: face error and centre error", ylim=(0.0, 4.0))
    velocity.set(ylabel="m/s", title="Moving car: error of the velocity over ground", ylim=(0.0, None))


def _draw_time_to_sight(appear: Axes, scans: Sequence[Scan], told: Told) -> None:
    """Draw the time to direct sight as tracks foretell it and as it was."""
    for way in (STANDING, STATELESS, TRACKED):
        moving = told[way][CAR]
        foretold = [math.nan if one.time_to_appear_s is None else one.time_to_appear_s for one in moving]
        appear.plot([one.time_s for one in moving], foretold, "o-", markersize=4, color=COLOURS[way], label=way)
    appear.plot([0.0, sight_s(scans)], [sight_s(scans), 0.0], "k--", label="as it was")
    appear.set(ylabel="s", title="Moving car: time to direct sight", ylim=(0.0, None))


def _draw_world(plan: Axes, course: Course, scans: Sequence[Scan]) -> None:
    """Walls, the radar's way and the cars' true ways."""
    for surface in course.scene.surfaces:
        plan.plot(*np.array(surface.polyline_m).T, "k-", linewidth=2.5 if surface.role == "occluder" else 1.2)
    poses = [_start_from_radar(scans, scan) for scan in scans]
    plan.plot([pose.x_m for pose in poses], [pose.y_m for pose in poses], "g.-", label="radar, by odometry")
    car, parked = course.scene.objects
    way_m = car.speed_mps * np.array([scan.time_s for scan in scans])
    yaw_rad = math.radians(car.yaw_deg)
    plan.plot(car.x_m + way_m * math.cos(yaw_rad), car.y_m + way_m * math.sin(yaw_rad), "k:", label="car, true centre")
    for one, end_s in ((car, scans[-1].time_s), (parked, 0.0)):
        outline_m = one.corners_m() + end_s * one.speed_mps * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
        label = "cars' outlines at direct sight" if one is car else None
        plan.fill(*outline_m.T, fill=False, edgecolor="k", linewidth=1.0, label=label)


def _draw_motion(axes: Axes, course: Course, scans: Sequence[Scan]) -> None:
    """Speed and yaw rate: what the bus says, the true ones, and what odometry makes of them."""
    start_ns, end_ns = scans[0].frame.stamp_ns, scans[-1].frame.stamp_ns
    states = [state for state in course.states(0) if start_ns <= state.stamp_ns <= end_ns]
    told_s = [s_from_ns(state.stamp_ns - start_ns) for state in states]
    scans_s = np.array([scan.time_s for scan in scans])
    axes.plot(told_s, [state.speed_mps for state in states], color="tab:red", label="speed as told, m/s")
    axes.plot(scans_s, course.motion.speed_at(scans_s), "k:", label="true speed")
    told_deg = np.degrees([state.yaw_rate_rps for state in states])
    axes.plot(told_s, told_deg, color="tab:purple", label="yaw rate as told, with bias, deg/s")
    axes.plot(told_s, np.degrees(course.motion.yaw_rate_at(np.array(told_s))), "k--", label="true yaw rate")
    axes.plot(scans_s, np.degrees([scan.place.yaw_rate_rps for scan in scans]), "g.", label="yaw rate by odometry")
    axes.set(xlabel="time, s", ylabel="m/s, deg/s", title="The log: speed and yaw rate", ylim=(-1.0, 10.0))


def _in_start(scans: Sequence[Scan], values: Sequence[Said]) -> np.ndarray:
    """Places [N, 2] in the frame of the first scan, by odometry; NaN where nothing is said."""
    pairs = zip(scans, values, strict=False)
    return np.array([_start_from_radar(scans, scan).apply(np.array([one.x_m, one.y_m])) for scan, one in pairs])


def line(one: Row) -> str:
    leads = ", ".join("none" if lead is None else f"{lead:.1f}" for lead in one.lead_s)
    rmse = "none"
    if one.face_rmse_m is not None:
        rmse = f"face {one.face_rmse_m:.2f} m, centre {one.centre_rmse_m:.2f} m"
    foretold = "" if one.foretold_rms_s is None else f"  foretold {one.foretold}, rms {one.foretold_rms_s:.2f} s"
    velocity = "" if one.velocity_rmse_mps is None else f"  velocity {one.velocity_rmse_mps:.2f} m/s"
    return (
        f"{one.way:31s} hidden {one.hidden:3d}  found {one.found_share:.2f}  RMSE {rmse}{velocity}  "
        f"id switches {one.id_switches}  others {one.others_per_scan:.2f} a scan  lead {leads} s{foretold}"
    )


def describe(change: Difference) -> str:
    """One line on what odometry changes."""
    (face_low, face_high), (centre_low, centre_high) = change.face_interval_m, change.centre_interval_m
    return (
        f"with odometry less without vehicle states: face {change.face_m:+.2f} m [{face_low:+.2f}, {face_high:+.2f}], "
        f"centre {change.centre_m:+.2f} m [{centre_low:+.2f}, {centre_high:+.2f}]"
    )


def about(stretch: Stretch) -> str:
    """One line on the stretch of a log."""
    rest = (
        f"{stretch.rest_s:.1f} s of rest before it" if stretch.rest_s else "no rest before it: the bias is not learnt"
    )
    return (
        f"{stretch.log}, {stretch.from_s:.1f}..{stretch.to_s:.1f} s: {stretch.slowest_mps:.1f}.."
        f"{stretch.fastest_mps:.1f} m/s, turns by {stretch.turn_deg:.1f} deg, stamps jitter by "
        f"{stretch.jitter_ms:.2f} ms; {rest}"
    )


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--profile", default=DEFAULT, help="a name or a file")
    parser.add_argument("--chirps", type=int, default=128)
    parser.add_argument("--figure", type=Path, help="draws the first seed")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--log", type=Path, help="a CAN log that moves the vehicle")
    parser.add_argument("--dbc", type=Path)
    parser.add_argument("--mapping", type=Path)
    parser.add_argument("--from", type=float, dest="from_s", metavar="S", help="seconds from the log's first state")
    arguments = parser.parse_args()
    if min(arguments.seeds, arguments.chirps) < 1:
        parser.error("--seeds and --chirps must be 1 at least")
    if len({value is None for value in (arguments.log, arguments.dbc, arguments.mapping)}) > 1:
        parser.error("--log, --dbc and --mapping go together")
    if arguments.from_s is not None and arguments.log is None:
        parser.error("--from needs --log")
    return arguments


def course_of(arguments: argparse.Namespace) -> Course:
    """The drive that was asked for; ValueError or OSError where its files do not give one."""
    if arguments.log is None:
        return scripted()
    states = read_states(arguments.log, arguments.dbc, arguments.mapping)
    return logged(states, arguments.log.name, arguments.from_s, arguments.seeds)


def main() -> int:
    arguments = read_arguments()
    try:
        course = course_of(arguments)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    drives = [drive(course, seed, arguments.profile, arguments.chirps) for seed in range(arguments.seeds)]
    told = [ways(scans) for scans in drives]
    rows = [row(way, told, [sight_s(scans) for scans in drives]) for way in told[0]]
    if arguments.figure:
        draw_figure(course, drives[0], told[0], arguments.figure)
    command = "python -m benchmarks.accuracy.side_street " + " ".join(sys.argv[1:])
    costs = [cost for seed, scans in enumerate(drives) for cost in costs_ms(course, scans, seed)]
    drifts = [drift(course, scans) for scans in drives]
    change, means = difference(told), [mean for scans in drives for mean in visible_means(scans)]
    face_m, centre_m = (_rms(values) for values in zip(*means, strict=True))
    if arguments.json:
        found = {"rows": rows, "tracking_ms": costs, "stretch": course.stretch, "drift": drifts}
        found |= {"difference": change, "visible_mean_m": {"face": face_m, "centre": centre_m}}
        print(json.dumps({"machine": machine(), "command": command, **msgspec.to_builtins(found)}))
        return 0
    cost = f"tracking a scan: median {np.median(costs):.1f} ms, largest {max(costs):.1f} ms"
    worst = max(drifts, key=lambda one: one.away_m)
    off = f"odometry: off by {worst.away_m:.2f} m and {worst.turned_deg:.2f} deg after {worst.time_s:.1f} s, at worst"
    text = [about(course.stretch)] if course.stretch else []
    visible = f"the mean of a car's visible points, by truth: face {face_m:.2f} m, centre {centre_m:.2f} m"
    print("\n".join([*text, *map(line, rows), describe(change), visible, off, cost, command, machine()]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
