"""Values of the ROS 2 messages, whatever store their types come from: geometry, covariances, stamps, by hand."""

from __future__ import annotations

import math
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from contrib.imports.detection_mapping import mapping_path, read_mapping
from contrib.ros2.ros2_inputs import DetectionInput, OdometryInput, reason_of, stamp_ns_of
from contrib.ros2.ros2_messages import Ros2Messages
from contrib.ros2.ros2_types import SCAN
from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.frames import Pose2
from msgs.values.perception import BevGrid, HiddenObject, Track, Visibility
from msgs.values.vehicle import VehicleState
from nodes.node import ShedTally
from tests.fuzz.cases import ra_map, view

HIDDEN = HiddenObject(
    id=(1 << 40) - 2, x_m=13.0, y_m=-9.0, length_m=4.0, width_m=2.0, yaw_rad=math.pi / 3, score=0.5,
    cov_m2=((1.0, 0.1), (0.1, 2.0)), object_class="car",
)  # fmt: skip
TRACK = Track(
    id=258, x_m=1.0, y_m=2.0, velocity_x_mps=-3.0, velocity_y_mps=4.0, age_s=1.5, cov_m2=((1.0, 0.1), (0.1, 2.0)),
    velocity_cov_m2ps2=((3.0, 0.3), (0.3, 4.0)),
)  # fmt: skip
FRAME = msgspec.structs.replace(view(1, 2_000_000_005), objects=(HIDDEN,), tracks=(TRACK,))


@pytest.fixture
def messages() -> Ros2Messages:
    """Messages whose types hold whatever they are given."""
    return Ros2Messages(defaultdict(lambda: SimpleNamespace))


def xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def test_markers_stand_where_the_view_has_them(messages: Ros2Messages) -> None:
    clear, wall, box, arrow = messages.markers(FRAME).markers
    assert (clear.action, wall.ns, box.ns, arrow.ns) == (3, "walls", "objects", "tracks")
    assert [xyz(at) for at in wall.points] == [(20.0, -10.0, 0.0), (20.0, 10.0, 0.0)]
    assert (xyz(box.pose.position), xyz(box.scale)) == ((13.0, -9.0, 0.75), (4.0, 2.0, 1.5))
    assert (box.pose.orientation.z, box.pose.orientation.w) == pytest.approx((0.5, math.sqrt(0.75)))
    assert (box.id, box.type, wall.type, arrow.type) == (0x7FFFFFFE, 1, 4, 0)
    # as long as the way of a second
    assert [xyz(at) for at in arrow.points] == [(1.0, 2.0, 0.0), (-2.0, 6.0, 0.0)]
    assert (box.header.frame_id, box.header.stamp.sec, box.header.stamp.nanosec) == ("radar", 2, 5)


def test_stamps_are_moved_to_the_readers_clock_and_never_negative(messages: Ros2Messages) -> None:
    messages.offset_ns = 3_000_000_000
    assert messages.markers(FRAME).markers[0].header.stamp.sec == 5
    messages.offset_ns = -3_000_000_000
    stamp = messages.markers(FRAME).markers[0].header.stamp
    assert (stamp.sec, stamp.nanosec) == (0, 0)


def test_detections_have_box_class_and_covariance(messages: Ros2Messages) -> None:
    (detection,) = messages.detections(FRAME).detections
    (result,) = detection.results
    assert (result.hypothesis.class_id, result.hypothesis.score, detection.id) == ("car", 0.5, str((1 << 40) - 2))
    covariance = np.reshape(result.pose.covariance, (6, 6))
    assert covariance[:2, :2].tolist() == [[1.0, 0.1], [0.1, 2.0]]
    assert np.count_nonzero(covariance) == 4
    assert (xyz(detection.bbox.center.position), xyz(detection.bbox.size)) == ((13.0, -9.0, 0.75), (4.0, 2.0, 1.5))


def test_tracks_have_velocity_and_both_covariances(messages: Ros2Messages) -> None:
    """xx, xy, xz, yy, yz, zz; the number 258 ends in the bytes 1, 2."""
    (track,) = messages.tracks(FRAME).tracks
    assert (xyz(track.position), xyz(track.velocity)) == ((1.0, 2.0, 0.0), (-3.0, 4.0, 0.0))
    np.testing.assert_allclose(track.position_covariance, [1.0, 0.1, 0.0, 2.0, 0.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(track.velocity_covariance, [3.0, 0.3, 0.0, 4.0, 0.0, 0.0], rtol=1e-6)
    assert track.uuid.uuid.tolist() == [0] * 14 + [1, 2]


def test_a_map_is_four_grey_levels_a_decibel_with_far_up_and_left_left(messages: Ros2Messages) -> None:
    """30 dBm over noise of 10 dBm are 20 dB: level 80."""
    plain = ra_map(1, 10)
    values = np.full(plain.grid.shape, 1e-3, np.complex64)
    values[2, 5] = 31.6231
    image = messages.map_image(msgspec.structs.replace(plain, values=values, noise_power_mw=10.0))
    grey = image.data.reshape(image.height, image.width)
    assert (grey[-3, -6], np.count_nonzero(grey), image.step) == (80, 1, plain.grid.azimuth_bins)


def test_the_mask_is_three_states_from_its_corner_on(messages: Ros2Messages) -> None:
    grid = BevGrid(x_min_m=3.0, y_min_m=-7.0, cell_m=0.25, rows=2, columns=3)
    mask = np.array([[0, 1, 2], [2, 2, 2]], np.uint8)
    assert (Visibility.UNKNOWN, Visibility.DIRECT, Visibility.MIRRORED) == (0, 1, 2)
    said = messages.occupancy(msgspec.structs.replace(FRAME, grid=grid, visibility=mask))
    assert said.data.tolist()[:5] == [-1, 0, 50, 50, 50]
    assert (said.info.resolution, said.info.width, said.info.height) == (0.25, 3, 2)
    assert xyz(said.info.origin.position) == (3.0, -7.0, 0.0)


def test_points_are_four_floats(messages: Ros2Messages) -> None:
    cloud = messages.cloud(FRAME)
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8), ("score", 12)]
    assert np.frombuffer(cloud.data.tobytes(), "<f4").tolist() == [13.0, -9.0, 0.0, 0.5]
    assert (cloud.point_step, cloud.row_step, cloud.width) == (16, 16, 1)


def test_pose_and_twist_of_the_vehicle(messages: Ros2Messages) -> None:
    said = messages.odometry(VehicleState(stamp_ns=1, speed_mps=3.0, yaw_rate_rps=0.2), Pose2(5.0, 6.0, math.pi))
    assert (xyz(said.pose.pose.position), said.pose.pose.orientation.z) == ((5.0, 6.0, 0.0), 1.0)
    assert (xyz(said.twist.twist.linear), xyz(said.twist.twist.angular)) == ((3.0, 0.0, 0.0), (0.0, 0.0, 0.2))
    assert (said.header.frame_id, said.child_frame_id) == ("odom", "base_link")
    mounting = messages.mounting_transform(1, Pose2(1.4, 0.2, 0.0))
    assert (mounting.header.frame_id, mounting.child_frame_id) == ("base_link", "radar")
    assert xyz(mounting.transform.translation) == (1.4, 0.2, 0.0)


@pytest.mark.parametrize(
    ("state", "level"),
    [(NodeState.READY, 0), (NodeState.DEGRADED, 1), (NodeState.STARTING, 1), (NodeState.STOPPING, 3)],
)
def test_a_heartbeat_is_a_status(messages: Ros2Messages, state: NodeState, level: int) -> None:
    status = NodeStatus(
        stamp_ns=1, node="geometry", pid=1, state=state, reason="slow", cpu_s=1.234, resident_bytes=3 << 19,
        stages=(StageTime(name="fold", count=2, last_ms=1.0, mean_ms=2.0, max_ms=3.0),),
        received=(TopicCount(topic="log", messages=9, bytes=9, lost=4),),
        shed=(ShedCount(what="beam", reason="late", count=5),),
    )  # fmt: skip
    (said,) = messages.diagnostics(status).status
    assert (said.level, said.message, said.name) == (level, "slow", "mirrorwave: geometry")
    assert {value.key: value.value for value in said.values} == {
        "cpu_s": "1.23", "resident_mib": "1.5", "fold_mean_ms": "2.000", "log lost": "4", "beam shed, late": "5",
    }  # fmt: skip


def test_odometry_comes_in_as_speed_and_yaw_rate() -> None:
    vector = SimpleNamespace
    twist = SimpleNamespace(linear=vector(x=3.0, y=7.0, z=8.0), angular=vector(x=5.0, y=6.0, z=-0.2))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=2, nanosec=5))
    message = SimpleNamespace(header=header, twist=SimpleNamespace(twist=twist))
    assert stamp_ns_of(message) == 2_000_000_005
    state = OdometryInput().convert(message, 9).message
    assert state == VehicleState(stamp_ns=9, speed_mps=3.0, yaw_rate_rps=-0.2)
    # scans are numbered as they come, whatever they hold
    returns = DetectionInput(SCAN, read_mapping(mapping_path(SCAN)), ShedTally())
    scans = [returns.convert(SimpleNamespace(returns=[]), at).message for at in (5, 6)]
    assert [(scan.scan_id, scan.stamp_ns, len(scan)) for scan in scans] == [(0, 5, 0), (1, 6, 0)]
    assert (reason_of(ValueError("a\n b")), reason_of(KeyError("x" * 300))[:11]) == ("a b", "KeyError: '")
    assert len(reason_of(KeyError("x" * 300))) == 200
