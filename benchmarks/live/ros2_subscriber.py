"""A node of ROS 2 that subscribes to the bridge: run with the interpreter that has rclpy.

Usage: PYTHON ros2_subscriber.py [--latched-points]
Writes a line of JSON for each message: topic, its header's stamp, arrival on the monotonic clock; and one for each
topic's publisher with both type hashes. Ends when its standard input is closed.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS: dict[str, tuple[Any, Any]] = {
    "/hidden_objects": (MarkerArray, 10),
    "/hidden_points": (PointCloud2, 10),
    "/visibility": (OccupancyGrid, LATCHED),
    "/ra_map": (Image, 5),
    "/odom": (Odometry, 200),
    "/diagnostics": (DiagnosticArray, 200),
}


def say(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def subscribe(node: Any, name: str, kind: Any, quality: Any) -> None:
    def take(message: Any) -> None:
        header = message.markers[0].header if name == "/hidden_objects" else message.header
        stamp_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
        say({"topic": name, "stamp_ns": stamp_ns, "at_ns": time.monotonic_ns()})

    node.create_subscription(kind, name, take, quality)


def say_hashes(node: Any) -> None:
    """Compare the hash that the bridge announces with that of this side's own type support."""
    for name in TOPICS:
        own = {str(info.topic_type_hash) for info in node.get_subscriptions_info_by_topic(name)}
        theirs = {str(info.topic_type_hash) for info in node.get_publishers_info_by_topic(name)}
        say({"hash_of": name, "agrees": own == theirs})


def main() -> None:
    topics = {"/hidden_points": (PointCloud2, LATCHED)} if "--latched-points" in sys.argv else TOPICS
    closed = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), closed.set()), daemon=True).start()
    rclpy.init()
    node = rclpy.create_node("benchmark")
    for name, (kind, quality) in topics.items():
        subscribe(node, name, kind, quality)
    while not closed.is_set():
        rclpy.spin_once(node, timeout_sec=0.05)
    if topics is TOPICS:
        say_hashes(node)


if __name__ == "__main__":
    main()
