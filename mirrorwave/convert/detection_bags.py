"""Detections in ROS 1 and ROS 2 bags, read by the library rosbags: `PointCloud2` of radars, `radar_msgs/RadarScan`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mirrorwave.convert.detection_tables import ScanRows
from msgs.values.units import NANOSECONDS_PER_SECOND
from nodes.bridges.detection_mapping import READERS
from nodes.bridges.ros2_types import CLOUD, SCAN, type_store

#: Ends of names that rosbags reads; a ROS 2 bag may also be a folder.
SUFFIXES = (".bag", ".mcap", ".db3")


def require_library() -> None:
    """Raise `ImportError` that names the package where rosbags is not installed."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError as error:
        raise ImportError("rosbags, which reads ROS bags (pip install mirrorwave[convert])") from error


class DetectionBag:
    """The messages of one topic of an open bag."""

    def __init__(self, reader: Any, path: Path, connections: list[Any]) -> None:
        self._reader, self._path, self._connections = reader, path, connections
        self.topic: str = connections[0].topic
        self.kind: str = connections[0].msgtype
        self.count = sum(connection.msgcount for connection in connections)
        #: Why the bag could not be read to its end; empty where it could.
        self.loss = ""

    def scans(
        self, wanted: Collection[str | int], left_out: Counter[str], advance: Callable[[], None]
    ) -> Iterator[ScanRows]:
        """Yield a scan for each message; those whose `wanted` columns cannot be read are counted in `left_out`."""
        messages = self._reader.messages(connections=self._connections)
        while True:
            try:
                connection, time_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # noqa: BLE001 - a damaged bag fails in whatever way the damage makes its reader
                self.loss = f"{self._path}: cannot be read on: {_reason(error)}"
                return
            advance()
            try:
                message = self._reader.deserialize(data, connection.msgtype)
                columns = READERS[self.kind](message, wanted)
            except Exception as error:  # noqa: BLE001 - as above
                left_out[f"message: {_reason(error)}"] += 1
                continue
            yield ScanRows(_stamp_ns(message.header.stamp) or time_ns, columns)


@contextmanager
def open_bag(path: Path, topic: str | None) -> Iterator[DetectionBag]:
    """Open a bag at the topic named, or at its only one with detections.

    Raises `ImportError` without rosbags, `ValueError` naming the bag where it is none or the topic is not to be told.
    """
    require_library()
    from rosbags.highlevel import AnyReader

    with _bag_errors(path):
        reader = AnyReader([path], default_typestore=type_store())
        reader.open()
    try:
        yield DetectionBag(reader, path, _of_topic(reader.connections, path, topic))
    finally:
        reader.close()


def _of_topic(connections: list[Any], path: Path, topic: str | None) -> list[Any]:
    kinds = {connection.topic: connection.msgtype for connection in connections}
    known = sorted(name for name, kind in kinds.items() if kind in (CLOUD, SCAN))
    listed = ", ".join(known) or "none"
    if topic is not None and topic not in known:
        raise ValueError(f"{path}: --topic must be one with {CLOUD} or {SCAN} ({listed}), got {topic!r}")
    if topic is None and len(known) != 1:
        raise ValueError(f"{path}: --topic must name one of its topics with {CLOUD} or {SCAN}: {listed}")
    wanted = topic or known[0]
    return [connection for connection in connections if connection.topic == wanted]


@contextmanager
def _bag_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise ValueError(f"{path}: no ROS bag that can be read: {_reason(error)}") from None


def _stamp_ns(stamp: Any) -> int:
    return int(stamp.sec) * NANOSECONDS_PER_SECOND + int(stamp.nanosec)


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
