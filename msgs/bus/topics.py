"""The one table of topics: type, nominal rate, history and byte limit. No other module states these facts."""

from __future__ import annotations

import msgspec

from msgs.values.camera import CameraImage
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import LogRecord, NodeStatus
from msgs.values.environment import WallPriors
from msgs.values.lidar import LidarPoints, LidarSetup, PhotonHistograms
from msgs.values.node_params import NodeParams, ParamRequest
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from msgs.values.wording import did_you_mean

MIB = 1 << 20


class Topic(msgspec.Struct, frozen=True, kw_only=True):
    """Facts of one topic."""

    name: str
    type: type
    rate_hz: float
    #: Largest message accepted, header and arrays together.
    max_bytes: int
    #: Bytes that may wait in a queue before the oldest message is dropped; a bound in bytes, never in messages alone.
    history_bytes: int
    #: Late joiners get the last message.
    latched: bool = False
    #: Receivers that fall behind want the newest message only.
    newest_only: bool = False
    #: Each message stands for itself, whoever sends it; else a node takes those of one publisher (`nodes.inputs`).
    shared: bool = False

    @property
    def history_messages(self) -> int:
        """Queue length that keeps `history_bytes` even if every message were as large as allowed."""
        return max(1, self.history_bytes // self.max_bytes)


_ALL = (
    Topic(name="radar/beam", type=RadarBeam, rate_hz=25 / 0.3, max_bytes=5 * MIB, history_bytes=125 * MIB),
    Topic(name="radar/setup", type=RadarSetup, rate_hz=0.0, max_bytes=16 * MIB, history_bytes=16 * MIB, latched=True),
    Topic(
        name="radar/ra_map",
        type=RangeAzimuthMap,
        rate_hz=1 / 0.3,
        max_bytes=4 * MIB,
        history_bytes=16 * MIB,
        newest_only=True,
    ),
    Topic(
        name="radar/detections",
        type=RadarDetections,
        rate_hz=17.0,
        max_bytes=2 * MIB,
        history_bytes=16 * MIB,
        newest_only=True,
    ),
    Topic(name="lidar/setup", type=LidarSetup, rate_hz=0.0, max_bytes=MIB // 16, history_bytes=MIB, latched=True),
    Topic(
        name="lidar/histograms",
        type=PhotonHistograms,
        rate_hz=1 / 0.3,
        max_bytes=16 * MIB,
        history_bytes=64 * MIB,
    ),
    Topic(
        name="lidar/points",
        type=LidarPoints,
        rate_hz=10.0,
        max_bytes=16 * MIB,
        history_bytes=128 * MIB,
        newest_only=True,
    ),
    Topic(
        name="camera/image",
        type=CameraImage,
        rate_hz=10.0,
        max_bytes=8 * MIB,
        history_bytes=64 * MIB,
        newest_only=True,
    ),
    Topic(
        name="perception/peaks",
        type=Peaks,
        rate_hz=1 / 0.3,
        max_bytes=4 * MIB,
        history_bytes=16 * MIB,
        newest_only=True,
    ),
    Topic(
        name="perception/hidden_objects",
        type=BevFrame,
        rate_hz=1 / 0.3,
        max_bytes=4 * MIB,
        history_bytes=16 * MIB,
        newest_only=True,
    ),
    Topic(name="vehicle/state", type=VehicleState, rate_hz=50.0, max_bytes=4096, history_bytes=1 * MIB),
    # neither latched nor newest only: a wall without its time is none, and one source must not displace another
    Topic(
        name="environment/walls",
        type=WallPriors,
        rate_hz=0.0,
        max_bytes=MIB // 8,
        history_bytes=4 * MIB,
        shared=True,
    ),
    Topic(name="sim/truth", type=SceneTruth, rate_hz=1 / 0.3, max_bytes=4 * MIB, history_bytes=32 * MIB),
    Topic(
        name="diagnostics/node",
        type=NodeStatus,
        rate_hz=2.0,
        max_bytes=MIB // 4,
        history_bytes=4 * MIB,
        shared=True,
    ),
    Topic(
        name="param/request",
        type=ParamRequest,
        rate_hz=0.0,
        max_bytes=MIB // 4,
        history_bytes=4 * MIB,
        shared=True,
    ),
    Topic(
        name="param/values",
        type=NodeParams,
        rate_hz=0.0,
        max_bytes=MIB // 4,
        history_bytes=4 * MIB,
        latched=True,
        shared=True,
    ),
    Topic(name="log", type=LogRecord, rate_hz=0.0, max_bytes=MIB // 16, history_bytes=4 * MIB, shared=True),
)

TOPICS: dict[str, Topic] = {topic.name: topic for topic in _ALL}
#: What nodes say of themselves and are asked to be: it says nothing of who works for whom, and is never played into
#: another graph, where it would be taken for living nodes, or change some.
ABOUT_NODES = frozenset({"diagnostics/node", "log", "param/request", "param/values"})
#: Set-up topic of each kind of sensor, and the topic of its measurements; a graph has one kind of sensor.
SENSOR_TOPICS = (("radar/setup", "radar/beam"), ("lidar/setup", "lidar/histograms"))

#: Of a radar that gives no beats; it needs no set-up.
DETECTIONS_TOPIC = "radar/detections"
#: Sensors beside the radar: recorded and shown with it, taken by no perception.
SIDE_TOPICS = ("lidar/points", "camera/image")
#: What the graph starts from.
RAW_TOPICS = (*(raw for _, raw in SENSOR_TOPICS), DETECTIONS_TOPIC)


def topic_facts(name: str) -> Topic:
    """Return the facts of a topic by name; an unknown name is refused with a list of the names that exist."""
    if name not in TOPICS:
        raise ValueError(f"unknown topic {name!r}; known are {', '.join(sorted(TOPICS))}{did_you_mean(name, TOPICS)}")
    return TOPICS[name]
