"""One view of the scans of several radars on a vehicle: their walls, masks and objects in the vehicle's frame.

Objects that two see are joined by covariance intersection, as errors of their walls are common (S. Julier, J. Uhlmann,
"A non-divergent estimation algorithm in the presence of unknown correlations", ACC 1997).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from models.perception.mirrors.observability import visibility_at
from models.perception.timing import Timed
from models.perception.track.estimate import symmetric
from models.perception.track.measurements import rotation
from models.perception.track.odometry import OdometryPose, odom_from_radar_after
from models.perception.track.scan_state import MemoryParams, ScanMemory
from models.perception.track.wall_fusion import SCAN_ANGLE_STD_RAD, SCAN_OFFSET_STD_M, is_one_wall
from models.perception.track.wall_lines import WallLine
from msgs.values.arrays import Covariance
from msgs.values.frames import Pose2, wrap_angle
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, HiddenPoint, Visibility, Wall
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState

#: Flag of a view that lacks one of its radars.
RADAR_LOST = "radar_lost"
#: Square of the Mahalanobis distance of two views of one object: 99 % of true pairs in two dimensions.
GATE = 9.21
#: Added to each object's own error: two radars see different faces of a vehicle.
PLACE_STD_M = 0.6
#: Standard deviation of the speed of what is seen, for objects of different times.
SPEED_STD_MPS = 8.0
#: Views of one object are no further apart, however uncertain.
MAX_APART_M = 4.0


class RadarView(NamedTuple):
    """The view of one radar, and where the radar sits on the vehicle."""

    frame: BevFrame
    vehicle_from_radar: Pose2
    #: As its peaks have it.
    ego_compensated: bool = True


class FusionStage:
    """Joins views, and follows their objects over scans."""

    def __init__(self, memory: MemoryParams | None = None, grid: BevGrid | None = None, timed: Timed = nullcontext):
        self._memory, self._grid, self._timed = ScanMemory(memory or MemoryParams()), grid or BevGrid(), timed

    def add_state(self, state: VehicleState) -> None:
        """Take in a state of the vehicle."""
        self._memory.add(state)

    def view(self, views: Sequence[RadarView], is_whole: bool = True) -> BevFrame:
        """Return the view of the vehicle, of its radars' views about one time; not `is_whole`: its flags say so."""
        stamp_ns = max(view.frame.stamp_ns for view in views)
        with self._timed("join"):
            now = self._memory.pose_at(stamp_ns)
            moved = [in_vehicle(view, stamp_ns, now, self._memory.pose_before) for view in views]
            frame = joined(moved, self._grid)
            if not is_whole:
                frame = msgspec.structs.replace(frame, flags=(*frame.flags, RADAR_LOST))
        with self._timed("tracking"):
            return self._memory.tracked(frame, Pose2())


PoseBefore = Callable[[int], OdometryPose | None]


def in_vehicle(view: RadarView, stamp_ns: int, now: OdometryPose | None, before: PoseBefore) -> RadarView:
    """Return a view in the vehicle's frame at a later time, `now`, from poses `before`; unknown: it has not moved."""
    frame, mounted = view.frame, view.vehicle_from_radar
    then = before(frame.stamp_ns)
    if now is None or then is None or now.frame != then.frame:
        now = then = OdometryPose(-1, Pose2(), 0.0, 0.0)
    now_from_odom = now.odom_from_vehicle.inverse()

    def from_radar_at(at_ns: int) -> Pose2:
        elapsed_s = 0.0 if view.ego_compensated else s_from_ns((at_ns or frame.stamp_ns) - frame.stamp_ns)
        return now_from_odom @ odom_from_radar_after(then, mounted, elapsed_s)

    pose = from_radar_at(frame.stamp_ns)
    moved = msgspec.structs.replace(
        frame,
        stamp_ns=stamp_ns,
        walls=tuple(_moved_wall(wall, pose) for wall in frame.walls),
        points=tuple(_moved_point(point, pose) for point in frame.points),
        # an object without a stamp of its own was measured at the frame's
        objects=tuple(
            _moved_object(msgspec.structs.replace(item, stamp_ns=item.stamp_ns or frame.stamp_ns), from_radar_at)
            for item in frame.objects
        ),
        tracks=(),
        los_points_m=pose.apply(frame.los_points_m.astype(np.float64)).astype(np.float32),
    )
    return RadarView(moved, pose)


def joined(views: Sequence[RadarView], grid: BevGrid) -> BevFrame:
    """Return one frame of views in the vehicle's frame, the first one's scan; masks keep their radar's axes."""
    frames = [view.frame for view in views]
    walls, wall_of = _joined_walls([frame.walls for frame in frames])
    objects: list[HiddenObject] = []
    for frame in frames:
        objects = joined_objects(objects, frame.objects)
    return msgspec.structs.replace(
        frames[0],
        walls=tuple(walls),
        points=tuple(
            msgspec.structs.replace(point, wall=-1 if point.wall < 0 else numbers[point.wall])
            for frame, numbers in zip(frames, wall_of, strict=True)
            for point in frame.points
        ),
        objects=tuple(msgspec.structs.replace(item, id=number) for number, item in enumerate(objects)),
        los_points_m=np.concatenate([frame.los_points_m for frame in frames]),
        grid=grid,
        visibility=_joined_mask(views, grid),
        ego=next((frame.ego for frame in frames if frame.ego is not None), None),
        settled_stamp_ns=_least_settled(frames),
        flags=tuple(dict.fromkeys(flag for frame in frames for flag in frame.flags)),
    )


def joined_objects(first: Sequence[HiddenObject], second: Sequence[HiddenObject]) -> list[HiddenObject]:
    """Return the objects of two radars in one frame, those that both see once, in pairs of least distance in all."""
    distance2 = np.full((len(first), len(second)), math.inf)
    for row, column in np.ndindex(distance2.shape):
        distance2[row, column] = _distance2(first[row], second[column])
    # outside the gate a pair is worth nothing, and as many as can be are made of the rest
    pairs = dict(zip(*linear_sum_assignment(np.minimum(distance2, GATE) - GATE), strict=True))
    pairs = {row: column for row, column in pairs.items() if distance2[row, column] < GATE}
    both = [_one_of(item, second[pairs[number]]) if number in pairs else item for number, item in enumerate(first)]
    return both + [item for number, item in enumerate(second) if number not in pairs.values()]


def covariance_intersection(
    first_m: np.ndarray, first_m2: np.ndarray, second_m: np.ndarray, second_m2: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return position [2] and covariance [2, 2], of least trace, of two estimates whose common errors are unknown."""
    first, second = np.linalg.inv(first_m2), np.linalg.inv(second_m2)

    def covariance(share: float) -> np.ndarray:
        return np.asarray(np.linalg.inv(share * first + (1.0 - share) * second))

    least = minimize_scalar(lambda share: float(np.trace(covariance(share))), bounds=(0.0, 1.0), method="bounded")
    # the search leaves out the ends; of shares that are alike the middle one
    even_m2 = float(np.trace(covariance(0.5)))
    share = min((0.5, float(least.x), 0.0, 1.0), key=lambda at: round(float(np.trace(covariance(at))) / even_m2, 9))
    joint = covariance(share)
    position_m = joint @ (share * first @ first_m + (1.0 - share) * second @ second_m)
    return position_m, symmetric(joint)


def _distance2(first: HiddenObject, second: HiddenObject) -> float:
    """Return the square of the Mahalanobis distance of two objects; infinite for those that cannot be one."""
    offset_m = np.array([first.x_m - second.x_m, first.y_m - second.y_m])
    elapsed_s = s_from_ns(first.stamp_ns - second.stamp_ns)
    if math.hypot(*offset_m) > MAX_APART_M + SPEED_STD_MPS * abs(elapsed_s):
        return math.inf
    spread_m2 = 2.0 * PLACE_STD_M**2 + (SPEED_STD_MPS * elapsed_s) ** 2
    covariance_m2 = np.array(first.cov_m2) + np.array(second.cov_m2) + spread_m2 * np.eye(2)
    return float(offset_m @ np.linalg.solve(covariance_m2, offset_m))


def _one_of(first: HiddenObject, second: HiddenObject) -> HiddenObject:
    """Return one object of two views: the likelier one's shape and existence, and the place of both."""
    likelier, less = (first, second) if first.score >= second.score else (second, first)
    place_m, less_m = (np.array([item.x_m, item.y_m]) for item in (likelier, less))
    position_m, covariance_m2 = covariance_intersection(
        place_m, np.array(likelier.cov_m2), less_m, np.array(less.cov_m2)
    )
    shift_m = position_m - place_m
    centre_m = likelier.centre_m
    return msgspec.structs.replace(
        likelier,
        x_m=float(position_m[0]),
        y_m=float(position_m[1]),
        cov_m2=_as_covariance(covariance_m2),
        centre_m=None if centre_m is None else (centre_m[0] + float(shift_m[0]), centre_m[1] + float(shift_m[1])),
        points=first.points + second.points,
        radial_speed=likelier.radial_speed or less.radial_speed,
    )


def _joined_walls(walls: Sequence[Sequence[Wall]]) -> tuple[list[Wall], list[list[int]]]:
    """Return the walls of all views, those on one line once, and for each view the numbers that its walls have now."""
    kept: list[Wall] = []
    wall_of: list[list[int]] = []
    for own in walls:
        numbers: list[int] = []
        for wall in own:
            # two walls of one view are two
            same = next((at for at, each in enumerate(kept) if at not in numbers and _is_one(each, wall)), None)
            if same is None:
                kept.append(wall)
            else:
                kept[same] = _one_wall(kept[same], wall)
            numbers.append(len(kept) - 1 if same is None else same)
        wall_of.append(numbers)
    return kept, wall_of


def _is_one(first: Wall, second: Wall) -> bool:
    return not (first.curvature_per_m or second.curvature_per_m) and is_one_wall(_line(first), _line(second))


def _one_wall(first: Wall, second: Wall) -> Wall:
    """Return the wall of two stretches of it."""
    line, more = _line(first), _line(second)
    off, noise = more.seen_at(line)
    return (
        line.corrected(np.eye(2), off, noise)
        .reaching(np.concatenate([line.ends_m, more.ends_m]))
        .as_wall(first.inliers + second.inliers)
    )


def _line(wall: Wall) -> WallLine:
    """Return a wall with the errors that all returns of its scan share."""
    line = WallLine.of(wall)
    return replace(line, covariance=line.covariance + np.diag(np.square([SCAN_OFFSET_STD_M, SCAN_ANGLE_STD_RAD])))


def _joined_mask(views: Sequence[RadarView], grid: BevGrid) -> np.ndarray:
    """Return what any of the radars can see of each cell, directly before in a mirror; uint8 [rows, columns]."""
    cells_m = grid.cell_centres_m().reshape(-1, 2)
    rank = np.array([0, 2, 1])
    best = np.zeros(len(cells_m), np.int64)
    for frame, pose, _ in views:
        own = visibility_at(frame.visibility, frame.grid, pose.inverse().apply(cells_m))
        best = np.maximum(best, rank[own])
    states = np.array([Visibility.UNKNOWN, Visibility.MIRRORED, Visibility.DIRECT], np.uint8)
    return states[best].reshape(grid.rows, grid.columns)


def _least_settled(frames: Sequence[BevFrame]) -> int | None:
    stamps = [frame.settled_stamp_ns for frame in frames]
    return None if None in stamps else min(stamp for stamp in stamps if stamp is not None)


def _moved_wall(wall: Wall, pose: Pose2) -> Wall:
    """Return a wall in other axes, its normal towards their origin."""
    ends_m = pose.apply(np.array(wall.ends_m))
    normal = pose.rotate(np.array(wall.normal))
    offset_m = -float(normal @ ends_m.mean(axis=0))
    sign = -1.0 if offset_m < 0.0 else 1.0
    (ax, ay), (bx, by) = ends_m.tolist()
    return msgspec.structs.replace(
        wall,
        normal=(sign * float(normal[0]), sign * float(normal[1])),
        offset_m=sign * offset_m,
        ends_m=((ax, ay), (bx, by)),
        curvature_per_m=sign * wall.curvature_per_m,
    )


def _moved_point(point: HiddenPoint, pose: Pose2) -> HiddenPoint:
    (x_m, y_m), (image_x_m, image_y_m) = pose.apply(
        np.array([[point.x_m, point.y_m], [point.image_x_m, point.image_y_m]])
    ).tolist()
    return msgspec.structs.replace(point, x_m=x_m, y_m=y_m, image_x_m=image_x_m, image_y_m=image_y_m)


def _moved_object(item: HiddenObject, pose_at: Callable[[int], Pose2]) -> HiddenObject:
    pose = pose_at(item.stamp_ns)
    x_m, y_m = pose.apply(np.array([item.x_m, item.y_m])).tolist()
    turn = rotation(pose)
    radial = item.radial_speed
    return msgspec.structs.replace(
        item,
        x_m=x_m,
        y_m=y_m,
        yaw_rad=wrap_angle(item.yaw_rad + pose.yaw_rad),
        cov_m2=_as_covariance(turn @ np.array(item.cov_m2) @ turn.T),
        centre_m=None if item.centre_m is None else tuple(pose.apply(np.array(item.centre_m)).tolist()),
        radial_speed=radial
        and msgspec.structs.replace(radial, azimuth_rad=wrap_angle(radial.azimuth_rad + pose.yaw_rad)),
    )


def _as_covariance(matrix: np.ndarray) -> Covariance:
    (xx, xy), (_, yy) = symmetric(matrix).tolist()
    return (xx, xy), (xy, yy)
