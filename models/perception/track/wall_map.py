"""Wall map over scans in the odometry frame: several scans confirm a wall that is too weak for one.

A line is kept with the covariance of its direction and offset and with its evidence, the log likelihood of its returns
over that of scattered ones, which adds up over scans and fades. Every scan corrects the line (a Kalman filter of two
states) by the wall found there or, where none was found, by the returns that lie on it. Each scan adds process noise to
the covariance, because errors of successive scans are alike; odometry adds noise with the distance driven.

Moving objects form lines too. A kept line is a mirror only where one scan alone showed it longer than any vehicle's
side, and only along the part that at least two scans showed. A wall in view without returns loses evidence; one with
returns behind it is dropped at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from models.perception.mirrors.lines import gains
from models.perception.mirrors.mirror_table import wall_arrays
from models.perception.mirrors.walls import WallParams, find_walls
from models.perception.track.estimate import linear_update
from models.perception.track.odometry import OdometryPose
from models.physics.mirror import crosses
from msgs.values.frames import Pose2, wrap_angle
from msgs.values.perception import Wall
from msgs.values.units import s_from_ns

RADAR = np.zeros(2)


#: A line starts from fewer and less certain returns than a wall of a single scan.
CANDIDATE = WallParams(
    min_inliers=3, min_score=4.0, max_angle_std_rad=math.radians(15.0), sparse_min_score=6.0, curved=False
)
#: A kept line is a mirror from so many scans, so much evidence and so certain a direction on.
MIN_SCANS = 3
MIN_SCORE = 12.0
MAX_ANGLE_STD_RAD = math.radians(4.0)
#: And where one scan alone showed it this long: longer than a vehicle.
MIN_SPAN_M = 6.0
#: Evidence fades to 1/e in this time and over this distance; it never exceeds `MAX_SCORE`.
FADE_S = 5.0
FADE_M = 30.0
MAX_SCORE = 40.0
#: Evidence that a scan costs in which a wall in view gave no return.
MISS_SCORE = 3.0
#: Number of returns of a scan behind a line that prove that it is no wall.
SEEN_THROUGH_POINTS = 2
#: Unevenness of real walls, added to each return's own error.
FLATNESS_M = 0.08
#: Errors that a scan adds to a line: those that the returns of the next scan share.
SCAN_ANGLE_STD_RAD = math.radians(0.3)
SCAN_OFFSET_STD_M = 0.03
#: Of odometry, over a metre driven and a radian turned.
PLACE_STD_M_PER_M = 0.02
HEADING_STD_RAD_PER_M = math.radians(0.05)
HEADING_STD_RAD_PER_RAD = 0.02
#: Two lines are one where they differ by less than so many standard deviations plus these margins.
SAME_SIGMAS = 3.0
SAME_ANGLE_RAD = math.radians(2.0)
SAME_OFFSET_M = 0.2
MAX_GAP_M = 6.5
#: Half the field of view.
VIEW_RAD = math.radians(60.0)
MAX_WALLS = 40


@dataclass
class _KeptLine:
    """A line in the odometry frame, through `middle_m` [2] with a normal at `normal_rad`.

    `covariance` [2, 2] is that of (offset [m] at the middle, direction [rad]); `seen_m` and `sure_m` are the ends
    (along the normal turned to the left, from the middle) of the parts that one scan and that two scans showed.
    """

    middle_m: np.ndarray
    normal_rad: float
    covariance: np.ndarray
    seen_m: tuple[float, float]
    sure_m: tuple[float, float] | None
    score: float
    span_m: float
    inliers: int
    scans: int = 1

    def corrected(self, factors: np.ndarray, off_m: np.ndarray, noise: np.ndarray) -> None:
        """Take in measurements [M] of (offset, direction) by `factors` [M, 2], with their covariance [M, M]."""
        gain, self.covariance = linear_update(self.covariance, factors, noise)
        shift_m, turn_rad = gain @ off_m
        self.normal_rad = wrap_angle(self.normal_rad + turn_rad)
        normal = np.array([math.cos(self.normal_rad), math.sin(self.normal_rad)])
        self.middle_m = self.middle_m - shift_m * normal

    def reached(self, low_m: float, high_m: float) -> None:
        """Extend the line by a further scan; the part that two scans showed is certain."""
        twice = max(self.seen_m[0], low_m), min(self.seen_m[1], high_m)
        if twice[0] < twice[1]:
            self.sure_m = twice if self.sure_m is None else _union(self.sure_m, twice)
        self.seen_m = _union(self.seen_m, (low_m, high_m))
        self.span_m = max(self.span_m, high_m - low_m)
        self.scans += 1


@dataclass(frozen=True)
class _Local:
    """A kept line in the radar frame of a scan: normal towards the radar [2], tangent [2], middle [2], offset."""

    kept: _KeptLine
    normal: np.ndarray
    middle_m: np.ndarray
    offset_m: float
    #: -1 where the normal was turned to face the radar, and with it the tangent and the signs of measurements.
    sign: float

    @classmethod
    def of(cls, kept: _KeptLine, radar_from_odom: Pose2) -> _Local:
        angle_rad = kept.normal_rad + radar_from_odom.yaw_rad
        normal = np.array([math.cos(angle_rad), math.sin(angle_rad)])
        middle_m = radar_from_odom.apply(kept.middle_m)
        offset_m = -float(normal @ middle_m)
        return cls(kept, normal, middle_m, offset_m, 1.0 if offset_m >= 0.0 else -1.0)

    @property
    def tangent(self) -> np.ndarray:
        return np.array([-self.normal[1], self.normal[0]])

    def along_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return the coordinates of points [N, 2] along the line, from its middle [N]."""
        return np.asarray((points_m - self.middle_m) @ self.tangent)

    def off_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return the heights of points [N, 2] over the line [N]."""
        return np.asarray((points_m - self.middle_m) @ self.normal)

    def ends_m(self, reach_m: tuple[float, float]) -> np.ndarray:
        """Return the ends [2, 2] of a stretch of it."""
        return self.middle_m + np.array(reach_m)[:, None] * self.tangent

    def as_wall(self, reach_m: tuple[float, float]) -> Wall:
        """Return the message value over a stretch of the line."""
        ends_m = self.ends_m(reach_m)
        at = np.array([1.0, 0.5 * (reach_m[0] + reach_m[1])])
        (ax, ay), (bx, by) = ends_m.tolist()
        return Wall(
            normal=(float(self.sign * self.normal[0]), float(self.sign * self.normal[1])),
            offset_m=self.sign * self.offset_m,
            ends_m=((ax, ay), (bx, by)),
            inliers=self.kept.inliers,
            angle_std_rad=math.sqrt(self.kept.covariance[1, 1]),
            offset_std_m=math.sqrt(at @ self.kept.covariance @ at),
        )


class WallMap:
    """Map of the walls of one radar; one call a scan, in the order of their stamps."""

    def __init__(self) -> None:
        self._kept: list[_KeptLine] = []
        self._last: tuple[int, OdometryPose] | None = None

    def step(
        self,
        stamp_ns: int,
        pose: OdometryPose,
        vehicle_from_radar: Pose2,
        points_m: np.ndarray,
        covariance_m2: np.ndarray,
        walls: list[Wall],
        wall_of_point: np.ndarray,
    ) -> tuple[list[Wall], np.ndarray]:
        """Return the walls of a scan, sharpened by earlier ones, and those that only several scans show; radar frame.

        Returns [N, 2] with covariances [N, 2, 2], walls and the wall of each return [N] are those of `find_walls`; the
        last two come back with the walls of earlier scans after the scan's own. A repeated or late scan changes
        nothing.
        """
        if self._last is not None and self._last[1].frame == pose.frame and stamp_ns <= self._last[0]:
            return walls, wall_of_point
        self._age(stamp_ns, pose)
        odom_from_radar = pose.odom_from_vehicle @ vehicle_from_radar
        radar_from_odom = odom_from_radar.inverse()
        walls, met = self._merge(walls, radar_from_odom)
        free = np.flatnonzero(wall_of_point == -1)
        wall_of_point = wall_of_point.copy()
        for kept in [line for line in self._kept if id(line) not in met]:
            local = _Local.of(kept, radar_from_odom)
            on_line = free[self._on(local, points_m[free], covariance_m2[free])]
            if len(on_line):
                self._support(local, points_m[on_line], covariance_m2[on_line])
                free = np.setdiff1d(free, on_line)
            elif self._in_view(local, walls):
                kept.score -= MISS_SCORE
            local = _Local.of(kept, radar_from_odom)
            if self._seen_through(local, points_m):
                kept.score = 0.0
            elif self._is_mirror(local):
                wall_of_point[on_line] = len(walls)
                walls = [*walls, local.as_wall(kept.sure_m or kept.seen_m)]
        self._begin(points_m[free], covariance_m2[free], odom_from_radar)
        self._kept = sorted((line for line in self._kept if line.score > 0.0), key=lambda line: -line.score)
        self._kept = self._kept[:MAX_WALLS]
        return walls, wall_of_point

    def _age(self, stamp_ns: int, pose: OdometryPose) -> None:
        """Let evidence fade and uncertainty grow since the last scan; a new odometry frame clears the map."""
        last, self._last = self._last, (stamp_ns, pose)
        if last is None or last[1].frame != pose.frame:
            self._kept = []
            return
        moved = last[1].odom_from_vehicle.inverse() @ pose.odom_from_vehicle
        driven_m = math.hypot(moved.x_m, moved.y_m)
        fade = math.exp(-s_from_ns(stamp_ns - last[0]) / FADE_S - driven_m / FADE_M)
        angle = SCAN_ANGLE_STD_RAD**2 + (HEADING_STD_RAD_PER_RAD * moved.yaw_rad) ** 2
        angle += driven_m * HEADING_STD_RAD_PER_M**2
        offset = SCAN_OFFSET_STD_M**2 + (PLACE_STD_M_PER_M * driven_m) ** 2
        for line in self._kept:
            line.score *= fade
            line.covariance = line.covariance + np.diag([offset, angle])

    def _merge(self, walls: list[Wall], radar_from_odom: Pose2) -> tuple[list[Wall], set[int]]:
        """Merge each straight wall of a scan with its kept line, or keep it as a new one; return their `id`s too."""
        merged: list[Wall] = []
        met: set[int] = set()
        for wall in walls:
            local = None if wall.curvature_per_m else self._same(wall, met, radar_from_odom)
            if local is not None:
                met.add(id(local.kept))
                self._correct(local, wall)
                wall = _sharpened(wall, local.kept, radar_from_odom)
            elif not wall.curvature_per_m:
                self._kept.append(_begun(wall, CANDIDATE.min_score * 2.0, radar_from_odom.inverse()))
                met.add(id(self._kept[-1]))
            merged.append(wall)
        return merged, met

    def _same(self, wall: Wall, met: set[int], radar_from_odom: Pose2) -> _Local | None:
        """Return the kept line that matches a wall: the nearest of those within the errors of both; None: none."""
        best: tuple[float, _Local] | None = None
        for kept in self._kept:
            local = _Local.of(kept, radar_from_odom)
            apart = math.inf if id(kept) in met else _apart(local, wall)
            if apart < (best[0] if best else math.inf):
                best = apart, local
        return best[1] if best else None

    def _correct(self, local: _Local, wall: Wall) -> None:
        """Correct a kept line by a wall of a scan."""
        ends_m = np.array(wall.ends_m)
        low_m, high_m = np.sort(local.along_m(ends_m)).tolist()
        at_m = ends_m.mean(axis=0)[None]
        factors = np.array([[1.0, local.along_m(at_m)[0]], [0.0, 1.0]])
        off = -local.off_m(at_m)[0], _turn_rad(local, wall)
        noise = np.diag([max(wall.offset_std_m, 1e-3) ** 2, max(wall.angle_std_rad, 1e-4) ** 2])
        local.kept.corrected(factors, np.array(off), noise)
        local.kept.reached(low_m, high_m)
        local.kept.score = min(local.kept.score + 2.0 * CANDIDATE.min_score, MAX_SCORE)
        local.kept.inliers = max(local.kept.inliers, wall.inliers)

    def _on(self, local: _Local, points_m: np.ndarray, covariance_m2: np.ndarray) -> np.ndarray:
        """Return which returns [N] lie on a kept line, within the errors of both and near its known part; bool [N]."""
        along_m = local.along_m(points_m)
        near = (along_m > local.kept.seen_m[0] - MAX_GAP_M) & (along_m < local.kept.seen_m[1] + MAX_GAP_M)
        return near & (self._gains(local, points_m, covariance_m2) > 1.0)

    def _gains(self, local: _Local, points_m: np.ndarray, covariance_m2: np.ndarray) -> np.ndarray:
        """Return what each return adds to the evidence of a kept line [N]."""
        factors = np.stack([np.ones(len(points_m)), local.along_m(points_m)], axis=1)
        own = np.einsum("ni,ij,nj->n", factors, local.kept.covariance, factors) + FLATNESS_M**2
        widened = covariance_m2 + own[:, None, None] * np.eye(2)
        return gains(np.array(points_m), widened, local.normal[0], local.normal[1], local.offset_m)

    def _support(self, local: _Local, points_m: np.ndarray, covariance_m2: np.ndarray) -> None:
        """Correct a kept line by returns that lie on it."""
        along_m, kept = local.along_m(points_m), local.kept
        gained = float(self._gains(local, points_m, covariance_m2).sum())
        noise = np.einsum("i,nij,j->n", local.normal, covariance_m2, local.normal) + FLATNESS_M**2
        factors = np.stack([np.ones(len(along_m)), along_m], axis=1)
        kept.corrected(factors, -local.off_m(points_m), np.diag(noise))
        kept.reached(float(along_m.min()), float(along_m.max()))
        kept.score = min(kept.score + gained, MAX_SCORE)
        kept.inliers = max(kept.inliers, len(points_m))

    def _in_view(self, local: _Local, walls: list[Wall]) -> bool:
        """Return whether a kept line should be visible: its middle ahead, and no wall of the scan in front of it."""
        middle_m = local.ends_m(local.kept.seen_m).mean(axis=0)
        if abs(math.atan2(middle_m[1], middle_m[0])) > VIEW_RAD:
            return False
        arrays = wall_arrays(walls)
        return not crosses(RADAR, 0.98 * middle_m[None], arrays.a, arrays.b).any()

    def _seen_through(self, local: _Local, points_m: np.ndarray) -> bool:
        """Return whether returns of a scan lie behind the certain part of a kept line, by more than its own error."""
        if local.kept.sure_m is None:
            return False
        low_m, high_m = local.kept.sure_m
        trim_m = min(1.0, 0.25 * (high_m - low_m))
        ends_m = local.ends_m((low_m + trim_m, high_m - trim_m))
        behind = local.sign * local.off_m(points_m) < -1.0
        crossed = crosses(RADAR, points_m[behind], ends_m[:1], ends_m[1:])
        return bool(crossed.sum() >= SEEN_THROUGH_POINTS)

    def _is_mirror(self, local: _Local) -> bool:
        """Return whether a kept line is a mirror."""
        kept = local.kept
        sure = kept.scans >= MIN_SCANS and kept.score >= MIN_SCORE and kept.sure_m is not None
        long = kept.span_m >= MIN_SPAN_M
        straight = math.sqrt(kept.covariance[1, 1]) <= MAX_ANGLE_STD_RAD
        shows = abs(local.offset_m) >= CANDIDATE.min_offset_m and self._is_ahead(local)
        return sure and long and straight and shows

    def _is_ahead(self, local: _Local) -> bool:
        """Return whether any part of a kept line lies in the field of view: only there it can be a mirror."""
        x_m, y_m = local.ends_m(local.kept.sure_m or local.kept.seen_m).T
        share = np.linspace(0.0, 1.0, 9)
        azimuth_rad = np.arctan2(y_m[0] + share * (y_m[1] - y_m[0]), x_m[0] + share * (x_m[1] - x_m[0]))
        return bool((np.abs(azimuth_rad) <= VIEW_RAD).any())

    def _begin(self, points_m: np.ndarray, covariance_m2: np.ndarray, odom_from_radar: Pose2) -> None:
        """Start new lines from returns on no kept line."""
        labels = np.zeros(len(points_m), np.int64)
        walls, _ = find_walls(points_m, covariance_m2, labels, CANDIDATE)
        self._kept += [_begun(wall, CANDIDATE.min_score, odom_from_radar) for wall in walls]


def _begun(wall: Wall, score: float, odom_from_radar: Pose2) -> _KeptLine:
    """Return a new kept line from a wall of its first scan."""
    ends_m = np.array(wall.ends_m)
    half_m = 0.5 * float(np.hypot(*(ends_m[1] - ends_m[0])))
    return _KeptLine(
        middle_m=odom_from_radar.apply(ends_m.mean(axis=0)),
        normal_rad=wrap_angle(math.atan2(wall.normal[1], wall.normal[0]) + odom_from_radar.yaw_rad),
        covariance=np.diag([max(wall.offset_std_m, 1e-3) ** 2, max(wall.angle_std_rad, 1e-4) ** 2]),
        seen_m=(-half_m, half_m),
        sure_m=None,
        score=score,
        span_m=2.0 * half_m,
        inliers=wall.inliers,
    )


def _turn_rad(local: _Local, wall: Wall) -> float:
    """Return the angle from a kept line's normal to a wall's, as lines: within a quarter turn."""
    normal = local.sign * local.normal
    cross = normal[0] * wall.normal[1] - normal[1] * wall.normal[0]
    return math.atan2(cross, float(normal @ np.array(wall.normal)))


def _apart(local: _Local, wall: Wall) -> float:
    """Return the distance of a wall from a kept line in units of the allowed distance, infinite where more."""
    ends_m = np.array(wall.ends_m)
    low_m, high_m = np.sort(local.along_m(ends_m)).tolist()
    gap_m = max(low_m - local.kept.seen_m[1], local.kept.seen_m[0] - high_m)
    at = np.array([1.0, 0.5 * (low_m + high_m)])
    angle_std_rad = math.sqrt(local.kept.covariance[1, 1] + wall.angle_std_rad**2)
    offset_std_m = math.sqrt(at @ local.kept.covariance @ at + wall.offset_std_m**2)
    turned = abs(_turn_rad(local, wall)) / (SAME_SIGMAS * angle_std_rad + SAME_ANGLE_RAD)
    offset = abs(local.off_m(ends_m.mean(axis=0)[None])[0]) / (SAME_SIGMAS * offset_std_m + SAME_OFFSET_M)
    return max(turned, offset) if gap_m <= MAX_GAP_M and max(turned, offset) <= 1.0 else math.inf


def _sharpened(wall: Wall, kept: _KeptLine, radar_from_odom: Pose2) -> Wall:
    """Return a wall of a scan with its own ends on the line of all scans."""
    local = _Local.of(kept, radar_from_odom)
    low_m, high_m = np.sort(local.along_m(np.array(wall.ends_m))).tolist()
    return msgspec.structs.replace(local.as_wall((low_m, high_m)), inliers=wall.inliers)


def _union(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    return min(first[0], second[0]), max(first[1], second[1])
