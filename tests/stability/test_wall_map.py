"""Hard cases of walls gathered over scans: far from the frame's origin, at the seam of angles, seen alike for long."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.track.odometry import OdometryPose
from models.perception.track.wall_map import WallMap
from msgs.values.frames import Pose2
from msgs.values.perception import Wall
from tests.stability.catalogue import Errors

NOTHING = np.zeros((0, 2)), np.zeros((0, 2, 2))
ANGLE_STD_RAD, OFFSET_STD_M = math.radians(0.6), 0.05


def wall(angle_rad: float, offset_m: float) -> Wall:
    """20 m of wall ahead whose normal is turned by so much from facing the radar."""
    normal = np.array([-math.cos(angle_rad), -math.sin(angle_rad)])
    tangent = np.array([-normal[1], normal[0]])
    foot_m = -offset_m * normal
    ends_m = foot_m - 10.0 * tangent, foot_m + 10.0 * tangent
    return Wall(
        normal=tuple(normal.tolist()), offset_m=offset_m, ends_m=tuple(tuple(end.tolist()) for end in ends_m),
        inliers=8, angle_std_rad=ANGLE_STD_RAD, offset_std_m=OFFSET_STD_M,
    )  # fmt: skip


def gathered(seen: list[Wall], poses: list[Pose2]) -> Wall:
    """The wall as told with the last of scans in which it was seen alone."""
    walls = WallMap()
    last: list[Wall] = []
    for scan, (one, pose) in enumerate(zip(seen, poses, strict=True)):
        place = OdometryPose(0, pose, 0.0, 0.0)
        last, _ = walls.step(scan * 300_000_000, place, Pose2(), *NOTHING, [one], np.zeros(0, np.int64))
    return last[0]


@pytest.mark.hard(
    where="models.perception.track.wall_map.WallMap",
    naive="means of normals and of offsets from the frame's origin",
    bound=3.0 * OFFSET_STD_M,
    unit="m",
    source="three standard deviations of one scan's offset",
)
def test_a_wall_a_thousand_kilometres_from_the_origin(errors: Errors) -> None:
    """After a day's drive: an error of the direction must not swing the wall about the frame's origin."""
    rng, origin = np.random.default_rng(0), Pose2(6e5, 8e5, 0.7)
    seen = [wall(ANGLE_STD_RAD * rng.standard_normal(), 20.0 + OFFSET_STD_M * rng.standard_normal()) for _ in range(10)]
    last = gathered(seen, [origin] * 10)
    ours = abs(np.array(last.normal) @ np.array([20.0, 0.0]) + last.offset_m)
    normals = np.array([origin.rotate(np.array(one.normal)) for one in seen])
    offsets_m = [one.offset_m - normal @ [origin.x_m, origin.y_m] for one, normal in zip(seen, normals, strict=True)]
    mean = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
    true_m = origin.apply(np.array([20.0, 0.0]))
    errors(naive=abs(mean @ true_m + np.mean(offsets_m)), ours=float(ours))


@pytest.mark.hard(
    where="models.perception.track.wall_map.WallMap",
    naive="mean of the normals' angles",
    bound=3.0 * ANGLE_STD_RAD,
    unit="rad",
    source="three standard deviations of one scan's direction",
)
def test_a_wall_that_is_faced(errors: Errors) -> None:
    """Its normal points back at the radar, at 180 degrees: half of the scans say +179, half -179."""
    angles_rad = [ANGLE_STD_RAD * sign for sign in (1, -1, 1, -1, 1, -1)]
    last = gathered([wall(one, 20.0) for one in angles_rad], [Pose2()] * 6)
    normals = np.array([wall(one, 20.0).normal for one in angles_rad])
    naive = np.arctan2(normals[:, 1], normals[:, 0]).mean()
    errors(
        naive=abs(math.remainder(naive - math.pi, 2.0 * math.pi)),
        ours=abs(math.remainder(math.atan2(last.normal[1], last.normal[0]) - math.pi, 2.0 * math.pi)),
    )


@pytest.mark.hard(
    where="models.perception.track.wall_map.WallMap",
    naive="standard deviation of the mean of independent scans",
    bound=4.0,
    unit="standard deviations told",
    source="an error is rarely beyond four of its standard deviations",
)
def test_three_minutes_before_a_wall_whose_error_is_always_the_same(errors: Errors) -> None:
    """Standing, every scan sees the same spots with the same error: what many alike scans say is no surer."""
    scans = 600
    last = gathered([wall(ANGLE_STD_RAD, 20.0)] * scans, [Pose2()] * scans)
    errors(naive=math.sqrt(scans), ours=ANGLE_STD_RAD / last.angle_std_rad)


@pytest.mark.hard(
    where="models.perception.track.wall_map.WallMap",
    naive="normal kept as first seen",
    bound=1e-9,
    unit="m",
    source="rounding of a mirror 20 m off",
)
def test_the_radar_passes_to_the_other_side(errors: Errors) -> None:
    """A free-standing wall seen from both sides: its normal faces the radar each time, or images fold away from it."""
    other = Pose2(40.0, 0.0, math.pi)
    last = gathered([wall(0.0, 20.0)] * 4, [Pose2(), Pose2(), other, other])
    image_m, offset_m = np.array([25.0, 3.0]), last.offset_m
    ours = image_m - 2.0 * (image_m @ np.array(last.normal) + offset_m) * np.array(last.normal)
    naive_normal = other.inverse().rotate(np.array([-1.0, 0.0]))
    naive = image_m - 2.0 * (image_m @ naive_normal + 20.0) * naive_normal
    expected_m = np.array([15.0, 3.0])
    errors(naive=math.dist(naive, expected_m), ours=math.dist(ours, expected_m))
