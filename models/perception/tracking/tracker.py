"""Tracking of hidden objects over scans in an odometry frame: nearly-constant-velocity Kalman filters and assignment.

Each object comes with its own covariance and its own time of measurement, so a track is predicted to that time, gated
by Mahalanobis distance and assigned to at most one object of a scan (global nearest neighbour). A track is confirmed
by M hits in N scans; ids are never used twice.

No tracking library is used: Stone Soup 1.9.1 would bring plotly, rtree, pymap3d, utm, ruamel.yaml and ordered-set to
the vehicle, FilterPy 2.0.0 has filters but no tracks, gates or assignment. The filter itself is 20 lines.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from models.perception.tracking.odometry import OdometryPose
from models.physics.mirror import blocked
from msgs.values.arrays import require_positive
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Covariance, HiddenObject, Track, Wall
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import ego_motion

#: Cost of a pair outside the gate: larger than any sum of those inside.
FORBIDDEN = 1e9
#: An object measured further from its scan's stamp does not belong to that scan.
LONGEST_SCAN_NS = 2_000_000_000
#: A radar at the reference point of the vehicle's motion.
FRONT = Pose2()
#: Measurement matrix of a state (x, y, vx, vy).
MEASURED = np.eye(2, 4)


class TrackerParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Motion model, track confirmation and deletion, and the horizon of the prediction."""

    #: Spectral density of the white acceleration: after 1 s the velocity has this variance more.
    acceleration_density_m2ps3: float = 2.0
    #: Standard deviation of the velocity of an object detected once, along each axis.
    first_speed_std_mps: float = 8.0
    #: Added to each object's own: the centre of the visible part of a vehicle wanders over its face.
    place_std_m: float = 0.4
    #: Square of the Mahalanobis distance: 99.7 % of true pairs in two dimensions.
    gate: float = 11.8
    confirm_hits: int = 3
    confirm_scans: int = 5
    #: A confirmed track is deleted after more misses in a row.
    max_misses: int = 5
    #: All tracks are deleted where no scan arrived for longer, or the clock went back by more.
    max_gap_s: float = 2.0
    horizon_s: float = 6.0
    step_s: float = 0.1
    #: An object comes into sight with its nose, so far ahead of the centre of its visible part.
    nose_m: float = 2.0
    #: Walls of scans this recent still block: a scan does not find every wall.
    wall_memory_s: float = 1.5
    #: Slower objects count as stationary: the time to appear then follows from the ego motion alone.
    slow_mps: float = 0.5

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require_positive(f"tracker.{name}", getattr(self, name))
        if self.confirm_hits > self.confirm_scans:
            raise ValueError(
                f"tracker.confirm_hits must be at most confirm_scans ({self.confirm_scans}), got {self.confirm_hits!r}"
            )


@dataclass(frozen=True)
class Estimate:
    """State (x, y, vx, vy) [m, m/s] of an object in the odometry frame at a time, with its covariance [4, 4]."""

    stamp_ns: int
    mean: np.ndarray
    covariance: np.ndarray

    def at(self, stamp_ns: int, density_m2ps3: float) -> Estimate:
        """Return the state at another time, before or after; uncertainty grows either way."""
        if stamp_ns == self.stamp_ns:
            return self
        elapsed_s = s_from_ns(stamp_ns - self.stamp_ns)
        step = np.eye(4) + elapsed_s * np.eye(4, k=2)
        covariance = step @ self.covariance @ step.T + motion_noise(elapsed_s, density_m2ps3)
        return Estimate(stamp_ns, step @ self.mean, _symmetric(covariance))

    def updated(self, position_m: np.ndarray, measurement_covariance_m2: np.ndarray) -> Estimate:
        """Return the state after a position measurement; Joseph's form, a sum of squares whatever the gain's
        rounding.
        """
        gain = _gain(self.covariance, measurement_covariance_m2)
        rest = np.eye(4) - gain @ MEASURED
        covariance = rest @ self.covariance @ rest.T + gain @ measurement_covariance_m2 @ gain.T
        return Estimate(self.stamp_ns, self.mean + gain @ (position_m - self.mean[:2]), _symmetric(covariance))


def motion_noise(elapsed_s: float, density_m2ps3: float) -> np.ndarray:
    """Return the covariance [4, 4] that white acceleration adds over a time, which may be negative."""
    # back in time only the covariance of position and velocity changes its sign
    length_s, cross = abs(elapsed_s), 0.5 * elapsed_s * abs(elapsed_s)
    block = np.array([[length_s**3 / 3.0, cross], [cross, length_s]])
    return density_m2ps3 * np.kron(block, np.eye(2))


def _gain(covariance: np.ndarray, measurement_covariance_m2: np.ndarray) -> np.ndarray:
    """Return the Kalman gain [4, 2] of a measured position."""
    return np.linalg.solve(covariance[:2, :2] + measurement_covariance_m2, covariance[:2]).T


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


@dataclass(frozen=True)
class Sighting:
    """A hidden object in the odometry frame: position [2], covariance [2, 2], time of measurement."""

    stamp_ns: int
    position_m: np.ndarray
    covariance_m2: np.ndarray


@dataclass
class _TrackState:
    """State of one track."""

    id: int
    first_ns: int
    estimate: Estimate
    #: Hit or miss in the last scans, newest last.
    hits: deque[bool]
    confirmed: bool = False
    misses: int = 0
    #: A wall hid it at some time: only then can it come into sight.
    was_blocked: bool = False


@dataclass(frozen=True)
class _ScanWalls:
    """Walls of one scan, ends a and b [W, 2] in the odometry frame."""

    stamp_ns: int
    a: np.ndarray
    b: np.ndarray


@dataclass
class Tracker:
    """Tracker of the hidden objects of one radar; one call a scan, in the order of their stamps."""

    params: TrackerParams = field(default_factory=TrackerParams)
    _tracks: list[_TrackState] = field(default_factory=list, init=False)
    _walls: list[_ScanWalls] = field(default_factory=list, init=False)
    _next_id: int = field(default=1, init=False)
    _last_ns: int | None = field(default=None, init=False)
    _frame: int | None = field(default=None, init=False)
    _messages: tuple[Track, ...] = field(default=(), init=False)

    def step(self, frame: BevFrame, pose: OdometryPose | None, vehicle_from_radar: Pose2 = FRONT) -> tuple[Track, ...]:
        """Return the confirmed tracks after a scan, in the radar's axes and at the time of that scan's stamp, by id.

        `pose`: the vehicle at the scan's stamp (`ScanOdometry.at`); without it no object can be tracked and all tracks
        end, as they do when its frame changes. `stationary_pose` is the pose of a radar that never moves. A repeated or
        late scan changes nothing and returns the tracks of the scan before it again.
        """
        if pose is None:
            self._forget(None)
            return ()
        if self._is_late(frame.stamp_ns):
            return self._messages
        if pose.frame != self._frame or self._is_gap(frame.stamp_ns):
            self._forget(pose.frame)
        self._last_ns = frame.stamp_ns
        odom_from_radar = pose.odom_from_vehicle @ vehicle_from_radar
        self._follow(sightings(frame, odom_from_radar, self.params.place_std_m), frame.stamp_ns)
        a, b = self._recent_walls(frame, odom_from_radar)
        confirmed = [track for track in self._tracks if track.confirmed]
        ahead_m = radar_ahead(pose, vehicle_from_radar, self.params)
        self._messages = tuple(
            self._to_message(track, frame.stamp_ns, odom_from_radar, ahead_m, a, b) for track in confirmed
        )
        return self._messages

    def _is_late(self, stamp_ns: int) -> bool:
        if self._last_ns is None:
            return False
        return 0 <= self._last_ns - stamp_ns <= ns_from_s(self.params.max_gap_s)

    def _is_gap(self, stamp_ns: int) -> bool:
        return self._last_ns is not None and abs(stamp_ns - self._last_ns) > ns_from_s(self.params.max_gap_s)

    def _forget(self, frame: int | None) -> None:
        """End all tracks; the next id stays."""
        self._tracks, self._walls, self._last_ns, self._frame, self._messages = [], [], None, frame, ()

    def _follow(self, measurements: Sequence[Sighting], stamp_ns: int) -> None:
        """Assign, update, begin and end tracks."""
        density = self.params.acceleration_density_m2ps3
        pairs = assign([track.estimate for track in self._tracks], measurements, self.params)
        for index, track in enumerate(self._tracks):
            hit = pairs.get(index)
            if hit is not None:
                sighting = measurements[hit]
                track.estimate = track.estimate.at(sighting.stamp_ns, density).updated(
                    sighting.position_m, sighting.covariance_m2
                )
            else:
                track.estimate = track.estimate.at(max(stamp_ns, track.estimate.stamp_ns), density)
            self._count(track, hit is not None)
        self._tracks = [track for track in self._tracks if self._is_kept(track)]
        assigned = set(pairs.values())
        self._tracks += [self._begun(sighting) for index, sighting in enumerate(measurements) if index not in assigned]

    def _count(self, track: _TrackState, hit: bool) -> None:
        track.hits.append(hit)
        track.misses = 0 if hit else track.misses + 1
        track.confirmed |= sum(track.hits) >= self.params.confirm_hits

    def _is_kept(self, track: _TrackState) -> bool:
        if track.confirmed:
            return track.misses <= self.params.max_misses
        # with more misses than this, too few hits remain possible within the window
        return track.hits.count(False) <= self.params.confirm_scans - self.params.confirm_hits

    def _begun(self, sighting: Sighting) -> _TrackState:
        """Return a track of an object detected for the first time."""
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = sighting.covariance_m2
        covariance[2:, 2:] = self.params.first_speed_std_mps**2 * np.eye(2)
        estimate = Estimate(sighting.stamp_ns, np.append(sighting.position_m, np.zeros(2)), covariance)
        track = _TrackState(self._next_id, sighting.stamp_ns, estimate, deque([True], self.params.confirm_scans))
        track.confirmed = self.params.confirm_hits == 1
        self._next_id += 1
        return track

    def _recent_walls(self, frame: BevFrame, odom_from_radar: Pose2) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends [W, 2] in the odometry frame of the walls of this scan and of those shortly before."""
        oldest_ns = frame.stamp_ns - ns_from_s(self.params.wall_memory_s)
        self._walls = [walls for walls in self._walls if walls.stamp_ns >= oldest_ns]
        self._walls.append(_ScanWalls(frame.stamp_ns, *_wall_ends(frame.walls, odom_from_radar)))
        return np.concatenate([walls.a for walls in self._walls]), np.concatenate([walls.b for walls in self._walls])

    def _to_message(
        self,
        track: _TrackState,
        stamp_ns: int,
        odom_from_radar: Pose2,
        ahead_m: np.ndarray,
        a: np.ndarray,
        b: np.ndarray,
    ) -> Track:
        """Return the message of a track."""
        now = track.estimate.at(stamp_ns, self.params.acceleration_density_m2ps3)
        hidden = hidden_ahead(now.mean, ahead_m, a, b, self.params)
        track.was_blocked |= bool(hidden[0])
        radar_from_odom = odom_from_radar.inverse()
        at_m, velocity = radar_from_odom.apply(now.mean[:2]), radar_from_odom.rotate(now.mean[2:])
        return Track(
            id=track.id,
            x_m=float(at_m[0]),
            y_m=float(at_m[1]),
            velocity_x_mps=float(velocity[0]),
            velocity_y_mps=float(velocity[1]),
            age_s=max(s_from_ns(stamp_ns - track.first_ns), 0.0),
            cov_m2=_rotated(now.covariance[:2, :2], radar_from_odom),
            velocity_cov_m2ps2=_rotated(now.covariance[2:, 2:], radar_from_odom),
            misses=track.misses,
            time_to_appear_s=self._time_to_appear_s(hidden) if track.was_blocked else None,
        )

    def _time_to_appear_s(self, hidden: np.ndarray) -> float | None:
        """Return the time of the first step in sight, None where there is none within the horizon."""
        return None if hidden.all() else float(hidden.argmin()) * self.params.step_s


def sightings(frame: BevFrame, odom_from_radar: Pose2, place_std_m: float) -> list[Sighting]:
    """Return the valid hidden objects of a scan in the odometry frame."""
    valid = (item for item in frame.objects if _is_valid(item, frame.stamp_ns))
    return [_sighting(item, frame, odom_from_radar, place_std_m) for item in valid]


def _is_valid(item: HiddenObject, stamp_ns: int) -> bool:
    """Return whether an object has a finite position, a valid covariance and a time near its scan's."""
    covariance = np.array(item.cov_m2)
    if not np.isfinite([item.x_m, item.y_m, *covariance.ravel()]).all():
        return False
    timely = item.stamp_ns == 0 or abs(item.stamp_ns - stamp_ns) <= LONGEST_SCAN_NS
    return timely and bool(np.linalg.eigvalsh(_symmetric(covariance))[0] >= 0.0)


def _sighting(item: HiddenObject, frame: BevFrame, odom_from_radar: Pose2, place_std_m: float) -> Sighting:
    turn = _rotation(odom_from_radar)
    covariance = _symmetric(turn @ np.array(item.cov_m2) @ turn.T) + place_std_m**2 * np.eye(2)
    # an object without a stamp of its own was measured at the frame's
    return Sighting(item.stamp_ns or frame.stamp_ns, odom_from_radar.apply(np.array([item.x_m, item.y_m])), covariance)


def assign(tracks: Sequence[Estimate], measurements: Sequence[Sighting], params: TrackerParams) -> dict[int, int]:
    """Assign sightings to tracks: as many pairs within the gate as possible, then the likeliest."""
    cost = np.full((len(tracks), len(measurements)), FORBIDDEN)
    for i, track in enumerate(tracks):
        for j, sighting in enumerate(measurements):
            cost[i, j] = _pair_cost(
                track.at(sighting.stamp_ns, params.acceleration_density_m2ps3), sighting, params.gate
            )
    rows, columns = linear_sum_assignment(cost)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {i: j for i, j in pairs if cost[i, j] < FORBIDDEN}


def _pair_cost(track: Estimate, sighting: Sighting, gate: float) -> float:
    """Return twice the negative log likelihood, up to a constant; `FORBIDDEN` outside the gate."""
    spread = track.covariance[:2, :2] + sighting.covariance_m2
    offset = sighting.position_m - track.mean[:2]
    distance = float(offset @ np.linalg.solve(spread, offset))
    # the determinant keeps a track with a wide covariance from winning
    return distance + float(np.linalg.slogdet(spread)[1]) if distance <= gate else FORBIDDEN


def hidden_ahead(
    state: np.ndarray, radar_m: np.ndarray, a: np.ndarray, b: np.ndarray, params: TrackerParams
) -> np.ndarray:
    """Return whether walls a -> b [W, 2] hide an object from the radar [steps, 2] now and in each step ahead; bool
    [steps].

    The object (x, y, vx, vy) keeps its velocity and is in sight when its nose is. Odometry frame.
    """
    times_s = _steps_s(params)
    speed_mps = math.hypot(state[2], state[3])
    velocity = state[2:] if speed_mps > params.slow_mps else np.zeros(2)
    nose_m = params.nose_m * velocity / max(speed_mps, params.slow_mps)
    targets = state[:2] + nose_m + times_s[:, None] * velocity
    return blocked(radar_m, targets, a, b)


def _steps_s(params: TrackerParams) -> np.ndarray:
    """Return the times from now to the horizon [steps]."""
    return params.step_s * np.arange(round(params.horizon_s / params.step_s) + 1)


def radar_ahead(pose: OdometryPose, vehicle_from_radar: Pose2, params: TrackerParams) -> np.ndarray:
    """Return the positions of the radar [steps, 2] in the odometry frame if the vehicle keeps its speed and yaw
    rate.
    """
    times_s = _steps_s(params)
    motions = (ego_motion(pose.speed_mps, pose.yaw_rate_rps, float(time_s)) for time_s in times_s)
    poses = [pose.odom_from_vehicle @ motion @ vehicle_from_radar for motion in motions]
    return np.array([[radar_pose.x_m, radar_pose.y_m] for radar_pose in poses])


def _wall_ends(walls: Sequence[Wall], odom_from_radar: Pose2) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of walls in the odometry frame, each [W, 2]."""
    ends = np.array([wall.ends_m for wall in walls], np.float64).reshape(-1, 2, 2)
    return odom_from_radar.apply(ends[:, 0]), odom_from_radar.apply(ends[:, 1])


def _rotation(pose: Pose2) -> np.ndarray:
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return np.array([[c, -s], [s, c]])


def _rotated(covariance: np.ndarray, pose: Pose2) -> Covariance:
    """Return a covariance rotated into the axes of a pose."""
    turn = _rotation(pose)
    (xx, xy), (_, yy) = (turn @ covariance @ turn.T).tolist()
    return (xx, xy), (xy, yy)
