"""Numbers over time, for the plots of a page: bounded however many come, and for however long."""

from __future__ import annotations

import math
import threading
from array import array
from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any

import numpy as np

from msgs.values.units import s_from_ns

#: Series at most; those that have been silent for longest make room for new ones.
MAX_SERIES = 512
#: Numbers taken of one message at most.
MAX_FIELDS = 256
#: Samples of a series at most, and those that are sent to a page: more than it has pixels.
MAX_SAMPLES, MAX_SENT = 4096, 2048
#: Samples of a group are at least this far apart: 20 a second, 200 s of a vehicle's states and 20 minutes of views.
LEAST_GAP_NS = 45_000_000
#: A series without samples for this long may be forgotten.
SILENT_S = 10.0


class _Series:
    """Samples of one field; NaN where it was missing."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.times_s, self.values = array("d"), array("d")

    def append(self, time_s: float, value: float) -> None:
        self.times_s.append(time_s)
        self.values.append(value)

    def end(self, time_s: float) -> None:
        """End the line."""
        if not math.isnan(self.values[-1]):
            self.append(time_s, math.nan)

    def shorten(self, keeps_all: bool) -> None:
        if len(self.values) <= MAX_SAMPLES:
            return
        if keeps_all:
            times_s, values = thinned(np.array(self.times_s), np.array(self.values))
            self.times_s, self.values = array("d", times_s), array("d", values)
        else:
            del self.times_s[: MAX_SAMPLES // 4], self.values[: MAX_SAMPLES // 4]


class SeriesStore:
    """Series by group (a topic or a node) and field. One thread takes, any may read.

    Full series forget their oldest samples; with `keeps_all`, for a recording, they keep the whole span with fewer.
    """

    def __init__(self, keeps_all: bool = False) -> None:
        self._keeps_all = keeps_all
        self._lock = threading.Lock()
        self._groups: dict[str, dict[str, _Series]] = {}
        self._taken_ns: dict[str, int] = {}
        self._start_ns: int | None = None
        self._zero_ns: int | None = None
        self._now_s = 0.0
        self._next = 1
        #: Counts changes of the list of fields, and samples.
        self.fields_version = self.version = 0

    def is_due(self, group: str, now_ns: int) -> bool:
        """Return whether a sample of a group is wanted: asked before its numbers are collected."""
        taken_ns = self._taken_ns.get(group)
        return taken_ns is None or now_ns - taken_ns >= LEAST_GAP_NS

    def take(self, group: str, fields: Iterable[tuple[str, float]], now_ns: int) -> None:
        """Add a sample of each field of a group; fields of it that are missing end their lines."""
        with self._lock:
            self._start_ns = now_ns if self._start_ns is None else self._start_ns
            self._taken_ns[group] = now_ns
            time_s = s_from_ns(now_ns - self._start_ns)
            self._now_s = max(self._now_s, time_s)
            known = self._groups.setdefault(group, {})
            taken = dict(islice(fields, MAX_FIELDS))
            for field in known.keys() - taken.keys():
                known[field].end(time_s)
            self._make_room(group, len(taken.keys() - known.keys()))
            for field, value in taken.items():
                series = known.get(field) or self._new_series(known, field)
                if series is not None:
                    series.append(time_s, value)
            for series in known.values():
                series.shorten(self._keeps_all)
            self.version += 1

    def advance(self, now_ns: int) -> None:
        """Let time pass without samples: the newest are then not of now."""
        if self._start_ns is not None:
            self._now_s = max(self._now_s, s_from_ns(now_ns - self._start_ns))
            self.version += 1

    def set_zero(self, zero_ns: int) -> None:
        """Set the time from which a page counts; without one it counts back from now."""
        self._zero_ns = zero_ns

    def fields_json(self) -> dict[str, Any]:
        """Return number, group and name of all series."""
        with self._lock:
            rows = [
                [item.number, group, field] for group, known in self._groups.items() for field, item in known.items()
            ]
        return {"type": "fields", "fields": rows}

    def series_json(self, numbers: Sequence[int]) -> dict[str, Any]:
        """Return samples of the series of these numbers, as far as there are such; None where a line is interrupted."""
        with self._lock:
            items = {item.number: item for known in self._groups.values() for item in known.values()}
            zero_s = self._zero_s()
            return {
                "type": "series",
                "now_s": round(self._now_s - zero_s, 3),
                "series": [_json_of(items[number], zero_s) for number in numbers if number in items],
            }

    def _zero_s(self) -> float:
        if self._zero_ns is None or self._start_ns is None:
            return self._now_s
        return s_from_ns(self._zero_ns - self._start_ns)

    def _new_series(self, known: dict[str, _Series], field: str) -> _Series | None:
        """Return an empty series; None where there is no room for one."""
        if self._count() >= MAX_SERIES:
            return None
        self.fields_version += 1
        series = known[field] = _Series(self._next)
        self._next += 1
        return series

    def _count(self) -> int:
        return sum(map(len, self._groups.values()))

    def _make_room(self, group: str, wanted: int) -> None:
        """Forget so many series that are silent, the longest silent first; `group` stays even if it is empty."""
        missing = self._count() + wanted - MAX_SERIES
        if missing <= 0:
            return
        last = [(item.times_s[-1], of, field) for of, known in self._groups.items() for field, item in known.items()]
        for _, of, field in sorted(entry for entry in last if self._is_silent(*entry))[:missing]:
            del self._groups[of][field]
            self.fields_version += 1
            if not self._groups[of] and of != group:
                del self._groups[of], self._taken_ns[of]

    def _is_silent(self, last_s: float, group: str, field: str) -> bool:
        is_interrupted = math.isnan(self._groups[group][field].values[-1])
        return is_interrupted or self._now_s - last_s > SILENT_S


def thinned(times_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return about half of the samples [N], two of each four in order of time: the largest, and the least or a NaN."""
    whole = len(values) - len(values) % 4
    fours = values[:whole].reshape(-1, 4)
    gaps, first = np.isnan(fours), np.arange(0, whole, 4)
    largest = np.where(gaps, -np.inf, fours).argmax(axis=1)
    # from the end: of samples that are all alike the first and the last are kept
    least = 3 - np.where(gaps, -np.inf, fours)[:, ::-1].argmin(axis=1)
    kept = np.unique(np.concatenate([first + largest, first + least, np.arange(whole, len(values))]))
    return times_s[kept], values[kept]


def _json_of(series: _Series, zero_s: float) -> dict[str, Any]:
    times_s, values = np.array(series.times_s) - zero_s, np.array(series.values)
    while len(values) > MAX_SENT:
        times_s, values = thinned(times_s, values)
    return {"id": series.number, "t": times_s.round(3).tolist(), "v": values.tolist()}
