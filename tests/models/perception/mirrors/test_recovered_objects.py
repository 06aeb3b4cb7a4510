from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from models.perception.mirrors.recovered_objects import ObjectParams, form_objects, joint_score
from models.perception.mirrors.recovery import Recovered
from msgs.values.perception import HiddenObject, Wall

OCCLUDER = Wall(normal=(0.0, -1.0), offset_m=5.0, ends_m=((4.0, 5.0), (24.0, 5.0)), inliers=9)


def recovered(points: np.ndarray, score: float = 0.8, snr_db: float = 30.0, std_m: float = 0.3) -> Recovered:
    """Places behind the occluder with images in a wall x = 30."""
    points = np.asarray(points, np.float64).reshape(-1, 2)
    count = len(points)
    return Recovered(
        points_m=points, images_m=np.stack([60.0 - points[:, 0], points[:, 1]], axis=1),
        image_covariance_m2=np.tile(std_m**2 * np.eye(2), (count, 1, 1)),
        wall_covariance_m2=np.tile(0.05**2 * np.eye(2), (count, 1, 1)), wall=np.zeros(count, np.int64),
        second=np.full(count, -1),
        score=np.full(count, score), snr_db=np.full(count, snr_db), stamp_ns=np.arange(count, dtype=np.int64) * 10,
        radial_speed_mps=np.full(count, np.nan),
    )  # fmt: skip


def together(*parts: Recovered) -> Recovered:
    return Recovered(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in Recovered.__dataclass_fields__}
    )


def face(x: float, y: float, length: float, count: int, yaw: float = 0.0) -> np.ndarray:
    along = np.linspace(-length / 2, length / 2, count)
    return np.stack([x + along * math.cos(yaw), y + along * math.sin(yaw)], axis=1)


def objects_of(points: Recovered) -> tuple[HiddenObject, ...]:
    return form_objects(points, [OCCLUDER], ObjectParams())


def test_a_face_becomes_one_object_at_its_centre():
    """Nine points over 4.4 m: variance L^2 (n+1) / (12 (n-1)) less 0.3^2, so L (5/4 - ...)^1/2 = 4.8 m."""
    (one,) = objects_of(recovered(face(15.0, 9.0, 4.4, 9, yaw=0.6)))
    assert (one.x_m, one.y_m) == pytest.approx((15.0, 9.0))
    assert one.yaw_rad == pytest.approx(0.6, abs=1e-6)
    assert one.length_m == pytest.approx(math.sqrt(4.4**2 * 10.0 / 8.0 - 12.0 * 0.09), abs=1e-6)
    assert (one.points, one.stamp_ns, one.id) == (9, 40, 0)
    assert one.score == pytest.approx(1.0 - 0.2**9)


def test_covariance_shrinks_with_points_down_to_that_of_the_wall():
    few, many = (np.array(objects_of(recovered(face(15.0, 9.0, 2.0, n)))[0].cov_m2) for n in (2, 16))
    assert np.trace(many) < 0.3 * np.trace(few)
    assert (np.linalg.eigvalsh(many) > 0.05**2).all()


def test_centre_and_covariance_of_two_points_worked_out_by_hand():
    """Points at x = 14 and 16, y = 9, of scores 0.9 and 0.6, the first of twice the amplitude (6.02 dB).

    Weights 0.9 * 2 : 0.6 * 1 are 0.75 : 0.25, so the centre is x = 14.5 (by power: 0.9 * 4 : 0.6, 14.29). About it the
    scatter is 0.75 * 0.25 + 0.25 * 2.25 = 0.75 along x; each point errs by 0.3 m by itself. The centre has
    0.75^2 + 0.25^2 = 0.625 of both, 0.625 * 0.84 = 0.525 and 0.625 * 0.09 = 0.05625, and the error of the wall whole,
    which is the same for both points. Tolerance: rounding.
    """
    both = together(recovered([[14.0, 9.0]], 0.9, 20.0 + 20.0 * math.log10(2.0)), recovered([[16.0, 9.0]], 0.6, 20.0))
    of_wall = np.array([[0.04, 0.01], [0.01, 0.02]])
    (one,) = objects_of(replace(both, wall_covariance_m2=np.tile(of_wall, (2, 1, 1))))
    assert (one.x_m, one.y_m) == pytest.approx((14.5, 9.0))
    np.testing.assert_allclose(one.cov_m2, [[0.565, 0.01], [0.01, 0.07625]], atol=1e-12)


def test_two_objects_apart_and_their_order():
    strong, weak = recovered(face(20.0, 9.0, 2.0, 3), 0.9), recovered(face(10.0, 9.0, 2.0, 3), 0.6)
    objects = objects_of(together(weak, strong))
    assert [round(one.x_m) for one in objects] == [20, 10]
    assert [one.id for one in objects] == [0, 1]


def test_order_of_the_points_does_not_matter():
    points = together(recovered(face(20.0, 9.0, 2.0, 3)), recovered(face(10.0, 9.0, 2.0, 4)))
    shuffled = points.take(np.random.default_rng(0).permutation(7))
    for one, other in zip(objects_of(points), objects_of(shuffled), strict=True):
        assert (one.x_m, one.y_m, one.score) == pytest.approx((other.x_m, other.y_m, other.score))


def test_fragments_of_one_vehicle_are_joined_and_two_vehicles_are_not():
    """2.7 m between the nearest points, eps 2.5 and one sigma of 0.42 m: one vehicle if all fit in its box."""
    near = together(recovered(face(13.0, 9.0, 1.0, 2)), recovered(face(16.7, 9.0, 1.0, 2)))
    assert len(objects_of(near)) == 1
    long = together(recovered(face(12.0, 9.0, 4.4, 6)), recovered(face(19.1, 9.0, 4.4, 6)))
    assert len(objects_of(long)) == 2


@pytest.mark.parametrize(("score", "snr_db", "expected"), [(0.9, 30.0, 1), (0.4, 30.0, 0), (0.9, 10.0, 0)])
def test_a_single_point_must_be_strong(score, snr_db, expected):
    assert len(objects_of(recovered([[15.0, 9.0]], score, snr_db))) == expected


def test_a_pair_in_open_view_is_a_ghost_and_the_same_behind_the_occluder_is_not():
    assert objects_of(recovered(face(15.0, -9.0, 1.0, 2))) == ()
    assert len(objects_of(recovered(face(15.0, 9.0, 1.0, 2)))) == 1


def test_a_mirrored_wall_is_no_object():
    assert objects_of(recovered(face(15.0, 12.0, 16.0, 17))) == ()


def test_the_next_face_of_a_building_is_no_object():
    """An 8 m line from the occluder's end; the same line 6 m away from it is a bus."""
    assert objects_of(recovered(face(24.5, 9.5, 8.0, 9, yaw=math.pi / 2))) == ()
    assert len(objects_of(recovered(face(15.0, 15.0, 8.0, 9, yaw=math.pi / 2)))) == 1


def test_a_side_lobe_at_the_same_range_is_no_object():
    main, lobe = recovered(face(15.0, 9.0, 1.0, 3), snr_db=50.0), recovered(face(14.0, 14.0, 1.0, 3), snr_db=20.0)
    # the images stand 45.9 and 48.1 m off; move the lobe to the same range
    shift = np.hypot(*main.images_m.mean(axis=0)) / np.hypot(*lobe.images_m.mean(axis=0))
    lobe.images_m[:] *= shift
    assert len(objects_of(together(main, lobe))) == 1


def test_nothing_recovered_is_no_object():
    assert objects_of(recovered(np.zeros((0, 2)))) == ()


def test_joint_score_stays_within_zero_and_one():
    assert joint_score(np.array([0.5, 0.5])) == 0.75
    assert joint_score(np.array([1.0, 0.3])) == 1.0


def test_a_stray_peak_in_the_beam_of_a_long_vehicle_is_part_of_it() -> None:
    """Image range of the stray is that of the vehicle's near end, 6 deg beside it: one beam holds both."""
    along = np.linspace(-3.0, 3.0, 6)
    vehicle = recovered(np.stack([np.full(6, 12.0), 8.0 + along], axis=1))
    stray = recovered(np.array([[12.0 + 0.2, 8.0 + 3.0 + 3.6]]), snr_db=30.0)
    assert len(objects_of(together(vehicle, stray))) == 1
    apart = recovered(np.array([[12.0, 8.0 + 3.0 + 9.0]]), snr_db=30.0)
    assert len(objects_of(together(vehicle, apart))) == 2
