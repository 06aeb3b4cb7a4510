"""Node `recorded_sensors`: a recorded LiDAR and camera beside the radar, as `lidar/points` and `camera/image`.

Sources are a ROS bag with clouds and images, and directories of clouds or images. What cannot be read is refused with
one line each; all else goes on.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from contrib.annotate.clouds import RECORDED_SUFFIXES, read_columns
from contrib.imports.jpeg import jpeg_of_file
from contrib.imports.ros_bag import RosBag, is_bag, open_bag
from contrib.ros2.point_cloud2 import LidarMounting, columns_cloud
from contrib.ros2.ros2_inputs import reason_of, side_input, stamp_ns_of
from contrib.ros2.ros2_types import CLOUD, SIDE_KINDS
from msgs.bus.interface import Outgoing, Received
from msgs.bus.topics import SIDE_TOPICS
from msgs.recording.clock_steps import Bridged
from msgs.values.arrays import require_positive
from msgs.values.camera import CameraImage
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import MAX_NAME_LENGTH, LidarPoints
from msgs.values.units import NANOSECONDS_PER_SECOND, ns_from_s
from msgs.values.wording import counted
from nodes.inputs.refusals import Refusals
from nodes.node import Node
from nodes.player import moved

_LOG = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".ppm", ".webp")
MAX_IMAGE_FILE_BYTES = 64 << 20
#: Names that are stamps: seconds with a fraction, and whole milli-, micro- and nanoseconds of this century.
_SECONDS = re.compile(r"(\d{9,10})[._](\d{1,9})")
_WHOLE_NS = {13: 1_000_000, 16: 1_000, 19: 1}
_DIGITS = re.compile(r"(\d+)")
#: Messages of one sensor may come so much later than those of the other.
_LATE_NS = NANOSECONDS_PER_SECOND
#: Most messages that one step may send.
BURST = 4


class SideParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sources of a LiDAR and a camera."""

    #: ROS bags (one at most) and directories of clouds, of images, or of both.
    sources: tuple[str, ...]
    #: Topics of the bag; none: its only one with clouds and its only one with images.
    topics: tuple[str, ...] = ()
    #: Rate of files whose names are no stamps.
    file_rate_hz: float = 10.0
    mounting: LidarMounting = LidarMounting()

    def __post_init__(self) -> None:
        require_positive("file_rate_hz", self.file_rate_hz)
        if not self.sources:
            raise ValueError("sources must name a bag or a directory, got none")
        bags = [source for source in self.sources if is_bag(Path(source))]
        if len(bags) > 1:
            raise ValueError(f"sources must hold one bag at most, got {', '.join(bags)}")


class Params(SideParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sources, and how they are played: stamps are those of the bus clock."""

    #: Speed of play; 1 is real time.
    rate: float = 1.0
    #: Begin again at the end.
    loop: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("rate", self.rate)


class SideEvent(NamedTuple):
    """A message of a sensor, stamped as its source says."""

    stamp_ns: int
    outgoing: Outgoing


#: Takes what cannot be read: "cloud" or "image", and why.
Refuse = Callable[[str, ValueError], None]


class SideSources:
    """The opened sources; iterate over `events` once, `loss` says then why a bag ended early."""

    def __init__(self, params: SideParams, refuse: Refuse) -> None:
        self._params, self._refuse = params, refuse
        self._closing = ExitStack()
        self._counts: dict[str, Iterator[int]] = {topic: itertools.count() for topic in SIDE_TOPICS}
        self._bag: RosBag | None = None
        self._topics: tuple[str, ...] = ()
        self._files: list[tuple[str, list[tuple[int | None, Path]]]] = []
        try:
            for source in params.sources:
                self._open(Path(source))
        except BaseException:
            self.close()
            raise

    @property
    def total(self) -> int:
        """Number of messages, as far as the sources say it."""
        held = 0 if self._bag is None else sum(self._bag.counts.get(topic, 0) for topic in self._topics)
        return held + sum(len(files) for _, files in self._files)

    @property
    def loss(self) -> str:
        """Return why a bag could not be read as a whole; empty where it could."""
        return self._bag.loss if self._bag is not None else ""

    def events(self) -> Iterator[tuple[SideEvent, int]]:
        """Yield the messages in order with their times, which have no steps of the clock."""
        known = [self._bag_events()] if self._bag is not None else []
        known += [self._file_events(topic, files, 0) for topic, files in self._files if files[0][0] is not None]
        heads = [(head, stream) for stream in known if (head := next(stream, None)) is not None]
        # files without stamps begin with the others
        start_ns = min((head.stamp_ns for head, _ in heads), default=0)
        streams: list[Iterator[SideEvent]] = [itertools.chain([head], stream) for head, stream in heads]
        streams += [self._file_events(topic, files, start_ns) for topic, files in self._files if files[0][0] is None]
        whose = f"{', '.join(self._params.sources)}: the clock"
        merged = heapq.merge(*streams, key=lambda event: event.stamp_ns)
        yield from Bridged(merged, lambda event: event.stamp_ns, whose, late_ns=_LATE_NS)

    def close(self) -> None:
        """Close the bag."""
        self._closing.close()

    def _open(self, path: Path) -> None:
        if is_bag(path):
            self._bag = self._closing.enter_context(open_bag(path))
            self._topics = _wanted(self._bag, self._params.topics)
            return
        if not path.is_dir():
            raise FileNotFoundError(2, "must be a ROS bag or a directory", str(path))
        held = sorted(file for file in path.iterdir() if file.is_file())
        before = len(self._files)
        for topic, suffixes in zip(SIDE_TOPICS, (RECORDED_SUFFIXES, IMAGE_SUFFIXES), strict=True):
            files = [file for file in held if file.suffix.lower() in suffixes]
            if files:
                self._files.append((topic, _in_time(files)))
        if len(self._files) == before:
            ends = ", ".join((*RECORDED_SUFFIXES, *IMAGE_SUFFIXES))
            raise ValueError(f"{path}: must hold clouds or images, by the ends of their names: {ends}")

    def _bag_events(self) -> Iterator[SideEvent]:
        bag = self._bag
        assert bag is not None
        inputs = {topic: side_input(bag.kinds[topic] or "", self._params.mounting) for topic in self._topics}
        for raw in bag.messages(self._topics):
            kind = "cloud" if bag.kinds[raw.topic] == CLOUD else "image"
            try:
                message = bag.deserialize(raw)
                stamp_ns = stamp_ns_of(message) or raw.time_ns
                outgoing = inputs[raw.topic].convert(message, stamp_ns)
            except Exception as error:  # noqa: BLE001 - a damaged message fails in whatever way it is damaged
                self._refuse(kind, ValueError(f"{bag.path}: {raw.topic} at {raw.time_ns} ns: {reason_of(error)}"))
            else:
                yield SideEvent(stamp_ns, self._counted(outgoing))

    def _file_events(self, topic: str, files: list[tuple[int | None, Path]], start_ns: int) -> Iterator[SideEvent]:
        read, kind = (self._cloud, "cloud") if topic == SIDE_TOPICS[0] else (self._image, "image")
        for index, (named_ns, path) in enumerate(files):
            stamp_ns = start_ns + ns_from_s(index / self._params.file_rate_hz) if named_ns is None else named_ns
            try:
                message = read(path, stamp_ns)
            except (ValueError, OSError) as error:
                self._refuse(kind, ValueError(str(error) if str(path) in str(error) else f"{path}: {error}"))
            else:
                yield SideEvent(stamp_ns, self._counted(Outgoing(topic, message)))

    def _counted(self, outgoing: Outgoing) -> Outgoing:
        """Return a message numbered among those of its topic, whatever source it is from."""
        number = next(self._counts[outgoing.topic])
        name = "scan_id" if isinstance(outgoing.message, LidarPoints) else "image_id"
        return Outgoing(outgoing.topic, msgspec.structs.replace(outgoing.message, **{name: number}))

    def _cloud(self, path: Path, stamp_ns: int) -> LidarPoints:
        try:
            fields, data = columns_cloud(read_columns(path))
        except ImportError as error:
            raise ValueError(f"{path}: needs {error}") from None
        mounting = self._params.mounting
        return LidarPoints(
            stamp_ns=stamp_ns, sensor=path.parent.name[:MAX_NAME_LENGTH], fields=fields, data=data,
            vehicle_from_lidar=mounting.vehicle_from_lidar, lidar_height_m=mounting.height_m,
        )  # fmt: skip

    def _image(self, path: Path, stamp_ns: int) -> CameraImage:
        if (size := path.stat().st_size) > MAX_IMAGE_FILE_BYTES:
            raise ValueError(f"{path}: at most {MAX_IMAGE_FILE_BYTES} bytes are read, got {size}")
        data = path.read_bytes()
        # a name that says JPEG is held to it
        jpeg = data if path.suffix.lower() in (".jpg", ".jpeg") else jpeg_of_file(data)
        return CameraImage.of(jpeg, stamp_ns, sensor=path.parent.name[:MAX_NAME_LENGTH])


def without_position(points: LidarPoints) -> int:
    """Return how many points of a cloud have no position, which is how many sensors say "no return"."""
    return len(points) - len(points.positions_m())


def _wanted(bag: RosBag, topics: tuple[str, ...]) -> tuple[str, ...]:
    """Return the topics of a bag that are named, else its only one with clouds and its only one with images."""
    known = {topic: kind for topic, kind in bag.kinds.items() if kind in SIDE_KINDS}
    listed = ", ".join(known) or "none"
    if strange := [topic for topic in topics if topic not in known]:
        raise ValueError(f"{bag.path}: topics must be of {', '.join(SIDE_KINDS)} ({listed}), got {strange[0]!r}")
    # raw images beside their compressed form
    wanted = topics or tuple(topic for topic in known if f"{topic}/compressed" not in known)
    clouds = [topic for topic in wanted if known[topic] == CLOUD]
    images = [topic for topic in wanted if known[topic] != CLOUD]
    if max(len(clouds), len(images)) > 1 or not wanted:
        raise ValueError(f"{bag.path}: topics must name one with clouds, one with images, or both: {listed}")
    return (*clouds, *images)


def _in_time(files: list[Path]) -> list[tuple[int | None, Path]]:
    """Return files in order with the stamps that their names are; None for all where one is no stamp."""
    stamps = [_stamp_of(file.stem) for file in files]
    if None in stamps:
        return [(None, file) for file in sorted(files, key=_natural)]
    return sorted(zip(stamps, files, strict=True), key=lambda item: (item[0] or 0, item[1]))


def _stamp_of(stem: str) -> int | None:
    if match := _SECONDS.fullmatch(stem):
        return int(match[1]) * NANOSECONDS_PER_SECOND + int(match[2].ljust(9, "0"))
    unit_ns = _WHOLE_NS.get(len(stem)) if stem.isascii() and stem.isdecimal() else None
    return None if unit_ns is None else int(stem) * unit_ns


def _natural(file: Path) -> list[Any]:
    """Sort frame_2 before frame_10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in _DIGITS.split(file.name)]


class RecordedSensors(Node):
    """Sends each message when its time has come, stamped with the bus clock."""

    outputs = SIDE_TOPICS

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params
        self._refusals = Refusals(_LOG, self.shed)
        self._is_again = False
        self._sources = SideSources(params, self._refuse)
        self._events = self._sources.events()
        self._next = next(self._events, None)
        self._has_positions = True
        self._start_ns: int | None = None
        self._first_ns = self._sent_ns = 0 if self._next is None else self._next[1]
        if self._next is None:
            self._sources.close()
            raise ValueError(self._refusals.reason or f"{', '.join(params.sources)}: holds no cloud and no image")

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the next message is to be sent."""
        return now_ns if self._start_ns is None or self._next is None else self._due_ns(self._next[1])

    def finished(self) -> bool:
        """Return whether all messages were sent."""
        return self._next is None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the messages whose time has come."""
        self._start_ns = now_ns if self._start_ns is None else self._start_ns
        out: list[Outgoing] = []
        while self._next is not None and len(out) < BURST and self._due_ns(self._next[1]) <= now_ns:
            (event, time_ns), message = self._next, self._next[0].outgoing.message
            self._note_positions(message)
            out.append(Outgoing(event.outgoing.topic, moved(message, self._due_ns(time_ns) - event.stamp_ns)))
            self._sent_ns = time_ns
            with self.stages("read"):
                self._advance()
        return out

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while input is refused."""
        return self._refusals.health()

    def close(self) -> None:
        """Close the bag."""
        self._sources.close()

    def _due_ns(self, time_ns: int) -> int:
        return (self._start_ns or 0) + round((time_ns - self._first_ns) / self._params.rate)

    def _advance(self) -> None:
        refused = self.shed.counts()
        self._next = next(self._events, None)
        if self._next is None and self._sources.loss:
            _LOG.warning("%s", self._sources.loss)
        if self._next is None and self._params.loop:
            self._restart()
        if self.shed.counts() == refused:
            self._refusals.accept()

    def _restart(self) -> None:
        """Begin again, a period of the files after the last message."""
        self._start_ns = self._due_ns(self._sent_ns + ns_from_s(1.0 / self._params.file_rate_hz))
        self._sources.close()
        self._is_again = True
        self._sources = SideSources(self._params, self._refuse)
        self._events = self._sources.events()
        self._next = next(self._events, None)

    def _refuse(self, kind: str, error: ValueError) -> None:
        """Count what cannot be read; it is said once, not at each repetition."""
        if self._is_again:
            self.shed.add(kind, "refused")
        else:
            self._refusals.refuse(kind, error)

    def _note_positions(self, message: msgspec.Struct) -> None:
        """Say once of a cloud that some of its points have no position."""
        if self._has_positions and isinstance(message, LidarPoints) and (missing := without_position(message)):
            self._has_positions = False
            _LOG.info("%d of %s have no position", missing, counted(len(message), "point"))


def create(params: Params) -> RecordedSensors:
    """Return the node; `ValueError` or `OSError` for sources that are none, or hold nothing that can be read."""
    return RecordedSensors(params)
