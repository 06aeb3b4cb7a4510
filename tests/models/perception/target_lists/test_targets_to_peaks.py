"""The stage on a street: walls, images, what is hidden and what is explained."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.perception.mirrors.image_walls import DirectReturns
from models.perception.mirrors.mirror_table import NO_WALL
from models.perception.mirrors.peaks_to_view import fold_scan, recover_bev
from models.perception.mirrors.recovery import Recovered
from models.perception.mirrors.rejection import hidden_mask
from models.perception.target_lists.defaults import DETECTION_GEOMETRY
from models.perception.target_lists.list_map import list_map
from models.perception.target_lists.sensor import DetectionSensor
from models.perception.target_lists.targets_to_peaks import DetectionsStage
from models.perception.target_lists.two_witnesses import agreed
from models.physics.mirror import wall_from_ends
from msgs.values.detections import RadarDetections
from msgs.values.perception import BevFrame, HiddenObject, PathClass, Visibility, Wall
from msgs.values.radar import NO_RADIAL_SPEED
from tests.models.perception.target_lists.street import (
    CAR_M,
    FACADE_Y_M,
    SENSOR,
    car_points,
    detections,
    images,
    standing_speeds,
    street_points,
)


def viewed(message: RadarDetections, sensor: DetectionSensor = SENSOR) -> BevFrame:
    return recover_bev(DetectionsStage(sensor, DETECTION_GEOMETRY).peaks(message), DETECTION_GEOMETRY)


def bare_street() -> np.ndarray:
    """Return the street whose facade shows the car alone."""
    points_m = street_points()
    return np.concatenate([points_m[:190], points_m[-11:]])


def test_a_hidden_car_stands_where_its_image_folds_to() -> None:
    """Its visible faces have their centre 0.7 m before the car's; the errors of the wall and the returns add 0.3 m."""
    frame = viewed(detections(street_points()))
    (car,) = frame.objects
    assert np.hypot(*(np.array([car.x_m, car.y_m]) - car_points().mean(axis=0))) < 0.3
    facade = min(frame.walls, key=lambda wall: wall.ends_m[0][1])
    assert facade.offset_m == pytest.approx(-FACADE_Y_M, abs=0.05)


def test_a_row_that_shows_nothing_of_what_is_before_it_is_no_mirror() -> None:
    """The same street without the building's image: what lies behind the line stands there. What moves is an image."""
    message = detections(bare_street())
    assert viewed(message).objects == ()
    speeds = np.where(np.arange(len(message)) < 190, 0.0, 3.0)
    moving = msgspec.structs.replace(message, radial_speed_mps=speeds, over_ground=True)
    assert len(viewed(moving).objects) == 1


def test_a_car_in_plain_sight_explains_its_image() -> None:
    """Same image, no building; then the car's own returns: folded, and no hidden object."""
    points = street_points()[:120]
    seen = np.concatenate([points, images(car_points()), car_points()])
    peaks = DetectionsStage(SENSOR, DETECTION_GEOMETRY).peaks(detections(seen))
    folded = fold_scan(peaks, DETECTION_GEOMETRY).recovered.points_m
    assert np.hypot(*(folded.mean(axis=0) - CAR_M)) < 1.5
    assert viewed(detections(seen)).objects == ()
    assert viewed(detections(np.concatenate([points, images(car_points())]))).objects == ()


def test_images_of_a_standing_world_keep_its_speed() -> None:
    """The radar drives at 9 m/s: an image of a standing car stands over ground too, a moving one does not."""
    message = detections(bare_street())
    speeds = standing_speeds(message, np.array([9.0, 0.0]))
    speeds[-11:] += 3.0
    peaks = DetectionsStage(SENSOR, DETECTION_GEOMETRY).peaks(msgspec.structs.replace(message, radial_speed_mps=speeds))
    image = peaks.path_class == PathClass.MIRRORED
    np.testing.assert_allclose(np.median(peaks.radial_speed_mps[image]), 3.0, atol=0.05)
    np.testing.assert_allclose(peaks.radial_speed_mps[~image], 0.0, atol=0.05)


@pytest.mark.parametrize(
    ("image_mps", "return_mps", "hidden"),
    [(0.0, 0.1, False), (4.0, 0.1, True), (4.0, -1.0, False), (np.nan, 4.0, False)],
)
def test_a_standing_return_does_not_explain_a_moving_image(image_mps: float, return_mps: float, hidden: bool) -> None:
    """A folded position at a direct return of like strength, behind the building, so that no other rule decides."""
    at_m, other = np.array([[28.0, 12.0]]), np.zeros((1, 2, 2))
    recovered = Recovered(
        points_m=at_m, images_m=images(at_m), image_covariance_m2=other, wall_covariance_m2=other,
        wall=np.zeros(1, int), second=np.full(1, NO_WALL), score=np.ones(1), snr_db=np.full(1, 20.0),
        stamp_ns=np.zeros(1, np.int64),
        radial_speed_mps=np.array([image_mps]),
    )  # fmt: skip
    returns = DirectReturns(at_m, np.full(1, 20.0), np.zeros(1, int), np.full(1, NO_WALL), np.array([return_mps]))
    normal, offset_m = wall_from_ends(np.array([4.0, 6.0]), np.array([20.0, 6.0]), np.zeros(2))
    building = Wall(
        normal=(float(normal[0]), float(normal[1])), offset_m=offset_m, ends_m=((4.0, 6.0), (20.0, 6.0)), inliers=9
    )
    assert hidden_mask(recovered, [building], returns, DETECTION_GEOMETRY.recovery).tolist() == [hidden]


def test_heights_tell_a_building_and_the_ground() -> None:
    """Images 8 m up form no object; returns 5 m below the ground are none at all."""
    message = detections(street_points())
    height_m = np.zeros(len(message))
    height_m[-11:] = 8.0
    sensor = msgspec.structs.replace(SENSOR, elevation_std_deg=0.5)
    tall = msgspec.structs.replace(message, elevation_rad=np.arcsin(height_m / message.range_m))
    # the facade must not end below the ray
    tall.elevation_rad[:120:2] = np.arcsin(6.0 / message.range_m[:120:2])
    assert viewed(tall, sensor).objects == ()
    below = msgspec.structs.replace(message, elevation_rad=np.arcsin(-5.0 / message.range_m))
    assert len(DetectionsStage(sensor, DETECTION_GEOMETRY).peaks(below)) == 0


def test_a_ray_over_the_wall_is_no_image() -> None:
    """A house 20 m high behind a fence of 1 m is in plain sight."""
    message = detections(bare_street())
    height_m = np.zeros(len(message))
    height_m[-11:] = 20.0
    over = msgspec.structs.replace(message, elevation_rad=np.arcsin(height_m / message.range_m))
    peaks = DetectionsStage(msgspec.structs.replace(SENSOR, elevation_std_deg=0.5), DETECTION_GEOMETRY).peaks(over)
    assert (peaks.path_class == PathClass.LOS).all()


def test_limits_of_the_sensor_reach_the_view() -> None:
    """It sees to 30 m and 20 degrees: no cell beyond is observed, and none without a stated sensitivity."""
    sensor = msgspec.structs.replace(SENSOR, max_range_m=30.0, azimuth_limit_deg=20.0, reference_range_m=80.0)
    frame = viewed(detections(street_points(car=False)[:120]), sensor)
    centres_m = frame.grid.cell_centres_m()
    direct = centres_m[frame.visibility == Visibility.DIRECT]
    assert len(direct) > 100
    assert np.hypot(*direct.T).max() <= 30.0
    assert np.degrees(np.abs(np.arctan2(direct[:, 1], direct[:, 0]))).max() <= 20.0
    assert (viewed(detections(street_points())).visibility == Visibility.UNKNOWN).all()


def test_a_list_is_a_map_with_its_returns_as_loud_as_listed() -> None:
    """One at 30 m and 20 deg, one beyond the map; the speed stands in the cell of the first."""
    points_m = np.array([[30.0 * np.cos(0.35), 30.0 * np.sin(0.35)], [200.0, 0.0]])
    peaks = DetectionsStage(SENSOR).peaks(detections(points_m, radial_speed_mps=np.array([2.0, 3.0]), over_ground=True))
    ra_map = list_map(peaks)
    level_db = 20.0 * np.log10(np.abs(ra_map.values))
    row, column = np.unravel_index(level_db.argmax(), level_db.shape)
    assert ra_map.grid.range_at(row) == pytest.approx(30.0, abs=0.3)
    assert ra_map.grid.azimuth_at(column) == pytest.approx(0.35, abs=0.02)
    assert level_db.max() == pytest.approx(25.0, abs=1.5)
    assert np.unique(ra_map.radial_speed_cmps).tolist() == [NO_RADIAL_SPEED, 200]


def test_an_unlikely_object_counts_where_returns_fold_to_it() -> None:
    """Of three that the network sees, 10 m apart: the sure one, and an unlikely one at a cluster."""

    def seen(x_m: float, score: float) -> HiddenObject:
        cov_m2 = ((0.1, 0.0), (0.0, 0.1))
        return HiddenObject(id=0, x_m=x_m, y_m=0.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=score, cov_m2=cov_m2)

    judged = seen(10.0, 0.8), seen(20.0, 0.3), seen(30.0, 0.2)
    assert [item.x_m for item in agreed(judged, ())] == [10.0]
    both = agreed(judged, (seen(28.5, 0.9), seen(50.0, 0.9)))
    assert [(item.id, item.x_m, item.score) for item in both] == [(0, 30.0, 0.9), (1, 10.0, 0.8)]


def test_detections_of_another_sensor_are_refused() -> None:
    stage = DetectionsStage(msgspec.structs.replace(SENSOR, name="front"))
    with pytest.raises(ValueError, match=r"detections\.sensor must be 'front', got 'rear'"):
        stage.peaks(detections([[10.0, 0.0]], sensor="rear"))
