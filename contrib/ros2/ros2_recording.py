"""Recordings as a ROS 2 bag (MCAP storage) with standard messages, written by the library rosbags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from contrib.ros2.ros2_messages import Ros2Messages
from contrib.ros2.ros2_types import type_store
from msgs.bus.topics import SIDE_TOPICS
from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.vehicle import VehicleState
from nodes.recording.shapes import Account, Odometry, counted

TOPICS = ("perception/hidden_objects", "vehicle/state", "radar/ra_map", "diagnostics/node", *SIDE_TOPICS)
#: Of the metadata file: ROS 2 Jazzy's.
BAG_VERSION: Literal[9] = 9


def topics() -> tuple[str, ...]:
    """Return the topics that have a place in this format."""
    return TOPICS


def require_library() -> None:
    """Raise `ImportError` that names the package where rosbags is not installed."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError as error:
        raise ImportError("rosbags, which --to ros2 needs (pip install rosbags)") from error


def write(
    reader: RecordingReader, out: Path, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> None:
    """Write the topics as a bag folder; bag times are those of the recording, header stamps the messages' own."""
    require_library()
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(out, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        sink = _Sink(bag, account)
        for recorded in counted(reader, topics, account, advance):
            sink.take(recorded)


class _Sink:
    """Turns messages into ROS's and writes them."""

    def __init__(self, bag: Any, account: Account) -> None:
        self._bag, self._account = bag, account
        self._store = type_store()
        self._build = Ros2Messages(self._store.types)
        self._connections: dict[str, Any] = {}
        self._odometry = Odometry()

    def take(self, recorded: Recorded) -> None:
        """Write what a message becomes."""
        for name, build in self._build.drafts(recorded.message).items():
            self._put(f"/{name}", build(), recorded.log_time_ns)
        if isinstance(recorded.message, VehicleState):
            self._take_state(recorded.message, recorded)

    def _take_state(self, state: VehicleState, recorded: Recorded) -> None:
        pose = self._odometry.advance(state)
        if pose is None:
            self._account.leave_out(recorded.topic, Odometry.REFUSED)
            return
        self._put("/odom", self._build.odometry(state, pose), recorded.log_time_ns)
        odom = self._build.odom_transform(state.stamp_ns, pose)
        mounting = self._build.mounting_transform(state.stamp_ns)
        self._put("/tf", self._build.transforms(odom, mounting), recorded.log_time_ns)

    def _put(self, topic: str, message: Any, time_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._bag.add_connection(topic, kind, typestore=self._store)
        self._bag.write(self._connections[topic], time_ns, self._store.serialize_cdr(message, kind))
