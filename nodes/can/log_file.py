"""CAN logs of other tools, frame by frame, in bounded memory whatever their contents or compression."""

from __future__ import annotations

import gzip
import io
import logging
import math
import re
import struct
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

import can

from models.vehicle.can_decoder import RESTART_NS
from msgs.files.text_files import AS_CP1252, text_encoding
from msgs.files.unpacking import Budget, UnpackedFile, unpack
from msgs.recording.clock_steps import Bridged
from msgs.values.units import ns_from_s
from msgs.values.wording import counted
from nodes.can.asc_header import plain_asc
from nodes.can.bus import LogFrame, frame_stamp_ns

_LOG = logging.getLogger(__name__)

#: Maximum characters of a line; one with a frame of CAN FD has some hundred.
MAX_LINE = 1 << 16
#: Maximum bytes of an object in a BLF, usually a compressed container, and of one unpacked: tools write some 128 KiB.
MAX_OBJECT_BYTES, MAX_CONTAINER_BYTES = 1 << 20, 1 << 22
#: Channels that a refusal lists.
_MAX_LISTED = 16
#: Frames in a row whose stamps are off, at most: seconds of a slow bus.
_LOOK_AHEAD = 256

_KINDS = {
    ".log": can.CanutilsLogReader,
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".csv": can.CSVReader,
    ".trc": can.TRCReader,
}
#: Their channels are numbers from 1, which python-can counts from 0.
_COUNTED_FROM_1 = (".asc", ".blf")
#: Object of a BLF: signature, size of its head, version, size, type. A container's data begin with its compression.
_OBJECT_HEAD, _CONTAINER_HEAD = struct.Struct("<4sHHLL"), struct.Struct("<H6xL4x")
_CONTAINER, _ZLIB = 10, 2
#: Head of an object that says to be shorter than itself: python-can would read it for ever.
_NO_OBJECT = re.compile(rb"LOBJ.{4}[\x00-\x0f]\x00{3}", re.DOTALL)


def read_log(path: Path, channel: str | None = None) -> Iterator[LogFrame]:
    """Yield frames of a candump (.log), ASC, BLF, CSV or TRC log (also gzipped), of one channel if one is named.

    Channels are named as in the file and its tools: ASC and BLF count from 1. Raises `ValueError` naming the file and
    the frame that cannot be read, or the channels that there are in place of the one named; `OSError` if the file
    cannot be opened.
    """
    is_packed = path.suffix.lower() == ".gz"
    kind = Path(path.stem if is_packed else path).suffix.lower()
    if kind not in _KINDS:
        raise ValueError(f"{path}: a CAN log must be one of {', '.join(_KINDS)}, gzipped or not, got {kind!r}")
    count = stamp_ns = 0
    is_found = channel is None
    channels: dict[str, None] = {}
    with path.open("rb") as stored, _unpacked(stored) if is_packed else stored as content:
        try:
            for frame in (reader := _reader(kind, content)):
                count += 1
                stamp_ns = _log_stamp_ns(reader, frame, stamp_ns)
                if kind in _COUNTED_FROM_1 and isinstance(frame.channel, int):
                    frame.channel += 1
                if len(channels) < _MAX_LISTED:
                    channels[str(frame.channel)] = None
                if channel is None or str(frame.channel) == channel:
                    is_found = True
                    yield LogFrame(frame, stamp_ns)
        except Exception as error:  # noqa: BLE001 - readers of foreign formats fail in whatever way the damage makes them
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ValueError(f"{path}: cannot be read after {counted(count, 'frame')}: {reason}") from None
    if channel is None and len(channels) > 1:
        _LOG.warning("%s: frames of channels %s are read as one bus", path, ", ".join(channels))
    elif count and not is_found:
        listed = f"its channels are {', '.join(channels)}" if channels.keys() != {"None"} else "it names no channels"
        raise ValueError(f"{path}: holds no frames of channel {channel}; {listed}")


def _unpacked(stored: BinaryIO) -> BinaryIO:
    return io.BufferedReader(UnpackedFile(gzip.GzipFile(fileobj=stored), stored))


def _reader(kind: str, content: BinaryIO) -> Any:
    if kind == ".blf":
        return _BoundedContainers(_BoundedReads(cast("io.RawIOBase", content)))
    # ASC is read as seconds since the first frame by default; all others keep the time of day
    options = {"relative_timestamp": False} if kind == ".asc" else {}
    buffered = content if isinstance(content, io.BufferedReader) else io.BufferedReader(cast("io.RawIOBase", content))
    return _KINDS[kind](_BoundedLines(buffered, kind), **options)


def _log_stamp_ns(reader: Any, frame: can.Message, last_ns: int) -> int:
    """Return a frame's stamp; an ASC log with "relative" in its header counts each stamp from the frame before."""
    if getattr(reader, "timestamps_format", None) != "relative" or not math.isfinite(frame.timestamp):
        return frame_stamp_ns(frame)
    start_ns = ns_from_s(reader.start_time)
    return (last_ns or start_ns) + frame_stamp_ns(frame) - start_ns


def on_one_clock(frames: Iterable[LogFrame]) -> Generator[LogFrame, None, None]:
    """Yield the frames of a log without steps of the logger's clock; those without a time as they are."""
    timed = Bridged(frames, _stamp_of, "the log's clock", noun="frame", late_ns=RESTART_NS, look_ahead=_LOOK_AHEAD)
    try:
        for frame, time_ns in timed:
            yield frame if frame.stamp_ns < 0 else frame._replace(stamp_ns=time_ns)
    finally:
        timed.close()


def _stamp_of(frame: LogFrame) -> int | None:
    return frame.stamp_ns if frame.stamp_ns >= 0 else None


class _BoundedLines(io.TextIOWrapper):
    """Text whose lines have at most `MAX_LINE` characters, in the spelling that python-can reads."""

    def __init__(self, content: io.BufferedReader, kind: str) -> None:
        super().__init__(content, encoding=text_encoding(content.peek(4)[:4]), errors=AS_CP1252)
        lines: Iterable[str] = iter(self._line, "")
        self._lines = iter(plain_asc(lines) if kind == ".asc" else _plain_trc(lines) if kind == ".trc" else lines)

    def __next__(self) -> str:  # type: ignore[override]
        return next(self._lines)

    def _line(self) -> str:
        line = self.readline(MAX_LINE + 1)
        if len(line) > MAX_LINE:
            raise ValueError(f"a line must be of at most {MAX_LINE} characters")
        return line


def _plain_trc(lines: Iterable[str]) -> Iterator[str]:
    """Yield lines of a TRC log; its start is a number of days, with a comma where the machine writes numbers so."""
    for line in lines:
        yield line.replace(",", ".") if line.startswith(";$STARTTIME") else line


class _BoundedReads(io.BufferedReader):
    """Bytes of which at most `MAX_OBJECT_BYTES` are taken at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or not 0 <= size <= MAX_OBJECT_BYTES:
            raise ValueError(f"an object must be of 0 to {MAX_OBJECT_BYTES} bytes, got {size}")
        return super().read(size)


class _BoundedContainers(can.BLFReader):
    """Frames of a BLF: its containers unpack to so much and no more, and an object never takes more of them than one.

    python-can unpacks a container whatever it becomes, and takes one that the file cuts off for its end.
    """

    def __iter__(self) -> Iterator[can.Message]:  # type: ignore[override]
        budget, read = Budget(), 0
        while head := self.file.read(_OBJECT_HEAD.size):
            signature, _, _, size, kind = _OBJECT_HEAD.unpack(head)
            if signature != b"LOBJ":
                raise ValueError("object must begin with LOBJ")
            data = self.file.read(size - _OBJECT_HEAD.size)
            if len(data) < size - _OBJECT_HEAD.size:
                raise ValueError(f"ends within an object of {size} bytes")
            self.file.read(size % 4)
            read += size
            if kind == _CONTAINER:
                method = {0: "", _ZLIB: "zlib"}[_CONTAINER_HEAD.unpack_from(data)[0]]
                content = unpack(data[_CONTAINER_HEAD.size :], method, MAX_CONTAINER_BYTES)
                if len(content) > MAX_CONTAINER_BYTES:
                    raise ValueError(f"a container must unpack to at most {MAX_CONTAINER_BYTES} bytes")
                budget.spend(len(content), read)
                yield from self._parse_container(content)

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        if _NO_OBJECT.search(self._tail + data):
            raise ValueError(f"an object must be of at least {_OBJECT_HEAD.size} bytes")
        yield from super()._parse_container(data)
        if len(self._tail) > MAX_OBJECT_BYTES:
            raise ValueError(f"an object must be of at most {MAX_OBJECT_BYTES} bytes, {len(self._tail)} so far")
