"""The one table of topics: type, nominal rate, history and byte limit; those of installed packages and launch files
too.

A package declares its own in the tuple `TOPICS` of a module named under `[project.entry-points."mirrorwave.topics"]`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import msgspec

from msgs.bus.message_types import refusal_of
from msgs.files.plugins import MODULE_NAME, Plugin, import_named, plugins
from msgs.files.plugins import TOPICS as TOPIC_PLUGINS
from msgs.values.arrays import is_sensor_name, require_sensor_name
from msgs.values.camera import CameraImage
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import LogRecord, NodeStatus
from msgs.values.environment import GnssPose, WallPriors
from msgs.values.lidar import LidarPoints, LidarSetup, PhotonHistograms
from msgs.values.node_params import NodeParams, ParamRequest
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from msgs.values.wording import did_you_mean

MIB = 1 << 20


#: Words of a-z, 0-9 and _, between slashes: a topic is the name of a socket file, with "." for "/".
TOPIC_NAME = re.compile(r"[a-z][a-z0-9_]*(/[a-z][a-z0-9_]*)*")
_MAX_NAME = 48
#: What a message in a recording may have; and what a queue of ZeroMQ can count.
_MIN_BYTES, _MAX_BYTES, _MAX_HISTORY_BYTES = 1024, 1 << 28, 1 << 30
_MAX_HZ = 1e6
_SHIPPED_BY = "mirrorwave"


#: First words of the shipped topics that each of several sensors has for itself: `radar/beam` of the sensor `left` is
#: `radar/left/beam`. All others are of the vehicle.
_SENSOR_ROOTS = ("radar", "lidar", "perception")


def is_of_sensor(topic: str) -> bool:
    """Return whether each of several sensors has a topic for itself."""
    return topic.partition("/")[0] in _SENSOR_ROOTS and topic in SHIPPED


def sensor_topic(topic: str, sensor: str) -> str:
    """Return the topic of a sensor with a name, "": without; `ValueError` for what is no name of a sensor."""
    if not (sensor and is_of_sensor(topic)):
        return topic
    require_sensor_name(sensor)
    root, _, rest = topic.partition("/")
    return f"{root}/{sensor}/{rest}"


def plain_topic(topic: str) -> str:
    """Return a topic without the name of its sensor."""
    words = topic.split("/")
    plain = f"{words[0]}/{words[-1]}"
    return plain if len(words) == 3 and is_of_sensor(plain) else topic


def sensor_of(topic: str) -> str:
    """Return the name of a topic's sensor; "" where it has none."""
    return "" if plain_topic(topic) == topic else topic.split("/")[1]


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts of a topic beside its name and type."""

    #: Nominal rate; 0: none.
    rate_hz: float = 0.0
    #: Largest message accepted, header and arrays together.
    max_bytes: int = MIB
    #: Bytes that may wait in a queue before the oldest message is dropped; a bound in bytes, never in messages alone.
    history_bytes: int = 16 * MIB
    #: Late joiners get the last message.
    latched: bool = False
    #: Receivers that fall behind want the newest message only.
    newest_only: bool = False
    #: Each message stands for itself, whoever sends it; else a node takes those of one publisher (`nodes.inputs`).
    shared: bool = False


class Declaration(Facts, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic as a launch file declares it: its type by name, `package.module.Class`."""

    type: str

    def __post_init__(self) -> None:
        if not ("." in self.type and MODULE_NAME.fullmatch(self.type)):
            raise ValueError(f"type must be package.module.Class, got {self.type!r}")


class Topic(Facts, frozen=True, kw_only=True):
    """A topic: its name, the type of its messages, and its facts."""

    name: str
    type: type

    @property
    def history_messages(self) -> int:
        """Queue length that keeps `history_bytes` even if every message were as large as allowed."""
        return max(1, self.history_bytes // self.max_bytes)


#: What a scan brings, of which receivers want the newest.
_NEWEST: dict[str, Any] = {"rate_hz": 1 / 0.3, "max_bytes": 4 * MIB, "history_bytes": 16 * MIB, "newest_only": True}
_SHIPPED = (
    Topic(name="radar/beam", type=RadarBeam, rate_hz=25 / 0.3, max_bytes=5 * MIB, history_bytes=125 * MIB),
    Topic(name="radar/setup", type=RadarSetup, max_bytes=16 * MIB, history_bytes=16 * MIB, latched=True),
    Topic(name="radar/ra_map", type=RangeAzimuthMap, **_NEWEST),
    Topic(name="radar/detections", type=RadarDetections, **_NEWEST | {"rate_hz": 17.0, "max_bytes": 2 * MIB}),
    Topic(name="lidar/setup", type=LidarSetup, max_bytes=MIB // 16, history_bytes=MIB, latched=True),
    Topic(name="lidar/histograms", type=PhotonHistograms, rate_hz=1 / 0.3, max_bytes=16 * MIB, history_bytes=64 * MIB),
    Topic(
        name="lidar/points",
        type=LidarPoints,
        rate_hz=10.0,
        max_bytes=16 * MIB,
        history_bytes=128 * MIB,
        newest_only=True,
    ),
    Topic(
        name="camera/image", type=CameraImage, rate_hz=10.0, max_bytes=8 * MIB, history_bytes=64 * MIB, newest_only=True
    ),
    Topic(name="perception/peaks", type=Peaks, **_NEWEST),
    Topic(name="perception/hidden_objects", type=BevFrame, **_NEWEST),
    Topic(name="vehicle/state", type=VehicleState, rate_hz=50.0, max_bytes=4096, history_bytes=1 * MIB),
    Topic(name="vehicle/gnss", type=GnssPose, rate_hz=5.0, max_bytes=4096, history_bytes=1 * MIB),
    # neither latched nor newest only: a wall without its time is none, and one source must not displace another
    Topic(name="environment/walls", type=WallPriors, max_bytes=MIB // 8, history_bytes=4 * MIB, shared=True),
    Topic(name="sim/truth", type=SceneTruth, rate_hz=1 / 0.3, max_bytes=4 * MIB, history_bytes=32 * MIB),
    Topic(
        name="diagnostics/node", type=NodeStatus, rate_hz=2.0, max_bytes=MIB // 4, history_bytes=4 * MIB, shared=True
    ),
    Topic(name="param/request", type=ParamRequest, max_bytes=MIB // 4, history_bytes=4 * MIB, shared=True),
    Topic(name="param/values", type=NodeParams, max_bytes=MIB // 4, history_bytes=4 * MIB, latched=True, shared=True),
    Topic(name="log", type=LogRecord, max_bytes=MIB // 16, history_bytes=4 * MIB, shared=True),
)


class _Declared(NamedTuple):
    """A topic, and who declares it."""

    topic: Topic
    origin: str


class Topics(Mapping[str, Topic]):
    """Topics by name: the shipped ones, then those of installed packages and of the launch file, imported when needed.

    A declaration that cannot be used is left out, and `refused` says why.
    """

    def __init__(self, shipped: Iterable[Topic]) -> None:
        self._declared = {topic.name: _Declared(topic, _SHIPPED_BY) for topic in shipped}
        #: Declarations of a launch file whose types are not imported yet.
        self._expected: dict[str, tuple[Declaration, str]] = {}
        self._has_asked = False
        #: One line for each declaration that is left out, by topic; by plugin and package where it has no topics.
        self.refused: dict[str, str] = {}

    def __getitem__(self, name: str) -> Topic:
        if name not in self._declared:
            self._find(name)
        return self._declared[name].topic

    def __contains__(self, name: object) -> bool:
        if name not in self._declared and isinstance(name, str):
            self._find(name)
        return name in self._declared

    def __iter__(self) -> Iterator[str]:
        self._ask_packages()
        for name in list(self._expected):
            self._find(name)
        return iter(list(self._declared))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def own(self) -> dict[str, Topic]:
        """Return the topics that are not shipped."""
        return {name: self[name] for name in self if self._declared[name].origin != _SHIPPED_BY}

    def origin(self, name: str) -> str:
        """Return who declares a known topic."""
        return self._declared[name].origin

    def declare(self, topic: Topic, origin: str) -> None:
        """Add a topic of `origin`, a package or a file; the same one again changes nothing.

        Raises `ValueError`, one line, for what cannot be, and for a topic that is declared otherwise already.
        """
        where = f"{origin}: topic {topic.name!r}"
        require_topic_name(topic.name, origin)
        if reason := refusal_of(topic.type):
            raise ValueError(f"{where}: {reason}")
        require_facts(topic, where)
        known = self._declared.get(topic.name)
        if known is not None and known.topic != topic:
            raise ValueError(f"{origin}: topic {topic.name!r}: {_difference(topic, known)}")
        self._declared.setdefault(topic.name, _Declared(topic, origin))

    def expect(self, name: str, declaration: Declaration, origin: str) -> None:
        """Note the declaration of a launch file; its type is imported once it is needed."""
        if self._expected.get(name) == (declaration, origin):
            return
        self._expected[name] = declaration, origin
        self.refused.pop(name, None)
        if name in self._declared:
            self._resolve(name)

    @contextmanager
    def restored(self) -> Iterator[None]:
        """Take back at the end of the context what was declared in it."""
        kept = self._declared.copy(), self._expected.copy(), self._has_asked, self.refused.copy()
        try:
            yield
        finally:
            self._declared, self._expected, self._has_asked, self.refused = kept

    def expect_sensor(self, sensor: str) -> None:
        """Make the topics of a sensor with a name known, all that there may be; `ValueError` for what is no name."""
        for topic in _SHIPPED:
            if is_of_sensor(topic.name):
                self._find(sensor_topic(topic.name, sensor))

    def _find(self, name: str) -> None:
        if name in self._expected and name not in self.refused:
            self._resolve(name)
        elif name not in self._declared:
            self._ask_packages()
        if name not in self._declared and is_sensor_name(sensor_of(name)):
            own = msgspec.structs.replace(self[plain_topic(name)], name=name)
            self._declared[name] = _Declared(own, _SHIPPED_BY)

    def _resolve(self, name: str) -> None:
        declaration, origin = self._expected[name]
        try:
            self.declare(_resolved(name, declaration, origin), origin)
        except ValueError as error:
            self.refused[name] = str(error)

    def _ask_packages(self) -> None:
        """Declare the topics of installed packages, once; two that disagree about a topic lose it both."""
        if self._has_asked:
            return
        # first: a module that is imported below may look a topic up
        self._has_asked = True
        brought = plugins(TOPIC_PLUGINS)
        self.refused |= {str(refusal.plugin): str(refusal) for refusal in brought.refused}
        for plugin in brought.usable.values():
            try:
                topics = _topics_of(plugin)
            except ValueError as error:
                self.refused[str(plugin)] = str(error)
                continue
            for topic in topics:
                self._take(topic, str(plugin))

    def _take(self, topic: Topic, origin: str) -> None:
        name = str(topic.name)
        if name in self.refused:
            return
        try:
            self.declare(topic, origin)
        except ValueError as error:
            self.refused[name] = str(error)
            known = self._declared.get(name)
            if known is not None and known.origin != _SHIPPED_BY and name not in self._expected:
                # which of them came first is a matter of their names
                del self._declared[name]


def require_topic_name(name: object, origin: str) -> None:
    """Raise `ValueError` for what is no name of a topic."""
    if not (isinstance(name, str) and TOPIC_NAME.fullmatch(name) and len(name) <= _MAX_NAME):
        rule = f"must be words of a-z, 0-9 and _, joined by /, at most {_MAX_NAME} characters, as 'my/topic'"
        raise ValueError(f"{origin}: topic {name!r}: a name {rule}")


def require_facts(facts: Facts, where: str) -> None:
    """Raise `ValueError` naming the fact that is out of its range."""
    rate_hz = facts.rate_hz
    if not (isinstance(rate_hz, int | float) and math.isfinite(rate_hz) and 0.0 <= rate_hz <= _MAX_HZ):
        raise ValueError(f"{where}: rate_hz must be 0..{_MAX_HZ:g}, got {rate_hz!r}")
    lowest = _MIN_BYTES
    for name, highest in (("max_bytes", _MAX_BYTES), ("history_bytes", _MAX_HISTORY_BYTES)):
        value = getattr(facts, name)
        if not (isinstance(value, int) and lowest <= value <= highest):
            raise ValueError(f"{where}: {name} must be {lowest}..{highest}, got {value!r}")
        # a queue holds one message at least
        lowest = value
    for name in ("latched", "newest_only", "shared"):
        if not isinstance(getattr(facts, name), bool):
            raise ValueError(f"{where}: {name} must be true or false, got {getattr(facts, name)!r}")


def _difference(topic: Topic, known: _Declared) -> str:
    """Return in what a declaration differs from the known one."""
    by = f"by {known.origin}"
    if topic.type is not known.topic.type:
        names = [f"{kind.__module__}.{kind.__name__}" for kind in (topic.type, known.topic.type)]
        return f"declared twice with two types, {names[0]} here and {names[1]} {by}"
    name = next(name for name in Facts.__struct_fields__ if getattr(topic, name) != getattr(known.topic, name))
    return f"declared twice, {name} {getattr(topic, name)!r} here and {getattr(known.topic, name)!r} {by}"


def _topics_of(plugin: Plugin) -> tuple[Topic, ...]:
    """Return the topics that a package's module declares; `ValueError` for a module that has none."""
    module = plugin.load("TOPICS")
    topics = module.TOPICS
    if not (isinstance(topics, tuple | list) and all(isinstance(topic, Topic) for topic in topics)):
        raise ValueError(f"{plugin}: TOPICS of {module.__name__} must be a tuple of Topic, got {type(topics).__name__}")
    return tuple(topics)


def _resolved(name: str, declaration: Declaration, origin: str) -> Topic:
    """Return a topic of a launch file with its type imported; `ValueError` where there is none of its name."""
    module_name, _, kind = declaration.type.rpartition(".")
    try:
        module = import_named(module_name)
    except ValueError as error:
        raise ValueError(f"{origin}: topic {name!r}: type {declaration.type}: {error}") from None
    if not hasattr(module, kind):
        raise ValueError(f"{origin}: topic {name!r}: type {declaration.type}: {module_name} defines no {kind}")
    facts = {field: getattr(declaration, field) for field in Facts.__struct_fields__}
    return Topic(name=name, type=getattr(module, kind), **facts)


TOPICS = Topics(_SHIPPED)
#: Names of the topics that come with the code.
SHIPPED = tuple(topic.name for topic in _SHIPPED)
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
    """Return the facts of a topic; `ValueError` for an unknown name, with its refusal or the names that exist."""
    if name in TOPICS:
        return TOPICS[name]
    if name in TOPICS.refused:
        raise ValueError(f"unknown topic {name!r}: {TOPICS.refused[name]}")
    # a package that cannot be imported may have meant to declare it
    lost = "".join(f"; {line}" for key, line in TOPICS.refused.items() if " " in key)
    raise ValueError(f"unknown topic {name!r}; known are {', '.join(sorted(TOPICS))}{did_you_mean(name, TOPICS)}{lost}")
