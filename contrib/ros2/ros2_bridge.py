"""Node `ros2`: the graph's answer on topics of ROS 2; detections, odometry, clouds and images of ROS 2 in the graph.

It speaks DDS as ROS 2 does and needs no ROS 2 on this machine. Without a reader nothing is built; a reader that takes
nothing loses messages, and the graph never waits for it.
"""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec

from contrib.imports.detection_mapping import mapping_path, read_mapping
from contrib.ros2.point_cloud2 import LidarMounting
from contrib.ros2.ros2_inputs import (
    CloudInput,
    DetectionInput,
    ImageInput,
    Input,
    OdometryInput,
    reason_of,
    stamp_ns_of,
)
from contrib.ros2.ros2_link import LOOPBACK, MAX_DOMAIN, Reader, Ros2Link, Writer, require_interface, require_library
from contrib.ros2.ros2_messages import Frames, Ros2Messages
from contrib.ros2.ros2_topics import INPUT_DEPTH, OF_VEHICLE, Ros2Topic, published_topics, require_topic_name
from contrib.ros2.ros2_types import CLOUD, COMPRESSED_IMAGE, IMAGE, SCAN, type_store
from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from msgs.values.frames import Pose2
from msgs.values.perception import Peaks
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.vehicle import VehicleState
from nodes.inputs.refusals import Refusals
from nodes.node import Node
from nodes.recording.shapes import Odometry

_LOG = logging.getLogger(__name__)

#: How often mismatches are looked for.
_WATCH_NS = NANOSECONDS_PER_SECOND
#: A wall clock that is this far off was set.
_CLOCK_STEP_NS = NANOSECONDS_PER_SECOND
#: Stamps of messages from ROS 2 are within this of now, or of another clock.
_MAX_STAMP_AGE_S = 60.0
_KINDS = {"cloud": CLOUD, "scan": SCAN, "compressed": COMPRESSED_IMAGE, "raw": IMAGE}


class InputParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic of ROS 2 that the graph hears."""

    topic: str
    #: Best effort hears every publisher; reliable asks it to repeat what was lost, and hears reliable ones alone.
    reliable: bool = False

    def __post_init__(self) -> None:
        require_topic_name("topic", self.topic)

    def topic_of(self, kind: str, source: str) -> Ros2Topic:
        """Return the topic with its quality of service."""
        name = self.topic.removeprefix("/")
        return Ros2Topic(name=name, kind=kind, source=source, depth=INPUT_DEPTH, reliable=self.reliable)


class DetectionParams(InputParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Detections of a radar in ROS 2."""

    topic: str = "/radar/detections"
    #: sensor_msgs/PointCloud2 or radar_msgs/RadarScan.
    type: Literal["cloud", "scan"] = "cloud"
    #: What the fields mean; empty: the shipped mapping of the type, in launch/detections.
    mapping: str = ""


class OdometryParams(InputParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle's odometry in ROS 2."""

    topic: str = "/odom"


class LidarParams(InputParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Clouds of a LiDAR in ROS 2 (sensor_msgs/PointCloud2)."""

    topic: str = "/ouster/points"
    mounting: LidarMounting = LidarMounting()


class CameraParams(InputParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Images of a camera in ROS 2."""

    topic: str = "/camera/image_raw/compressed"
    #: sensor_msgs/CompressedImage or sensor_msgs/Image.
    type: Literal["compressed", "raw"] = "compressed"


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Domain, interface, names, and what is heard."""

    #: ROS_DOMAIN_ID of the nodes that are to hear the graph.
    domain: int = 0
    #: Network interface; the loopback keeps it to this machine. On others anybody in the network hears the graph.
    interface: str = LOOPBACK
    frames: Frames = Frames()
    #: Other names for topics, as hidden_objects: /corner/objects; "": not published.
    topics: dict[str, str] = {}
    detections: DetectionParams | None = None
    odometry: OdometryParams | None = None
    lidar: LidarParams | None = None
    camera: CameraParams | None = None
    #: Time of messages on the other side: that of acquisition, or of arrival where stamps are of another clock (a
    #: recording, a simulation).
    stamps: Literal["acquisition", "arrival"] = "acquisition"

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= MAX_DOMAIN:
            raise ValueError(f"domain must be 0..{MAX_DOMAIN}, got {self.domain!r}")
        self.published()

    def published(self) -> dict[str, Ros2Topic]:
        """Return what is published; the vehicle's topics are ROS 2's own where its state comes from there."""
        return published_topics(self.topics, OF_VEHICLE if self.odometry is not None else ())


class RosClock:
    """The clock of ROS 2, this machine's wall clock, against the bus's."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None

    def update(self, now_ns: int) -> int:
        """Return the offset: the least that was measured, since a busy machine only adds to it, or a later step's."""
        offset_ns = time.time_ns() - now_ns
        last_ns = offset_ns if self.offset_ns is None else self.offset_ns
        if abs(offset_ns - last_ns) > _CLOCK_STEP_NS:
            _LOG.warning("the wall clock was set by %.3f s", s_from_ns(offset_ns - last_ns))
            last_ns = offset_ns
        self.offset_ns = min(offset_ns, last_ns)
        return self.offset_ns


class Ros2Bridge(Node):
    """Publishes what readers in ROS 2 want, and passes on what the graph hears from there."""

    #: As the viewer's: perception goes first on busy cores.
    nice = 10
    #: What waits meanwhile is late for ROS 2, not lost.
    wants_all = True

    def __init__(self, params: Params, link: Ros2Link, store: Any) -> None:
        super().__init__()
        self._params, self._link, self._store = params, link, store
        self._build = Ros2Messages(store.types, params.frames)
        self._clock = RosClock()
        self._wall_from_bus_ns = 0
        self._odometry = Odometry()
        self._mounting: Pose2 | None = None
        self._refusals = Refusals(_LOG, self.shed)
        self._watched_ns = 0
        self._writers = {name: link.writer(topic) for name, topic in params.published().items()}
        self._readers = self._open_inputs()
        # the bus has no topic twice: a state that ROS 2 gives is not heard from the graph too
        heard = {source for reader, source, _, _ in self._readers}
        self.inputs = tuple(dict.fromkeys(writer.topic.source for writer in self._writers.values()))
        self.outputs = tuple(heard)

    def watched(self) -> tuple[int, ...]:
        """Return what can be read when a message of ROS 2 has arrived."""
        return (self._link.descriptor,) if self._readers else ()

    def due_ns(self, now_ns: int) -> int:
        """Return the next look at readers and publishers whose quality of service does not match."""
        return self._watched_ns + _WATCH_NS

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Publish the graph's messages, return those of ROS 2."""
        self._wall_from_bus_ns = self._clock.update(now_ns)
        for received in inputs:
            with self.stages("publish"):
                self._publish(received.message, now_ns)
        if now_ns >= self.due_ns(now_ns):
            self._watched_ns = now_ns
            self._log_mismatches()
        return self._hear(now_ns) if self._readers else []

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while input is refused."""
        return self._refusals.health()

    def close(self) -> None:
        """Leave the domain."""
        self._link.close()

    def _open_inputs(self) -> list[tuple[Reader, str, str, Input]]:
        readers: list[tuple[Reader, str, str, Input]] = []
        if (given := self._params.detections) is not None:
            kind = _KINDS[given.type]
            mapping = read_mapping(mapping_path(kind, Path(given.mapping) if given.mapping else None))
            topic = given.topic_of(kind, "radar/detections")
            readers.append((self._link.reader(topic), topic.source, kind, DetectionInput(kind, mapping, self.shed)))
        if self._params.odometry is not None:
            topic = self._params.odometry.topic_of("nav_msgs/msg/Odometry", "vehicle/state")
            readers.append((self._link.reader(topic), topic.source, topic.kind, OdometryInput()))
        if (lidar := self._params.lidar) is not None:
            topic = lidar.topic_of(CLOUD, "lidar/points")
            readers.append((self._link.reader(topic), topic.source, topic.kind, CloudInput(lidar.mounting)))
        if (camera := self._params.camera) is not None:
            topic = camera.topic_of(_KINDS[camera.type], "camera/image")
            readers.append((self._link.reader(topic), topic.source, topic.kind, ImageInput()))
        return readers

    def _publish(self, message: Any, now_ns: int) -> None:
        by_arrival = self._params.stamps == "arrival"
        self._build.offset_ns = self._wall_from_bus_ns + (now_ns - message.stamp_ns if by_arrival else 0)
        try:
            for name, build in self._build.drafts(message).items():
                self._put(name, build)
            if isinstance(message, VehicleState):
                self._publish_state(message)
            elif isinstance(message, Peaks):
                self._publish_mounting(message)
        except (ValueError, OverflowError, struct.error) as error:
            self._refusals.refuse("message", ValueError(f"{type(message).__name__}: {reason_of(error)}"))

    def _publish_state(self, state: VehicleState) -> None:
        pose = self._odometry.advance(state)
        if pose is None:
            self.shed.add("state", Odometry.REFUSED)
            return
        self._put("odom", lambda: self._build.odometry(state, pose))
        self._put("tf", lambda: self._build.transforms(self._build.odom_transform(state.stamp_ns, pose)))

    def _publish_mounting(self, peaks: Peaks) -> None:
        mounting = peaks.vehicle_from_radar
        if mounting == self._mounting:
            return
        self._mounting = mounting
        self._put("tf_static", lambda: self._build.transforms(self._build.mounting_transform(peaks.stamp_ns, mounting)))

    def _put(self, name: str, build: Callable[[], Any]) -> None:
        """Build and send a message that has a reader."""
        writer = self._writers.get(name)
        if writer is None or not writer.is_wanted:
            return
        if not writer.write(bytes(self._store.serialize_cdr(build(), writer.topic.kind))):
            self.shed.add(f"/{writer.topic.name} message", "a reader takes nothing")

    def _hear(self, now_ns: int) -> list[Outgoing]:
        self._link.clear()
        outgoing = []
        for reader, _, kind, converter in self._readers:
            for cdr in reader.take():
                try:
                    message = self._store.deserialize_cdr(cdr, kind)
                    outgoing.append(converter.convert(message, self._bus_stamp_ns(message, now_ns)))
                    self._refusals.accept()
                except Exception as error:  # noqa: BLE001 - a damaged message fails in whatever way it is damaged
                    self._refusals.refuse("message", ValueError(f"/{reader.name}: {reason_of(error)}"))
        return outgoing

    def _bus_stamp_ns(self, message: Any, now_ns: int) -> int:
        if self._params.stamps == "arrival":
            return now_ns
        stamp_ns = stamp_ns_of(message) - self._wall_from_bus_ns
        if abs(age_s := s_from_ns(now_ns - stamp_ns)) > _MAX_STAMP_AGE_S:
            raise ValueError(
                f"header.stamp must be within {_MAX_STAMP_AGE_S:g} s of now, got {age_s:.0f} s ago; "
                "stamps of another clock need the parameter stamps: arrival"
            )
        return stamp_ns

    def _log_mismatches(self) -> None:
        ends: list[tuple[Writer | Reader, str, str]] = [
            (writer, writer.topic.name, "a reader") for writer in self._writers.values()
        ]
        ends += [(reader, reader.name, "a publisher") for reader, _, _, _ in self._readers]
        for end, name, peer in ends:
            if policy := end.mismatch():
                _LOG.warning("/%s: %s has another quality of service and is left out: %s", name, peer, policy)


def create(params: Params) -> Ros2Bridge:
    """Return the node, in its domain; `ValueError` without the libraries, the interface or a readable mapping."""
    require_library()
    require_interface(params.interface)
    store = type_store()
    link = Ros2Link(params.domain, params.interface, store)
    try:
        return Ros2Bridge(params, link, store)
    except BaseException:
        link.close()
        raise
