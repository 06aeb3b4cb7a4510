"""Mounting pose of the radar on the vehicle and its clock offset, from walls seen while driving.

Walls are static in the world: transformed there by the vehicle's odometry and the right mounting, all sightings of a
wall fall on one line. Pose, clock, the odometry's own errors (bias of the yaw rate, scale of the speed) and all walls
are solved for together, by robust weighted least squares on the distances of points from their wall.

Quantities that a drive does not determine are not guessed: one whose standard deviation stays above its limit is
reported as its prior, while the others are those of the solution in which it was free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import least_squares

from msgs.values.frames import Pose2, wrap_angle
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.vehicle import VehicleState

#: Unknowns before the walls (angle and offset of each), in this order.
UNKNOWNS = ("x_m", "y_m", "yaw_rad", "clock_offset_s", "yaw_rate_bias_rps", "speed_scale")
#: Step of central differences, in metres, radians, seconds.
STEP = 1e-5
#: The calibrated quantities; the rest are the odometry's errors.
WANTED = UNKNOWNS[:4]


#: Gates of sightings of one wall (angle, offset), before and after the first solution, and how often they are solved.
FIRST_GATE, GATE, ROUNDS = (math.radians(12.0), 2.5), (math.radians(5.0), 0.8), 3
#: Maximum gap along a wall between its sightings; unevenness of walls, added to each point's own error.
GAP_M, FLATNESS_M = 15.0, 0.05
MIN_SCANS, MIN_SIGHTINGS = 10, 3
#: Travel and turn below which a vehicle counts as stationary.
MIN_WAY_M, MIN_TURN_DEG = 3.0, 10.0
MAX_CLOCK_OFFSET_S = 0.5
#: Standard deviations of `WANTED` above which a drive does not determine a quantity.
KNOWN_STD = np.array([0.15, 0.15, math.radians(0.7), 0.03])
#: Prior standard deviations of `UNKNOWNS`: of the mounting very wide, of the odometry those of typical cars.
PRIOR_STD = np.array([3.0, 3.0, math.radians(20.0), 0.5, math.radians(0.5), 0.01])
#: A longer silence of the bus ends a stretch of odometry; the longest stretch is used.
MAX_GAP_S = 0.5


class Sighting(NamedTuple):
    """A straight wall in one scan, radar frame at `stamp_ns`: unit normal [2], ends [2, 2], points [N, 2] with
    covariances [N, 2, 2], metres."""

    stamp_ns: int
    normal: np.ndarray
    ends_m: np.ndarray
    points_m: np.ndarray
    covariance_m2: np.ndarray


class CalibratedQuantity(msgspec.Struct, frozen=True, kw_only=True):
    """One quantity with its standard deviation; `observed` False: undetermined by the drive, the value is the prior."""

    value: float
    std: float
    observed: bool


class WallFit(msgspec.Struct, frozen=True, kw_only=True):
    """Residuals of the sightings of one wall about one line; ends in the odometry frame."""

    sightings: int
    points: int
    rms_m: float
    ends_m: tuple[tuple[float, float], tuple[float, float]]


class DriveSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Motion of the vehicle while walls were seen; spans are of the middle nine tenths of the states."""

    way_m: float
    turned_deg: float
    speed_span_mps: float
    yaw_rate_span_dps: float


class Mounting(msgspec.Struct, frozen=True, kw_only=True):
    """The result: stamps of the bus plus `clock_offset_s` are times of the radar."""

    x_m: CalibratedQuantity
    y_m: CalibratedQuantity
    yaw_rad: CalibratedQuantity
    clock_offset_s: CalibratedQuantity
    yaw_rate_bias_rps: float
    speed_scale: float
    #: The solution itself, determined by the drive or not: the best fit of the walls.
    solved_pose: Pose2
    solved_clock_s: float
    #: Residuals of all points in metres and in their own standard deviations, before (with the prior) and after.
    rms_before_m: float
    rms_m: float
    rms_sigmas: float
    scans: int
    sightings: int
    points: int
    drive: DriveSummary
    walls: tuple[WallFit, ...]

    @property
    def vehicle_from_radar(self) -> Pose2:
        """The pose, with the prior for undetermined quantities."""
        return Pose2(self.x_m.value, self.y_m.value, self.yaw_rad.value)


class Motion:
    """Odometry of one stretch as poses at any time, for any error of the odometry.

    Raises ValueError if fewer than two valid states follow one another.
    """

    def __init__(self, states: Sequence[VehicleState]) -> None:
        states = sorted((state for state in states if state.valid), key=lambda state: state.stamp_ns)
        if len(states) < 2:
            raise ValueError(f"vehicle/state must hold at least 2 valid states, got {len(states)}")
        stamp_ns = np.array([state.stamp_ns for state in states], np.int64)
        gaps = np.flatnonzero(np.diff(stamp_ns) > MAX_GAP_S * NANOSECONDS_PER_SECOND) + 1
        stretch = max(np.split(np.arange(len(states)), gaps), key=lambda part: stamp_ns[part[-1]] - stamp_ns[part[0]])
        first = stretch[np.flatnonzero(np.diff(stamp_ns[stretch], prepend=-1) > 0)]
        self.start_ns = int(stamp_ns[first[0]])
        #: Seconds after `start_ns`, rising; speed and yaw rate as received; [N].
        self.time_s = (stamp_ns[first] - self.start_ns) / NANOSECONDS_PER_SECOND
        self.speed_mps = np.array([states[index].speed_mps for index in first])
        self.yaw_rate_rps = np.array([states[index].yaw_rate_rps for index in first])

    @property
    def rest_bias_rps(self) -> float:
        """Mean yaw rate at rest, if the rest lasts a second; else zero."""
        rests = np.abs(self.speed_mps) < 0.05
        return float(self.yaw_rate_rps[rests].mean()) if rests.mean() * self.time_s[-1] >= 1.0 else 0.0

    def seconds(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return times after the start of stamps of the bus."""
        return (np.asarray(stamp_ns, np.int64) - self.start_ns) / NANOSECONDS_PER_SECOND

    def poses(self, time_s: np.ndarray, bias_rps: float = 0.0, scale: float = 1.0) -> np.ndarray:
        """Return x, y [m] and heading [rad], not wrapped, at times within the stretch: [N, 3].

        Trapezoids between states; between poses straight lines, 0.2 mm off at 50 Hz and 3 m/s^2 across.
        """
        step_s = np.diff(self.time_s)
        turn_rad = 0.5 * (self.yaw_rate_rps[1:] + self.yaw_rate_rps[:-1] - 2.0 * bias_rps) * step_s
        travel_m = 0.5 * scale * (self.speed_mps[1:] + self.speed_mps[:-1]) * step_s
        yaw_rad = np.concatenate([[0.0], np.cumsum(turn_rad)])
        middle_rad = yaw_rad[:-1] + 0.5 * turn_rad
        x_m = np.concatenate([[0.0], np.cumsum(travel_m * np.cos(middle_rad))])
        y_m = np.concatenate([[0.0], np.cumsum(travel_m * np.sin(middle_rad))])
        return np.stack([np.interp(time_s, self.time_s, values) for values in (x_m, y_m, yaw_rad)], axis=1)

    def state_at(self, stamp_ns: int, bias_rps: float = 0.0, scale: float = 1.0) -> VehicleState | None:
        """Return speed and yaw rate without the odometry's errors; None outside the stretch."""
        time_s = s_from_ns(stamp_ns - self.start_ns)
        if not 0.0 <= time_s <= self.time_s[-1]:
            return None
        speed_mps = scale * float(np.interp(time_s, self.time_s, self.speed_mps))
        yaw_rate_rps = float(np.interp(time_s, self.time_s, self.yaw_rate_rps)) - bias_rps
        return VehicleState(stamp_ns=stamp_ns, speed_mps=speed_mps, yaw_rate_rps=yaw_rate_rps)


@dataclass(frozen=True)
class _Problem:
    """Points of all sightings with their walls; the unknowns are `UNKNOWNS` and two of each wall."""

    motion: Motion
    prior: np.ndarray
    prior_std: np.ndarray
    #: Of each scan: seconds on the radar's clock.
    scan_time_s: np.ndarray
    #: Of each point: scan, position and covariance in the radar frame, wall.
    scan: np.ndarray
    points_m: np.ndarray
    covariance_m2: np.ndarray
    wall: np.ndarray
    #: Of each wall, in the odometry frame: its pivot point, and its normal's direction.
    pivot_m: np.ndarray
    normal_rad: np.ndarray
    flatness_m: float

    def points_in_odom(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points in the odometry frame [N, 2] and the heading of the radar at each [N]."""
        x_m, y_m, yaw_rad, clock_s, bias_rps, scale = unknowns[: len(UNKNOWNS)]
        pose = self.motion.poses(self.scan_time_s - clock_s, bias_rps, scale)[self.scan]
        in_vehicle = _rotated(self.points_m, yaw_rad) + np.array([x_m, y_m])
        return _rotated(in_vehicle, pose[:, 2]) + pose[:, :2], pose[:, 2] + yaw_rad

    def normals(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the unit normal of each point's wall, [N, 2]."""
        angle_rad = (self.normal_rad + unknowns[len(UNKNOWNS) :: 2])[self.wall]
        return np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)

    def off_wall_m(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the distance of each point from its wall, [N]."""
        points_m, _ = self.points_in_odom(unknowns)
        along_normal = np.einsum("ni,ni->n", points_m - self.pivot_m[self.wall], self.normals(unknowns))
        return np.asarray(along_normal - unknowns[len(UNKNOWNS) + 1 :: 2][self.wall])

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Return derivatives of the distances, [N, unknowns]: analytic for walls, central differences for the rest."""
        result = np.zeros((len(self.wall), len(unknowns)))
        for index in range(len(UNKNOWNS)):
            step = np.zeros(len(unknowns))
            step[index] = STEP
            result[:, index] = (self.off_wall_m(unknowns + step) - self.off_wall_m(unknowns - step)) / (2.0 * STEP)
        normal, point = self.normals(unknowns), np.arange(len(self.wall))
        from_pivot = self.points_in_odom(unknowns)[0] - self.pivot_m[self.wall]
        result[point, len(UNKNOWNS) + 2 * self.wall] = from_pivot[:, 1] * normal[:, 0] - from_pivot[:, 0] * normal[:, 1]
        result[point, len(UNKNOWNS) + 2 * self.wall + 1] = -1.0
        return result

    def std_m(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the standard deviation of each distance, [N]."""
        _, heading_rad = self.points_in_odom(unknowns)
        normal = _rotated(self.normals(unknowns), -heading_rad)
        variance = np.einsum("ni,nij,nj->n", normal, self.covariance_m2, normal)
        return np.sqrt(variance + self.flatness_m**2)


def _rotated(vectors: np.ndarray, angle_rad: np.ndarray | float) -> np.ndarray:
    """Return vectors [N, 2], each turned by its own angle or all by one."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=1)


def solve_mounting(
    sightings: Sequence[Sighting],
    states: Sequence[VehicleState],
    prior: Pose2 | None = None,
    clock_offset_s: float | None = None,
    known_pose: bool = False,
) -> Mounting:
    """Return pose and clock from straight walls seen along a drive.

    `clock_offset_s` and `known_pose` hold the clock or the pose (at `prior`). Raises ValueError for a drive without
    walls, scans or motion.
    """
    prior, motion = prior or Pose2(), Motion(states)
    clock_s = clock_offset_s or 0.0
    margin_s = MAX_CLOCK_OFFSET_S if clock_offset_s is None else 0.0
    sightings = _within(sightings, motion, clock_s, margin_s)
    _require_scans(sightings)
    start = np.array([prior.x_m, prior.y_m, prior.yaw_rad, clock_s, motion.rest_bias_rps, 1.0])
    drive = _drive_of(motion, sightings, clock_s)
    if drive.way_m < MIN_WAY_M and drive.turned_deg < MIN_TURN_DEG:
        raise ValueError(
            f"the vehicle must move {MIN_WAY_M:g} m or turn {MIN_TURN_DEG:g} deg while walls are seen, "
            f"got {drive.way_m:.2f} m and {drive.turned_deg:.1f} deg"
        )
    held = np.array([known_pose] * 3 + [clock_offset_s is not None, False, False])
    problem, unknowns = _rounds(sightings, motion, start, held)
    std = _std(problem, unknowns, _held(problem, held))
    observed = ~held[: len(WANTED)] & (std[: len(WANTED)] <= KNOWN_STD)
    before = np.concatenate([start, unknowns[len(UNKNOWNS) :]])
    before = _fit(problem, before, np.arange(len(before)) < len(UNKNOWNS))
    return _report(problem, before, unknowns, std, observed, drive)


def _within(sightings: Sequence[Sighting], motion: Motion, clock_s: float, margin_s: float) -> list[Sighting]:
    """Return the sightings with odometry at their time, for any clock offset within the margin."""
    low_s, high_s = motion.time_s[0] + margin_s, motion.time_s[-1] - margin_s
    times = [s_from_ns(sighting.stamp_ns - motion.start_ns) - clock_s for sighting in sightings]
    return [sighting for sighting, time_s in zip(sightings, times, strict=True) if low_s <= time_s <= high_s]


def _require_scans(sightings: Sequence[Sighting]) -> None:
    scans = len({sighting.stamp_ns for sighting in sightings})
    if scans < MIN_SCANS:
        raise ValueError(f"straight walls must be seen in at least {MIN_SCANS} scans with states, got {scans}")


def _drive_of(motion: Motion, sightings: Sequence[Sighting], clock_s: float) -> DriveSummary:
    stamps = np.array([sighting.stamp_ns for sighting in sightings], np.int64)
    time_s = motion.seconds(np.array([stamps.min(), stamps.max()])) - clock_s
    inside = (motion.time_s >= time_s[0]) & (motion.time_s <= time_s[1])
    poses = motion.poses(motion.time_s[inside], motion.rest_bias_rps)
    # single states are noisy: spans are those of the middle nine tenths
    speed, yaw_rate = motion.speed_mps[inside], motion.yaw_rate_rps[inside]
    return DriveSummary(
        way_m=float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
        turned_deg=math.degrees(float(np.ptp(poses[:, 2]))),
        speed_span_mps=float(np.ptp(np.percentile(speed, [5, 95]))),
        yaw_rate_span_dps=math.degrees(float(np.ptp(np.percentile(yaw_rate, [5, 95])))),
    )


def _held(problem: _Problem, held: np.ndarray) -> np.ndarray:
    """Return a mask of the unknowns that are held; no wall is."""
    return np.concatenate([held, np.zeros(2 * len(problem.pivot_m), bool)])


def _rounds(
    sightings: list[Sighting], motion: Motion, start: np.ndarray, held: np.ndarray
) -> tuple[_Problem, np.ndarray]:
    """Sort sightings to walls, solve, and repeat with the result."""
    unknowns = start
    for number in range(ROUNDS):
        problem = _problem(sightings, motion, start, unknowns, GATE if number else FIRST_GATE)
        full = np.concatenate([unknowns[: len(UNKNOWNS)], np.zeros(2 * len(problem.pivot_m))])
        full = _fit(problem, full, _held(problem, held), MAX_CLOCK_OFFSET_S)
        unknowns = full[: len(UNKNOWNS)]
    return problem, full


def _problem(
    sightings: list[Sighting], motion: Motion, prior: np.ndarray, unknowns: np.ndarray,
    gate: tuple[float, float],
) -> _Problem:  # fmt: skip
    """Return the sightings sorted to walls by the unknowns; ValueError if no wall is seen often enough."""
    x_m, y_m, yaw_rad, clock_s, bias_rps, scale = unknowns
    time_s = motion.seconds(np.array([sighting.stamp_ns for sighting in sightings], np.int64))
    poses = motion.poses(time_s - clock_s, bias_rps, scale)
    odom_from_radar = [Pose2(*pose) @ Pose2(x_m, y_m, yaw_rad) for pose in poses.tolist()]
    wall = _sorted_to_walls(sightings, odom_from_radar, gate, GAP_M)
    sighting_count = np.bincount(wall)
    kept = np.flatnonzero(sighting_count >= MIN_SIGHTINGS)
    if len(kept) == 0:
        raise ValueError(f"a straight wall must be seen at least {MIN_SIGHTINGS} times, got {sighting_count.max()}")
    of_kept = np.searchsorted(kept, wall) * np.isin(wall, kept) - ~np.isin(wall, kept)
    used = [index for index in range(len(sightings)) if of_kept[index] >= 0]
    counts = [len(sightings[index].points_m) for index in used]
    points_in_odom = [odom_from_radar[index].apply(sightings[index].points_m) for index in used]
    normals = [odom_from_radar[index].rotate(sightings[index].normal) for index in used]
    of_used = of_kept[used]
    scan_time_s, scan = np.unique(time_s[used], return_inverse=True)
    pivot, normal_rad = np.empty((len(kept), 2)), np.empty(len(kept))
    for index in range(len(kept)):
        members = [number for number in range(len(used)) if of_used[number] == index]
        pivot[index] = np.concatenate([points_in_odom[number] for number in members]).mean(axis=0)
        normal_rad[index] = np.arctan2(*_one_side(np.array([normals[number] for number in members])).sum(axis=0)[::-1])
    return _Problem(
        motion=motion,
        prior=prior,
        prior_std=PRIOR_STD,
        scan_time_s=scan_time_s,
        scan=np.repeat(scan, counts),
        points_m=np.concatenate([sightings[index].points_m for index in used]),
        covariance_m2=np.concatenate([sightings[index].covariance_m2 for index in used]),
        wall=np.repeat(of_used, counts),
        pivot_m=pivot,
        normal_rad=normal_rad,
        flatness_m=FLATNESS_M,
    )


def _one_side(normals: np.ndarray) -> np.ndarray:
    """Return normals [N, 2] turned to the side of the first: a wall may be seen from both."""
    return np.where((normals @ normals[0] < 0.0)[:, None], -normals, normals)


class _LastSighting(NamedTuple):
    """The last sighting of a wall: its direction, its ends in the odometry frame."""

    tangent: np.ndarray
    ends_m: np.ndarray


def _sorted_to_walls(
    sightings: Sequence[Sighting], odom_from_radar: Sequence[Pose2], gate: tuple[float, float], gap_m: float
) -> np.ndarray:
    """Return each sighting's wall number, in order of time, int64 [N]; each is compared with a wall's last sighting."""
    walls: list[_LastSighting] = []
    wall_of_sighting = np.empty(len(sightings), np.int64)
    for index in sorted(range(len(sightings)), key=lambda number: sightings[number].stamp_ns):
        pose, sighting = odom_from_radar[index], sightings[index]
        normal = pose.rotate(sighting.normal)
        now = _LastSighting(np.array([-normal[1], normal[0]]), pose.apply(sighting.ends_m))
        off = [_off(now, wall, gate[0], gap_m) for wall in walls]
        best = int(np.argmin(off)) if off else -1
        if best >= 0 and off[best] <= gate[1]:
            walls[best] = now
        else:
            best = len(walls)
            walls.append(now)
        wall_of_sighting[index] = best
    return wall_of_sighting


def _off(now: _LastSighting, wall: _LastSighting, gate_rad: float, gap_m: float) -> float:
    """Return the distance across of the nearer parts of two sightings; infinite if they are of two walls."""
    if abs(float(now.tangent @ wall.tangent)) < math.cos(gate_rad):
        return math.inf
    reach, before = np.sort(now.ends_m @ wall.tangent), np.sort(wall.ends_m @ wall.tangent)
    low, high = max(reach[0], before[0]), min(reach[1], before[1])
    if low - high > gap_m:
        return math.inf
    middle = 0.5 * (low + high)
    return abs(_across(now, wall.tangent, middle) - _across(wall, wall.tangent, middle))


def _across(wall: _LastSighting, tangent: np.ndarray, reach_m: float) -> float:
    """Return a wall's offset across `tangent` at a reach along it."""
    a, b = wall.ends_m @ tangent
    share = (reach_m - a) / (b - a) if abs(b - a) > 1e-6 else 0.5
    position = wall.ends_m[0] + share * (wall.ends_m[1] - wall.ends_m[0])
    return float(tangent[0] * position[1] - tangent[1] * position[0])


def _residuals(problem: _Problem, unknowns: np.ndarray, std_m: np.ndarray) -> np.ndarray:
    """Return distances in standard deviations, then the priors, [N + 6]."""
    prior = (unknowns[: len(UNKNOWNS)] - problem.prior) / problem.prior_std
    return np.concatenate([problem.off_wall_m(unknowns) / std_m, prior])


def _residual_jacobian(problem: _Problem, unknowns: np.ndarray, std_m: np.ndarray) -> np.ndarray:
    """Return derivatives of the residuals, [N + 6, unknowns]."""
    prior = np.zeros((len(UNKNOWNS), len(unknowns)))
    np.fill_diagonal(prior, 1.0 / problem.prior_std)
    return np.concatenate([problem.jacobian(unknowns) / std_m[:, None], prior])


def _fit(problem: _Problem, unknowns: np.ndarray, held: np.ndarray, clock_limit_s: float = 0.5) -> np.ndarray:
    """Return the unknowns that are not held, at the least soft-L1 sum of residuals; reweighted once."""
    free = np.flatnonzero(~held)
    limit = np.full(len(unknowns), np.inf)
    limit[UNKNOWNS.index("clock_offset_s")] = clock_limit_s + abs(unknowns[UNKNOWNS.index("clock_offset_s")])
    for _ in range(2):
        start, std_m = unknowns.copy(), problem.std_m(unknowns)

        def whole(values: np.ndarray, start: np.ndarray = start) -> np.ndarray:
            every = start.copy()
            every[free] = values
            return every

        unknowns = whole(
            least_squares(
                lambda values, std_m=std_m, whole=whole: _residuals(problem, whole(values), std_m),
                start[free],
                jac=lambda values, std_m=std_m, whole=whole: _residual_jacobian(problem, whole(values), std_m)[:, free],
                loss="soft_l1",
                f_scale=2.0,
                x_scale="jac",
                bounds=(-limit[free], limit[free]),
                ftol=1e-6,
                xtol=1e-7,
            ).x
        )
    return unknowns


def _std(problem: _Problem, unknowns: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each unknown, zero if held: the larger of two.

    One takes all points as independent and inflates by their residuals, the other takes the common error of the points
    of a scan as one error of that scan (clustered covariance).
    """
    free = np.flatnonzero(~held)
    std_m = problem.std_m(unknowns)
    residuals = _residuals(problem, unknowns, std_m)
    jacobian = _residual_jacobian(problem, unknowns, std_m)[:, free]
    count = len(problem.scan)
    weight = np.ones(len(residuals))
    weight[:count] = 1.0 / np.sqrt(1.0 + (residuals[:count] / 2.0) ** 2)
    # columns of one size: seconds, metres and radians would make the inverse ill-conditioned
    size = np.sqrt((weight[:, None] * jacobian**2).sum(axis=0))
    scaled = jacobian / size
    inverse = np.linalg.inv((scaled * weight[:, None]).T @ scaled)
    inflate = max(1.0, float((weight * residuals**2)[:count].sum() / max(count - len(free), 1)))
    pull = np.zeros((int(problem.scan.max()) + 1, len(free)))
    np.add.at(pull, problem.scan, scaled[:count] * (weight * residuals)[:count, None])
    clustered = inverse @ (pull.T @ pull) @ inverse
    variance = np.maximum(inflate * np.diag(inverse), np.diag(clustered))
    result = np.zeros(len(unknowns))
    result[free] = np.sqrt(variance) / size
    return result


def _report(
    problem: _Problem, before: np.ndarray, unknowns: np.ndarray, std: np.ndarray, observed: np.ndarray,
    drive: DriveSummary,
) -> Mounting:  # fmt: skip
    off_m = problem.off_wall_m(unknowns)
    # the rest was free in the solution: a determined result does not depend on a prior that may be wrong
    quantities = [
        CalibratedQuantity(
            value=float(value if is_observed else prior), std=float(deviation), observed=bool(is_observed)
        )
        for value, prior, deviation, is_observed in zip(unknowns, problem.prior, std, observed, strict=False)
    ]
    x_m, y_m, yaw_rad, clock_offset_s = quantities
    return Mounting(
        x_m=x_m,
        y_m=y_m,
        yaw_rad=msgspec.structs.replace(yaw_rad, value=wrap_angle(yaw_rad.value)),
        clock_offset_s=clock_offset_s,
        yaw_rate_bias_rps=float(unknowns[UNKNOWNS.index("yaw_rate_bias_rps")]),
        speed_scale=float(unknowns[UNKNOWNS.index("speed_scale")]),
        solved_pose=Pose2(*unknowns[:3].tolist()),
        solved_clock_s=float(unknowns[UNKNOWNS.index("clock_offset_s")]),
        rms_before_m=_rms(problem.off_wall_m(before)),
        rms_m=_rms(off_m),
        rms_sigmas=_rms(off_m / problem.std_m(unknowns)),
        scans=int(problem.scan.max()) + 1,
        sightings=len(np.unique(np.stack([problem.scan, problem.wall]), axis=1).T),
        points=len(off_m),
        drive=drive,
        walls=tuple(_wall_fit(problem, unknowns, off_m, wall) for wall in range(len(problem.pivot_m))),
    )


def _wall_fit(problem: _Problem, unknowns: np.ndarray, off_m: np.ndarray, wall: int) -> WallFit:
    on_wall = problem.wall == wall
    angle_rad = problem.normal_rad[wall] + unknowns[len(UNKNOWNS) + 2 * wall]
    normal = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    tangent = np.array([-normal[1], normal[0]])
    reach = (problem.points_in_odom(unknowns)[0][on_wall] - problem.pivot_m[wall]) @ tangent
    foot = problem.pivot_m[wall] + unknowns[len(UNKNOWNS) + 2 * wall + 1] * normal
    (ax, ay), (bx, by) = (foot + np.outer([reach.min(), reach.max()], tangent)).tolist()
    return WallFit(
        sightings=len(np.unique(problem.scan[on_wall])),
        points=int(on_wall.sum()),
        rms_m=_rms(off_m[on_wall]),
        ends_m=((ax, ay), (bx, by)),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
