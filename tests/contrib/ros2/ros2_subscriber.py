"""A node of ROS 2 that subscribes to the bridge: run with the interpreter that has rclpy.

Usage: PYTHON ros2_subscriber.py [--latched-points]
Writes a line of JSON that names its topics, those whose types this ROS 2 has; one for each message: topic, its header's
stamp, arrival on the monotonic clock; and one for each topic's publisher with both type hashes. Ends when its standard
input is closed.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS: dict[str, tuple[str, Any]] = {
    "/hidden_objects": ("visualization_msgs.msg.MarkerArray", 10),
    "/hidden_detections": ("vision_msgs.msg.Detection3DArray", 10),
    "/hidden_tracks": ("radar_msgs.msg.RadarTracks", 10),
    "/hidden_points": ("sensor_msgs.msg.PointCloud2", 10),
    "/visibility": ("nav_msgs.msg.OccupancyGrid", LATCHED),
    "/ra_map": ("sensor_msgs.msg.Image", 5),
    "/odom": ("nav_msgs.msg.Odometry", 200),
    "/tf": ("tf2_msgs.msg.TFMessage", 200),
    "/tf_static": ("tf2_msgs.msg.TFMessage", LATCHED),
    "/diagnostics": ("diagnostic_msgs.msg.DiagnosticArray", 200),
}


def say(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def kind_of(path: str) -> Any:
    """Return a message type, or None where this ROS 2 lacks its package."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError:
        return None


def header_of(message: Any) -> Any:
    """Return the header of a message, or of the first that it is made of."""
    for parts in ("markers", "transforms"):
        if hasattr(message, parts):
            return getattr(message, parts)[0].header
    return message.header


def subscribe(node: Any, name: str, kind: Any, quality: Any) -> None:
    def take(message: Any) -> None:
        stamp = header_of(message).stamp
        say({"topic": name, "stamp_ns": stamp.sec * 10**9 + stamp.nanosec, "at_ns": time.monotonic_ns()})

    node.create_subscription(kind, name, take, quality)


def say_hashes(node: Any, names: list[str]) -> None:
    """Compare the hash that the bridge announces with that of this side's own type support."""
    for name in names:
        own = {str(info.topic_type_hash) for info in node.get_subscriptions_info_by_topic(name)}
        theirs = {str(info.topic_type_hash) for info in node.get_publishers_info_by_topic(name)}
        say({"hash_of": name, "agrees": own == theirs})


def main() -> None:
    is_whole = "--latched-points" not in sys.argv
    topics = TOPICS if is_whole else {"/hidden_points": (TOPICS["/hidden_points"][0], LATCHED)}
    known = {name: (kind, quality) for name, (path, quality) in topics.items() if (kind := kind_of(path))}
    closed = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), closed.set()), daemon=True).start()
    rclpy.init()
    node = rclpy.create_node("benchmark")
    for name, (kind, quality) in known.items():
        subscribe(node, name, kind, quality)
    say({"subscribed": list(known)})
    while not closed.is_set():
        rclpy.spin_once(node, timeout_sec=0.05)
    if is_whole:
        say_hashes(node, list(known))


if __name__ == "__main__":
    main()
