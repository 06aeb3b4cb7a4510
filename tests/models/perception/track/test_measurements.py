"""Objects in the odometry frame with their errors, and the probability that a scan would have reported one."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.perception.track.estimate import Estimate
from models.perception.track.measurements import (
    GREATEST_SCORE,
    LEAST_SCORE,
    UNOBSERVABLE_SHARE,
    detection_probabilities,
    sightings,
)
from msgs.values.arrays import Covariance
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, RadialSpeed, Visibility

EYE: Covariance = ((0.09, 0.0), (0.0, 0.09))


def seen(x_m: float, y_m: float, stamp_ns: int = 0, cov_m2: Covariance = EYE, score: float = 0.9) -> HiddenObject:
    return HiddenObject(
        id=0, x_m=x_m, y_m=y_m, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=score, cov_m2=cov_m2, stamp_ns=stamp_ns
    )


def frame(*objects: HiddenObject, visibility: np.ndarray | None = None) -> BevFrame:
    """A view of 20 x 20 cells of 1 m, x from 0 and y from -10."""
    mask = np.zeros((20, 20), np.uint8) if visibility is None else visibility
    return BevFrame(
        stamp_ns=1_000_000_000, scan_id=0, objects=objects, los_points_m=np.zeros((0, 2), np.float32),
        grid=BevGrid(x_min_m=0.0, y_min_m=-10.0, cell_m=1.0, rows=20, columns=20), visibility=mask,
    )  # fmt: skip


def standing(x_m: float, y_m: float, std_m: float = 1e-3) -> Estimate:
    return Estimate(0, np.array([x_m, y_m, 0.0, 0.0]), np.diag([std_m**2, std_m**2, 1.0, 1.0]))


def test_a_sighting_is_turned_into_the_odometry_frame_with_its_error():
    """A radar at (1, 2) turned by 30 deg sees an object 10 m ahead, 2 m uncertain along the ray and 1 m across.

    Place: (1 + 10 cos, 2 + 10 sin). Covariance R diag(4, 1) R' = [[4 c2 + s2, 3 c s], [3 c s, 4 s2 + c2]] with c2 = 3/4
    and s2 = 1/4, and 0.4 m of wandering on each axis beside it. Tolerance: rounding.
    """
    (there,) = sightings(frame(seen(10.0, 0.0, cov_m2=((4.0, 0.0), (0.0, 1.0)))), Pose2(1.0, 2.0, math.pi / 6.0), 0.4)
    assert there.position_m == pytest.approx([1.0 + 5.0 * math.sqrt(3.0), 7.0])
    slant = 0.75 * math.sqrt(3.0)
    np.testing.assert_allclose(there.covariance_m2, [[3.25 + 0.16, slant], [slant, 1.75 + 0.16]], rtol=1e-12)


def test_objects_have_the_time_of_their_beams_and_those_of_another_are_left_out():
    objects = [seen(1.0, 1.0, stamp_ns=stamp_ns) for stamp_ns in (1_050_000_000, 0, 1 << 60)]
    assert [item.stamp_ns for item in sightings(frame(*objects), Pose2(), 0.4)] == [1_050_000_000, 1_000_000_000]


@pytest.mark.parametrize(("score", "expected"), [(0.7, 0.7), (1.0, GREATEST_SCORE), (0.0, LEAST_SCORE)])
def test_a_score_is_a_probability_short_of_certain(score: float, expected: float):
    (there,) = sightings(frame(seen(1.0, 1.0, score=score)), Pose2(), 0.4)
    assert there.score == expected


def test_an_object_is_reported_where_the_mask_says_it_can_be():
    """Cells of x in [5, 6) observable, row y in [2, 3) alone; a radar at (10, 0) turned by 90 deg looks along y.

    A track at (7.5, 5.5) in the odometry frame is 5.5 ahead and 2.5 to the left.
    """
    mask = np.zeros((20, 20), np.uint8)
    mask[12, 5] = Visibility.MIRRORED
    mask[12, 6] = Visibility.DIRECT
    turned = Pose2(10.0, 0.0, math.pi / 2.0)
    tracks = [standing(7.5, 5.5), standing(7.5, 6.5), standing(7.5, 4.5), standing(-500.0, 0.0)]
    probability = detection_probabilities(frame(visibility=mask), tracks, turned, 0.8)
    blind = 0.8 * UNOBSERVABLE_SHARE
    np.testing.assert_allclose(probability, [0.8, blind, blind, blind])


def test_a_vague_position_is_seen_as_far_as_it_reaches():
    """Everything beyond y = 0 observable, 1 m uncertain at y = 0.5: of five points at 0 and +-sqrt(3) m along both axes
    the one at y = -1.23, with weight 1/6, is not.
    """
    mask = np.zeros((20, 20), np.uint8)
    mask[10:] = Visibility.MIRRORED
    (probability,) = detection_probabilities(frame(visibility=mask), [standing(9.5, 0.5, 1.0)], Pose2(), 1.0)
    assert probability == pytest.approx(5 / 6 + UNOBSERVABLE_SHARE / 6)


def test_a_view_without_a_mask_may_see_everything():
    assert detection_probabilities(frame(), [standing(5.0, 5.0)], Pose2(), 0.8).tolist() == [0.8]


def test_a_radial_speed_is_turned_with_the_radar_and_nonsense_is_none():
    """A radar turned by 30 deg: 20 deg in its axes are 50 deg in the odometry frame; speed and error as they were."""

    def moving(azimuth_rad: float, speed_mps: float, std_mps: float) -> HiddenObject:
        radial = RadialSpeed(azimuth_rad=azimuth_rad, speed_mps=speed_mps, std_mps=std_mps)
        return msgspec.structs.replace(seen(10.0, 0.0), radial_speed=radial)

    pose = Pose2(1.0, 2.0, math.pi / 6.0)
    (there,) = sightings(frame(moving(math.radians(20.0), 3.0, 0.5)), pose, 0.4)
    assert there.radial_speed is not None
    assert (there.radial_speed.speed_mps, there.radial_speed.std_mps) == (3.0, 0.5)
    np.testing.assert_allclose(there.direction, [math.cos(math.radians(50.0)), math.sin(math.radians(50.0))])
    (round_the_corner,) = sightings(frame(moving(math.radians(170.0), 3.0, 0.5)), pose, 0.4)
    np.testing.assert_allclose(
        round_the_corner.direction, [math.cos(math.radians(200.0)), math.sin(math.radians(200.0))]
    )
    bad = (moving(0.0, 3.0, 0.0), moving(0.0, 101.0, 0.5))
    assert [item.radial_speed for item in sightings(frame(*bad), pose, 0.4)] == [None] * len(bad)
