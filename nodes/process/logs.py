"""Output of a process: one line for people, one JSON object for machines, one record on the topic `log`."""

from __future__ import annotations

import contextlib
import json
import logging
import logging.handlers
import os
import time
from collections import deque
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msgs.values.diagnostics import LogRecord
from msgs.values.wording import as_utf8, counted

#: First character of a line that is a JSON record (RFC 7464); all other lines of a child are plain text.
RECORD_SEPARATOR = "\x1e"
#: Text of a record on the bus; the topic's byte limit leaves room for this many characters of any script.
BUS_TEXT_LIMIT = 8000
#: Maximum records that wait for the loop; older ones are dropped from the bus, never from the file.
PENDING_LIMIT = 256
_FILE_BYTES = 8 << 20
_FILES_KEPT = 3
#: Maximum output of a process, on average and at once; a terminal and a disk are for people, not for floods.
LINES_PER_S = 200
LINES_AT_ONCE = 2000
_LEVELS = ("debug", "info", "warning", "error", "critical")


def utc_now() -> str:
    """Return wall-clock time for people, ISO 8601; intervals are measured on the monotonic clock instead."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class SeparatedJsonFormatter(logging.Formatter):
    """A log record as one JSON object: time, node, level, text and, where there is one, the traceback.

    A record separator before it tells a supervisor that it is no text that a library wrote to the same stream.
    """

    def __init__(self, node: str) -> None:
        super().__init__()
        self._node = node

    def format(self, record: logging.LogRecord) -> str:
        """Return one line; line ends inside the text are escaped by JSON."""
        entry = {"time": utc_now(), "node": self._node, "level": record.levelname.lower(), "text": record.getMessage()}
        if state := getattr(record, "state", None):
            entry["state"] = state
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return RECORD_SEPARATOR + json.dumps(entry)


def of_thread(node: str) -> Callable[[logging.LogRecord], bool]:
    """Return a filter that lets records of the thread that is named like `node` pass."""
    return lambda record: record.threadName == node


class BusLogHandler(logging.Handler):
    """Keeps log records, from whatever thread, until the node's loop publishes them."""

    def __init__(self, node: str) -> None:
        super().__init__()
        self._node = node
        self._pending: deque[LogRecord] = deque(maxlen=PENDING_LIMIT)

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the record; the loop owns the bus, so nothing is sent from here.

        A text in `extra={"in_public": ...}` replaces the message: recordings and other machines receive this topic.
        """
        text = str(getattr(record, "in_public", None) or record.getMessage())
        self._pending.append(
            LogRecord(
                stamp_ns=time.monotonic_ns(),
                node=self._node,
                level=record.levelname.lower(),
                text=as_utf8(text[:BUS_TEXT_LIMIT]),
            )
        )

    def drain(self) -> list[LogRecord]:
        """Return all waiting records, oldest first."""
        return [self._pending.popleft() for _ in range(len(self._pending))]


class JsonLog:
    """The JSON lines of a run, bounded in size: the newest `_FILES_KEPT + 1` files of `_FILE_BYTES` are kept.

    Readable by its owner alone: it holds the viewer's address. `lost` counts lines for which there was no space.
    """

    def __init__(self, path: Path) -> None:
        self.lost = 0
        self._handler = _PrivateFileHandler(
            path, maxBytes=_FILE_BYTES, backupCount=_FILES_KEPT, encoding="utf-8", delay=True
        )
        # A full disk must not stop the graph, nor fill the terminal with tracebacks: the line is lost.
        self._handler.handleError = self._count  # type: ignore[method-assign]

    def write(self, entry: dict[str, Any]) -> None:
        """Append one entry."""
        self._handler.emit(logging.LogRecord("run", logging.INFO, "", 0, json.dumps(entry), None, None))

    def close(self) -> None:
        """Flush and close the file."""
        with contextlib.suppress(OSError):
            self._handler.close()

    def _count(self, record: logging.LogRecord) -> None:
        self.lost += 1


class _PrivateFileHandler(logging.handlers.RotatingFileHandler):
    """Files that nobody but their owner may read."""

    def _open(self) -> Any:
        return open(self.baseFilename, self.mode, encoding=self.encoding, opener=_open_private)


def _open_private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


class LineSplitter:
    """Bytes of a pipe to lines; a line without end is cut at `limit` bytes, and a flood of lines is dropped.

    Of a flood `LINES_AT_ONCE` pass and then `LINES_PER_S` by `clock`; a line of its own reports the dropped ones.
    Lines that report a state to the supervisor always pass.
    """

    def __init__(self, limit: int = 1 << 16, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit, self._clock = limit, clock
        self._rest = b""
        self._left_out = 0
        self._allowed, self._allowed_at_s = float(LINES_AT_ONCE), clock()

    def feed(self, data: bytes) -> list[str]:
        """Return whole lines so far, without their ends."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        while len(self._rest) >= self._limit:
            lines.append(self._rest[: self._limit])
            self._rest = self._rest[self._limit :]
        now_s = self._clock()
        self._allowed = min(self._allowed + LINES_PER_S * (now_s - self._allowed_at_s), LINES_AT_ONCE)
        self._allowed_at_s = now_s
        return [text for line in lines for text in self._passed(line)]

    def finish(self) -> list[str]:
        """Return the rest when the pipe has closed."""
        lines, self._rest = ([_printable(self._rest)] if self._rest else []), b""
        return self._say_left_out() + lines

    def _passed(self, line: bytes) -> list[str]:
        if line.startswith(RECORD_SEPARATOR.encode()) and b'"state"' in line:
            return [_printable(line)]
        if self._allowed < 1.0:
            self._left_out += 1
            return []
        self._allowed -= 1.0
        return [*self._say_left_out(), _printable(line)]

    def _say_left_out(self) -> list[str]:
        count, self._left_out = self._left_out, 0
        return [f"({counted(count, 'line')} left out: more than {LINES_PER_S} a second)"] if count else []


def _printable(line: bytes) -> str:
    return printable(line.decode("utf-8", "replace").rstrip("\r"), "\t" + RECORD_SEPARATOR)


def printable(text: str, kept: str = "\t\n") -> str:
    """Return text without control characters but `kept`: a child's output must not move the terminal's cursor."""
    return text if text.isprintable() else "".join(mark for mark in text if mark.isprintable() or mark in kept)


def parse_line(node: str, line: str, members: Collection[str] = ()) -> dict[str, Any]:
    """Return a line of a child as a log entry: its own record if it is one, else its text at level "output".

    An entry has time, node, level and text, and state and traceback where the record has them. Its node is `node`, or
    the one of `members` that the record names: never another's.
    """
    entry = _record(line) if line.startswith(RECORD_SEPARATOR) else None
    if entry is None:
        return {"time": utc_now(), "node": node, "level": "output", "text": line.replace(RECORD_SEPARATOR, "")}
    level, name = entry.get("level"), entry.get("node")
    more = {key: printable(entry[key]) for key in ("state", "traceback") if isinstance(entry.get(key), str)}
    return {
        "time": utc_now(),
        "node": name if isinstance(name, str) and name in members else node,
        "level": level if level in _LEVELS else "output",
        # one that begins on a new line could imitate another node's
        "text": printable(entry["text"]).replace("\n", "\n    "),
        **more,
    }


def _record(line: str) -> dict[str, Any] | None:
    """Return the record in a line, None where it is none."""
    try:
        entry = json.loads(line[1:])
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) and isinstance(entry.get("text"), str) else None


def install_handlers(handlers: list[logging.Handler], level: int = logging.INFO) -> Callable[[], None]:
    """Put `handlers` on the root logger; the returned function removes them again."""
    root = logging.getLogger()
    previous = root.level
    root.setLevel(level)
    for handler in handlers:
        root.addHandler(handler)

    def remove() -> None:
        root.setLevel(previous)
        for handler in handlers:
            root.removeHandler(handler)

    return remove
