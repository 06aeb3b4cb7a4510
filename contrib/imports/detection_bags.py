"""Detections in ROS 1 and ROS 2 bags: `PointCloud2` of radars, `radar_msgs/RadarScan`, lists of `ars_40X`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from contrib.imports import ros_bag
from contrib.imports.detection_mapping import READERS
from contrib.imports.detection_tables import ScanRows
from contrib.imports.ros_bag import RosBag, reason_of
from contrib.ros2.ros2_inputs import stamp_ns_of


class DetectionBag:
    """The messages of one topic of an open bag; `count` is their number where the bag says it."""

    def __init__(self, bag: RosBag, topic: str) -> None:
        self.topic, self.kind, self.count = topic, bag.kinds[topic] or "", bag.counts.get(topic)
        self._bag = bag

    @property
    def loss(self) -> str:
        """Return why the bag could not be read as a whole; empty where it could."""
        return self._bag.loss

    def scans(
        self, wanted: Collection[str | int], left_out: Counter[str], advance: Callable[[], None]
    ) -> Iterator[ScanRows]:
        """Yield a scan for each message; those whose `wanted` columns cannot be read are counted in `left_out`."""
        for raw in self._bag.messages((self.topic,)):
            advance()
            try:
                message = self._bag.deserialize(raw)
                columns = READERS[self.kind].columns(message, wanted)
            except Exception as error:  # noqa: BLE001 - a damaged message fails in whatever way it is damaged
                left_out[f"message: {reason_of(error)}"] += 1
                continue
            yield ScanRows(stamp_ns_of(message) or raw.time_ns, columns)


@contextmanager
def open_bag(path: Path, topic: str | None) -> Iterator[DetectionBag]:
    """Open a bag at the topic named, or at its only one with detections.

    Raises `ImportError` without rosbags, `ValueError` naming the bag where it is none or the topic is not to be told.
    """
    with ros_bag.open_bag(path) as bag:
        yield DetectionBag(bag, _wanted(bag.kinds, path, topic))


def _wanted(kinds: Mapping[str, str | None], path: Path, topic: str | None) -> str:
    """Return the topic of detections that is named, or the only one."""
    known = sorted(name for name, kind in kinds.items() if kind in READERS)
    listed = ", ".join(known) or "none"
    if topic is not None and topic not in known:
        raise ValueError(f"{path}: --topic must be one with {' or '.join(READERS)} ({listed}), got {topic!r}")
    if topic is None and len(known) != 1:
        raise ValueError(f"{path}: --topic must name one of its topics with {' or '.join(READERS)}: {listed}")
    return topic or known[0]
