"""CAN logs of other tools, frame by frame, in bounded memory whatever their contents or compression."""

from __future__ import annotations

import gzip
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can

from msgs.values.units import ns_from_s
from msgs.values.wording import counted
from nodes.can.bus import LogFrame, frame_stamp_ns

#: Maximum characters of a line; one with a frame of CAN FD has some hundred.
MAX_LINE = 1 << 16
#: Maximum bytes of an object in a BLF, usually a compressed container: tools write some 128 KiB.
MAX_OBJECT_BYTES = 1 << 20

_KINDS = {
    ".log": can.CanutilsLogReader,
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".csv": can.CSVReader,
    ".trc": can.TRCReader,
}


def read_log(path: Path, channel: str | None = None) -> Iterator[LogFrame]:
    """Yield frames of a candump (.log), ASC, BLF, CSV or TRC log (also gzipped), of one channel if one is named.

    Raises `ValueError` naming the file and the frame that cannot be read; `OSError` if it cannot be opened.
    """
    is_packed = path.suffix.lower() == ".gz"
    kind = Path(path.stem if is_packed else path).suffix.lower()
    if kind not in _KINDS:
        raise ValueError(f"{path}: a CAN log must be one of {', '.join(_KINDS)}, gzipped or not, got {kind!r}")
    count = 0
    stamp_ns = 0
    with path.open("rb") as stored, gzip.open(stored) if is_packed else stored as content:
        try:
            for frame in (reader := _reader(kind, content)):
                count += 1
                stamp_ns = _log_stamp_ns(reader, frame, stamp_ns)
                if channel is None or str(frame.channel) == channel:
                    yield LogFrame(frame, stamp_ns)
        except Exception as error:  # noqa: BLE001 - readers of foreign formats fail in whatever way the damage makes them
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ValueError(f"{path}: cannot be read after {counted(count, 'frame')}: {reason}") from None


def _reader(kind: str, content: Any) -> Any:
    if kind == ".blf":
        return _BoundedContainers(_BoundedReads(content))
    # ASC is read as seconds since the first frame by default; all others keep the time of day
    options = {"relative_timestamp": False} if kind == ".asc" else {}
    return _KINDS[kind](_BoundedLines(content, encoding="utf-8"), **options)


def _log_stamp_ns(reader: Any, frame: can.Message, last_ns: int) -> int:
    """Return a frame's stamp; an ASC log with "relative" in its header counts each stamp from the frame before."""
    if getattr(reader, "timestamps_format", None) != "relative" or not math.isfinite(frame.timestamp):
        return frame_stamp_ns(frame)
    start_ns = ns_from_s(reader.start_time)
    return (last_ns or start_ns) + frame_stamp_ns(frame) - start_ns


class _BoundedLines(io.TextIOWrapper):
    """Text whose lines have at most `MAX_LINE` characters."""

    def __next__(self) -> str:  # type: ignore[override]
        line = self.readline(MAX_LINE + 1)
        if len(line) > MAX_LINE:
            raise ValueError(f"a line must be of at most {MAX_LINE} characters")
        if not line:
            raise StopIteration
        return line


class _BoundedReads(io.BufferedReader):
    """Bytes of which at most `MAX_OBJECT_BYTES` are taken at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or not 0 <= size <= MAX_OBJECT_BYTES:
            raise ValueError(f"an object must be of 0 to {MAX_OBJECT_BYTES} bytes, got {size}")
        return super().read(size)


class _BoundedContainers(can.BLFReader):
    """Frames of a BLF whose objects are never collected from more containers than one such object takes."""

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        yield from super()._parse_container(data)
        if len(self._tail) > MAX_OBJECT_BYTES:
            raise ValueError(f"an object must be of at most {MAX_OBJECT_BYTES} bytes, {len(self._tail)} so far")
