"""A recording under the viewer's page: a position that pages and time move."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from typing import NoReturn

from mirrorwave.replay.view_log import overview_json, read_log
from msgs.bus.topics import RAW_TOPICS, SIDE_TOPICS, plain_topic
from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.perception import BevFrame
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from nodes.viewer.assembly import ScanAssembly, post_sensor, post_warnings
from nodes.viewer.newest import Board, json_text
from nodes.viewer.server import Command, Play, Seek, Step
from nodes.viewer.side_sensors import NEAR_NS

VIEW_TOPIC = "perception/hidden_objects"
#: Of these the messages of the shown scan are read; the rest follows from the whole recording (`view_log`).
TOPICS_OF_A_SCAN = (VIEW_TOPIC, "radar/ra_map", "perception/peaks", "sim/truth", "vehicle/state")
#: Truth that was sent a little after its view still belongs to it.
LATE_NS = NANOSECONDS_PER_SECOND // 10
#: Map, peaks and truth of a view were sent this much before it at most.
RUN_UP_NS = 3 * NANOSECONDS_PER_SECOND
MAX_SPEED = 100.0
#: The last scan stays this long before play begins anew.
LAST_SCAN_S = 1.0
#: A command is answered this much later at most while nothing else happens.
POLL_S = 0.2


def _source_of_views(reader: RecordingReader) -> str:
    if any(plain_topic(topic) in RAW_TOPICS for topic in reader.types):
        return f"of its raw data `mirrorwave process {reader.path} --view` makes some"
    return "record one: mirrorwave launch --record"


class Playback:
    """A position in a recording, moved by commands and by time; posts on a board what a live graph would.

    Raises `ValueError` where the recording holds no view.
    """

    def __init__(self, reader: RecordingReader, board: Board) -> None:
        self._reader, self._board = reader, board
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        log = read_log(reader, board.series)
        self._scans = log.moments
        self._times_ns = log.times_ns
        if not self._scans:
            raise ValueError(f"{reader.path}: holds no {VIEW_TOPIC} to show; {_source_of_views(reader)}")
        self._index = -1
        self._recent: list[Recorded] = []
        self._speed = 0.0
        self._loops = False
        #: When the next scan is due, on the monotonic clock.
        self._due_s = 0.0
        if log.sensor is not None:
            post_sensor(board, log.sensor)
        overview = overview_json(log)
        board.post("overview", lambda: (json_text(overview),))
        board.post_series()
        self.show(0)

    @property
    def count(self) -> int:
        """Scans that can be shown."""
        return len(self._scans)

    @property
    def index(self) -> int:
        """The shown scan, from 0."""
        return self._index

    @property
    def playing(self) -> bool:
        """True if time moves it."""
        return self._speed > 0.0

    def run(self) -> NoReturn:
        """Obey commands and time, until the process is interrupted."""
        while True:
            self.turn(time.monotonic())

    def turn(self, now_s: float) -> None:
        """Show the next scan if it is due, else wait for a command until it is; obey all that wait."""
        if self.playing and now_s >= self._due_s:
            self._advance(now_s)
        wait_s = min(POLL_S, max(self._due_s - now_s, 0.0)) if self.playing else POLL_S
        try:
            waiting = [self.commands.get(timeout=wait_s)]
        except queue.Empty:
            return
        while not self.commands.empty():
            waiting.append(self.commands.get())
        self.obey(waiting, time.monotonic())

    def obey(self, commands: list[Command], now_s: float) -> None:
        """Do what pages asked for, then show where that leads, once: a slider that is dragged asks often."""
        target = self._index
        for command in commands:
            match command:
                case Play(speed, loops):
                    self._speed, self._loops = min(max(speed, 0.0), MAX_SPEED), loops
                    # whoever plays at the end wants to see it again
                    target = 0 if self.playing and target >= self.count - 1 else target
                case Seek(index):
                    target = index
                case Step(by):
                    target += by
        if target != self._index:
            self.show(target)
        self._due_s = now_s + self._gap_s()
        self._post_timeline()

    def show(self, index: int) -> None:
        """Show scan `index`, or the nearest there is: the same, whatever was shown before."""
        before, self._index = self._index, min(max(index, 0), self.count - 1)
        scan = self._scans[self._index]
        self._read(before)
        assembly = ScanAssembly(self._board)
        # before the view, which chooses among them
        for recorded in self._side_messages():
            assembly.take(recorded.message, recorded.log_time_ns)
        for recorded in self._recent:
            # of other scans in the run-up nothing is shown, but the vehicle's motion counts
            if getattr(recorded.message, "scan_id", scan.scan_id) == scan.scan_id:
                assembly.take(recorded.message, recorded.log_time_ns, scan.past, since_ns=scan.since_ns)
        self._board.post("nodes", lambda: (scan.table,))
        post_warnings(self._board, scan.warnings, scan.sent_ns)
        self._post_timeline()

    def _read(self, before: int) -> None:
        """Hold the messages of the shown scan and its run-up; those of the next scan are read on where it follows."""
        start_ns = max(self._scans[self._index].sent_ns - RUN_UP_NS, 0)
        follows = 0 <= before == self._index - 1
        kept = [recorded for recorded in self._recent if recorded.log_time_ns >= start_ns] if follows else []
        read_ns = max(start_ns, self._end_ns(before)) if follows else start_ns
        self._recent = [*kept, *self._reader.messages(TOPICS_OF_A_SCAN, read_ns, self._end_ns(self._index))]

    def _side_messages(self) -> Iterator[Recorded]:
        """Yield what the sensors beside the radar measured about the time of the shown view."""
        if not any(topic in self._reader.types for topic in SIDE_TOPICS):
            return
        scan = self._scans[self._index]
        stamps_ns = [
            recorded.message.stamp_ns
            for recorded in self._recent
            if isinstance(recorded.message, BevFrame) and recorded.message.scan_id == scan.scan_id
        ]
        # a stamp of another clock says nothing
        is_known = bool(stamps_ns) and 0 <= scan.sent_ns - stamps_ns[-1] <= RUN_UP_NS
        at_ns = stamps_ns[-1] if is_known else scan.sent_ns
        yield from self._reader.messages(SIDE_TOPICS, max(at_ns - NEAR_NS, 0), at_ns + NEAR_NS)

    def _end_ns(self, index: int) -> int:
        """Return the end of scan `index`, exclusive."""
        end_ns = self._scans[index].sent_ns + LATE_NS
        return min(end_ns, self._scans[index + 1].sent_ns) if index + 1 < self.count else end_ns

    def _gap_s(self) -> float:
        """Time to the next scan at the speed of play."""
        if not self.playing:
            return 0.0
        if self._index + 1 >= self.count:
            return LAST_SCAN_S if self._loops else 0.0
        return s_from_ns(self._times_ns[self._index + 1] - self._times_ns[self._index]) / self._speed

    def _advance(self, now_s: float) -> None:
        """The next scan; after the last one play ends, or begins anew."""
        if self._index + 1 < self.count:
            self.show(self._index + 1)
        elif self._loops:
            self.show(0)
        else:
            self._speed = 0.0
            self._post_timeline()
            return
        # in step with the recording; where showing takes longer than that, as fast as it goes
        self._due_s = max(self._due_s + self._gap_s(), now_s)

    def _post_timeline(self) -> None:
        start_ns = self._times_ns[0]
        timeline = {
            "type": "timeline",
            "index": self._index,
            "count": self.count,
            "time_s": round(s_from_ns(self._times_ns[self._index] - start_ns), 3),
            "duration_s": round(s_from_ns(self._times_ns[-1] - start_ns), 3),
            "playing": self.playing,
            "speed": self._speed,
            "loop": self._loops,
            "loss": self._reader.loss,
        }
        self._board.post("timeline", lambda: (json_text(timeline),))
