"""A recording read once from end to end: what each scan's page shows beyond its own messages, and what happened when.

Trails and warnings follow from all that came before, so they are reckoned in the order of the recording and kept: a
scan shows the same however it is reached.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Any, NamedTuple

from msgs.recording.clock_steps import Bridged
from msgs.recording.mcap import RecordingReader
from msgs.values.perception import BevFrame
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from nodes.inputs.view_latency import Setup
from nodes.viewer.assembly import TABLE_PERIOD_NS
from nodes.viewer.driver_warnings import DriverWarning, Level
from nodes.viewer.newest import json_text
from nodes.viewer.series import SeriesStore
from nodes.viewer.trails import Past
from nodes.viewer.watch import TOPICS_WATCHED, Watch

#: A hole in a recording is looked into this far.
LONGEST_HOLE_NS = 60 * NANOSECONDS_PER_SECOND
#: Marks on the timeline at most; the most urgent are kept.
MAX_MARKS = 1000


class Moment(NamedTuple):
    """A scan of a recording, with what its page shows beside its own messages."""

    sent_ns: int
    scan_id: int
    #: Hidden objects and tracks in it.
    objects: int
    tracks: int
    past: tuple[Past, ...]
    warnings: tuple[DriverWarning, ...]
    #: The node table as JSON.
    table: str
    #: Since when the graph ran, as far as known then.
    since_ns: int


class Mark(NamedTuple):
    """A warning on the timeline, as long as it is of one level; one that rises or falls goes on as another mark."""

    key: str
    start_ns: int
    end_ns: int
    level: Level
    title: str


class ViewLog(NamedTuple):
    """Scans in order, and the marks in order of their start."""

    moments: list[Moment]
    marks: list[Mark]
    #: Set-up of the sensor, the last that was told; None where none was.
    sensor: Setup | None
    #: Time of each scan on the timeline: when it was sent, without steps of the clock.
    times_ns: list[int]


def read_log(reader: RecordingReader, series: SeriesStore | None = None) -> ViewLog:
    """Read all scans of a recording, the numbers of all messages into `series`; unreadable messages are passed over."""
    series = series or SeriesStore(keeps_all=True)
    moments: list[Moment] = []
    marks = _Marks()
    watch: Watch | None = None
    due_ns = 0
    for recorded in reader.messages(TOPICS_WATCHED):
        now_ns, message = recorded.log_time_ns, recorded.message
        if watch is None:
            watch, due_ns = Watch(now_ns, series), now_ns
        # a live page asks this often, whether anything comes or not
        due_ns = max(due_ns, now_ns - LONGEST_HOLE_NS)
        while due_ns < now_ns:
            marks.add(watch.warnings(due_ns), due_ns)
            due_ns += TABLE_PERIOD_NS
        watch.take(message, now_ns)
        if isinstance(message, BevFrame):
            moments.append(_moment(message, watch, now_ns))
            marks.add(moments[-1].warnings, now_ns)
    if moments:
        series.set_zero(moments[0].sent_ns)
    timed = Bridged(moments, lambda moment: moment.sent_ns, f"{reader.path}: the clock", noun="scan")
    times_ns = [time_ns for _, time_ns in timed]
    return ViewLog(moments, marks.closed(), None if watch is None else watch.sensor, times_ns)


def _moment(frame: BevFrame, watch: Watch, now_ns: int) -> Moment:
    return Moment(
        sent_ns=now_ns,
        scan_id=frame.scan_id,
        objects=len(frame.objects),
        tracks=len(frame.tracks),
        past=watch.past,
        warnings=watch.warnings(now_ns),
        table=json_text(watch.table(now_ns)),
        since_ns=watch.since_ns,
    )


class _Marks:
    """Warnings of successive times joined to marks."""

    def __init__(self) -> None:
        self._open: dict[str, Mark] = {}
        self._closed: list[Mark] = []

    def add(self, warnings: Sequence[DriverWarning], now_ns: int) -> None:
        """Take in the warnings of a time."""
        self._closed += [self._open.pop(key) for key in set(self._open) - {warning.key for warning in warnings}]
        for warning in warnings:
            open_mark = self._open.get(warning.key)
            if open_mark is None:
                open_mark = Mark(warning.key, warning.since_ns, now_ns, warning.level, warning.title)
            elif warning.level != open_mark.level:
                self._closed.append(open_mark)
                open_mark = Mark(warning.key, now_ns, now_ns, warning.level, warning.title)
            self._open[warning.key] = open_mark if warning.ended else open_mark._replace(end_ns=now_ns)

    def closed(self) -> list[Mark]:
        """All marks, in order of their start."""
        worst = sorted([*self._closed, *self._open.values()], key=lambda mark: -mark.level)[:MAX_MARKS]
        return sorted(worst, key=lambda mark: (mark.start_ns, mark.key))


def overview_json(log: ViewLog) -> dict[str, Any]:
    """The whole recording for the strip above the slider; times in seconds from the first scan."""
    sent_ns = [moment.sent_ns for moment in log.moments]

    def time_s(at_ns: int) -> float:
        before = max(0, bisect_right(sent_ns, at_ns) - 1)
        # as long after a scan as it was, and not after the next one: the clock may have been set in between
        time_ns = min([log.times_ns[before] + at_ns - sent_ns[before], *log.times_ns[before + 1 : before + 2]])
        return round(s_from_ns(time_ns - log.times_ns[0]), 2)

    return {
        "type": "overview",
        "times_s": [time_s(at_ns) for at_ns in sent_ns],
        "seen": [max(moment.objects, moment.tracks) for moment in log.moments],
        "marks": [
            {
                "key": moment.key,
                "from_s": time_s(moment.start_ns),
                "to_s": time_s(moment.end_ns),
                "level": moment.level.name.lower(),
                "title": moment.title,
            }
            for moment in log.marks
            # what was over before the first scan is not seen at any
            if moment.end_ns >= sent_ns[0]
        ],
    }
