"""A recording played into a graph: when each message goes, what it waits for, where it goes on.

Steps of the clock that the recording was stamped with are not waited for.

The graph is waited for, unless asked to keep time: the first message of a scan goes when the last scan but one has been
answered and what must be known before it (set-up, vehicle states) was sent. Holding back, pausing, seeking and steps
happen between scans only: the RA former gives a scan up whose next beam does not come.

What was sent before a scan's first beam is there before it: a pass begins when all nodes have told that they took what
comes before the first scan; later states leave ahead of a beam through the same threads, and are a thousandth of its
size.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec

from mirrorwave.replay.keys import Key, Keyboard
from mirrorwave.replay.listeners import ANSWER_S, CONFIRM_S, LATE_ANSWER_S, NodeLoss, ReplayedGraph
from msgs.bus.topics import TOPICS
from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.radar import RadarBeam
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from nodes.node import SETTLE_S, Stop
from nodes.player import in_time, moved, setups_first

if TYPE_CHECKING:
    from msgs.bus.zmq import ZmqBus

#: Below, beams would come slower than the RA former waits for them.
SLOWEST = 0.05
FASTEST = 1000.0
SEEK_NS = 5 * NANOSECONDS_PER_SECOND
#: Held back by less than about a scan, what is late catches up; by more, everything after it comes later too.
_CATCH_UP_NS = NANOSECONDS_PER_SECOND * 3 // 10
#: A scan begun before the end is played to its end; one that lacks its last beam no longer than this.
_SCAN_ENDS_NS = NANOSECONDS_PER_SECOND
#: Older vehicle states say nothing about a scan (`models.perception.state_history`).
_STATES_NS = NANOSECONDS_PER_SECOND // 2
_TURN_S = 0.02
_STATE = "vehicle/state"


class ReplayParams(msgspec.Struct, frozen=True, kw_only=True):
    """Part of a recording to play, and how."""

    #: Topics as the recording names them.
    topics: tuple[str, ...]
    #: Other names for some of them.
    renamed: Mapping[str, str] = {}
    #: Speed against the recording, at most; 0: as fast as the graph takes it.
    rate: float = 1.0
    #: The graph is not waited for.
    keeps_time: bool = False
    loop: bool = False
    #: Log time of the first message that is not latched (`first_sensed_ns`).
    first_ns: int
    #: Log times of the span to play; None: to the end.
    start_ns: int
    end_ns: int | None = None
    #: Stamps are moved onto the bus clock.
    on_clock: bool = False
    paused: bool = False

    def __post_init__(self) -> None:
        require_pace(self.rate, self.keeps_time, self.on_clock)


def require_pace(rate: float, keeps_time: bool, on_clock: bool) -> None:
    """Raise `ValueError` for a rate that cannot be played, or not so."""
    if not (rate == 0.0 or SLOWEST <= rate <= FASTEST):
        raise ValueError(f"--rate must be 0 or {SLOWEST:g}..{FASTEST:g}, got {rate:g}")
    if keeps_time and rate == 0.0:
        raise ValueError("--realtime keeps time and needs a --rate above 0, got 0")
    if on_clock and rate != 1.0:
        raise ValueError(f"--clock needs --rate 1: stamps pass as fast as the clock, got {rate:g}")


class Position(msgspec.Struct, frozen=True, kw_only=True):
    """Position of a replay."""

    #: Since the start of the span that is played.
    time_s: float
    rate: float
    paused: bool
    messages: int


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Account of a replay: what was played, and what was lost."""

    path: str
    #: Messages sent per topic.
    messages: dict[str, int]
    passes: int
    #: Time of the recording that was played, and how long that took until the last answer, pauses apart.
    played_s: float
    elapsed_s: float
    rate: float
    achieved_rate: float | None
    scans: int
    #: Topic on which the graph answered the scans, and how many it did not; None where that is not known.
    answered_on: str | None
    unanswered: int | None
    #: Nodes that told what they took, and what they missed.
    nodes: tuple[str, ...]
    lost: tuple[NodeLoss, ...]
    #: Ended before its time: what is missing then is not told.
    interrupted: bool
    #: What the recording itself lacks.
    loss: str | None

    @property
    def is_whole(self) -> bool:
        """Nothing is known to be missing."""
        return not (self.lost or self.unanswered or self.loss)


class Schedule:
    """Times at which messages are due on the bus clock, by their log times."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._log_ns: int | None = None
        self._bus_ns = 0

    def restart(self) -> None:
        """The next message is due when it is asked for."""
        self._log_ns = None

    def due_ns(self, log_ns: int, now_ns: int) -> int:
        """Return when a message is due; at once where there is no pace."""
        if self._log_ns is None or self.rate == 0.0:
            self._log_ns, self._bus_ns = log_ns, now_ns
        return self._bus_ns + round((log_ns - self._log_ns) / (self.rate or 1.0))

    def forgive(self, log_ns: int, now_ns: int) -> None:
        """Have everything come later where a message is later than can be caught up with."""
        late_ns = now_ns - self.due_ns(log_ns, now_ns)
        self._bus_ns += max(0, late_ns - _CATCH_UP_NS)

    def change_rate(self, rate: float, log_ns: int, now_ns: int) -> None:
        """Go on at another pace from a message."""
        self._log_ns, self._bus_ns = log_ns, max(now_ns, self.due_ns(log_ns, now_ns))
        self.rate = rate


class Replay:
    """Plays one recording; `run` once."""

    def __init__(
        self,
        reader: RecordingReader,
        bus: ZmqBus,
        graph: ReplayedGraph,
        params: ReplayParams,
        stop: Stop,
        keyboard: Keyboard,
        show: Callable[[Position], None],
    ) -> None:
        self._reader, self._bus, self._graph, self._params = reader, bus, graph, params
        self._stop, self._keyboard, self._show = stop, keyboard, show
        self._schedule = Schedule(params.rate)
        #: Latched topics, as the recording names them.
        self._latched = [topic for topic in params.topics if TOPICS[params.renamed.get(topic, topic)].latched]
        self._sent: Counter[str] = Counter()
        self._passes = 0
        self._paused, self._steps = params.paused, 0
        self._jump_ns: int | None = None
        self._typed: list[Key] = []
        #: Something that all must have before the next scan was sent.
        self._unconfirmed = False
        #: Time of the message to be sent: its log time, without steps of the clock.
        self._time_ns = 0
        #: Time of the last message, None at the start of a pass.
        self._at_ns: int | None = None
        self._played_ns = 0
        #: When the first scan went, and how long nothing was to be played since.
        self._started_s: float | None = None
        self._waited_s = 0.0

    def run(self) -> Summary:
        """Play until the end, or until asked to stop."""
        start_ns: int | None = self._params.start_ns
        while start_ns is not None and not self._stop.requested:
            start_ns = self._pass(start_ns)
        elapsed_s = 0.0 if self._started_s is None else time.monotonic() - self._started_s - self._waited_s
        self._graph.confirm(LATE_ANSWER_S if self._params.keeps_time else CONFIRM_S)
        return self._summary(elapsed_s)

    def _pass(self, start_ns: int) -> int | None:
        """Play from a log time; gives where to go on, None at the end."""
        self._open(start_ns)
        for recorded, time_ns in in_time(self._messages(start_ns), self._reader.path):
            self._time_ns = recorded.log_time_ns if time_ns is None else time_ns
            if self._graph.begins_scan(recorded) and self._between_scans(recorded):
                self._finish_scans()
                return self._jump_ns
            due_ns = self._wait_until_due(recorded)
            if self._stop.requested:
                return None
            self._send(recorded, due_ns)
            # add the time since the message before
            if not TOPICS[recorded.topic].latched:
                self._played_ns += 0 if self._at_ns is None else max(0, self._time_ns - self._at_ns)
                self._at_ns = self._time_ns
        self._finish_scans()
        self._passes += 1
        # a span that holds nothing but what is said once would be begun again and again without a pause
        return self._params.start_ns if self._params.loop and self._at_ns is not None else None

    def _open(self, start_ns: int) -> None:
        """Whoever begins in the middle still needs what was said before."""
        self._schedule.restart()
        self._graph.restart()
        self._jump_ns = self._at_ns = None
        self._unconfirmed = True
        for recorded in self._latched_before(start_ns):
            self._send(recorded, None)
        states = [topic for topic in self._params.topics if self._params.renamed.get(topic, topic) == _STATE]
        for recorded in self._read(states, max(0, start_ns - _STATES_NS), start_ns):
            self._send(recorded, self._bus.now_ns() + recorded.log_time_ns - start_ns)

    def _messages(self, start_ns: int) -> Iterator[Recorded]:
        is_cut = start_ns > self._params.first_ns
        messages = self._read(self._params.topics, start_ns, None)
        if self._latched and not self._latched_before(start_ns):
            first = {topic: next(self._read([topic], start_ns, None), None) for topic in self._latched}
            messages = setups_first({topic: said for topic, said in first.items() if said is not None}, messages)
        return whole_scans(messages, is_cut, self._params.end_ns)

    def _latched_before(self, end_ns: int) -> list[Recorded]:
        """Return the last message before `end_ns` of each latched topic."""
        messages = self._read(self._latched, 0, end_ns) if self._latched else ()
        return list({recorded.topic: recorded for recorded in messages}.values())

    def _read(self, topics: Collection[str], start_ns: int, end_ns: int | None) -> Iterator[Recorded]:
        return self._reader.messages(topics, start_ns, end_ns, self._params.renamed)

    def _between_scans(self, recorded: Recorded) -> bool:
        """Wait for the graph and obey keys before a scan; True where play is to go on elsewhere."""
        if self._unconfirmed:
            # all take in what must be known before the scan
            started_s = time.monotonic()
            self._graph.confirm(SETTLE_S if self._params.keeps_time else CONFIRM_S)
            self._waited_s += time.monotonic() - started_s
            self._schedule.restart()
            self._unconfirmed = False
        if self._started_s is None:
            self._started_s, self._waited_s = time.monotonic(), 0.0
        if not self._params.keeps_time:
            self._graph.await_room()
        self._obey(recorded)
        if self._paused and not self._steps:
            started_s = time.monotonic()
            while self._paused and not (self._steps or self._stop.requested or self._jump_ns is not None):
                self._tell(recorded.log_time_ns)
                self._graph.serve(_TURN_S)
                self._obey(recorded)
            # the rate that was achieved does not suffer from it
            self._waited_s += time.monotonic() - started_s
            self._schedule.restart()
        self._steps = max(0, self._steps - 1)
        if not self._params.keeps_time:
            self._schedule.forgive(self._time_ns, self._bus.now_ns())
        self._tell(recorded.log_time_ns)
        return self._jump_ns is not None

    def _wait_until_due(self, recorded: Recorded) -> int:
        """The bus is served meanwhile, for those who join late."""
        if TOPICS[recorded.topic].latched:
            return self._bus.now_ns()
        due_ns = self._schedule.due_ns(self._time_ns, self._bus.now_ns())
        while not self._stop.requested and (wait_ns := due_ns - self._bus.now_ns()) > 0:
            self._graph.serve(min(s_from_ns(wait_ns), _TURN_S))
            self._listen()
        return due_ns

    def _send(self, recorded: Recorded, due_ns: int | None) -> None:
        """Publish a message that was due; its stamp moves along if stamps are to be on the bus clock."""
        is_latched = TOPICS[recorded.topic].latched
        message = recorded.message
        if self._params.on_clock and due_ns is not None and not is_latched:
            message = moved(message, due_ns - recorded.log_time_ns)
        self._bus.publish(recorded.topic, message)
        self._graph.note_sent(recorded)
        if self._params.keeps_time:
            # late as it may be, answers are heard
            self._graph.serve(0.0)
        self._sent[recorded.topic] += 1
        self._unconfirmed |= is_latched

    def _finish_scans(self) -> None:
        """Let the graph answer what is on its way: what comes next may begin elsewhere."""
        self._graph.await_room(0, LATE_ANSWER_S if self._params.keeps_time else ANSWER_S)

    def _listen(self) -> None:
        """Take in keys; the end does not wait for a scan's end."""
        self._typed += self._keyboard.pressed()
        if Key.QUIT in self._typed:
            self._stop.request(at_once=True)

    def _obey(self, recorded: Recorded) -> None:
        self._listen()
        typed, self._typed = self._typed, []
        for key in typed:
            match key:
                case Key.PAUSE:
                    self._paused = not self._paused
                case Key.STEP:
                    self._paused, self._steps = True, self._steps + 1
                case Key.BACK:
                    self._seek(recorded.log_time_ns - SEEK_NS)
                case Key.FORWARD:
                    self._seek(recorded.log_time_ns + SEEK_NS)
                case Key.FASTER:
                    self._change_rate(2.0)
                case Key.SLOWER:
                    self._change_rate(0.5)

    def _seek(self, log_ns: int) -> None:
        """Go on from a time within the span that is played; past its end play ends."""
        self._jump_ns = max(log_ns, self._params.start_ns)

    def _change_rate(self, factor: float) -> None:
        if not self._params.on_clock and self._schedule.rate > 0.0:
            rate = min(max(self._schedule.rate * factor, SLOWEST), FASTEST)
            self._schedule.change_rate(rate, self._time_ns, self._bus.now_ns())

    def _tell(self, log_ns: int) -> None:
        time_s = s_from_ns(log_ns - self._params.start_ns)
        messages = sum(self._sent.values())
        self._show(Position(time_s=time_s, rate=self._schedule.rate, paused=self._paused, messages=messages))

    def _summary(self, elapsed_s: float) -> Summary:
        graph, played_s = self._graph, s_from_ns(self._played_ns)
        skipped = sum(self._reader.skipped.values())
        unreadable = f"{skipped} unreadable messages were left out" if skipped else None
        return Summary(
            path=str(self._reader.path),
            messages=dict(self._sent),
            passes=self._passes,
            played_s=played_s,
            elapsed_s=elapsed_s,
            rate=self._params.rate,
            achieved_rate=played_s / elapsed_s if elapsed_s > 0.0 and played_s > 0.0 else None,
            scans=graph.scans,
            answered_on=graph.answer,
            unanswered=graph.unanswered if graph.answer and not self._stop.requested else None,
            nodes=graph.nodes,
            lost=() if self._stop.requested else graph.losses(),
            interrupted=self._stop.requested,
            loss=self._reader.loss or unreadable,
        )


def whole_scans(messages: Iterator[Recorded], is_cut: bool, end_ns: int | None) -> Iterator[Recorded]:
    """Messages up to `end_ns`, without the scan that a cut at the start tore, with all of the one that the end would.

    Beams of a scan come in order; a scan that the recording itself holds in part stays as it is.
    """
    torn: int | None = None
    is_open: int | None = None
    for recorded in messages:
        beam = recorded.message if isinstance(recorded.message, RadarBeam) else None
        if end_ns is not None and recorded.log_time_ns >= end_ns:
            is_other = is_open is None or (beam is not None and beam.scan_id != is_open)
            if is_other or recorded.log_time_ns >= end_ns + _SCAN_ENDS_NS:
                return
        if beam is not None:
            torn = beam.scan_id if is_cut and beam.beam_index > 0 else torn
            is_cut = False
            if beam.scan_id == torn:
                continue
            is_open = None if beam.beam_index == beam.beam_count - 1 else beam.scan_id
        yield recorded


def first_sensed_ns(reader: RecordingReader, topics: tuple[str, ...], renamed: Mapping[str, str]) -> int:
    """Log time of the first message that is not latched: what is said once may have been said long before."""
    timely = [topic for topic in topics if not TOPICS[renamed.get(topic, topic)].latched]
    return next((recorded.log_time_ns for recorded in reader.messages(timely, renamed=renamed)), reader.span_ns[0])
