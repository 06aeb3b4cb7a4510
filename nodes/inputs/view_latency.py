"""Latency of views against the deadline: the one module that measures latency of the live graph.

Latency of a view counts from the nominal end of the last beam of its scan (its start plus its time on air) to its
arrival. A deadline is missed by a view that comes later than `DEADLINE_S`, and by a scan without any view.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import msgspec
import numpy as np

from msgs.values.diagnostics import NodeStatus, StageTime
from msgs.values.lidar import LidarSetup
from msgs.values.perception import BevFrame, HiddenObject
from msgs.values.radar import RadarSetup
from msgs.values.units import ns_from_s, s_from_ns

#: One scan period of the default radar: a view that takes longer is overtaken by the next.
DEADLINE_S = 0.3
#: Length of the recent window.
WINDOW_S = 10.0
#: Before any heartbeat tells since when the graph runs, it is taken to run this much longer than it is watched.
UNHEARD_NS = ns_from_s(60.0)


#: Set-up of a sensor.
Setup = RadarSetup | LidarSetup


def scan_period_s(setup: Setup) -> float:
    """Return the time from one scan to the next."""
    return setup.radar.scan_period_s if isinstance(setup, RadarSetup) else setup.period_s


def last_beam_ns(setup: Setup | None = None) -> int:
    """Return the time from the start of a scan to the nominal end of its last beam or azimuth; None: default radar."""
    setup = setup or RadarSetup()
    if isinstance(setup, LidarSetup):
        return ns_from_s(setup.grid.azimuth_bins * setup.spad.measurement_time_s)
    return (len(setup.beams) - 1) * setup.beam_interval_ns + ns_from_s(setup.radar.beam_duration_s)


def latency_ns(stamp_ns: int, now_ns: int, setup: Setup | None = None) -> int:
    """Return time since the nominal end of the last beam of the scan that began at `stamp_ns`."""
    return now_ns - stamp_ns - last_beam_ns(setup)


def on_one_clock(stamp_ns: int, now_ns: int, since_ns: int = 0) -> bool:
    """Return whether a graph that runs since `since_ns` can have measured at `stamp_ns` on the clock of `now_ns`."""
    return since_ns <= stamp_ns <= now_ns


class GraphStart:
    """Since when a graph runs, by the heartbeats of its nodes.

    A stamp within that time has an age, however long; an earlier one is of a capture that is played back.
    """

    def __init__(self, start_ns: int) -> None:
        self.since_ns = start_ns - UNHEARD_NS
        self._is_heard = False

    def hear(self, status: NodeStatus, now_ns: int) -> None:
        """Take in a heartbeat that arrived at `now_ns`; the node's own clock may be another host's."""
        if not status.uptime_s > 0.0:
            # a node of other people need not say it
            return
        started_ns = now_ns - ns_from_s(status.uptime_s)
        self.since_ns = min(self.since_ns, started_ns) if self._is_heard else started_ns
        self._is_heard = True


class NewObjects:
    """Picks from successive views the objects that were measured anew; of views that share beams, once a sweep."""

    def __init__(self) -> None:
        self._settled_ns: int | None = None

    def of(self, frame: BevFrame) -> list[HiddenObject]:
        """Return the objects of a view whose beams no earlier view has settled, and that it settles itself."""
        after_ns, self._settled_ns = self._settled_ns, frame.settled_stamp_ns
        if frame.settled_stamp_ns is None or after_ns is None:
            return list(frame.objects)
        return [item for item in frame.objects if after_ns < item.stamp_ns <= frame.settled_stamp_ns]


class StageFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Durations of one stage over several heartbeats; quantiles None if no heartbeat carried samples."""

    name: str
    count: int
    mean_ms: float
    p50_ms: float | None
    p99_ms: float | None
    max_ms: float


def stage_figures(stages: list[StageTime]) -> list[StageFigures]:
    """Return figures of each stage over all heartbeats of a node, in the order in which the stages first ran."""
    names = dict.fromkeys(stage.name for stage in stages)
    return [_stage(name, [stage for stage in stages if stage.name == name]) for name in names]


def _stage(name: str, stages: list[StageTime]) -> StageFigures:
    count = sum(stage.count for stage in stages)
    samples_ms = [ms for stage in stages for ms in stage.samples_ms]
    p50_ms, p99_ms = (float(value) for value in np.percentile(samples_ms, [50, 99])) if samples_ms else (None, None)
    return StageFigures(
        name=name,
        count=count,
        mean_ms=sum(stage.mean_ms * stage.count for stage in stages) / max(count, 1),
        p50_ms=p50_ms,
        p99_ms=p99_ms,
        max_ms=max(stage.max_ms for stage in stages),
    )


class ViewFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Views of the graph within the recent window, and since the watch began; None if nothing is known."""

    watched_s: float
    window_s: float
    deadline_s: float
    #: Time since the nominal end of the last beam of the newest view's scan.
    age_ms: float | None
    #: Views a second.
    rate_hz: float
    latency_p50_ms: float | None
    latency_p99_ms: float | None
    latency_max_ms: float | None
    views: int
    views_total: int
    #: Views that came after the deadline, and scans without any view, between the first and the newest.
    late: int
    late_total: int
    absent: int
    absent_total: int
    #: Deadlines passed since the newest view, by the radar's nominal rate; 0 while views are in time.
    overdue: int

    @property
    def misses(self) -> int:
        """Deadlines missed in the window."""
        return self.late + self.absent

    @property
    def misses_total(self) -> int:
        """Deadlines missed since the watch began."""
        return self.late_total + self.absent_total


def views_text(views: ViewFigures) -> str:
    """Return one line for people: age, rate, latency, deadlines missed in the window and in total."""
    if views.views_total == 0:
        return "no view yet"
    parts = [
        "age of the view unknown" if views.age_ms is None else f"view {views.age_ms:.0f} ms after its last beam",
        f"{views.rate_hz:.1f} views/s",
    ]
    if views.latency_p50_ms is not None and views.latency_p99_ms is not None:
        parts.append(f"last beam to view {views.latency_p50_ms:.0f} ms, p99 {views.latency_p99_ms:.0f} ms")
    parts.append(
        f"deadline {views.deadline_s:g} s missed {views.misses}x in {views.window_s:.0f} s "
        f"({views.late} late, {views.absent} without view), {views.misses_total}x in {views.watched_s:.0f} s"
    )
    if views.overdue:
        parts.append(f"{views.overdue} overdue")
    return "; ".join(parts)


class _View(NamedTuple):
    at_ns: int
    scan_id: int
    stamp_ns: int
    #: None if the stamp is of another clock.
    latency_ns: int | None
    #: Scans without a view between the view before and this one.
    absent: int


class ViewWatch:
    """Counts views as they arrive. Belongs to one thread."""

    def __init__(self, start_ns: int, window_s: float = WINDOW_S, deadline_s: float = DEADLINE_S) -> None:
        self._start_ns, self._window_s, self._deadline_s = start_ns, window_s, deadline_s
        self._setup: Setup = RadarSetup()
        self._graph = GraphStart(start_ns)
        self._views: deque[_View] = deque()
        self._newest: _View | None = None
        self._total = self._late_total = self._absent_total = 0

    def set_up(self, setup: Setup) -> None:
        """Set beams and their time on air from now on."""
        self._setup = setup

    @property
    def since_ns(self) -> int:
        """Since when the graph runs, as far as known: earlier stamps are of another clock."""
        return self._graph.since_ns

    def hear(self, status: NodeStatus, now_ns: int) -> None:
        """Take in a heartbeat of a node."""
        self._graph.hear(status, now_ns)

    def add(self, scan_id: int, stamp_ns: int, now_ns: int) -> bool:
        """Add the view of a scan that began at `stamp_ns`; return true if it came after the deadline."""
        is_ours = on_one_clock(stamp_ns, now_ns, self.since_ns)
        latency = latency_ns(stamp_ns, now_ns, self._setup) if is_ours else None
        view = _View(now_ns, scan_id, stamp_ns, latency, self._absent_before(scan_id, stamp_ns))
        self._newest = view
        self._views.append(view)
        self._total += 1
        self._late_total += self._is_late(view)
        self._absent_total += view.absent
        self._forget(now_ns)
        return self._is_late(view)

    def figures(self, now_ns: int) -> ViewFigures:
        """Return the current figures."""
        self._forget(now_ns)
        watched_s = s_from_ns(now_ns - self._start_ns)
        latencies_ms = [1e-6 * view.latency_ns for view in self._views if view.latency_ns is not None]
        quantiles = np.percentile(latencies_ms, [50, 99, 100]) if latencies_ms else [None] * 3
        p50_ms, p99_ms, max_ms = (None if value is None else float(value) for value in quantiles)
        age_ns = self._age_ns(now_ns)
        return ViewFigures(
            watched_s=watched_s,
            window_s=min(self._window_s, watched_s),
            deadline_s=self._deadline_s,
            age_ms=None if age_ns is None else 1e-6 * age_ns,
            rate_hz=len(self._views) / max(min(self._window_s, watched_s), 1e-3),
            latency_p50_ms=p50_ms,
            latency_p99_ms=p99_ms,
            latency_max_ms=max_ms,
            views=len(self._views),
            views_total=self._total,
            late=sum(self._is_late(view) for view in self._views),
            late_total=self._late_total,
            absent=sum(view.absent for view in self._views),
            absent_total=self._absent_total,
            overdue=self._overdue(age_ns),
        )

    def _is_late(self, view: _View) -> bool:
        return view.latency_ns is not None and view.latency_ns > ns_from_s(self._deadline_s)

    def _age_ns(self, now_ns: int) -> int | None:
        if self._newest is None or self._newest.latency_ns is None:
            return None
        return latency_ns(self._newest.stamp_ns, now_ns, self._setup)

    def _overdue(self, age_ns: int | None) -> int:
        """Return the missed deadlines: the scan after the newest view's ends a period later, and so on."""
        period_ns = ns_from_s(scan_period_s(self._setup))
        return 0 if age_ns is None else max(0, (age_ns - ns_from_s(self._deadline_s) - 1) // period_ns)

    def _absent_before(self, scan_id: int, stamp_ns: int) -> int:
        """Return scans skipped since the newest view, by number and by time: a restarted source skips none."""
        if self._newest is None:
            return 0
        elapsed_ns = stamp_ns - self._newest.stamp_ns
        by_time = round(elapsed_ns / ns_from_s(scan_period_s(self._setup))) - 1
        return max(0, min(scan_id - self._newest.scan_id - 1, by_time))

    def _forget(self, now_ns: int) -> None:
        while self._views and self._views[0].at_ns < now_ns - ns_from_s(self._window_s):
            self._views.popleft()
