"""Steps of the clock that a stream was stamped with: recognised, said, and taken out of its time.

What follows a step comes a usual interval after what came before; where stamps return, those in between lie between
their neighbours.
"""

from __future__ import annotations

import logging
import statistics
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import Generic, TypeVar

from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.wording import counted

_LOG = logging.getLogger(__name__)

#: A stamp that is further ahead, and further than so many intervals, may be off.
_NEAR_NS, _NEAR_INTERVALS = NANOSECONDS_PER_SECOND // 10, 3
#: A longer gap is said, and a much longer one is a step of the clock; a slow stream may be silent for some intervals.
GAP_NS, SILENCE_NS, _INTERVALS = NANOSECONDS_PER_SECOND, 60 * NANOSECONDS_PER_SECOND, 10
#: Whoever waits for a gap this long wants to know why; and in a stream this dense, stamps cannot tell silence from a
#: clock that was set ahead.
_LONG_GAP_NS, _DENSE_INTERVALS = 10 * NANOSECONDS_PER_SECOND, 100
#: Intervals of which the median is the usual one.
_KEPT_INTERVALS = 31
#: Stamps in a row that are off, at most: more of them are a step.
LOOK_AHEAD = 8
#: Lines that are logged; the rest is counted in one at the end.
_MAX_LINES = 5
_YEAR_S = 365.25 * 86_400.0

Item = TypeVar("Item")


class Bridged(Generic[Item]):
    """Iterator over the items of a stream with their times, without steps of the clock: (item, time_ns).

    The time of the first item is its stamp. `stamp_ns` gives the stamp of an item, None where it has none: it then has
    the time of the item before. Items may come late by up to `late_ns`, whose time goes back. `whose` names the clock
    in the log, `noun` an item. An error of `items` is raised once all items before it have been given.
    """

    def __init__(
        self,
        items: Iterable[Item],
        stamp_ns: Callable[[Item], int | None],
        whose: str,
        *,
        noun: str = "message",
        late_ns: int = 0,
        look_ahead: int = LOOK_AHEAD,
    ) -> None:
        self._items, self._stamp_ns, self._whose, self._noun = iter(items), stamp_ns, whose, noun
        self._late_ns, self._look_ahead = late_ns, look_ahead
        #: Items that were read ahead, and the error that ended the stream.
        self._waiting: deque[Item] = deque()
        self._error: Exception | None = None
        #: Stamp and time of the newest item whose stamp is right, None before the first.
        self._last_ns: int | None = None
        self._time_ns = 0
        self._shift_ns = 0
        #: Times of the next items, whose stamps are off.
        self._given: deque[int] = deque()
        self._intervals_ns: deque[int] = deque(maxlen=_KEPT_INTERVALS)
        self._count = self._said = 0
        #: Lasting steps, items whose stamps were off, and gaps that were kept.
        self.steps = self.off = self.gaps = 0

    def __iter__(self) -> Iterator[tuple[Item, int]]:
        return self

    def __next__(self) -> tuple[Item, int]:
        if not self._waiting and not self._read():
            if self._said > _MAX_LINES:
                more = counted(self._said - _MAX_LINES, "more time", "more times")
                _LOG.warning("%s was set, off or silent %s", self._whose, more)
                self._said = 0
            if (error := self._error) is not None:
                self._error = None
                raise error
            raise StopIteration
        item = self._waiting.popleft()
        stamp_ns = self._stamp_ns(item)
        self._time_ns = self._time_of(stamp_ns) if stamp_ns is not None else self._time_ns
        self._count += 1
        return item, self._time_ns

    def close(self) -> None:
        """Close the stream, if it can be closed."""
        self._waiting.clear()
        if (close := getattr(self._items, "close", None)) is not None:
            close()

    def _read(self) -> bool:
        """Read one item ahead; return whether there was one."""
        if self._error is not None:
            return False
        try:
            self._waiting.append(next(self._items))
        except StopIteration:
            return False
        except (ValueError, OSError) as error:
            self._error = error
            return False
        return True

    def _time_of(self, stamp_ns: int) -> int:
        if self._given:
            return self._given.popleft()
        if self._last_ns is None:
            self._last_ns = stamp_ns
            return stamp_ns
        away_ns = stamp_ns - self._last_ns
        if self._fits(stamp_ns):
            self._keep(stamp_ns)
            return stamp_ns + self._shift_ns
        ahead_ns = self._stamps_ahead()
        returns = next((at for at, ahead in enumerate(ahead_ns) if self._returns(stamp_ns, ahead, at + 2)), None)
        if returns is not None:
            return self._put_between(away_ns, returns + 1, ahead_ns[returns])
        usual_ns = self._usual_ns([stamp_ns, *ahead_ns])
        # what stands alone at the end is not waited for
        is_last = not ahead_ns and bool(self._intervals_ns)
        longest_ns = max(GAP_NS if is_last else SILENCE_NS, _INTERVALS * usual_ns)
        if not 0 <= away_ns <= longest_ns:
            self.steps += 1
            self._say(logging.WARNING, f"was set by {amount(away_ns)}", "without that")
            self._shift_ns -= away_ns - usual_ns
            self._last_ns = stamp_ns
        elif away_ns > max(GAP_NS, _INTERVALS * usual_ns):
            self.gaps += 1
            is_odd = away_ns > min(_LONG_GAP_NS, _DENSE_INTERVALS * usual_ns)
            level = logging.WARNING if is_odd else logging.INFO
            self._say(level, f"has a gap of {s_from_ns(away_ns):.1f} s, or was set ahead,")
            self._last_ns = stamp_ns
        else:
            self._keep(stamp_ns)
        return stamp_ns + self._shift_ns

    def _keep(self, stamp_ns: int) -> None:
        """Note a stamp that is right, and its interval unless it is late."""
        assert self._last_ns is not None
        if stamp_ns > self._last_ns:
            self._intervals_ns.append(stamp_ns - self._last_ns)
            self._last_ns = stamp_ns

    def _fits(self, stamp_ns: int, intervals: int = 1) -> bool:
        """Return whether a stamp may follow the newest right one, so many intervals later."""
        assert self._last_ns is not None
        usual_ns = statistics.median_low(self._intervals_ns) if self._intervals_ns else 0
        near_ns = intervals * max(_NEAR_NS, _NEAR_INTERVALS * usual_ns)
        return -self._late_ns <= stamp_ns - self._last_ns <= near_ns

    def _returns(self, off_ns: int, stamp_ns: int, intervals: int) -> bool:
        """Return whether a stamp goes on where the stream was before one that is off."""
        assert self._last_ns is not None
        is_back = stamp_ns < off_ns if off_ns > self._last_ns else stamp_ns > off_ns
        return is_back and self._fits(stamp_ns, intervals)

    def _stamps_ahead(self) -> list[int]:
        """Read ahead; return the stamps of the items that come next."""
        while len(self._waiting) < self._look_ahead and self._read():
            pass
        return [stamp for item in self._waiting if (stamp := self._stamp_ns(item)) is not None]

    def _usual_ns(self, ahead_ns: list[int]) -> int:
        """Return the usual interval so far; where there was none, that of the items ahead."""
        following = [after - before for before, after in pairwise(ahead_ns) if after > before]
        known = self._intervals_ns or following
        return statistics.median_low(known) if known else 0

    def _put_between(self, away_ns: int, count: int, next_ns: int) -> int:
        """Give `count` items whose stamps are off times between those of their neighbours; return the first."""
        assert self._last_ns is not None
        self.off += count
        self._say(
            logging.WARNING, f"was off by {amount(away_ns)} for {counted(count, self._noun)}", "with their neighbours"
        )
        start_ns = self._last_ns + self._shift_ns
        span_ns = max(0, next_ns + self._shift_ns - start_ns)
        # the one that returns follows them, not a gap
        self._last_ns = next_ns
        self._given.extend(start_ns + span_ns * at // (count + 1) for at in range(1, count + 1))
        return self._given.popleft()

    def _say(self, level: int, what: str, how: str = "") -> None:
        self._said += 1
        if self._said <= _MAX_LINES:
            end = f"; it is played on {how}" if how else ""
            _LOG.log(level, "%s %s after %s%s", self._whose, what, counted(self._count, self._noun), end)


def amount(step_ns: int) -> str:
    """Return a step in words: "+6.0 s", "-100 s", "+1700000000 s (53.9 years)"."""
    step_s = s_from_ns(step_ns)
    years = f" ({abs(step_s) / _YEAR_S:.1f} years)" if abs(step_s) > _YEAR_S else ""
    digits = 0 if abs(step_s) >= 10.0 else 1 if abs(step_s) >= 0.1 else 3
    return f"{step_s:+.{digits}f} s{years}"
