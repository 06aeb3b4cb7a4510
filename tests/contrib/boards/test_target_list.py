"""Target lists: values against frames packed without the DBC, standard deviations, loss, frames that do not fit."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from contrib.boards.target_list import TargetListParams, TargetListReader, std_of_code
from msgs.values.detections import RadarDetections
from nodes.can.bus import load_dbc
from tests.contrib.boards.target_radar_stand_in import (
    Frame,
    Target,
    general,
    measurement,
    object_general,
    object_quality,
    object_status,
    quality,
    random_targets,
    status,
)

DBC = Path("launch/can/target_radar.dbc")
#: Codes and their bounds as published, in m or m/s.
PUBLISHED_STDS = {
    0: 0.005,
    1: 0.006,
    2: 0.008,
    5: 0.018,
    10: 0.063,
    16: 0.288,
    21: 1.023,
    25: 2.817,
    29: 7.762,
    30: 10.0,
}
CYCLE_NS = 59_000_000


def reader(**params: object) -> TargetListReader:
    return TargetListReader(load_dbc(DBC), TargetListParams(**params), "front")  # type: ignore[arg-type]


def read(target_list: TargetListReader, frames: list[Frame], stamp_ns: int = 0) -> list[RadarDetections]:
    return [each for number, data in frames for each in target_list.add(number, data, stamp_ns)]


def two(targets: list[Target], **options: object) -> list[RadarDetections]:
    """Detections of the same targets twice: of the first measurement only the second's status shows the end."""
    frames = [frame for counter in (7, 8) for frame in measurement(targets, counter, **options)]  # type: ignore[arg-type]
    return read(reader(sensor_id=options.get("sensor_id", 0)), frames)


def test_a_frame_written_out_by_hand() -> None:
    """x 20.0 m = -500 + 0.2 * 2600, y 10.1 m = -102.3 + 0.2 * 562, -5 m/s along, 3 m/s across, 12.5 dBsm."""
    target = Target(number=5, along=2600, across=562, speed_along=492, speed_across=268, rcs=153)
    assert general(target) == bytes([5, 0x51, 0x42, 0x32, 0x7B, 0x21, 0x81, 0x99])
    (first, _) = two([target])
    x_m, y_m = 20.0, 10.1
    assert first.range_m[0] == pytest.approx(math.hypot(x_m, y_m), rel=1e-12)
    assert first.azimuth_rad[0] == pytest.approx(math.atan2(y_m, x_m), rel=1e-12)
    assert first.radial_speed_mps is not None
    assert first.rcs_dbsm is not None
    assert first.radial_speed_mps[0] == pytest.approx((-5.0 * x_m + 3.0 * y_m) / math.hypot(x_m, y_m), rel=1e-12)
    assert (first.rcs_dbsm[0], first.over_ground, first.lost, first.sensor) == (12.5, False, 0, "front")


@pytest.mark.parametrize("sensor_id", [0, 3, 7])
def test_what_is_sent_is_read(sensor_id: int) -> None:
    """64 targets: positions, radial speeds, levels to rounding, covariances with the frames' own steps."""
    targets = random_targets(64, seed=sensor_id)
    first, second = two(targets, sensor_id=sensor_id)
    position_m = np.array([target.position_m for target in targets])
    for found in (first, second):
        assert np.allclose(found.range_m * np.cos(found.azimuth_rad), position_m[:, 0], atol=1e-9)
        assert np.allclose(found.range_m * np.sin(found.azimuth_rad), position_m[:, 1], atol=1e-9)
        assert np.allclose(found.radial_speed_mps, [target.radial_speed_mps for target in targets], atol=1e-9)
        assert np.array_equal(found.rcs_dbsm, [0.5 * target.rcs - 64.0 for target in targets])
    assert (first.scan_id, second.scan_id) == (0, 1)
    for at, target in enumerate(targets):
        variances = np.diag([std_of_code(code) ** 2 + 0.2**2 / 12.0 for code in target.stds[:2]])
        cos, sin = np.cos(first.azimuth_rad[at]), np.sin(first.azimuth_rad[at])
        turn = np.array([[cos, sin], [-sin, cos]])
        across = np.diag([1.0, 1.0 / first.range_m[at]])
        assert np.allclose(first.covariance[at], across @ turn @ variances @ turn.T @ across, rtol=1e-9)


def test_codes_of_standard_deviations_are_those_published() -> None:
    assert {code: round(std_of_code(code), 3) for code in PUBLISHED_STDS} == PUBLISHED_STDS
    assert math.isnan(std_of_code(31))


@pytest.mark.parametrize("targets", [[Target(0, 2600, 512, stds=(31, 16, 10, 10))], [Target(0, 2600, 512)]])
def test_errors_that_are_not_sent_are_the_data_sheets(targets: list[Target]) -> None:
    (first, _) = two(targets, with_quality=targets[0].stds[0] == 31)
    assert np.allclose(first.covariance[0], np.diag([0.4**2, math.radians(1.0) ** 2]))


def test_missing_targets_are_said_and_the_rest_is_published() -> None:
    targets = random_targets(10, seed=1)
    target_list = reader()
    frames = measurement(targets, 1)
    del frames[4:7]
    frames = [frame for frame in frames if frame[0] != 0x702 or frame[1][0] not in (3, 4, 5)]
    (found,) = read(target_list, [*frames, *measurement(targets, 2)][: len(frames) + 1])
    assert (len(found), found.lost, target_list.lost) == (7, 3, 3)


def test_a_measurement_ends_after_its_time() -> None:
    target_list = reader()
    assert read(target_list, measurement(random_targets(4, 0), 1)[:3], stamp_ns=10) == []
    assert target_list.tick(200_000_010) == []
    (found,) = target_list.tick(200_000_011)
    assert (len(found), found.lost, found.stamp_ns) == (2, 2, 10)
    assert target_list.tick(10**12) == []


def test_without_quality_a_measurement_ends_with_its_last_target() -> None:
    """Only the first waits for the next status; quality frames that begin later are waited for from the next on."""
    targets, target_list = random_targets(3, 0), reader()
    assert read(target_list, measurement(targets, 1, with_quality=False)) == []
    assert len(read(target_list, measurement(targets, 2, with_quality=False))) == 2
    assert len(read(target_list, measurement(targets, 3, with_quality=False))) == 1
    late, whole = read(target_list, measurement(targets, 4)), read(target_list, measurement(targets, 5))
    assert len(late) == 1
    assert np.allclose(late[0].covariance[:, 0, 0], 0.16)
    assert len(whole) == 1
    assert not np.allclose(whole[0].covariance[:, 0, 0], 0.16)


def test_counters_wrap_and_gaps_between_measurements_are_counted() -> None:
    targets, target_list = random_targets(2, 0), reader()
    frames = [frame for counter in (65534, 65535, 0, 4, 4, 30000) for frame in measurement(targets, counter)]
    # the same counter twice, and one far away, are a sensor that began anew
    assert [found.scan_id for found in read(target_list, frames)] == [0, 1, 2, 6, 7, 8]
    assert target_list.missed == 3


def test_empty_measurements_are_measurements() -> None:
    target_list = reader()
    found = read(target_list, [*measurement([], 1), *measurement([], 2), *measurement(random_targets(2, 0), 3)])
    assert [len(each) for each in found] == [0, 0, 2]


@pytest.mark.parametrize(("validity", "stays"), [(0, True), (4, True), (6, True), (17, True), (2, False), (14, False)])
def test_what_the_sensor_calls_invalid_is_left_out_but_mirror_images(validity: int, stays: bool) -> None:
    target_list = reader()
    targets = [Target(0, 2600, 512, validity=validity), Target(1, 2700, 512)]
    (found,) = read(target_list, measurement(targets, 1))
    assert (len(found), found.lost) == (2 if stays else 1, 0)
    assert sum(target_list.left_out.values()) == (0 if stays else 1)


def test_objects_are_read_where_they_are_asked_for() -> None:
    targets = [Target(3, 2600, 1523, speed_along=492), Target(4, 2600, 1024), Target(5, 2600, 1024)]
    frames = [(0x60A, object_status(3, 9)), *((0x60B, object_general(target)) for target in targets)]
    frames += [(0x60C, object_quality(target, state)) for target, state in zip(targets, (2, 3, 1), strict=True)]
    target_list = reader(kind="objects")
    (found,) = read(target_list, frames)
    assert found.range_m * np.exp(1j * found.azimuth_rad) == pytest.approx([20.0 + 100.0j, 20.0 + 0.2j], abs=1e-9)
    assert target_list.left_out == {"predicted, not measured": 1}


def test_lateral_distances_can_count_the_other_way() -> None:
    target = Target(0, 2600, 612, speed_across=300)
    left, right = (
        read(reader(left_positive=positive), measurement([target], 1))[0] for positive in (True, False)
    )  # fmt: skip
    assert right.azimuth_rad == -left.azimuth_rad != 0.0
    assert np.array_equal(left.radial_speed_mps, right.radial_speed_mps)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ((0x600, status(1, 0, 1)[:4]), "CLUSTER_STATUS: shorter than 5 bytes"),
        ((0x701, general(Target(9, 2600, 512))[:7]), "CLUSTER_GENERAL: shorter than 8 bytes"),
        ((0x702, quality(Target(9, 2600, 512))), "CLUSTER_QUALITY: of no target"),
        ((0x60A, object_status(1, 1)), "OBJECT_STATUS: the list is to be of clusters"),
    ],
)
def test_frames_that_do_not_fit_are_refused_with_a_reason(frame: Frame, reason: str) -> None:
    targets, target_list = random_targets(3, 0), reader()
    frames = measurement(targets, 1)
    (found,) = read(target_list, [*frames[:2], frame, *frames[2:]])
    assert (len(found), found.lost) == (3, 0)
    assert target_list.refused == {reason: 1}


@pytest.mark.parametrize(("with_quality", "missing"), [(True, 3), (True, 0), (False, 3)])
def test_measurements_are_never_mixed(with_quality: bool, missing: int) -> None:
    """A target is lost, and the next status too: what follows fills no gap of the measurement before."""
    old, new = random_targets(5, 0), random_targets(5, 1)
    target_list = reader()
    read(
        target_list, [*measurement(old, 1, with_quality=with_quality), *measurement(old, 2, with_quality=with_quality)]
    )
    frames = [frame for frame in measurement(old, 3, with_quality=with_quality) if frame[1][0] != missing]
    frames += measurement(new, 4, with_quality=with_quality)[1:]
    found = read(target_list, [*frames, *measurement(new, 5, with_quality=with_quality)])
    assert [(each.scan_id, len(each), each.lost) for each in found] == [(2, 4, 1), (4, 5, 0)]
    position_m = np.array([target.position_m for target in old if target.number != missing])
    assert np.allclose(found[0].range_m, np.hypot(*position_m.T))
    assert target_list.missed == 1


def test_more_than_announced_is_another_layout() -> None:
    target_list = reader()
    frames = measurement(random_targets(4, 0), 1, with_quality=False)
    (found,) = read(target_list, [(0x600, status(1, 1, 1)), *frames[1:], (0x600, status(0, 1, 2))])
    assert (len(found), found.lost) == (2, 0)
    assert target_list.refused == {"CLUSTER_GENERAL: more than announced": 2}


def test_frames_of_others_change_nothing() -> None:
    target_list = reader(sensor_id=2)
    targets = random_targets(3, 0)
    frames = [
        each for pair in zip(measurement(targets, 1, 2), measurement(targets, 9, 4), strict=True) for each in pair
    ]
    (found,) = read(target_list, [(0x100, b""), *frames, (0x201, bytes(8))])
    assert (len(found), dict(target_list.strangers), dict(target_list.refused)) == (3, {4: 7}, {})


def test_a_dbc_of_another_layout_is_refused(tmp_path: Path) -> None:
    text = DBC.read_text().replace("SG_ RCS : 63|8@0+", "SG_ LEVEL : 63|8@0+", 1)
    (tmp_path / "a.dbc").write_text(text)
    with pytest.raises(ValueError, match="CLUSTER_GENERAL: the DBC has no signal 'RCS'"):
        TargetListReader(load_dbc(tmp_path / "a.dbc"), TargetListParams())


@pytest.mark.parametrize("params", [{"sensor_id": 8}, {"sensor_id": -1}])
def test_params_are_checked(params: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(params))):
        TargetListParams(**params)


def test_the_error_of_a_radial_speed_is_that_of_its_parts_along_the_ray() -> None:
    """At (30, 39.9) m, 0.601 of it along and 0.799 across: codes 16 and 10 are 0.288 and 0.063 m/s, steps 0.25 m/s.

    sqrt(0.361 (0.288^2 + 0.25^2 / 12) + 0.639 (0.063^2 + 0.25^2 / 12)) = 0.194 m/s.
    """
    (first, _) = two([Target(0, 2650, 711, stds=(16, 16, 16, 10))])
    assert first.range_m[0] == pytest.approx(math.hypot(30.0, 39.9))
    assert first.radial_speed_std_mps is not None
    assert first.radial_speed_std_mps[0] == pytest.approx(0.1944, abs=5e-4)
