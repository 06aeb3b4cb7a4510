"""What a process says: one line for people, one JSON object for machines, one record on the topic `log`."""

from __future__ import annotations

import json
import logging
import logging.handlers
import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msgs.diagnostics import LogRecord

#: First character of a line that is a JSON record (RFC 7464); all other lines of a child are plain text.
RECORD_SEPARATOR = "\x1e"
#: Text of a record on the bus; the topic's byte limit leaves room for this many characters of any script.
BUS_TEXT_LIMIT = 8000
#: Records that wait for the loop at most; older ones are dropped from the bus, never from the file.
PENDING_LIMIT = 256
_FILE_BYTES = 8 << 20
_FILES_KEPT = 3


def utc_now() -> str:
    """Wall-clock time for people, ISO 8601; intervals are measured on the monotonic clock instead."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class JsonFormatter(logging.Formatter):
    """A log record as one JSON object: time, node, level, text and, where there is one, the traceback."""

    def __init__(self, node: str) -> None:
        super().__init__()
        self._node = node

    def format(self, record: logging.LogRecord) -> str:
        """One line; line ends inside the text are escaped by JSON."""
        entry = {"time": utc_now(), "node": self._node, "level": record.levelname.lower(), "text": record.getMessage()}
        if state := getattr(record, "state", None):
            entry["state"] = state
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class SeparatedJsonFormatter(JsonFormatter):
    """The same, marked so that a supervisor tells it from text that a library wrote to the same stream."""

    def format(self, record: logging.LogRecord) -> str:
        """The JSON object behind a record separator."""
        return RECORD_SEPARATOR + super().format(record)


class BusLogHandler(logging.Handler):
    """Keeps log records, from whatever thread, until the node's loop publishes them."""

    def __init__(self, node: str) -> None:
        super().__init__()
        self._node = node
        self._pending: deque[LogRecord] = deque(maxlen=PENDING_LIMIT)

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the record; the loop owns the bus, so nothing is sent from here."""
        self._pending.append(
            LogRecord(
                stamp_ns=time.monotonic_ns(),
                node=self._node,
                level=record.levelname.lower(),
                text=record.getMessage()[:BUS_TEXT_LIMIT],
            )
        )

    def drain(self) -> list[LogRecord]:
        """All records that wait, oldest first."""
        return [self._pending.popleft() for _ in range(len(self._pending))]


class JsonLog:
    """The JSON lines of a run, bounded in size: the newest `_FILES_KEPT + 1` files of `_FILE_BYTES` are kept."""

    def __init__(self, path: Path) -> None:
        self._handler = logging.handlers.RotatingFileHandler(
            path, maxBytes=_FILE_BYTES, backupCount=_FILES_KEPT, encoding="utf-8"
        )
        # A full disk must not take the graph down, nor fill the terminal with tracebacks: the line is lost.
        self._handler.handleError = _ignore  # type: ignore[method-assign]

    def write(self, entry: dict[str, Any]) -> None:
        """Append one entry."""
        self._handler.emit(logging.LogRecord("run", logging.INFO, "", 0, json.dumps(entry), None, None))

    def close(self) -> None:
        """Flush and close the file."""
        self._handler.close()


def _ignore(record: logging.LogRecord) -> None:
    return None


class LineSplitter:
    """Bytes of a pipe to lines; a line without end is cut at `limit` bytes instead of growing."""

    def __init__(self, limit: int = 1 << 16) -> None:
        self._limit = limit
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        """Whole lines so far, without their ends."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        while len(self._rest) >= self._limit:
            lines.append(self._rest[: self._limit])
            self._rest = self._rest[self._limit :]
        return [_printable(line) for line in lines]

    def finish(self) -> list[str]:
        """What is left when the pipe has closed."""
        lines, self._rest = ([_printable(self._rest)] if self._rest else []), b""
        return lines


def _printable(line: bytes) -> str:
    """Text without control characters: a child's output must not move the cursor of the terminal."""
    text = line.decode("utf-8", "replace").rstrip("\r")
    return "".join(mark for mark in text if mark.isprintable() or mark in "\t" + RECORD_SEPARATOR)


def parse_line(node: str, line: str) -> dict[str, Any]:
    """A line of a child as a log entry: its own record if it is one, else its text at level "output"."""
    if line.startswith(RECORD_SEPARATOR):
        try:
            entry = json.loads(line[1:])
        except ValueError:
            entry = None
        if isinstance(entry, dict) and isinstance(entry.get("text"), str):
            return entry
    text = line.replace(RECORD_SEPARATOR, "")
    return {"time": utc_now(), "node": node, "level": "output", "text": text}


def install_handlers(handlers: list[logging.Handler], level: int = logging.INFO) -> Callable[[], None]:
    """Put `handlers` on the root logger; the call that comes back takes them off again."""
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
