"""Views of several radars in groups about one time: the next of each, however late one of them is."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec

from models.perception.track.view_fusion import RadarView
from msgs.values.perception import BevFrame
from msgs.values.units import ns_from_s, s_from_ns

#: The others wait so long for the view of a radar, and no longer for a radar that has been silent for so long, or for
#: some of its own intervals.
WAIT_NS, SILENT_NS = ns_from_s(0.25), ns_from_s(1.0)
_INTERVALS = 3
#: Clocks of two radars differ where views of one come so much later after their stamps than those of the other, and two
#: of its intervals later: a recording may be played slowly.
CLOCKS_DIFFER_NS = ns_from_s(0.5)
#: By the quickest of so many views of each.
_LAGS = 8


@dataclass
class _Radar:
    """State of one radar."""

    waiting: list[tuple[RadarView, int]] = field(default_factory=list)
    heard_ns: int | None = None
    interval_ns: int = 0
    #: Times from the stamps of the last views to their arrival.
    lags_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_LAGS))

    @property
    def lag_ns(self) -> int | None:
        """The least of them: what a busy machine adds is not the clock's."""
        return min(self.lags_ns, default=None)

    def is_silent(self, now_ns: int, since_ns: int) -> bool:
        heard_ns = since_ns if self.heard_ns is None else self.heard_ns
        return now_ns - heard_ns > max(SILENT_NS, _INTERVALS * self.interval_ns)


class ViewGroups:
    """Groups the views of radars by their names; a view that comes after its group is left out and counted."""

    def __init__(self, names: Sequence[str]) -> None:
        self._radars = {name: _Radar() for name in names}
        self._since_ns: int | None = None
        self._state_lag_ns: int | None = None
        self._last_ns: int | None = None
        #: Views that came after their group, and of radars that sent two while the others sent one.
        self.left_out = 0

    def hear_state(self, stamp_ns: int, sent_ns: int) -> None:
        """Note when a state of the vehicle was measured and when it came: by its clock radars are judged."""
        lag_ns = sent_ns - stamp_ns
        self._state_lag_ns = lag_ns if self._state_lag_ns is None else min(self._state_lag_ns, lag_ns)

    def add(self, name: str, view: RadarView, sent_ns: int, now_ns: int) -> None:
        """Take in the view of a radar, which was sent at a time of the bus clock."""
        radar = self._radars[name]
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        radar.interval_ns = 0 if radar.heard_ns is None else now_ns - radar.heard_ns
        radar.heard_ns = now_ns
        radar.lags_ns.append(sent_ns - view.frame.stamp_ns)
        radar.waiting.append((view, now_ns))

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the wait for the missing ones is over; None where nothing waits."""
        came_ns = [radar.waiting[0][1] for radar in self._radars.values() if radar.waiting]
        return min(came_ns) + WAIT_NS if came_ns else None

    def take(self, now_ns: int) -> tuple[list[RadarView], bool] | None:
        """Return the next group in the order of the names, and whether it is whole; None while one is waited for."""
        due_ns, since_ns = self.due_ns(now_ns), self._since_ns
        if due_ns is None or since_ns is None:
            return None
        awaited = [radar for radar in self._radars.values() if not radar.is_silent(now_ns, since_ns)]
        if now_ns < due_ns and not all(radar.waiting for radar in awaited):
            return None
        group = [
            _moved(radar.waiting[-1][0], self._clock_offset_ns(name))
            for name, radar in self._radars.items()
            if radar.waiting
        ]
        self.left_out += sum(max(0, len(radar.waiting) - 1) for radar in self._radars.values())
        is_whole = all(radar.waiting or not radar.is_silent(now_ns, since_ns) for radar in self._radars.values())
        for radar in self._radars.values():
            radar.waiting.clear()
        stamp_ns = max(view.frame.stamp_ns for view in group)
        if len(group) < len(self._radars) and self._last_ns is not None and 0 <= self._last_ns - stamp_ns < SILENT_NS:
            self.left_out += len(group)
            return None
        self._last_ns = stamp_ns
        return group, is_whole

    def trouble(self, now_ns: int) -> str:
        """Return what is wrong with radars, in one line; empty while nothing is."""
        if self._since_ns is None:
            return ""
        lines = [self._trouble_of(name, now_ns, self._since_ns) for name in self._radars]
        return "; ".join(filter(None, lines))

    def _trouble_of(self, name: str, now_ns: int, since_ns: int) -> str:
        radar = self._radars[name]
        if radar.is_silent(now_ns, since_ns):
            return f"radar {name} is silent: the view is that of the others"
        if offset_ns := self._clock_offset_ns(name):
            where = "behind" if offset_ns > 0 else "ahead of"
            differs = f"its clock is {abs(s_from_ns(offset_ns)):.1f} s {where} that of the others"
            return f"radar {name}: {differs}, its views are taken by their arrival"
        return ""

    def _clock_offset_ns(self, name: str) -> int:
        """Return what is to be added to the stamps of a radar: 0 unless its clock differs from that of the others."""
        lags = {other: radar.lag_ns for other, radar in self._radars.items() if radar.lag_ns is not None}
        if name not in lags:
            return 0
        right = min(lags, key=self._doubt) if self._state_lag_ns is not None else next(iter(lags))
        offset_ns = (lags[name] or 0) - (lags[right] or 0)
        return offset_ns if abs(offset_ns) > max(CLOCKS_DIFFER_NS, 2 * self._radars[name].interval_ns) else 0

    def _doubt(self, name: str) -> tuple[bool, int]:
        """Return how much later than the vehicle's states the views of a radar come; none can come earlier."""
        later_ns = (self._radars[name].lag_ns or 0) - (self._state_lag_ns or 0)
        return later_ns < 0, abs(later_ns)


def _moved(view: RadarView, by_ns: int) -> RadarView:
    """Return a view as if it had been measured so much later."""
    frame: BevFrame = view.frame
    if not by_ns:
        return view
    objects = (
        msgspec.structs.replace(item, stamp_ns=item.stamp_ns + by_ns) if item.stamp_ns else item
        for item in frame.objects
    )
    return view._replace(frame=msgspec.structs.replace(frame, stamp_ns=frame.stamp_ns + by_ns, objects=tuple(objects)))
