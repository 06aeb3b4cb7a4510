"""The drives past the side street: as its file scripts it, and as a stretch of a recorded CAN log moves the vehicle.

Of a log, speed and yaw rate, smoothed, are the true motion; the states as our own decoder says them, with their
quantisation and their own stamps and a gyroscope's bias put in, are all that odometry gets. The street is turned and
moved so that the vehicle comes to the corner at the time, the place and the heading of the scripted drive.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter1d

from mirrorwave.convert.can_log import log_states
from models.perception.tracking.odometry import OdometryParams
from msgs.files.shipped import CHECKOUT
from msgs.values.frames import Pose2
from msgs.values.perception import SceneTruth
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion
from nodes.can.bus import load_decoder
from nodes.can.log_file import read_log
from sim_player.drive import Drive, DrivePlayer
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface, load_scene

#: Index of the cars in the scene.
CAR, PARKED = 0, 1
SCANS, PERIOD_S = 20, 0.3
SCENE = CHECKOUT / "launch" / "drives" / "side_street.yaml"
REST_S, STATE_PERIOD_S, START_NS = 3.0, 0.02, 10_000_000_000
BIAS_RPS, SPEED_STD_MPS, YAW_RATE_STD_RPS = math.radians(1.0), 0.03, math.radians(0.2)

#: When the car comes into direct sight in the scripted drive: there both drives pass the corner alike.
SIGHT_S = 4.8
#: Standard deviation of the smoothing, and the grid it is done on.
SMOOTH_S, GRID_S = 0.1, 0.01
#: Motion and beams go on a little after the last scan's start.
MARGIN_S = 0.5
#: What a stretch must hold: speeds, m/s; turn in all; states without a gap; scans with the car hidden; room.
SPEEDS_MPS, MIN_TURN_DEG, MAX_GAP_S, MIN_HIDDEN, CLEARANCE_M = (2.0, 8.0), 5.0, 0.1, 8, 1.0
#: The car's direct echoes lie this near its centre: half its diagonal.
SEEN_WITHIN_M = 2.5
#: Starts of stretches that are tried lie so far apart.
SEARCH_STEP_S = 0.5


class UnsuitableError(ValueError):
    """A stretch of a log past which the street cannot be laid; the text says why."""


class Stretch(msgspec.Struct, frozen=True, kw_only=True):
    """Which part of a log is driven, and what it is like; times from the log's first state on."""

    log: str
    from_s: float
    to_s: float
    slowest_mps: float
    fastest_mps: float
    turn_deg: float
    #: Standing before it in all, in which the bias can be learnt; 0 where there is none.
    rest_s: float
    jitter_ms: float


@dataclass(frozen=True)
class Course:
    """A drive: street and true motion in the vehicle's frame at the start, how it is played, what the bus says.

    `player` takes seed and chirps a beam; `states` takes the seed.
    """

    scene: Scene
    motion: Drive
    player: Callable[[int, int], ScenePlayer | DrivePlayer]
    states: Callable[[int], list[VehicleState]]
    #: None: no log.
    stretch: Stretch | None = None


def street() -> Scene:
    """The junction, as `mirrorwave launch launch/side_street.yaml` shows it live."""
    return load_scene(SCENE)


def scripted() -> Course:
    """Constant speed and yaw rate; states with noise and bias after a rest."""
    scene = street()
    speed_mps, yaw_rate_rps = scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps)
    return Course(
        scene=scene,
        motion=Drive(np.array([0.0, 1.0]), np.full(2, speed_mps), np.full(2, yaw_rate_rps)),
        player=lambda seed, chirps: ScenePlayer(scene, seed, start_ns=START_NS, chirps_per_beam=chirps),
        states=lambda seed: _scripted_states(scene.ego, SCANS * PERIOD_S, seed),
    )


def _scripted_states(ego: Ego, duration_s: float, seed: int) -> list[VehicleState]:
    """What the bus says: at rest for a while before the first scan, then driving; a constant bias and white noise."""
    rng = np.random.default_rng([seed, 21])
    found = []
    for time_s in np.arange(-REST_S, duration_s, STATE_PERIOD_S):
        drives = time_s >= -1e-9
        speed_mps = ego.speed_mps + SPEED_STD_MPS * rng.standard_normal() if drives else 0.0
        turning_rps = math.radians(ego.yaw_rate_dps) if drives else 0.0
        yaw_rate_rps = turning_rps + BIAS_RPS + YAW_RATE_STD_RPS * rng.standard_normal()
        stamp_ns = START_NS + ns_from_s(float(time_s))
        found.append(VehicleState(stamp_ns=stamp_ns, speed_mps=float(speed_mps), yaw_rate_rps=float(yaw_rate_rps)))
    return found


def read_states(log: Path, dbc: Path, mapping: Path) -> list[VehicleState]:
    """All states of a log; raises ValueError naming the file that cannot be read or says nothing, else OSError."""
    states = [state for step in log_states(load_decoder(dbc, mapping), read_log(log)) for state in step.states]
    if not any(state.valid for state in states):
        why = states[-1].reason if states else "it holds no frames"
        raise ValueError(f"{log}: no valid vehicle state: {why}")
    if any(after.stamp_ns < before.stamp_ns for before, after in pairwise(states)):
        raise ValueError(f"{log}: its stamps go back, must rise")
    return states


def logged(states: Sequence[VehicleState], name: str, from_s: float | None = None, seeds: int = 1) -> Course:
    """The drive from `from_s` on, else from the first start that suits; UnsuitableError where none does."""
    if from_s is not None:
        return _course(states, name, from_s, seeds)
    for start_s in np.arange(0.0, _duration_s(states), SEARCH_STEP_S):
        try:
            return _course(states, name, float(start_s), seeds)
        except UnsuitableError:
            continue
    duration_s = SCANS * PERIOD_S
    raise UnsuitableError(f"{name}: no stretch of {duration_s:g} s suits the street; --from S says why one does not")


def _duration_s(states: Sequence[VehicleState]) -> float:
    return s_from_ns(states[-1].stamp_ns - states[0].stamp_ns)


def _course(states: Sequence[VehicleState], name: str, from_s: float, seeds: int) -> Course:
    """The drive from one start; UnsuitableError names what it lacks."""
    where = f"{name}: from {from_s:g} s"
    if not 0.0 <= from_s <= _duration_s(states):
        raise UnsuitableError(f"{where}: must lie within the log, 0..{_duration_s(states):.1f} s")
    start_ns = states[0].stamp_ns + ns_from_s(from_s)
    motion = _motion(states, start_ns, where)
    _require_suitable(motion, where)
    scene = moved(street(), motion.pose(SIGHT_S) @ _scripted_pose(SIGHT_S).inverse())
    _require_room(scene, motion, where)

    def player(seed: int, chirps: int) -> DrivePlayer:
        return DrivePlayer(scene, motion, Pose2(), seed, start_ns, chirps)

    for seed in range(seeds):
        _require_sight(player(seed, 1), where)
    told = [_biased(one) for one in states if one.stamp_ns <= start_ns + ns_from_s(SCANS * PERIOD_S)]
    return Course(scene, motion, player, lambda seed: list(told), _stretch(told, motion, name, start_ns))


def _biased(state: VehicleState) -> VehicleState:
    return msgspec.structs.replace(state, yaw_rate_rps=state.yaw_rate_rps + BIAS_RPS)


def _motion(states: Sequence[VehicleState], start_ns: int, where: str) -> Drive:
    """Speed and yaw rate over the stretch and a little around it, smoothed; UnsuitableError where states lack."""
    grid_s = np.arange(-MARGIN_S, SCANS * PERIOD_S + MARGIN_S, GRID_S)
    low_ns, high_ns = (start_ns + ns_from_s(float(end_s)) for end_s in (grid_s[0], grid_s[-1]))
    first = bisect_left(states, low_ns, key=lambda state: state.stamp_ns)
    last = bisect_right(states, high_ns, key=lambda state: state.stamp_ns)
    valid = [state for state in states[first:last] if state.valid]
    time_s = np.array([s_from_ns(state.stamp_ns - start_ns) for state in valid])
    gap_s = np.diff(np.concatenate([grid_s[:1], time_s, grid_s[-1:]])).max()
    if gap_s > MAX_GAP_S:
        raise UnsuitableError(f"{where}: {gap_s:.2f} s without a valid state, must be {MAX_GAP_S:g} s at most")
    told = np.array([(state.speed_mps, state.yaw_rate_rps) for state in valid]).T
    smooth = [gaussian_filter1d(np.interp(grid_s, time_s, one), SMOOTH_S / GRID_S, mode="nearest") for one in told]
    return Drive(grid_s, *smooth)


def _stretch(states: Sequence[VehicleState], motion: Drive, name: str, start_ns: int) -> Stretch:
    """A stretch and the rest before it, in words."""
    speed_mps, turn_deg = _speeds_and_turn(motion)
    before = [state for state in states if state.stamp_ns <= start_ns]
    standstill_mps = OdometryParams().standstill_speed_mps
    rest_ns = [
        now.stamp_ns - last.stamp_ns
        for last, now in pairwise(before)
        if last.valid and now.valid and abs(now.speed_mps) <= standstill_mps
    ]
    periods_ns = np.diff([state.stamp_ns for state in states[len(before) :]])
    from_s = s_from_ns(start_ns - states[0].stamp_ns)
    return Stretch(
        log=name,
        from_s=from_s,
        to_s=from_s + SCANS * PERIOD_S,
        slowest_mps=float(speed_mps.min()),
        fastest_mps=float(speed_mps.max()),
        turn_deg=turn_deg,
        rest_s=s_from_ns(sum(rest_ns)),
        jitter_ms=1e-6 * float(np.std(periods_ns)),
    )


def _speeds_and_turn(motion: Drive) -> tuple[np.ndarray, float]:
    """Speeds, m/s, of the stretch, and how far its headings are apart, deg."""
    time_s = np.arange(0.0, SCANS * PERIOD_S, GRID_S)
    turned_rad = np.cumsum(motion.yaw_rate_at(time_s)) * GRID_S
    return motion.speed_at(time_s), math.degrees(float(np.ptp(turned_rad)))


def _require_suitable(motion: Drive, where: str) -> None:
    """A few metres a second, and a turn; else UnsuitableError."""
    speed_mps, turn_deg = _speeds_and_turn(motion)
    low, high = SPEEDS_MPS
    if not low <= speed_mps.min() <= speed_mps.max() <= high:
        told = f"{speed_mps.min():.1f}..{speed_mps.max():.1f}"
        raise UnsuitableError(f"{where}: speed {told} m/s, must stay within {low:g}..{high:g}")
    if turn_deg < MIN_TURN_DEG:
        raise UnsuitableError(f"{where}: turns by {turn_deg:.1f} deg, must be {MIN_TURN_DEG:g} at least")


def _scripted_pose(time_s: float) -> Pose2:
    """Where the scripted drive has the radar in the street's own frame."""
    ego = street().ego
    return ego_motion(ego.speed_mps, math.radians(ego.yaw_rate_dps), time_s)


def moved(scene: Scene, outer_from_scene: Pose2) -> Scene:
    """The same scene told in another frame, its radar standing."""

    def wall(one: Surface) -> Surface:
        points_m = outer_from_scene.apply(np.array(one.polyline_m)).tolist()
        return msgspec.structs.replace(one, polyline_m=tuple((x, y) for x, y in points_m))

    def thing(one: SceneObject) -> SceneObject:
        x_m, y_m = outer_from_scene.apply(np.array([one.x_m, one.y_m])).tolist()
        yaw_deg = one.yaw_deg + math.degrees(outer_from_scene.yaw_rad)
        return msgspec.structs.replace(one, x_m=x_m, y_m=y_m, yaw_deg=yaw_deg)

    surfaces, objects = tuple(map(wall, scene.surfaces)), tuple(map(thing, scene.objects))
    return msgspec.structs.replace(scene, surfaces=surfaces, objects=objects, ego=Ego())


def _require_room(scene: Scene, motion: Drive, where: str) -> None:
    """The way up to the corner keeps off all walls; else UnsuitableError."""
    poses = [motion.pose(time_s) for time_s in np.arange(0.0, SIGHT_S, PERIOD_S)]
    way_m = np.array([[pose.x_m, pose.y_m] for pose in poses])
    lines = [np.array(surface.polyline_m) for surface in scene.surfaces]
    room_m = min(_distance_m(way_m, a, b) for line in lines for a, b in pairwise(line))
    if room_m < CLEARANCE_M:
        raise UnsuitableError(
            f"{where}: passes a wall of the street at {room_m:.2f} m, must be {CLEARANCE_M:g} at least"
        )


def _distance_m(points_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Least distance of points [N, 2] from the line from a to b."""
    along = b - a
    share = np.clip((points_m - a) @ along / (along @ along), 0.0, 1.0)
    return float(np.hypot(*(points_m - a - share[:, None] * along).T).min())


def _require_sight(player: DrivePlayer, where: str) -> None:
    """By truth: the car is seen in the mirror alone for some scans, and then directly; else UnsuitableError."""
    for number in range(SCANS):
        truth = player.truth(number)
        if truth.objects[CAR].hidden:
            continue
        if number >= MIN_HIDDEN and in_sight(truth):
            return
        raise UnsuitableError(
            f"{where}: the car is hidden for {number} scans, must be {MIN_HIDDEN} at least and then in sight"
        )
    raise UnsuitableError(f"{where}: the car stays hidden for all {SCANS} scans")


def in_sight(truth: SceneTruth) -> bool:
    """Whether the moving car shows direct echoes."""
    car = truth.objects[CAR]
    away_m = np.hypot(*(truth.los_points_m[:, :2] - np.array([car.x_m, car.y_m])).T)
    return not car.hidden and bool((away_m < SEEN_WITHIN_M).any())
