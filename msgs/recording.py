"""Recordings: MCAP files, message encoding `msgpack`, one JSON Schema a topic, all checksums.

Times: `log_time` is when the message was sent (the bus clock), which orders a recording and paces its replay;
`publish_time` is the message's own `stamp_ns`, the time of acquisition. Each publisher of a topic has a channel of its
own, named in the channel's metadata.

A recording is written front to back and is readable at any moment: a process that is killed loses at most the chunk it
was filling. Readers therefore never need the index at the end; they walk the file's records by their lengths.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, NamedTuple, Self

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from msgs.codec import CodecError, decode_inline, encode_inline, json_schema
from msgs.topics import TOPICS, topic_facts
from msgs.units import NANOSECONDS_PER_SECOND, s_from_ns

CHUNK_BYTES = 1 << 20
#: Bus time after which an unfilled chunk is written all the same: what a killed recorder loses of slow topics.
FLUSH_INTERVAL_NS = NANOSECONDS_PER_SECOND
METADATA_NAME = "mirrorwave"
#: Just below the largest block that glibc may be taught to keep (32 MiB).
_LARGEST_HEAP_BLOCK = 31 << 20
_PUBLISHER_KEY = "publisher"
#: Larger records are damage: no chunk of ours comes near.
_MAX_RECORD_BYTES = 1 << 30
_MAX_U32 = (1 << 32) - 1
_MAX_U64 = (1 << 64) - 1
#: Opcode and length before each record.
_RECORD_HEAD = struct.Struct("<BQ")
#: First fields of a chunk: start, end, uncompressed size.
_CHUNK_HEAD = struct.Struct("<QQQ")
#: What reading a damaged record may raise.
_DAMAGE = (McapError, ValueError, struct.error, RuntimeError, MemoryError, zstandard.ZstdError)


class Recorded(NamedTuple):
    """A message of a recording."""

    topic: str
    message: msgspec.Struct
    publisher: str
    #: As sent, modulo 2^32.
    sequence: int
    #: When it was sent.
    log_time_ns: int


class TopicInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One topic of a recording."""

    topic: str
    type: str
    publishers: tuple[str, ...]
    messages: int
    bytes: int
    rate_hz: float
    #: False for topics that this program does not know: kept, never decoded.
    known: bool


class RecordingInfo(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording holds."""

    path: str
    size_bytes: int
    start_ns: int
    duration_s: float
    topics: tuple[TopicInfo, ...]
    metadata: dict[str, str]
    #: The recorder closed the file.
    complete: bool
    #: Every checksum of the data agrees.
    checksums_agree: bool
    #: What is missing or damaged, None where nothing is.
    loss: str | None


class RecordingWriter:
    """Writes a recording; a context manager.

    Raises `FileExistsError` (one line) where `path` exists and `overwrite` was not asked for, `OSError` where the disk
    refuses, `ValueError` for an unknown topic.
    """

    def __init__(self, path: Path, metadata: dict[str, str], *, overwrite: bool = False) -> None:
        self._file = _create(Path(path), overwrite)
        _keep_large_blocks()
        self._writer = Writer(
            self._file,
            chunk_size=CHUNK_BYTES,
            # noise does not compress, and must not cost time while it arrives
            compression=CompressionType.NONE,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile=METADATA_NAME, library=METADATA_NAME)
        self._writer.add_metadata(METADATA_NAME, metadata)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._flushed_ns: int | None = None

    def write(self, topic: str, message: msgspec.Struct, *, publisher: str, sequence: int, sent_ns: int) -> None:
        """Append a message that `publisher` sent at `sent_ns` (not negative)."""
        facts = topic_facts(topic)
        if type(message) is not facts.type:
            raise ValueError(f"{topic} carries {facts.type.__name__}, got {type(message).__name__}")
        if not 0 <= sent_ns <= _MAX_U64:
            raise ValueError(f"sent_ns must be 0..2^64-1, got {sent_ns!r}")
        stamp_ns: int = getattr(message, "stamp_ns", sent_ns)
        self._writer.add_message(
            channel_id=self._channel(topic, publisher),
            log_time=sent_ns,
            # unsigned in the file; the message itself keeps its exact stamp
            publish_time=min(max(stamp_ns, 0), _MAX_U64),
            sequence=sequence & _MAX_U32,
            data=encode_inline(message),
        )
        self._flush_when_due(sent_ns)

    def close(self) -> None:
        """Write the index and close the file; once is enough, twice does no harm."""
        if not self._file.closed:
            try:
                self._writer.finish()
            finally:
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _channel(self, topic: str, publisher: str) -> int:
        key = topic, publisher
        if key not in self._channels:
            if topic not in self._schemas:
                self._schemas[topic] = _register_schema(self._writer, topic)
            self._channels[key] = self._writer.register_channel(
                topic, MessageEncoding.MessagePack, self._schemas[topic], {_PUBLISHER_KEY: publisher}
            )
        return self._channels[key]

    def _flush_when_due(self, now_ns: int) -> None:
        if self._flushed_ns is None:
            self._flushed_ns = now_ns
        if now_ns - self._flushed_ns >= FLUSH_INTERVAL_NS:
            self._writer.flush()
            self._flushed_ns = now_ns


class RecordingReader:
    """Reads a recording, whole or cut off, chunk by chunk; a context manager.

    `loss` says in one line what is missing or damaged, None while nothing is known to be: that the file is cut is known
    at once, a damaged chunk when it was read. `skipped` counts messages per topic that are unknown here or unreadable.
    Raises `ValueError` naming the file where it is no recording at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._file = _open(self.path)
        try:
            self._walk = _walk_records(self._file)
        except BaseException:
            self._file.close()
            raise
        self._channels = self._walk.channels
        self._schemas = self._walk.schemas
        self._damage: dict[int, str] = {}
        self.skipped: dict[str, int] = {}
        if not self.complete:
            # the index that repeats all channels is missing: they stand in the chunks alone
            for _ in self._chunk_messages(self._walk.chunks):
                pass

    @property
    def metadata(self) -> dict[str, str]:
        """What the recorder wrote about the run."""
        return self._walk.metadata

    @property
    def complete(self) -> bool:
        """Whether the recorder closed the file."""
        return self._walk.complete

    @property
    def loss(self) -> str | None:
        """What is missing or damaged, as far as read."""
        reasons = [self._walk.cut] if self._walk.cut else []
        if self._damage:
            first = min(self._damage)
            reasons.append(f"{len(self._damage)} damaged chunks, the first at byte {first}: {self._damage[first]}")
        return "; ".join(reasons) or None

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Recorded]:
        """Messages in order of their sending, start included, end not; holds no more than overlapping chunks."""
        self.skipped = {}
        for channel, raw in self._in_order(start_ns, end_ns):
            if topics is not None and channel.topic not in topics:
                continue
            message = _decode(channel, raw)
            if message is None:
                self.skipped[channel.topic] = self.skipped.get(channel.topic, 0) + 1
            else:
                yield Recorded(channel.topic, message, _publisher(channel), raw.sequence, raw.log_time)

    def info(self) -> RecordingInfo:
        """Summary of the recording; reads all of it once to verify its checksums."""
        counts = _Counts()
        for channel, raw in self._chunk_messages(self._walk.chunks):
            counts.add(channel, raw)
        data_crc_agrees = self._walk.data_crc in (None, _crc32(self._file, 0, self._walk.data_end))
        return RecordingInfo(
            path=str(self.path),
            size_bytes=self._walk.size,
            start_ns=counts.start_ns or 0,
            duration_s=s_from_ns(counts.end_ns - (counts.start_ns or 0)),
            topics=counts.topics(self._schemas),
            metadata=self.metadata,
            complete=self.complete,
            checksums_agree=not self._damage and data_crc_agrees,
            loss=self.loss or (None if data_crc_agrees else "checksum of the data section disagrees"),
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _in_order(self, start_ns: int | None, end_ns: int | None) -> Iterator[tuple[Channel, Message]]:
        """Merge chunks by log time: a message may go once no later chunk can hold an earlier one."""
        start, end = start_ns or 0, _MAX_U64 + 1 if end_ns is None else end_ns
        chunks = [chunk for chunk in self._walk.chunks if chunk.end_ns >= start and chunk.start_ns < end]
        waiting: list[tuple[int, int, int, Channel, Message]] = []
        for chunk in sorted(chunks, key=lambda chunk: (chunk.start_ns, chunk.offset)):
            while waiting and waiting[0][0] < chunk.start_ns:
                yield heapq.heappop(waiting)[3:]
            for at, (channel, raw) in enumerate(self._chunk_messages([chunk])):
                if start <= raw.log_time < end:
                    heapq.heappush(waiting, (raw.log_time, chunk.offset, at, channel, raw))
        while waiting:
            yield heapq.heappop(waiting)[3:]

    def _chunk_messages(self, chunks: list[_Chunk]) -> Iterator[tuple[Channel, Message]]:
        """Messages of intact chunks in file order; damaged ones are noted and left out."""
        for chunk in chunks:
            try:
                records = _read_chunk(self._file, chunk)
            except _DAMAGE as error:
                self._damage[chunk.offset] = _one_line(error)
                continue
            for record in records:
                if isinstance(record, Schema):
                    self._schemas[record.id] = record
                elif isinstance(record, Channel):
                    self._channels[record.id] = record
                elif isinstance(record, Message):
                    if record.channel_id in self._channels:
                        yield self._channels[record.channel_id], record
                    else:
                        self._damage[chunk.offset] = f"message of channel {record.channel_id}, which nothing declares"


class _Chunk(NamedTuple):
    """Where messages stand in a file, and the span of their log times."""

    offset: int
    start_ns: int
    end_ns: int


class _Walk:
    """What a walk over a file's record heads found."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.chunks: list[_Chunk] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.metadata: dict[str, str] = {}
        self.complete = False
        self.cut: str | None = None
        #: End of the data section and its checksum, None where the file gives none.
        self.data_end = 0
        self.data_crc: int | None = None


def info(path: Path) -> RecordingInfo:
    """Summary of a recording, its checksums verified; raises `ValueError` where it is none."""
    with RecordingReader(path) as reader:
        return reader.info()


def copy_recording(
    source: Path,
    target: Path,
    *,
    topics: Collection[str] | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
    compress: bool = False,
    overwrite: bool = False,
) -> tuple[int, str | None]:
    """Copy messages byte for byte, unknown topics included, into a new and complete file: recover, trim, compress.

    Returns the number of messages and what the source had lost.
    """
    with RecordingReader(source) as reader, _create(Path(target), overwrite) as file:
        compression = CompressionType.ZSTD if compress else CompressionType.NONE
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=compression, enable_data_crcs=True)
        writer.start(profile=METADATA_NAME, library=METADATA_NAME)
        writer.add_metadata(METADATA_NAME, reader.metadata)
        channels: dict[int, int] = {}
        count = 0
        for channel, raw in reader._in_order(start_ns, end_ns):
            if topics is not None and channel.topic not in topics:
                continue
            if channel.id not in channels:
                channels[channel.id] = _copy_channel(writer, channel, reader._schemas)
            writer.add_message(channels[channel.id], raw.log_time, raw.data, raw.publish_time, raw.sequence)
            count += 1
        writer.finish()
        return count, reader.loss


class _Counts:
    """Figures per topic while a recording passes by."""

    def __init__(self) -> None:
        self.start_ns: int | None = None
        self.end_ns = 0
        self._channels: dict[str, dict[int, Channel]] = {}
        self._messages: dict[str, int] = {}
        self._bytes: dict[str, int] = {}
        self._span: dict[str, tuple[int, int]] = {}

    def add(self, channel: Channel, raw: Message) -> None:
        topic = channel.topic
        self.start_ns = raw.log_time if self.start_ns is None else min(self.start_ns, raw.log_time)
        self.end_ns = max(self.end_ns, raw.log_time)
        self._channels.setdefault(topic, {})[channel.id] = channel
        self._messages[topic] = self._messages.get(topic, 0) + 1
        self._bytes[topic] = self._bytes.get(topic, 0) + len(raw.data)
        first, last = self._span.get(topic, (raw.log_time, raw.log_time))
        self._span[topic] = min(first, raw.log_time), max(last, raw.log_time)

    def topics(self, schemas: dict[int, Schema]) -> tuple[TopicInfo, ...]:
        return tuple(self._topic(topic, schemas) for topic in sorted(self._channels))

    def _topic(self, topic: str, schemas: dict[int, Schema]) -> TopicInfo:
        channels = self._channels[topic].values()
        types = {schemas[channel.schema_id].name for channel in channels if channel.schema_id in schemas}
        first_ns, last_ns = self._span[topic]
        intervals = self._messages[topic] - 1
        return TopicInfo(
            topic=topic,
            type=", ".join(sorted(types)),
            publishers=tuple(sorted({_publisher(channel) for channel in channels})),
            messages=self._messages[topic],
            bytes=self._bytes[topic],
            rate_hz=intervals / s_from_ns(last_ns - first_ns) if last_ns > first_ns else 0.0,
            known=topic in TOPICS,
        )


def _keep_large_blocks() -> None:
    """Let the C allocator reuse blocks of a beam's size.

    glibc hands them back to the system at every free until a larger one was freed once; fetching them anew, page by
    page, costs more than all copies and checksums of a write together (measured: 250 against 950 MB/s).
    """
    block = bytearray(_LARGEST_HEAP_BLOCK)
    del block


def _create(path: Path, overwrite: bool) -> BinaryIO:
    try:
        return path.open("wb" if overwrite else "xb")
    except FileExistsError as error:
        raise FileExistsError(f"{path}: exists already and is not overwritten unless asked") from error


def _open(path: Path) -> BinaryIO:
    """The file of a recording, its first bytes checked."""
    if path.is_dir():
        raise ValueError(f"{path}: is a directory, not an MCAP recording")
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    if not path.is_file():
        raise ValueError(f"{path}: is not a regular file")
    file = path.open("rb")
    magic = file.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC:
        file.close()
        reason = "is not an MCAP recording: its first 8 bytes are not the MCAP magic" if magic else "is empty"
        raise ValueError(f"{path}: {reason}")
    return file


def _walk_records(file: BinaryIO) -> _Walk:
    """Visit every record by its head alone; chunks are noted, not read. Stops where the file is cut or damaged."""
    walk = _Walk(os.fstat(file.fileno()).st_size)
    offset = len(MCAP0_MAGIC)
    while not walk.complete:
        file.seek(offset)
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            walk.cut = f"cut off at byte {walk.size}"
            break
        opcode, length = _RECORD_HEAD.unpack(head)
        end = offset + _RECORD_HEAD.size + length
        if end > walk.size:
            walk.cut = f"cut off at byte {walk.size}, inside the record that begins at byte {offset}"
            break
        try:
            _note_record(walk, file, opcode, offset, length)
        except _DAMAGE as error:
            walk.cut = f"damaged at byte {offset}: {_one_line(error)}"
            break
        offset = end
    return walk


def _note_record(walk: _Walk, file: BinaryIO, opcode: int, offset: int, length: int) -> None:
    """Take in one record whose body the file stands at."""
    if opcode == Opcode.CHUNK:
        start_ns, end_ns, _ = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
        walk.chunks.append(_Chunk(offset, start_ns, end_ns))
    elif opcode == Opcode.MESSAGE:
        log_time = Message.read(_body(file, min(length, 22)), min(length, 22)).log_time
        walk.chunks.append(_Chunk(offset, log_time, log_time))
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(_body(file, length))
        walk.channels[channel.id] = channel
    elif opcode == Opcode.SCHEMA:
        schema = Schema.read(_body(file, length))
        walk.schemas[schema.id] = schema
    elif opcode == Opcode.METADATA:
        metadata = Metadata.read(_body(file, length))
        if metadata.name == METADATA_NAME:
            walk.metadata = metadata.metadata
    elif opcode == Opcode.DATA_END:
        walk.data_end = offset
        walk.data_crc = DataEnd.read(_body(file, length)).data_section_crc or None
    elif opcode == Opcode.FOOTER:
        _require_index_intact(file, Footer.read(_body(file, length)), offset)
        walk.complete = True
    elif opcode == 0 or opcode in range(0x10, 0x80):
        raise ValueError(f"{opcode} is no MCAP record type")


def _require_index_intact(file: BinaryIO, footer: Footer, offset: int) -> None:
    """Raise `ValueError` unless the checksum of the index, where given, agrees; it spans the footer's first fields."""
    spanned = offset + _RECORD_HEAD.size + 16
    start = footer.summary_start or offset
    if footer.summary_crc and (start > offset or _crc32(file, start, spanned) != footer.summary_crc):
        raise ValueError("checksum of the index disagrees")


def _body(file: BinaryIO, length: int) -> ReadDataStream:
    if length > _MAX_RECORD_BYTES:
        raise ValueError(f"record of {length} bytes exceeds {_MAX_RECORD_BYTES}")
    return ReadDataStream(BytesIO(file.read(length)))


def _read_chunk(file: BinaryIO, chunk: _Chunk) -> list[object]:
    """Records of a chunk, its checksum verified; may raise anything of `_DAMAGE`."""
    file.seek(chunk.offset)
    opcode, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
    body = _body(file, length)
    if opcode == Opcode.MESSAGE:
        return [Message.read(body, length)]
    whole = Chunk.read(body)
    if whole.uncompressed_size > _MAX_RECORD_BYTES:
        raise ValueError(f"chunk of {whole.uncompressed_size} bytes exceeds {_MAX_RECORD_BYTES}")
    return list(breakup_chunk(whole, validate_crc=True))


def _decode(channel: Channel, raw: Message) -> msgspec.Struct | None:
    """The message, or None where its topic or encoding is not ours or its bytes are unreadable."""
    if channel.topic not in TOPICS or channel.message_encoding != MessageEncoding.MessagePack:
        return None
    facts = TOPICS[channel.topic]
    try:
        message: msgspec.Struct = decode_inline(facts.type, raw.data)
    except CodecError:
        return None
    return message


def _register_schema(writer: Writer, topic: str) -> int:
    message_type = topic_facts(topic).type
    schema = msgspec.json.encode(json_schema(message_type))
    return writer.register_schema(message_type.__name__, SchemaEncoding.JSONSchema, schema)


def _copy_channel(writer: Writer, channel: Channel, schemas: dict[int, Schema]) -> int:
    schema = schemas.get(channel.schema_id)
    schema_id = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
    return writer.register_channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)


def _publisher(channel: Channel) -> str:
    return channel.metadata.get(_PUBLISHER_KEY, "")


def _crc32(file: BinaryIO, start: int, end: int) -> int:
    """Checksum of a file's bytes from `start` to before `end`."""
    file.seek(start)
    crc = 0
    while (left := end - file.tell()) > 0:
        crc = zlib.crc32(file.read(min(left, CHUNK_BYTES)), crc)
    return crc


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
