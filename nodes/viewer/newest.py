"""The board between the graph and its viewers: the newest of each kind, rendered once, on request."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec

from nodes.viewer.series import SeriesStore

#: One websocket message: text (JSON) or a binary tile.
WireMessage = str | bytes
#: Kind of the posts whose messages each reader chooses.
SERIES = "series"
Render = Callable[[], tuple[WireMessage, ...]]


class Posted(NamedTuple):
    """A post of one kind on the board."""

    #: Counts up from 1 with every post of this kind.
    version: int
    #: `time.monotonic_ns` of the post.
    at_ns: int
    render: Render


class Board:
    """Newest post of each kind. A post costs no more than a swap; any thread may post and read.

    There is no queue: a late reader gets the newest, and sees from the version how many it missed. Beside it hang the
    `series` that plots are drawn from: a post of `SERIES` says that there are new samples, each reader asks for some.
    """

    def __init__(self, series: SeriesStore | None = None) -> None:
        self.series = series or SeriesStore()
        self._lock = threading.Lock()
        self._posted: dict[str, Posted] = {}
        self._fields_version = self._series_version = 0
        self._rendered: dict[str, tuple[int, tuple[WireMessage, ...]]] = {}
        #: Called after each post, from the posting thread.
        self.on_post: Callable[[], None] = _nobody

    def post(self, kind: str, render: Render) -> None:
        """Post the newest of `kind`; `render` is called later, at most once, from a reader's thread."""
        with self._lock:
            before = self._posted.get(kind)
            self._posted[kind] = Posted(before.version + 1 if before else 1, time.monotonic_ns(), render)
        self.on_post()

    def post_series(self) -> None:
        """Post that series have new samples, and their list where it changed."""
        if self.series.fields_version != self._fields_version:
            self._fields_version = self.series.fields_version
            self.post("fields", lambda: (json_text(self.series.fields_json()),))
        if self.series.version != self._series_version:
            self._series_version = self.series.version
            self.post(SERIES, lambda: ())

    def newer(self, versions: Mapping[str, int]) -> dict[str, Posted]:
        """Return the posts newer than a reader's `versions`, in the order of first posts."""
        with self._lock:
            return {kind: post for kind, post in self._posted.items() if post.version > versions.get(kind, 0)}

    def messages(self, kind: str, posted: Posted) -> tuple[WireMessage, ...]:
        """Return the post as websocket messages; rendered once for all readers. For the readers' one thread."""
        version, messages = self._rendered.get(kind, (0, ()))
        if version != posted.version:
            messages = posted.render()
            self._rendered[kind] = posted.version, messages
        return messages


def _nobody() -> None:
    """Do nothing: no reader is connected."""


def json_text(value: Any) -> str:
    """Return compact JSON; numbers that JSON lacks become null."""
    return msgspec.json.encode(value).decode()
