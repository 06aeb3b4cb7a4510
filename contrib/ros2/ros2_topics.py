"""The one table of topics that the graph has in ROS 2: name, type and quality of service."""

from __future__ import annotations

import re
from collections.abc import Mapping

import msgspec

#: Names of topics in ROS 2, with or without the leading slash.
TOPIC_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


class Ros2Topic(msgspec.Struct, frozen=True, kw_only=True):
    """One topic; its quality of service is what ROS 2 itself uses for such data."""

    #: Topic in ROS 2, without the leading slash.
    name: str
    #: Type as ROS 2 writes it, "package/msg/Name".
    kind: str
    #: Topic of the graph that it is made of.
    source: str
    #: Messages kept for a reader that falls behind.
    depth: int
    reliable: bool = True
    #: Late joiners get the last message (transient local).
    latched: bool = False


_SCENE = "perception/hidden_objects"
_ALL = (
    Ros2Topic(name="hidden_objects", kind="visualization_msgs/msg/MarkerArray", source=_SCENE, depth=10),
    Ros2Topic(name="hidden_detections", kind="vision_msgs/msg/Detection3DArray", source=_SCENE, depth=10),
    Ros2Topic(name="hidden_tracks", kind="radar_msgs/msg/RadarTracks", source=_SCENE, depth=10),
    Ros2Topic(name="hidden_points", kind="sensor_msgs/msg/PointCloud2", source=_SCENE, depth=10),
    Ros2Topic(name="visibility", kind="nav_msgs/msg/OccupancyGrid", source=_SCENE, depth=1, latched=True),
    Ros2Topic(name="ra_map", kind="sensor_msgs/msg/Image", source="radar/ra_map", depth=5),
    Ros2Topic(name="odom", kind="nav_msgs/msg/Odometry", source="vehicle/state", depth=100),
    Ros2Topic(name="tf", kind="tf2_msgs/msg/TFMessage", source="vehicle/state", depth=100),
    Ros2Topic(name="tf_static", kind="tf2_msgs/msg/TFMessage", source="perception/peaks", depth=1, latched=True),
    Ros2Topic(name="diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray", source="diagnostics/node", depth=50),
)
PUBLISHED: dict[str, Ros2Topic] = {topic.name: topic for topic in _ALL}
#: Made of the vehicle's state: left out where that comes from ROS 2.
OF_VEHICLE = ("odom", "tf")
#: Messages kept between two looks at an input.
INPUT_DEPTH = 10


def require_topic_name(field: str, name: str) -> None:
    """Raise `ValueError` unless a name is one that ROS 2 takes."""
    if not TOPIC_NAME.fullmatch(name):
        raise ValueError(f"{field} must be letters, digits and _ between slashes, as /radar/map; got {name!r}")


def published_topics(names: Mapping[str, str], without: tuple[str, ...] = ()) -> dict[str, Ros2Topic]:
    """Return what is published, by its name in the table, with the names in ROS 2 that are given; "" leaves one out.

    Raises `ValueError` for a name that the table lacks, and for one that ROS 2 does not take or that stands twice.
    """
    for name, given in names.items():
        if name not in PUBLISHED:
            raise ValueError(f"topics.{name} is not published; {', '.join(PUBLISHED)} are")
        if given:
            require_topic_name(f"topics.{name}", given)
    topics = {
        name: msgspec.structs.replace(topic, name=names.get(name, name).removeprefix("/"))
        for name, topic in PUBLISHED.items()
        if name not in without and names.get(name, name)
    }
    used = [topic.name for topic in topics.values()]
    if twice := sorted({name for name in used if used.count(name) > 1}):
        raise ValueError(f"topics must have different names in ROS 2, got {', '.join(twice)} twice")
    return topics
