"""Detections in ROS 1 and ROS 2 bags, read by the library rosbags: `PointCloud2` of radars, `radar_msgs/RadarScan`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mirrorwave.convert.detection_tables import ScanRows
from msgs.files.unpacking import limited_memory
from msgs.recording.mcap import RecordingReader
from msgs.values.units import NANOSECONDS_PER_SECOND
from nodes.bridges.detection_mapping import READERS
from nodes.bridges.ros2_types import CLOUD, SCAN, type_store

#: Ends of names that rosbags reads; a ROS 2 bag may also be a folder.
SUFFIXES = (".bag", ".mcap", ".db3")
#: Memory that a bag may take to be read: its chunks are of some MiB.
MAX_BAG_BYTES = 1 << 30


def require_library() -> None:
    """Raise `ImportError` that names the package where rosbags is not installed."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError as error:
        raise ImportError("rosbags, which reads ROS bags (pip install mirrorwave[convert])") from error


class DetectionBag:
    """The messages of one topic of an open bag: `messages` gives their times and bytes, `deserialize` reads these.

    `count` is their number where the bag says it.
    """

    def __init__(
        self,
        path: Path,
        topic: str,
        kind: str,
        count: int | None,
        messages: Iterator[tuple[int, bytes]],
        deserialize: Callable[[bytes, str], Any],
        loss: Callable[[], str | None],
    ) -> None:
        self.topic, self.kind, self.count = topic, kind, count
        self._path, self._messages, self._deserialize, self._loss = path, messages, deserialize, loss
        self._end = ""

    @property
    def loss(self) -> str:
        """Return why the bag could not be read as a whole; empty where it could."""
        return self._end or (f"{self._path}: {loss}" if (loss := self._loss()) else "")

    def scans(
        self, wanted: Collection[str | int], left_out: Counter[str], advance: Callable[[], None]
    ) -> Iterator[ScanRows]:
        """Yield a scan for each message; those whose `wanted` columns cannot be read are counted in `left_out`."""
        while True:
            try:
                time_ns, data = next(self._messages)
            except StopIteration:
                return
            except Exception as error:  # noqa: BLE001 - a damaged bag fails in whatever way the damage makes its reader
                self._end = f"{self._path}: cannot be read on: {_reason(error)}"
                return
            advance()
            try:
                message = self._deserialize(data, self.kind)
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
    opened = _open_mcap if path.suffix.lower() == ".mcap" and path.is_file() else _open_any
    # what a chunk of rosbags unpacks to is not bounded
    with limited_memory(MAX_BAG_BYTES), opened(path, topic) as bag:
        yield bag


@contextmanager
def _open_mcap(path: Path, topic: str | None) -> Iterator[DetectionBag]:
    """Open a bag of one MCAP file by the reader of recordings, which needs no summary and bounds what unpacks."""
    with RecordingReader(path) as reader:
        kinds = reader.types
        wanted = _wanted(kinds, path, topic)
        messages = ((raw.log_time, raw.data) for _, raw in reader.raw_messages(None, None, (wanted,)))
        deserialize = type_store().deserialize_cdr
        yield DetectionBag(path, wanted, kinds[wanted], None, messages, deserialize, lambda: reader.loss)


@contextmanager
def _open_any(path: Path, topic: str | None) -> Iterator[DetectionBag]:
    from rosbags.highlevel import AnyReader

    with _bag_errors(path):
        reader = AnyReader([path], default_typestore=type_store())
        reader.open()
    try:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        wanted = _wanted(kinds, path, topic)
        connections = [connection for connection in reader.connections if connection.topic == wanted]
        count = sum(connection.msgcount for connection in connections)
        messages = ((time_ns, data) for _, time_ns, data in reader.messages(connections=connections))
        yield DetectionBag(path, wanted, kinds[wanted], count, messages, reader.deserialize, lambda: None)
    finally:
        reader.close()


def _wanted(kinds: Mapping[str, str | None], path: Path, topic: str | None) -> str:
    """Return the topic of detections that is named, or the only one."""
    known = sorted(name for name, kind in kinds.items() if kind in (CLOUD, SCAN))
    listed = ", ".join(known) or "none"
    if topic is not None and topic not in known:
        raise ValueError(f"{path}: --topic must be one with {CLOUD} or {SCAN} ({listed}), got {topic!r}")
    if topic is None and len(known) != 1:
        raise ValueError(f"{path}: --topic must name one of its topics with {CLOUD} or {SCAN}: {listed}")
    return topic or known[0]


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
