"""Messages of ROS 2 as messages of the graph: detections and odometry."""

from __future__ import annotations

from typing import Any

from models.sensors.detection_columns import DetectionMapping, detections_of
from msgs.bus.interface import Outgoing
from msgs.values.units import NANOSECONDS_PER_SECOND
from msgs.values.vehicle import VehicleState
from nodes.bridges.detection_mapping import READERS
from nodes.node import ShedTally

_REASON_LIMIT = 200


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message's header, on the clock of ROS 2."""
    return int(message.header.stamp.sec) * NANOSECONDS_PER_SECOND + int(message.header.stamp.nanosec)


class DetectionInput:
    """`PointCloud2` or `RadarScan` -> radar/detections."""

    def __init__(self, kind: str, mapping: DetectionMapping, shed: ShedTally) -> None:
        self._read, self._mapping, self._shed = READERS[kind], mapping, shed
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


def reason_of(error: Exception) -> str:
    """Return why a message was refused, on one line."""
    text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())[:_REASON_LIMIT]
