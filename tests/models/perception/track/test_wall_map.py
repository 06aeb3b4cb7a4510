"""Walls gathered over scans: a weak one becomes a mirror, what moves does not, what is gone is forgotten."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from models.perception.mirrors.walls import WallParams, find_walls
from models.perception.track.odometry import OdometryPose
from models.perception.track.wall_map import WallMap
from msgs.values.frames import Pose2, polar_from_xy
from msgs.values.perception import Wall

PERIOD_NS = 300_000_000
#: Errors of a return: 0.06 m along its ray, 0.7 degrees across.
RANGE_STD_M, AZIMUTH_STD_RAD = 0.06, math.radians(0.7)
STANDING = OdometryPose(-1, Pose2(), 0.0, 0.0)


def covariances(points_m: np.ndarray) -> np.ndarray:
    """Of returns [N, 2]; [N, 2, 2] in metres."""
    range_m, azimuth_rad = polar_from_xy(points_m)
    along = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    spread_m2 = (AZIMUTH_STD_RAD * range_m) ** 2
    return np.asarray(
        RANGE_STD_M**2 * along[:, :, None] * along[:, None]
        + spread_m2[:, None, None] * across[:, :, None] * across[:, None]
    )


class Street:
    """Scans of returns given in the odometry frame, with errors, through a wall map."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.map = WallMap()
        self.scan = 0
        self.alone: list[Wall] = []

    def see(self, points_m: np.ndarray, radar: Pose2 = STANDING.odom_from_vehicle, frame: int = -1) -> list[Wall]:
        """The walls after a scan from a place of the radar."""
        here_m = radar.inverse().apply(np.asarray(points_m, np.float64).reshape(-1, 2))
        covariance_m2 = covariances(here_m)
        here_m = here_m + np.array([self.rng.multivariate_normal(np.zeros(2), one) for one in covariance_m2]).reshape(
            -1, 2
        )
        self.alone, of_point = find_walls(here_m, covariance_m2, np.zeros(len(here_m), np.int64), WallParams())
        self.scan += 1
        place = OdometryPose(frame, radar, 0.0, 0.0)
        walls, _ = self.map.step(self.scan * PERIOD_NS, place, Pose2(), here_m, covariance_m2, self.alone, of_point)
        return walls


def weak_wall(rng: np.random.Generator, count: int = 3) -> np.ndarray:
    """A few spots of a wall at x = 20 from y = -8 to 8, its ends among them: too few for a wall of one scan."""
    return np.stack([np.full(count, 20.0), np.append([-7.0, 7.0], rng.uniform(-5.0, 5.0, count - 2))], axis=1)


def test_a_weak_wall_becomes_a_mirror_and_is_known_better_with_each_scan() -> None:
    """Three returns a scan make no wall (`min_inliers` is 4); by several scans it stands, and its errors shrink.

    Expected: angle of 3 returns over 14 m with some 0.1 m each, 0.6 degrees, less by the root of the scans down to
    the floor that `scan_angle_std_rad` sets.
    """
    street = Street()
    told = [street.see(weak_wall(street.rng)) for _ in range(8)]
    assert street.alone == []
    assert [len(walls) for walls in told[:2]] == [0, 0]
    assert [len(walls) for walls in told[3:]] == [1] * 5
    (first,), (last,) = told[3], told[-1]
    assert last.angle_std_rad < first.angle_std_rad < math.radians(1.0)
    angle_rad = math.atan2(last.normal[1], -last.normal[0])
    assert abs(angle_rad) < 3.0 * last.angle_std_rad + 1e-3
    assert last.offset_m == pytest.approx(20.0, abs=0.1)
    assert math.dist(*last.ends_m) > 10.0


def test_errors_are_what_the_covariance_says() -> None:
    """Over 40 seeds the angle's error over its standard deviation: root mean square 1 within a factor of 2."""
    ratios = []
    for seed in range(40):
        street = Street(seed)
        walls = [street.see(weak_wall(street.rng)) for _ in range(6)][-1]
        ratios += [math.atan2(wall.normal[1], -wall.normal[0]) / wall.angle_std_rad for wall in walls]
    assert len(ratios) >= 35
    assert 0.5 < float(np.sqrt(np.mean(np.square(ratios)))) < 2.0


def test_a_wall_of_every_scan_is_sharpened() -> None:
    """Eight returns a scan: found each time, and by ten scans known better than by one."""
    street, errors = Street(1), []
    for _ in range(20):
        (wall,) = street.see(weak_wall(street.rng, 8))
        errors.append([math.atan2(one.normal[1], -one.normal[0]) for one in (street.alone[0], wall)])
    alone_rad, ours_rad = np.sqrt(np.mean(np.square(errors[5:]), axis=0))
    assert ours_rad < alone_rad


def test_while_driving_a_wall_stays_where_it_is() -> None:
    """At 4 m/s in a bend of 10 degrees a second: told in the radar's axes, true in the odometry frame."""
    street, radar = Street(2), Pose2()
    walls: list[Wall] = []
    for step in range(8):
        radar = Pose2(1.2 * step, 0.05 * step**2, math.radians(3.0 * step))
        walls = street.see(weak_wall(street.rng), radar)
    ends_m = np.array([radar.apply(np.array(end)) for end in walls[0].ends_m])
    assert np.abs(ends_m[:, 0] - 20.0).max() < 0.5
    normal = radar.rotate(np.array(walls[0].normal))
    assert abs(math.atan2(normal[1], -normal[0])) < math.radians(1.5)


def test_a_car_driving_by_is_no_wall() -> None:
    """Three returns along a side of 4 m that moves on along its own line at 8 m/s: by its way a line of 20 m."""
    street = Street(3)
    side_m = np.stack([np.linspace(0.0, 4.0, 3), np.full(3, 6.0)], axis=1)
    assert not any(street.see(side_m + np.array([8.0 + 2.4 * step, 0.0])) for step in range(8))


def test_a_wall_that_no_longer_answers_is_dropped() -> None:
    """In view and silent: it fades within three seconds. Behind the radar nothing is asked of it."""
    street = Street(4)
    for _ in range(6):
        walls = street.see(weak_wall(street.rng))
    assert walls
    told = [bool(street.see(np.zeros((0, 2)))) for _ in range(10)]
    assert told[0]
    assert not any(told[8:])


def test_a_wall_that_is_seen_through_is_none_at_once() -> None:
    street = Street(5)
    for _ in range(6):
        assert street.see(weak_wall(street.rng)) or street.scan < 4
    behind_m = np.array([[30.0, -2.0], [31.0, 2.0], [33.0, 0.5]])
    assert street.see(behind_m) == []
    assert street.see(weak_wall(street.rng)) == []


def test_another_odometry_frame_is_another_world() -> None:
    street = Street(6)
    for _ in range(6):
        walls = street.see(weak_wall(street.rng))
    assert walls
    assert street.see(weak_wall(street.rng), frame=0) == []


def test_a_scan_that_comes_twice_or_late_changes_nothing() -> None:
    street, again = Street(7), Street(7)
    told = [street.see(weak_wall(street.rng)) for _ in range(6)]
    for number in range(6):
        assert again.see(weak_wall(again.rng)) == told[number]
        nothing = np.zeros((0, 2)), np.zeros((0, 2, 2)), [], np.zeros(0, np.int64)
        for late_ns in (0, PERIOD_NS):
            walls, _ = again.map.step(again.scan * PERIOD_NS - late_ns, STANDING, Pose2(), *nothing)
            assert walls == []


def test_scattered_returns_become_no_walls() -> None:
    """Eight returns anywhere in 40 m x 60 m, new in each of 30 scans: a wall in less than 5 % of them.

    One scan's own search finds none among so few; gathering must not make up many either.
    """
    street = Street(8)
    found = 0
    for _ in range(30):
        points_m = np.column_stack([street.rng.uniform(5.0, 45.0, 8), street.rng.uniform(-30.0, 30.0, 8)])
        walls = street.see(points_m)
        found += len(walls) - len(street.alone)
    assert found <= 1


def test_errors_of_kept_walls_grow_with_the_way_and_the_turn() -> None:
    """Over 10 m and 0.5 rad: 2 % of the way, 2 % of the turn, 0.05 deg by the root of a metre, and a scan's own."""
    walls = WallMap()
    line = SimpleNamespace(score=8.0, covariance=np.zeros((2, 2)))
    walls._age(0, STANDING)
    walls._kept = [line]  # type: ignore[list-item]
    walls._age(PERIOD_NS, STANDING._replace(odom_from_vehicle=Pose2(8.0, 6.0, 0.5)))
    offset = 0.03**2 + (0.02 * 10.0) ** 2
    angle = math.radians(0.3) ** 2 + (0.02 * 0.5) ** 2 + 10.0 * math.radians(0.05) ** 2
    np.testing.assert_allclose(line.covariance, np.diag([offset, angle]))
    assert line.score == pytest.approx(8.0 * math.exp(-1e-9 * PERIOD_NS / 5.0 - 10.0 / 30.0))


def test_evidence_of_a_wall_is_bounded_however_often_it_is_seen() -> None:
    street, rng = Street(), np.random.default_rng(2)
    for _ in range(60):
        street.see(weak_wall(rng, 5))
    assert max(line.score for line in street.map._kept) == 40.0
