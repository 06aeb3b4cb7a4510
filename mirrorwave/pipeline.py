"""The graph in one process, fed with messages: what sensors and the vehicle say in, views out, on a virtual clock."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from models.perception.chain import ScanView
from models.perception.track.view_fusion import RADAR_LOST
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalBus, LocalNetwork
from msgs.bus.topics import plain_topic, topic_facts
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import StageTime
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import RangeAzimuthMap
from msgs.values.wording import counted
from nodes.inputs.refusals import REFUSED
from nodes.node import InProcessGraph, Node, StageClock, load_node
from nodes.player import SENSED_TOPICS, Event
from nodes.process.launch_file import FUSION_MODULE, LaunchFile, NodeEntry

_LOG = logging.getLogger(__name__)

#: Topic of what sensors and the vehicle say.
_TOPICS = {topic_facts(topic).type: topic for topic in SENSED_TOPICS if topic != "sim/truth"}


def for_sensors(launch: LaunchFile, sensors: Sequence[str]) -> LaunchFile:
    """Return `launch` with its nodes, but for the player, once for each of several sensors, and their views joined."""
    if not sensors:
        return launch
    own = {
        f"{name}_{sensor}": msgspec.structs.replace(entry, sensor=sensor)
        for sensor in sensors
        for name, entry in launch.nodes.items()
        if name != "player"
    }
    fusion = NodeEntry(module=FUSION_MODULE, params={"radars": list(sensors)})
    nodes = {name: entry for name, entry in launch.nodes.items() if name == "player"}
    return msgspec.structs.replace(launch, nodes={**nodes, **own, "view_fusion": fusion})


class Pipeline:
    """The nodes of a launch file but its player, for a radar or a LiDAR whose set-up comes first, or for several.

    What nodes cannot take they log and leave out, as in the live graph.
    """

    def __init__(self, launch: LaunchFile) -> None:
        self._nodes = {
            name: load_node(entry.module, entry.params, name, entry.sensor)
            for name, entry in launch.nodes.items()
            if name != "player"
        }
        self._formers = _of_module(launch, "nodes.ra_former")
        self._judges = (*_of_module(launch, "nodes.dense_predictor"), *_of_module(launch, "nodes.geometry"))
        #: Names of its sensors where there are several: views are then of the vehicle.
        self.sensors = launch.sensors
        self._views = _Views(launch.sensors)
        self._network = LocalNetwork(lossless=True)
        self._graph = InProcessGraph(self._network, {**self._nodes, "views": self._views})
        self._bus = self._network.bus("player")
        #: Of what makes or reads messages.
        self.reading = StageClock()
        self._doubt = ""
        #: Maps and detections so far, and those that lack beams.
        self.scans = self.scans_with_loss = 0

    @property
    def refused_beams(self) -> int:
        """How many beams were refused so far."""
        counts = (count for name in self._formers for count in self._nodes[name].shed.counts())
        return sum(item.count for item in counts if (item.what, item.reason) == ("beam", REFUSED))

    @property
    def refusal(self) -> str:
        """Why a node refused its last input; empty once all take theirs."""
        return next((reason for node in self._nodes.values() if (reason := node.shed.refusal)), "")

    @property
    def left_out(self) -> str:
        """What nodes left out of their input beside what they refused, which they log; empty where nothing."""
        counts = [count for node in self._nodes.values() for count in node.shed.counts()]
        return ", ".join(f"{counted(item.count, item.what)} {item.reason}" for item in counts if item.reason != REFUSED)

    def feed(self, message: msgspec.Struct, offset_ns: int = 0, topic: str | None = None) -> list[ScanView]:
        """Take in a message that was sent `offset_ns` after the first; return the views that it brings.

        `topic`: None is that of its type, of the only sensor.

        A scan whose next beam is silent for as long as the live graph would wait is closed first.
        """
        topic = topic or _TOPICS.get(type(message))
        if topic is None or plain_topic(topic) not in _TOPICS.values():
            return []
        self._graph.run(until_ns=offset_ns - 1)
        self._network.advance(max(0, offset_ns - self._network.now_ns))
        self._bus.publish(topic, message)
        self._graph.run(until_ns=self._network.now_ns)
        if isinstance(message, RadarDetections):
            self._count(message.lost > 0)
        return self._taken()

    def listener(self, topics: Sequence[str]) -> LocalBus:
        """Return a connection that receives topics of its nodes from now on."""
        bus = self._network.bus("listener")
        for topic in topics:
            bus.subscribe(topic)
        return bus

    def finish(self) -> list[ScanView]:
        """Return the view of a scan whose last beams never came, if one was begun."""
        self._graph.run()
        return self._taken()

    def stage_times(self) -> dict[str, StageTime]:
        """Return the times of stages since the last call, by "node.stage"."""
        clocks = {"player": self.reading, **{name: node.stages for name, node in self._nodes.items()}}
        return {f"{name}.{stage.name}": stage for name, clock in clocks.items() for stage in clock.drain()}

    def _taken(self) -> list[ScanView]:
        """Return the views since the last call, and log in what the radar is not the one that networks know."""
        for ra_map in self._views.new_maps:
            self._count(bool(ra_map.missing_beams))
        if self.sensors:
            for view in self._views.taken:
                self._count(not {"missing_beams", RADAR_LOST}.isdisjoint(view.frame.flags))
        taken, self._views.taken, self._views.new_maps = self._views.taken, [], []
        if taken:
            doubts = (self._nodes[name].health()[1] for name in self._judges)
            doubt = next(filter(None, doubts), "")
            if doubt not in ("", self._doubt):
                _LOG.warning("%s", doubt)
            self._doubt = doubt
        return taken

    def _count(self, has_loss: bool) -> None:
        self.scans += 1
        self.scans_with_loss += has_loss


class _Views(Node):
    """Keeps each view with the map and the peaks that it was found in; that of several sensors with neither."""

    wants_all = True

    def __init__(self, sensors: Sequence[str]) -> None:
        super().__init__()
        self.sensors = sensors
        alone = () if sensors else ("radar/ra_map", "perception/peaks")
        self.inputs: tuple[str, ...] = (*alone, "perception/hidden_objects")
        self.taken: list[ScanView] = []
        self.new_maps: list[RangeAzimuthMap] = []
        self._map: RangeAzimuthMap | None = None
        self._peaks: Peaks | None = None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Note maps and peaks; a view takes those of its scan."""
        for received in sorted(inputs, key=lambda item: self.inputs.index(item.topic)):
            match received.message:
                case RangeAzimuthMap() as ra_map:
                    self.new_maps.append(ra_map)
                    self._map = ra_map
                case Peaks() as peaks:
                    self._peaks = peaks
                case BevFrame() as frame if self.sensors:
                    self.taken.append(ScanView(frame, None, None))
                case BevFrame() as frame:
                    assert self._peaks is not None
                    # a radar of detections gives none
                    own_map = None if self._peaks.sensor is not None else self._map
                    self.taken.append(ScanView(frame, own_map, self._peaks))
        return []


def _of_module(launch: LaunchFile, module: str) -> tuple[str, ...]:
    return tuple(name for name, entry in launch.nodes.items() if entry.module == module)


def played(events: Iterable[Event], pipeline: Pipeline) -> Iterator[ScanView | SceneTruth]:
    """Feed a pipeline with all that sensors said; yield views as they come, and the truth as it stands among them."""
    for event in events:
        message = event.outgoing.message
        if isinstance(message, SceneTruth):
            yield message
        else:
            yield from pipeline.feed(message, event.offset_ns, event.outgoing.topic)
    yield from pipeline.finish()
