"""Player of a scene, a SigMF capture or an MCAP recording onto the bus, at the sensor's rate or any other."""

from __future__ import annotations

import heapq
import itertools
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from models.perception.state_history import MAX_AGE_NS
from msgs.bus.interface import Outgoing, Received
from msgs.bus.topics import (
    DETECTIONS_TOPIC,
    RAW_TOPICS,
    SENSOR_TOPICS,
    SIDE_TOPICS,
    plain_topic,
    sensor_of,
    sensor_topic,
)
from msgs.recording.clock_steps import Bridged
from msgs.values.arrays import require_within
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import LidarSetup, PhotonHistograms
from msgs.values.radar import RADAR_LIMITS
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.node import Node
from nodes.process.validation import require_clock_offset, require_rest

if TYPE_CHECKING:
    from typing_extensions import TypeIs

    from msgs.recording.mcap import Recorded, RecordingReader
    from msgs.values.radar import RadarBeam, RadarSetup
    from sim_player.lidar.player import LidarPlayer
    from sim_player.player import ScenePlayer
    from sim_player.rig import RadarRig
    from sim_player.scene.description import Scene

    #: What plays a scene.
    SceneSource = ScenePlayer | LidarPlayer | RadarRig

_LOG = logging.getLogger(__name__)

WALLS_TOPIC = "environment/walls"
#: What the sensors say, walls known from elsewhere, and the truth. All else in a recording is the graph's own work and
#: is done again.
SENSED_TOPICS = (
    *itertools.chain(*SENSOR_TOPICS),
    DETECTIONS_TOPIC,
    "vehicle/state",
    "vehicle/gnss",
    WALLS_TOPIC,
    "sim/truth",
)
#: What is played of a recording: a scene has no sensors beside the radar.
PLAYED_TOPICS = (*SENSED_TOPICS, *SIDE_TOPICS)
#: What is said once, before all else.
SETUP_TOPICS = tuple(setup for setup, _ in SENSOR_TOPICS)
#: What must be known before a beam.
_KNOWN = (*SETUP_TOPICS, "vehicle/state")
#: A scan of a LiDAR lasts seconds; the vehicle's motion is told this often meanwhile, or at every azimuth.
_STATE_PERIOD_S = 0.02
#: Least time for the last message to get through.
END_REST_NS = ns_from_s(0.3)
#: Most messages that one step may send: heartbeats and a stop come between steps.
BURST = 8
#: A scan that would begin so much later than it is due is left out; of one that has begun, what comes later than that.
LATE_NS, LONGEST_LAG_NS = ns_from_s(0.5), ns_from_s(1.0)
#: Most messages that are made ahead: those of a scan.
MADE_AHEAD = 52
#: A player is degraded for so long after it left out a scan.
_DEGRADED_NS = ns_from_s(5.0)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Source to play and its speed; exactly one of `scene` and `capture`."""

    scene: str | None = None
    capture: str | None = None
    seed: int = 0
    #: Scans to play of a scene; None: without end.
    scans: int | None = None
    #: Speed of play; 1 is real time.
    rate: float = 1.0
    #: Rest before the first beam, in which subscribers get ready. After the last, for its way, it is 0.3 s at least.
    settle_s: float = 0.03
    #: Standard deviation of a random phase of each beam: the scene is then not coherent across a scan.
    phase_jitter_rad: float = 0.0
    chirps_per_beam: int | None = None
    #: Speed of every object along its heading, and of the radar; None: as the scene says.
    object_speed_mps: float | None = None
    ego_speed_mps: float | None = None
    #: Effects to simulate: auto (what the scene calls for under the budget), basic, all, or names between commas.
    effects: str = "auto"
    budget_db: float = -20.0
    #: What effects "auto" keep: samples, peaks or objects, what perception needs.
    purpose: Literal["samples", "peaks", "objects"] = "objects"
    #: Walls of a scene to publish once a scan, as a map knows them: none, true, or noisy (`MapErrors`).
    walls: Literal["none", "true", "noisy"] = "none"
    #: False where a car on a CAN bus says how the vehicle moves.
    publish_vehicle_state: bool = True
    #: Added to the stamps of a capture's vehicle states: what `mirrorwave calibrate clock` finds.
    vehicle_clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if (self.scene is None) == (self.capture is None):
            raise ValueError("player needs exactly one of scene and capture")
        if not self.rate > 0.0:
            raise ValueError(f"player.rate must be positive, got {self.rate!r}")
        if self.capture is not None and self.walls != "none":
            raise ValueError(f"player.walls are those of a scene, a capture has its own: got {self.walls!r}")
        if self.scans is not None and self.scans < 0:
            raise ValueError(f"player.scans must not be negative, got {self.scans!r}")
        if self.chirps_per_beam is not None:
            require_within("player.chirps_per_beam", *RADAR_LIMITS["chirps_per_beam"], self.chirps_per_beam)
        require_rest("player.settle_s", self.settle_s)
        require_clock_offset("player.vehicle_clock_offset_s", self.vehicle_clock_offset_s)


class Event(NamedTuple):
    """A message and when to send it, counted from the first beam."""

    offset_ns: int
    outgoing: Outgoing


class Backlog:
    """How far a player is behind its time, and the scans that it leaves out to keep up.

    `clock_ns` measures how long messages take to be made.
    """

    def __init__(self, rate: float, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._rate, self._clock_ns = rate, clock_ns
        #: When the first beam is due, and what time it is.
        self.start_ns: int | None = None
        self.now_ns = 0
        self.left_out = 0
        self._left_out_ns: int | None = None
        self._is_slow = self._is_warm = False
        #: How long the scan under way took to be made so far, and how much longer than it lasts the last one took.
        self._making_ns = self._excess_ns = 0

    @property
    def lead_ns(self) -> int:
        """How long before its time a scan must be begun."""
        return self._excess_ns if self._is_slow else 0

    def due_ns(self, offset_ns: int) -> int:
        """Return when what comes so long after the first beam is due."""
        return (self.start_ns or 0) + round(offset_ns / self._rate)

    def lag_ns(self, offset_ns: int) -> int:
        """Return how long what comes so long after the first beam has been due."""
        return 0 if self.start_ns is None else self.now_ns - self.due_ns(offset_ns)

    def leave_out(self) -> None:
        """Count a scan that is left out."""
        self.left_out += 1
        self._left_out_ns = self.now_ns

    @contextmanager
    def making(self) -> Iterator[None]:
        """Measure how long a message takes to be made."""
        start_ns = self._clock_ns()
        try:
            yield
        finally:
            self._making_ns += self._clock_ns() - start_ns

    def skips(self, offset_ns: int, duration_ns: int) -> bool:
        """Return whether a scan, its begin and its duration, is not to be made; to be asked of one after the other.

        Once behind, the next scan to be made is one that can be made in time.
        """
        duration_ns = round(duration_ns / self._rate)
        if self._making_ns:
            # the first one loads kernels, which says nothing of those that follow
            self._excess_ns = max(0, self._making_ns - duration_ns) if self._is_warm else 0
            self._is_slow = self._is_slow and self._excess_ns > 0
            self._making_ns, self._is_warm = 0, self._is_warm or self.start_ns is not None
        lag_ns = self.lag_ns(offset_ns)
        self._is_slow = self._is_slow or lag_ns > LATE_NS
        if self._is_slow and lag_ns > -self._excess_ns:
            self.leave_out()
            return True
        return False

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while scans take too long to be made, and for some seconds after one was left out."""
        is_over = self._left_out_ns is None or self.now_ns - self._left_out_ns > _DEGRADED_NS
        if is_over and not self._is_slow:
            return NodeState.READY, ""
        return NodeState.DEGRADED, f"cannot keep up with real time: {counted(self.left_out, 'scan')} left out so far"


class Player(Node):
    """Sends each event when its time has come; leaves scans out whole where it cannot keep up with time."""

    outputs = SENSED_TOPICS

    def __init__(
        self, events: Iterator[Event], rate: float, settle_s: float, restamp: bool, backlog: Backlog | None = None
    ) -> None:
        super().__init__()
        self._events = events
        self._backlog = backlog or Backlog(rate)
        self._settle_ns = round(settle_s * 1e9)
        self._restamp = restamp
        self._end_ns: int | None = None
        self._ended = False
        #: The next events: one, or more of them where making takes longer than time.
        self._made: deque[Event] = deque()
        #: Whether a beam has been sent, and what comes after it is still to be made.
        self._is_sent = False
        #: By raw topic the scan under way, and the one that is left out.
        self._scan: dict[str, int] = {}
        self._left_out: dict[str, int] = {}
        self._make_next()

    def finished(self) -> bool:
        """Return whether the last message has had time to get through."""
        return self._ended

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the next message is to be sent, or when to end."""
        if self._is_sent:
            return now_ns
        if not self._made:
            return self._end_ns or now_ns
        return now_ns if self._backlog.start_ns is None else self._backlog.due_ns(self._made[0].offset_ns)

    def pending(self) -> bool:
        """Return whether a message is still to be made."""
        return self._is_sent or self._makes_ahead()

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while scans are left out."""
        return self._backlog.health()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return all messages whose time has come; after a beam, make the next one, which must not hold that one up."""
        self._backlog.now_ns = now_ns
        if self._is_sent:
            self._make_next()
            return []
        if not self._made:
            self._ended = self._end_ns is not None and now_ns >= self._end_ns
            self._end_ns = self._end_ns or now_ns + max(self._settle_ns, END_REST_NS)
            return []
        if self._backlog.start_ns is None:
            return self._open(now_ns)
        out: list[Outgoing] = []
        for _ in range(BURST):
            if not self._made or self._is_sent or self._backlog.lag_ns(self._made[0].offset_ns) < 0:
                break
            if self._is_left_out(self._made[0]):
                self._made.popleft()
                if not self._made:
                    self._make_next()
            else:
                out.append(self._take())
        if not out and self._makes_ahead():
            self._make_next()
        self.shed.note("scan", "behind", self._backlog.left_out)
        return out

    def _open(self, now_ns: int) -> list[Outgoing]:
        """Return what must be known before the first beam, to be sent at once; the rest follows after settling.

        A car may have been heard long before its radar: what queues would not hold goes at its time.
        """
        self._backlog.start_ns = now_ns + self._settle_ns
        out: list[Outgoing] = []
        # of a scene nothing was heard before its start
        latest_ns = 0 if self._restamp else MAX_AGE_NS
        while (
            self._made and self._made[0].offset_ns <= latest_ns and plain_topic(self._made[0].outgoing.topic) in _KNOWN
        ):
            out.append(self._take())
        return out

    def _is_left_out(self, event: Event) -> bool:
        """Return whether a message that is due comes too late: of a scan none is sent, or no more."""
        topic, message = event.outgoing
        lag_ns = self._backlog.lag_ns(event.offset_ns)
        if topic == "vehicle/state":
            return lag_ns > LONGEST_LAG_NS
        if topic == "sim/truth":
            return message.scan_id in self._left_out.values()  # type: ignore[attr-defined]
        if plain_topic(topic) not in RAW_TOPICS:
            return False
        scan: int = message.scan_id  # type: ignore[attr-defined]
        if self._left_out.get(topic) != scan and lag_ns > (
            LONGEST_LAG_NS if self._scan.get(topic) == scan else LATE_NS
        ):
            self._left_out[topic] = scan
            self._backlog.leave_out()
        self._scan[topic] = scan
        return self._left_out.get(topic) == scan

    def _take(self) -> Outgoing:
        """Return the next message; the one after it is made at once, after a beam in the next step."""
        outgoing = self._stamped(self._made.popleft().outgoing)
        self._is_sent = plain_topic(outgoing.topic) in RAW_TOPICS and not self._made
        if not (self._is_sent or self._made):
            self._make_next()
        return outgoing

    def _makes_ahead(self) -> bool:
        """Return whether scans are made before their time, since making takes longer than they last."""
        return self._backlog.lead_ns > 0 and 0 < len(self._made) < MADE_AHEAD

    def _make_next(self) -> None:
        self._is_sent = False
        with self.stages("synthesise"), self._backlog.making():
            event = next(self._events, None)
        if event is not None:
            self._made.append(event)

    def _stamped(self, outgoing: Outgoing) -> Outgoing:
        """Return a message of a live scene stamped with the bus clock; one of a capture keeps its recorded stamp."""
        if not self._restamp or self._backlog.start_ns is None:
            return outgoing
        return Outgoing(outgoing.topic, moved(outgoing.message, self._backlog.start_ns))


def moved(message: msgspec.Struct, by_ns: int) -> msgspec.Struct:
    """Return a message with its stamp moved, as if it had been measured so much later."""
    stamps: dict[str, Any] = {"stamp_ns": message.stamp_ns + by_ns}  # type: ignore[attr-defined]
    if isinstance(message, PhotonHistograms):
        stamps["azimuth_stamp_ns"] = message.azimuth_stamp_ns + by_ns
    return msgspec.structs.replace(message, **stamps)


def scene_events(player: SceneSource, scans: int | None, backlog: Backlog | None = None) -> Iterator[Event]:
    """Return what the sensor of a scene sends, vehicle states and truth, scan after scan, stamped from zero.

    Scans are not made where the `backlog` has them left out. Without `scans` they end before the sensor meets a
    wall or an object.
    """
    from sim_player.scene.clear_path import ego_meeting, meeting_text

    if scans is None and (meeting := ego_meeting(player.scene)) is not None:
        scans = int(meeting[0] / s_from_ns(player.stamp_ns(1) - player.stamp_ns(0)))
        _LOG.warning("%s: its play ends with scan %d", meeting_text(meeting), scans - 1)
    backlog = backlog or Backlog(1.0)
    return _lidar_events(player, scans, backlog) if is_lidar(player) else _radar_events(player, scans, backlog)


def is_lidar(player: SceneSource) -> TypeIs[LidarPlayer]:
    """Return whether a scene is played as a LiDAR."""
    # by its set-up, not its class: to start a radar's player should not take bringing the LiDAR's along
    return isinstance(player.setup, LidarSetup)


def _lidar_events(player: LidarPlayer, scans: int | None, backlog: Backlog) -> Iterator[Event]:
    """Yield the histograms, each when its last azimuth has been measured."""
    setup = player.setup
    azimuths = setup.grid.azimuth_bins
    state_azimuths = range(0, azimuths, max(1, round(_STATE_PERIOD_S / setup.spad.measurement_time_s)))
    # compiles what scans need while the graph still waits
    player.scan(0)
    yield Event(0, Outgoing("lidar/setup", setup))
    for scan in itertools.count() if scans is None else range(scans):
        if backlog.skips(player.stamp_ns(scan), player.stamp_ns(1) - player.stamp_ns(0)):
            continue
        histograms = None
        for azimuth in state_azimuths:
            stamp_ns = player.stamp_ns(scan, azimuth)
            yield Event(stamp_ns, Outgoing("vehicle/state", player.vehicle_state(stamp_ns)))
            # made early, so that the scan's end finds it ready, and not while the scan before goes out
            histograms = player.scan(scan) if azimuth == state_azimuths[len(state_azimuths) // 3] else histograms
        end_ns = player.stamp_ns(scan, azimuths)
        yield Event(end_ns, Outgoing("lidar/histograms", histograms or player.scan(scan)))
        yield Event(end_ns, Outgoing("sim/truth", player.truth(scan)))


def _radar_events(player: ScenePlayer | RadarRig, scans: int | None, backlog: Backlog) -> Iterator[Event]:
    radars = radars_of(player)
    events = _beam_events(player, radars, scans, backlog)
    # while the graph still waits: kernels of moving things made its views late
    for radar in radars.values():
        radar.load_kernels()
    first = next(events, None)
    for name, radar in radars.items():
        yield Event(0, Outgoing(sensor_topic("radar/setup", name), radar.setup))
    if first is not None:
        yield first
        yield from events


def radars_of(player: ScenePlayer | RadarRig) -> dict[str, ScenePlayer]:
    """Return the radars of a scene by their names; the only one has none."""
    return getattr(player, "players", None) or {"": player}


def _beam_events(
    player: ScenePlayer | RadarRig, radars: dict[str, ScenePlayer], scans: int | None, backlog: Backlog
) -> Iterator[Event]:
    """Yield beams, each after the vehicle's state at its time, and the truth of a scan after its last beams."""
    for scan in itertools.count() if scans is None else range(scans):
        if backlog.skips(player.stamp_ns(scan), player.stamp_ns(1) - player.stamp_ns(0)):
            continue
        streams = [_beams_of(radar, scan, sensor_topic("radar/beam", name)) for name, radar in radars.items()]
        first, due_ns = sensor_topic("radar/beam", next(iter(radars))), 0
        for due_ns, outgoing in heapq.merge(*streams, key=lambda event: event.offset_ns):
            if outgoing.topic == first:
                stamp_ns: int = outgoing.message.stamp_ns  # type: ignore[attr-defined]
                yield Event(due_ns, Outgoing("vehicle/state", player.vehicle_state(stamp_ns)))
            yield Event(due_ns, outgoing)
        yield Event(due_ns, Outgoing("sim/truth", player.truth(scan)))


def _beams_of(radar: ScenePlayer, scan: int, topic: str) -> Iterator[Event]:
    """Yield the beams of one radar's scan."""
    beams: Iterable[RadarBeam] = (radar.beam(scan, index) for index in range(len(radar.setup.beams)))
    # those of a digital array are there at once: made before their time, not while they are due
    for beam in list(beams) if radar.setup.array.digital else beams:
        yield Event(beam.stamp_ns + _wait_ns(radar.setup, beam), Outgoing(topic, beam))


def with_walls(events: Iterator[Event], player: SceneSource, params: Params) -> Iterator[Event]:
    """Yield the messages of a scene, with its walls at the start of each scan where `params.walls` asks for them."""
    if params.walls == "none":
        yield from events
        return
    from sim_player.scene.wall_priors import known_walls

    scan = 0
    for event in events:
        yield event
        message = event.outgoing.message
        if not isinstance(message, VehicleState):
            continue
        while player.stamp_ns(scan) < message.stamp_ns:
            # it was left out
            scan += 1
        # a scan begins with the vehicle's state at its stamp
        if message.stamp_ns == (stamp_ns := player.stamp_ns(scan)):
            time_s = s_from_ns(stamp_ns - player.stamp_ns(0))
            walls = known_walls(player.scene, time_s, stamp_ns, params.seed, params.walls)
            yield event._replace(outgoing=Outgoing(WALLS_TOPIC, walls))
            scan += 1


def _wait_ns(setup: RadarSetup, beam: RadarBeam) -> int:
    """Return how long to delay a beam: queues cannot take those of one time at once, but over half of the scan."""
    return beam.beam_index * setup.beam_share_ns // 2 if setup.array.digital else 0


def capture_events(path: Path) -> Iterator[Event]:
    """Return the messages of a capture, SigMF or MCAP by its name."""
    return _recording_events(path) if path.suffix == ".mcap" else _sigmf_events(path)


def truth_beside(capture: Path) -> Path:
    """Return the path of the truth of a SigMF capture: NAME.truth.mcap beside NAME.sigmf-meta."""
    return capture.with_name(capture.name.split(".sigmf")[0] + ".truth.mcap")


def _sigmf_events(path: Path) -> Iterator[Event]:
    from msgs.recording.sigmf import SigmfCapture

    capture = SigmfCapture.open(path)
    yield Event(0, Outgoing("radar/setup", capture.setup))
    if truth_beside(path).is_file():
        for event in _recording_events(truth_beside(path)):
            yield event._replace(offset_ns=0)
    start_ns: int | None = None
    for beam, time_ns in Bridged(capture.beams(), lambda beam: beam.stamp_ns, f"{path}: the clock", noun="beam"):
        start_ns = time_ns if start_ns is None else start_ns
        yield Event(time_ns - start_ns + _wait_ns(capture.setup, beam), Outgoing("radar/beam", beam))


def _recording_events(path: Path) -> Iterator[Event]:
    from msgs.recording.mcap import RecordingReader

    with RecordingReader(path) as reader:
        start_ns: int | None = None
        topics = played_topics(reader)
        setups = first_setups(reader)
        for recorded, time_ns in in_time(setups_first(setups, reader.messages(topics=topics)), path):
            start_ns = time_ns if start_ns is None else start_ns
            offset_ns = 0 if time_ns is None or start_ns is None else time_ns - start_ns
            setup = setups.get(sensor_of(recorded.topic))
            if setup is not None:
                offset_ns += _simulated_wait_ns(setup.message, recorded)
            yield Event(offset_ns, Outgoing(recorded.topic, recorded.message))
        if reader.loss:
            _LOG.warning("%s: %s", path, reader.loss)


def in_time(messages: Iterator[Recorded], path: Path) -> Iterator[tuple[Recorded, int | None]]:
    """Yield the messages of a recording with their times: when they were sent, without steps of the clock.

    The set-ups at its start, which may have been sent long before all else, have none.
    """
    for recorded in messages:
        if plain_topic(recorded.topic) not in SETUP_TOPICS:
            sent = itertools.chain([recorded], messages)
            yield from Bridged(sent, lambda recorded: recorded.log_time_ns, f"{path}: the clock")
            return
        yield recorded, None


def _simulated_wait_ns(setup: msgspec.Struct, recorded: Recorded) -> int:
    """How long a beam that was written at the very time of its stamp is held back: no sensor sends it that soon."""
    from msgs.values.radar import RadarBeam, RadarSetup

    beam = recorded.message
    if not (isinstance(setup, RadarSetup) and isinstance(beam, RadarBeam)) or recorded.log_time_ns != beam.stamp_ns:
        return 0
    return _wait_ns(setup, beam)


def played_topics(reader: RecordingReader) -> tuple[str, ...]:
    """Return what is played of a recording: `PLAYED_TOPICS`, and those of sensors with names."""
    return *PLAYED_TOPICS, *(
        topic for topic in reader.types if sensor_of(topic) and plain_topic(topic) in PLAYED_TOPICS
    )


def first_setups(reader: RecordingReader) -> dict[str, Recorded]:
    """Return the first set-up of a recording by the name of its sensor, "" where the only one has none."""
    setups: dict[str, Recorded] = {}
    for sensor in dict.fromkeys(sensor_of(topic) for topic in played_topics(reader)):
        topics = [sensor_topic(topic, sensor) for topic in SETUP_TOPICS]
        if (setup := next(reader.messages(topics), None)) is not None:
            setups[sensor] = setup
    return setups


def setups_first(setups: Mapping[str, Recorded], messages: Iterator[Recorded]) -> Iterator[Recorded]:
    """Yield the `messages` of a recording with `setups`, the first ones among them, before all others.

    A part of a recording begins with the set-up, sent again with the part's first message; a beam that was sent a
    moment before and took longer on its way stands before both.
    """
    yield from setups.values()
    first = {setup.topic for setup in setups.values()}
    for recorded in messages:
        if recorded.topic in first:
            first.remove(recorded.topic)
        else:
            yield recorded


def _with_offset(events: Iterator[Event], offset_ns: int) -> Iterator[Event]:
    """Yield vehicle states on the radar's clock, without those from before that began; everything else as it is."""
    for event in events:
        if not isinstance(event.outgoing.message, VehicleState):
            yield event
        elif event.outgoing.message.stamp_ns + offset_ns >= 0:
            yield event._replace(outgoing=Outgoing(event.outgoing.topic, moved(event.outgoing.message, offset_ns)))


def _not_empty(events: Iterator[Event], capture: str | None) -> Iterator[Event]:
    first = next(events, None)
    if first is None:
        raise ValueError(f"{capture}: holds none of {', '.join(PLAYED_TOPICS)}")
    return itertools.chain([first], events)


def scene_of(params: Params) -> Scene:
    """Return the scene named by `params`, with the speeds it overrides.

    Raises `ValueError` naming file and field, also where the sensor would meet a wall or an object in `params.scans`.
    """
    from sim_player.scene.clear_path import require_clear_path
    from sim_player.scene.description import check_scene, load_scene

    scene = load_scene(Path(params.scene or ""))
    if params.object_speed_mps is not None:
        moving_objects = tuple(
            msgspec.structs.replace(item, speed_mps=params.object_speed_mps) for item in scene.objects
        )
        scene = msgspec.structs.replace(scene, objects=moving_objects)
    if params.ego_speed_mps is not None:
        ego = msgspec.structs.replace(scene.ego, speed_mps=params.ego_speed_mps)
        scene = msgspec.structs.replace(scene, ego=ego)
    try:
        check_scene(scene)
        if params.scans is not None:
            is_lidar = scene.radar.preset == "spad"
            period_s = scene.lidar.period_s if is_lidar else scene.setup.radar.scan_period_s
            require_clear_path(scene, params.scans * period_s)
    except ValueError as error:
        raise ValueError(f"{params.scene}: {error}") from None
    if scene.radar.preset == "spad":
        # `sim run` asks for samples where nothing is said
        radar_only = ("phase_jitter_rad", "chirps_per_beam", "effects", "budget_db", "purpose")
        default = Params(scene=params.scene)
        for name in radar_only:
            value = getattr(params, name)
            if value != getattr(default, name) and (name, value) != ("purpose", "samples"):
                raise ValueError(f"player.{name} is for radars, and {params.scene} has preset 'spad': got {value!r}")
    return scene


def scene_player(params: Params) -> SceneSource:
    """Return the simulator that plays `params.scene`: of its radars, or of a LiDAR where its preset is "spad"."""
    scene = scene_of(params)
    if scene.radar.preset == "spad":
        from sim_player.lidar.player import LidarPlayer

        return LidarPlayer(scene, seed=params.seed)

    from sim_player.player import ScenePlayer
    from sim_player.rig import RadarRig

    return (RadarRig if scene.radars else ScenePlayer)(
        scene,
        seed=params.seed,
        phase_jitter_rad=params.phase_jitter_rad,
        chirps_per_beam=params.chirps_per_beam,
        effects=params.effects,
        budget_db=params.budget_db,
        purpose=params.purpose,
    )


def events_of(params: Params, backlog: Backlog | None = None) -> Iterator[Event]:
    """Return the messages to play, of a scene or a capture; the first one is read or made here.

    Raises `ValueError` naming a capture that holds nothing to play.
    """
    if params.scene is not None:
        player = scene_player(params)
        events = with_walls(scene_events(player, params.scans, backlog), player, params)
    else:
        events = _not_empty(capture_events(Path(params.capture or "")), params.capture)
    if not params.publish_vehicle_state:
        return (event for event in events if event.outgoing.topic != "vehicle/state")
    if params.vehicle_clock_offset_s:
        return _with_offset(events, ns_from_s(params.vehicle_clock_offset_s))
    return events


def check(params: Params) -> None:
    """Raise `ValueError` for a scene, effects or a capture that cannot be played."""
    if params.scene is not None:
        from sim_player.effects.table import named_effects

        named_effects(params.effects)
    elif Path(params.capture or "").suffix != ".mcap":
        from msgs.recording.sigmf import SigmfCapture

        SigmfCapture.open(Path(params.capture or ""), verify=False)
    _more_topics(params)


def create(params: Params) -> Player:
    """Return the node with its parameters; the first message is made here: compiling ends before it is ready."""
    backlog = Backlog(params.rate)
    player = Player(events_of(params, backlog), params.rate, params.settle_s, params.scene is not None, backlog)
    player.outputs += _more_topics(params)
    return player


def _more_topics(params: Params) -> tuple[str, ...]:
    """Return the topics of sensors with names, and which sensors beside the radar a capture holds: these alone are
    announced.
    """
    from msgs.recording.mcap import RecordingReader

    capture = Path(params.capture or "")
    if params.scene is not None:
        sensors = scene_of(params).radars
        return tuple(sensor_topic(topic, sensor) for sensor in sensors for topic in SENSOR_TOPICS[0])
    if capture.suffix != ".mcap":
        return ()
    with RecordingReader(capture) as reader:
        of_sensors = set(played_topics(reader)) - set(PLAYED_TOPICS)
        return *(topic for topic in SIDE_TOPICS if topic in reader.types), *sorted(of_sensors)
