"""Messages of ROS as messages of the graph: detections, odometry, clouds of a LiDAR, images of a camera."""

from __future__ import annotations

from typing import Any

from contrib.imports.detection_columns import DetectionMapping, detections_of
from contrib.imports.detection_mapping import READERS
from contrib.imports.jpeg import jpeg_of_file, jpeg_of_pixels
from contrib.ros2.point_cloud2 import LidarMounting, lidar_points
from contrib.ros2.ros2_types import CLOUD
from msgs.bus.interface import Outgoing
from msgs.values.camera import CameraImage
from msgs.values.lidar import MAX_NAME_LENGTH
from msgs.values.units import NANOSECONDS_PER_SECOND
from msgs.values.vehicle import VehicleState
from nodes.node import ShedTally

_REASON_LIMIT = 200


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message's header, on the clock of ROS 2."""
    return int(message.header.stamp.sec) * NANOSECONDS_PER_SECOND + int(message.header.stamp.nanosec)


class DetectionInput:
    """`PointCloud2` or `RadarScan` -> radar/detections."""

    def __init__(self, kind: str, mapping: DetectionMapping, shed: ShedTally) -> None:
        self._read, self._mapping, self._shed = READERS[kind].columns, mapping, shed
        self._scan_id = 0

    def convert(self, message: Any, stamp_ns: int) -> Outgoing:
        """Return a scan's detections, unusable ones counted; `ValueError` for fields that do not fit."""
        detections, left_out = detections_of(
            self._read(message, self._mapping.columns.values()), self._mapping, stamp_ns, self._scan_id
        )
        self._scan_id += 1
        for reason, count in left_out.items():
            self._shed.add("detection", reason, count)
        return Outgoing("radar/detections", detections)


class OdometryInput:
    """`nav_msgs/Odometry` -> vehicle/state: speed along the vehicle's axis and yaw rate, of its twist."""

    def convert(self, message: Any, stamp_ns: int) -> Outgoing:
        """Return the state; `ValueError` where speed or yaw rate is no number or beyond any vehicle."""
        twist = message.twist.twist
        state = VehicleState(stamp_ns=stamp_ns, speed_mps=twist.linear.x, yaw_rate_rps=twist.angular.z)
        return Outgoing("vehicle/state", state)


class CloudInput:
    """`PointCloud2` -> lidar/points, all its fields byte for byte."""

    def __init__(self, mounting: LidarMounting) -> None:
        self._mounting, self._count = mounting, 0

    def convert(self, message: Any, stamp_ns: int) -> Outgoing:
        """Return the cloud; `ValueError` for fields or data that do not fit."""
        points = lidar_points(message, stamp_ns, self._count, self._mounting)
        self._count += 1
        return Outgoing("lidar/points", points)


class ImageInput:
    """`CompressedImage` or `Image` -> camera/image: a JPEG as it is, all else compressed."""

    def __init__(self) -> None:
        self._count = 0

    def convert(self, message: Any, stamp_ns: int) -> Outgoing:
        """Return the image; `ValueError` where it is none, or has an encoding that is not known."""
        is_raw = hasattr(message, "encoding")
        jpeg = jpeg_of_pixels(message) if is_raw else jpeg_of_file(message.data.tobytes())
        image = CameraImage.of(jpeg, stamp_ns, self._count, message.header.frame_id[:MAX_NAME_LENGTH])
        self._count += 1
        return Outgoing("camera/image", image)


def side_input(kind: str, mounting: LidarMounting) -> CloudInput | ImageInput:
    """Return what converts messages of a type of `SIDE_KINDS`."""
    return CloudInput(mounting) if kind == CLOUD else ImageInput()


Input = DetectionInput | OdometryInput | CloudInput | ImageInput


def reason_of(error: Exception) -> str:
    """Return why a message was refused, on one line."""
    text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())[:_REASON_LIMIT]
