"""Recordings: MCAP files, message encoding `msgpack`, one JSON Schema a topic, all checksums.

Times: `log_time` is the time of sending (the bus clock), which orders a recording and paces its replay;
`publish_time` is the message's own `stamp_ns`, the time of acquisition. Each publisher of a topic has a channel of its
own, named in the channel's metadata.

A recording is written front to back and is readable at any moment: a process that is killed loses at most the chunks it
was filling, one of raw beams (plain) and one of all else (zstd). Readers therefore need no index at the end; they walk
the file's records by their lengths, and use the index only where damage makes that impossible.
"""

from __future__ import annotations

import contextlib
import heapq
import logging
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from io import BytesIO, FileIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Message, Metadata, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC

from msgs.bus.codec import CodecError, decode_inline, encode_inline, json_schema
from msgs.bus.topics import TOPICS, plain_topic, topic_facts
from msgs.files.unpacking import UNPACKING_ERRORS, unpack
from msgs.files.whole_files import whole
from msgs.recording.mcap_writer import CHUNK_BYTES, MAX_U64, ZSTD_LEVEL, McapFile
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.wording import counted

_LOG = logging.getLogger(__name__)

#: 350 MB/s of noise, which does not compress and must not cost time while it arrives; all else is compressed.
RAW_TOPIC = "radar/beam"
#: A second a scan, and three quarters of the size.
ARCHIVE_ZSTD_LEVEL = 19
#: Bus time after which an unfilled chunk is written all the same: the loss of slow topics if a recorder is killed.
FLUSH_INTERVAL_NS = NANOSECONDS_PER_SECOND
METADATA_NAME = "mirrorwave"
#: Metadata record with the recorder's account of lost messages.
LOSSES_NAME = "mirrorwave:losses"
#: Just below the largest block that glibc may be set to keep (32 MiB).
_LARGEST_HEAP_BLOCK = 31 << 20
_PUBLISHER_KEY = "publisher"
#: Larger records are damage: no chunk of this project comes near.
_MAX_RECORD_BYTES = 1 << 30
#: What a compressed chunk may unpack to, and all of a file together: so much, or so many times its size if that is
#: more. Measured data become 2 to 20 times smaller, and a file of zeros 30,000 times.
_MAX_UNPACKED_CHUNK_BYTES, _FREE_UNPACKED_BYTES, _MAX_UNPACKED_RATIO = 1 << 28, 1 << 29, 1000
#: Records of a chunk beside one for each four stored bytes, measured are six for an empty message: millions of equal
#: ones fit into some kilobytes.
_FREE_RECORDS, _BYTES_PER_RECORD = 1000, 4
_MAX_U32 = (1 << 32) - 1
#: Opcode and length before each record.
_RECORD_HEAD = struct.Struct("<BQ")
#: First fields of a chunk: start, end, uncompressed size, its checksum, length of the compression's name.
_CHUNK_HEAD = struct.Struct("<QQQII")
#: First fields of a message: channel, sequence, log time, publish time.
_MESSAGE_HEAD = struct.Struct("<HIQQ")
#: Exceptions that reading a damaged record may raise.
_DAMAGE = (McapError, ValueError, OverflowError, struct.error, *UNPACKING_ERRORS)


class Recorded(NamedTuple):
    """A message of a recording."""

    topic: str
    message: msgspec.Struct
    publisher: str
    #: As sent, modulo 2^32.
    sequence: int
    #: Time of sending.
    log_time_ns: int


class Encoded(NamedTuple):
    """A message in the encoding of a recording."""

    topic: str
    publisher: str
    sequence: int
    #: Time of sending.
    sent_ns: int
    #: Its own stamp, the time of acquisition.
    stamp_ns: int
    data: bytes


class TopicLoss(msgspec.Struct, frozen=True, kw_only=True):
    """Messages of one topic that were sent and are not in the recording."""

    topic: str
    #: Lost in transit to the recorder, by gaps in the sequence numbers; rejected ones leave a gap too.
    lost: int = 0
    #: Arrived but unreadable.
    rejected: int = 0
    #: Arrived, and skipped because a newer one waited beside it.
    outdated: int = 0
    #: Arrived, and not written: the disk refused.
    missed: int = 0

    @property
    def total(self) -> int:
        """Number of missing messages."""
        return max(self.lost, self.rejected) + self.outdated + self.missed


class Losses(msgspec.Struct, frozen=True, kw_only=True):
    """A recorder's account of missing messages; topics without loss are left out."""

    topics: tuple[TopicLoss, ...] = ()
    #: Why the recording ended before it was asked to, None otherwise.
    ended: str | None = None

    @property
    def total(self) -> int:
        """Number of missing messages."""
        return sum(topic.total for topic in self.topics)


class TopicInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One topic of a recording."""

    topic: str
    type: str
    publishers: tuple[str, ...]
    messages: int
    bytes: int
    rate_hz: float
    #: False for topics unknown to this program: kept, never decoded.
    known: bool


class RecordingInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of a recording."""

    path: str
    size_bytes: int
    start_ns: int
    duration_s: float
    topics: tuple[TopicInfo, ...]
    metadata: dict[str, str]
    #: The recorder closed the file, and nothing follows.
    complete: bool
    #: Every checksum of the data agrees.
    checksums_agree: bool
    #: Missing or damaged part of the file, None if there is none.
    loss: str | None
    #: Messages that the recorder never received or could not write; None if the file does not say.
    losses: Losses | None = None


class RecordingWriter:
    """Writer of a recording; a context manager.

    Raises `FileExistsError` (one line) where `path` exists and `overwrite` was not asked for, `OSError` where the disk
    refuses, `ValueError` for an unknown topic. An `archive` is as small as zstd makes it, raw beams too: for files that
    are written once and copied often.
    """

    def __init__(self, path: Path, metadata: dict[str, str], *, overwrite: bool = False, archive: bool = False) -> None:
        self._file = _create(Path(path), overwrite)
        self._plain_topics = () if archive else (RAW_TOPIC,)
        _keep_large_blocks()
        with contextlib.ExitStack() as stack:
            if not overwrite:
                stack.callback(Path(path).unlink, missing_ok=True)
            stack.callback(self._file.close)
            self._mcap = McapFile(self._file, METADATA_NAME, ARCHIVE_ZSTD_LEVEL if archive else ZSTD_LEVEL)
            self._mcap.add_metadata(METADATA_NAME, metadata)
            stack.pop_all()
        self._channels: dict[tuple[str, str], int] = {}
        self._sequences: Counter[tuple[str, str]] = Counter()
        self._flushed_ns: int | None = None
        self._is_finished = False

    @property
    def size_bytes(self) -> int:
        """Size so far, without the index."""
        return self._mcap.size

    def growth_bytes(self, more: int = 0) -> int:
        """Return the maximum disk space in bytes until the recording is closed, if `more` bytes are written before."""
        return self._mcap.growth(more)

    def written(self) -> dict[str, int]:
        """Return the messages per topic that the file system has taken; after `close`, all that are in the file."""
        counts: dict[str, int] = {}
        for (topic, _), number in self._channels.items():
            counts[topic] = counts.get(topic, 0) + self._mcap.counts[number]
        return counts

    def write(
        self, topic: str, message: msgspec.Struct, *, publisher: str, sent_ns: int, sequence: int | None = None
    ) -> None:
        """Append a message that `publisher` sent at `sent_ns` (not negative); by default the next of its topic."""
        if sequence is None:
            sequence = self._sequences[topic, publisher]
            self._sequences[topic, publisher] += 1
        self.write_encoded(encoded(topic, message, publisher=publisher, sequence=sequence, sent_ns=sent_ns))

    def write_encoded(self, message: Encoded) -> None:
        """Append a message that was encoded before."""
        self._mcap.add_message(
            self._channel(message.topic, message.publisher),
            message.sequence & _MAX_U32,
            message.sent_ns,
            # unsigned in the file; the message itself keeps its exact stamp
            min(max(message.stamp_ns, 0), MAX_U64),
            message.data,
        )
        if self._flushed_ns is None:
            self._flushed_ns = message.sent_ns
        if message.sent_ns - self._flushed_ns >= FLUSH_INTERVAL_NS:
            self._mcap.flush()
            self._flushed_ns = message.sent_ns

    def flush(self) -> None:
        """Write the chunks in progress; data that the disk refuses is lost."""
        self._mcap.flush()

    def write_losses(self, losses: Losses) -> None:
        """Record what is missing; the last call before `close` counts. Amends a finished recording if space permits."""
        values = {"topics": msgspec.json.encode(losses.topics).decode()}
        add = self._mcap.amend if self._is_finished else self._mcap.add_metadata
        add(LOSSES_NAME, values | ({"ended": losses.ended} if losses.ended else {}))

    def finish(self) -> None:
        """Write the index; nothing but losses can be added afterwards."""
        if not self._is_finished:
            self._is_finished = True
            self._mcap.finish()

    def close(self) -> None:
        """Write the index and close the file; a second call does no harm."""
        if not self._file.closed:
            try:
                self.finish()
            finally:
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _channel(self, topic: str, publisher: str) -> int:
        key = topic, publisher
        if key not in self._channels:
            message_type = topic_facts(topic).type
            schema = msgspec.json.encode(json_schema(message_type))
            self._channels[key] = self._mcap.add_channel(
                topic,
                MessageEncoding.MessagePack,
                self._mcap.add_schema(message_type.__name__, SchemaEncoding.JSONSchema, schema),
                {_PUBLISHER_KEY: publisher},
                compressed=plain_topic(topic) not in self._plain_topics,
            )
        return self._channels[key]


def encoded(topic: str, message: msgspec.Struct, *, publisher: str, sequence: int, sent_ns: int) -> Encoded:
    """Return a message in the encoding of a recording; raises `ValueError` if topic, type or time do not fit."""
    facts = topic_facts(topic)
    if type(message) is not facts.type:
        raise ValueError(f"{topic} carries {facts.type.__name__}, got {type(message).__name__}")
    if not 0 <= sent_ns <= MAX_U64:
        raise ValueError(f"sent_ns must be 0..2^64-1, got {sent_ns!r}")
    stamp_ns: int = getattr(message, "stamp_ns", sent_ns)
    return Encoded(topic, publisher, sequence, sent_ns, stamp_ns, encode_inline(message))


class RecordingReader:
    """Reader of a recording, whole or cut off, chunk by chunk; a context manager.

    `loss` says in one line what is missing or damaged, None while no damage is known: a cut file is known
    at once, a damaged chunk when it was read. `skipped` counts messages per topic that are unknown here or unreadable.
    Raises `ValueError` naming the file if it is no recording at all.
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
        self._is_set_back = False
        self._searched = False
        self.skipped: dict[str, int] = {}

    @property
    def metadata(self) -> dict[str, str]:
        """The recorder's metadata of the run."""
        return self._walk.metadata.get(METADATA_NAME, {})

    @property
    def metadata_records(self) -> dict[str, dict[str, str]]:
        """All metadata records by name, other programs' included."""
        return self._walk.metadata

    @property
    def losses(self) -> Losses | None:
        """The recorder's account of missing messages; None if it gave none, as in a file that is cut off."""
        return _losses(self._walk.metadata.get(LOSSES_NAME))

    @property
    def complete(self) -> bool:
        """Return whether the recorder closed the file, and nothing follows."""
        return self._walk.complete and not self._walk.damage

    @property
    def loss(self) -> str | None:
        """Missing or damaged part, as far as read."""
        reasons = [self._walk.damage] if self._walk.damage else []
        if self._damage:
            first = min(self._damage)
            chunks = counted(len(self._damage), "damaged chunk")
            reasons.append(f"{chunks}, the first at byte {first}: {self._damage[first]}")
        return "; ".join(reasons) or None

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time, without reading the messages; zeros where there are none."""
        chunks = self._walk.chunks
        return min((chunk.start_ns for chunk in chunks), default=0), max((chunk.end_ns for chunk in chunks), default=0)

    def stored_bytes(self, start_ns: int | None = None, end_ns: int | None = None) -> int:
        """Return the bytes on disk of the chunks of a time span."""
        start, end = start_ns or 0, MAX_U64 + 1 if end_ns is None else end_ns
        chunks = sorted(self._walk.chunks)
        ends = [*(chunk.offset for chunk in chunks[1:]), self._walk.data_end or self._walk.size]
        spans = zip(chunks, ends, strict=False)
        return sum(at - chunk.offset for chunk, at in spans if chunk.end_ns >= start and chunk.start_ns < end)

    @property
    def types(self) -> dict[str, str]:
        """Name of each topic's type; where no index names the channels of a chunk, all chunks are read to find them."""
        if any(not self._channels.keys() >= set(chunk.channel_ids or (None,)) for chunk in self._walk.chunks):
            self._search_declarations()
        schemas = self._schemas
        return {
            channel.topic: schemas[channel.schema_id].name if channel.schema_id in schemas else ""
            for channel in self._channels.values()
        }

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        renamed: Mapping[str, str] | None = None,
    ) -> Iterator[Recorded]:
        """Yield messages in order of sending, start included, end not; holds no more than overlapping chunks.

        `topics` are named as in the recording; those in `renamed` are decoded and delivered under their new names.
        """
        self.skipped = {}
        for channel, raw in self.raw_messages(start_ns, end_ns, topics):
            topic = (renamed or {}).get(channel.topic, channel.topic)
            message = _decode(topic, channel, raw)
            if message is None:
                self.skipped[channel.topic] = self.skipped.get(channel.topic, 0) + 1
            else:
                yield Recorded(topic, message, publisher_of(channel), raw.sequence, raw.log_time)

    def schema_of(self, channel: Channel) -> Schema | None:
        """Return the schema of a channel's messages, None where the file has none."""
        return self._schemas.get(channel.schema_id)

    def info(self) -> RecordingInfo:
        """Return a summary of the recording; reads all of it once to verify its checksums."""
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
            losses=self.losses,
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def raw_messages(
        self, start_ns: int | None, end_ns: int | None, topics: Collection[str] | None = None
    ) -> Iterator[tuple[Channel, Message]]:
        """Yield messages as they lie in the file, in order of log time, start included, end not; chunks are merged."""
        start, end = start_ns or 0, MAX_U64 + 1 if end_ns is None else end_ns
        chunks = [chunk for chunk in self._walk.chunks if chunk.end_ns >= start and chunk.start_ns < end]
        if topics is not None:
            chunks = [chunk for chunk in chunks if self._may_hold(chunk, topics)]
        waiting: list[tuple[int, int, int, Channel, Message]] = []
        positions: dict[int, tuple[int, int]] = {}

        def first() -> tuple[Channel, Message]:
            _, offset, at, channel, raw = heapq.heappop(waiting)
            # say once that what one publisher sent comes in another order than it was written in
            if (offset, at) < positions.get(channel.id, (0, 0)) and not self._is_set_back:
                self._is_set_back = True
                consequence = "messages come by their times, not as they were sent"
                _LOG.warning(
                    "%s: the clock was set back while %s was recorded: %s", self.path, channel.topic, consequence
                )
            positions[channel.id] = offset, at
            return channel, raw

        for chunk in sorted(chunks, key=lambda chunk: (chunk.start_ns, chunk.offset)):
            while waiting and waiting[0][0] < chunk.start_ns:
                yield first()
            for at, (channel, raw) in enumerate(self._chunk_messages([chunk])):
                if start <= raw.log_time < end and (topics is None or channel.topic in topics):
                    heapq.heappush(waiting, (raw.log_time, chunk.offset, at, channel, raw))
        while waiting:
            yield first()

    def _may_hold(self, chunk: _Chunk, topics: Collection[str]) -> bool:
        """Return whether a chunk has to be read for these topics: raw beams are a thousand times all else."""
        declared = [self._channels.get(number) for number in chunk.channel_ids]
        return not declared or any(channel is None or channel.topic in topics for channel in declared)

    def _chunk_messages(self, chunks: list[_Chunk]) -> Iterator[tuple[Channel, Message]]:
        """Yield messages of intact chunks in the order given; damaged ones are noted and left out."""
        for chunk in chunks:
            for raw in self._declare(chunk):
                if raw.channel_id not in self._channels:
                    self._search_declarations()
                if raw.channel_id in self._channels:
                    yield self._channels[raw.channel_id], raw
                else:
                    self._damage[chunk.offset] = f"message of channel {raw.channel_id}, which nothing declares"

    def _declare(self, chunk: _Chunk) -> list[Message]:
        """Return messages of a chunk, once all that it declares is known; none where it is damaged."""
        try:
            records = _read_chunk(self._file, chunk)
        except _DAMAGE as error:
            self._damage[chunk.offset] = _one_line(error)
            return []
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
        return [record for record in records if isinstance(record, Message)]

    def _search_declarations(self) -> None:
        """Read chunks for channels: other programs declare each once, in any chunk; needed without an index."""
        if not self._searched:
            self._searched = True
            for chunk in self._walk.chunks:
                self._declare(chunk)


class _Chunk(NamedTuple):
    """Position of a chunk of messages in a file, and the span of their log times."""

    offset: int
    start_ns: int
    end_ns: int
    #: What it says to unpack to; zero for one that is not compressed.
    unpacked_bytes: int = 0
    #: Its channels according to the index; empty if the index does not say.
    channel_ids: tuple[int, ...] = ()


class _Walk:
    """Result of a walk over the record heads of a file."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.chunks: list[_Chunk] = []
        #: The same, as the index has them.
        self.indexed: list[_Chunk] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        #: Metadata records by name.
        self.metadata: dict[str, dict[str, str]] = {}
        self.complete = False
        self.damage: str | None = None
        #: End of the data section and its checksum, None if the file gives none.
        self.data_end = 0
        self.data_crc: int | None = None


def info(path: Path) -> RecordingInfo:
    """Return a summary of a recording, its checksums verified; raises `ValueError` if it is none."""
    with RecordingReader(path) as reader:
        return reader.info()


class _Counts:
    """Counts per topic while a recording is read."""

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
            publishers=tuple(sorted({publisher_of(channel) for channel in channels})),
            messages=self._messages[topic],
            bytes=self._bytes[topic],
            rate_hz=intervals / s_from_ns(last_ns - first_ns) if last_ns > first_ns else 0.0,
            known=topic in TOPICS,
        )


def _keep_large_blocks() -> None:
    """Let the C allocator reuse blocks of a beam's size: glibc returns them until a larger one was freed once.

    Measured: 950 against 250 MB/s.
    """
    block = bytearray(_LARGEST_HEAP_BLOCK)
    del block


def _losses(values: dict[str, str] | None) -> Losses | None:
    """Return the losses of a metadata record, None without one or for another program's."""
    if values is None:
        return None
    try:
        topics = msgspec.json.decode(values.get("topics", ""), type=tuple[TopicLoss, ...])
    except msgspec.MsgspecError:
        return None
    return Losses(topics=topics, ended=values.get("ended"))


@contextlib.contextmanager
def whole_recording(path: Path, metadata: dict[str, str]) -> Iterator[RecordingWriter]:
    """Yield a writer of a recording that is complete if the context ends well, else absent; raises as the writer."""
    with _whole(path, overwrite=False) as part, RecordingWriter(part, metadata) as writer:
        yield writer


@contextlib.contextmanager
def new_file(path: Path, overwrite: bool = False) -> Iterator[FileIO]:
    """Yield a new file that is at `path` if the context ends well; `FileExistsError` unless free or `overwrite`."""
    with _whole(path, overwrite) as part, _create(part, False) as file:
        yield file


def _whole(path: Path, overwrite: bool) -> contextlib.AbstractContextManager[Path]:
    if not overwrite and os.path.lexists(path):
        raise _exists_already(path)
    return whole(path)


def _create(path: Path, overwrite: bool) -> FileIO:
    try:
        return path.open("wb" if overwrite else "xb", buffering=0)
    except FileExistsError:
        raise _exists_already(path) from None


def _exists_already(path: Path) -> FileExistsError:
    return FileExistsError(f"{path}: exists already and is not overwritten unless asked")


def _open(path: Path) -> BinaryIO:
    """Return the file of a recording, its first bytes checked."""
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
        if path.suffix.startswith(".sigmf"):
            reason = "is a SigMF capture, must be an MCAP recording"
        raise ValueError(f"{path}: {reason}")
    return file


def _walk_records(file: BinaryIO) -> _Walk:
    """Visit every record by its head alone, to where the file is cut or damaged; `ValueError` for a bomb of chunks."""
    walk = _Walk(os.fstat(file.fileno()).st_size)
    offset = len(MCAP0_MAGIC)
    while not (walk.complete or walk.damage):
        file.seek(offset)
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            walk.damage = f"cut off at byte {walk.size}"
            break
        opcode, length = _RECORD_HEAD.unpack(head)
        end = offset + _RECORD_HEAD.size + length
        if end > walk.size:
            walk.damage = f"cut off at byte {walk.size}, inside the record that begins at byte {offset}"
            break
        try:
            _note_record(walk, file, opcode, offset, length)
        except _DAMAGE as error:
            walk.damage = f"damaged at byte {offset}: {_one_line(error)}"
        offset = end
    walked = {chunk.offset for chunk in walk.chunks}
    if walk.complete:
        if (end := offset + len(MCAP0_MAGIC)) < walk.size:
            # files put together, one after the other
            file.seek(end)
            rest = "another recording" if file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC else "what is no part of it"
            walk.damage = f"ends at byte {end} and is read so far; {rest}, {walk.size - end} bytes, follows and is not"
        # the index has a checksum, the heads of the records have none
        indexed = {chunk.offset: chunk for chunk in walk.indexed}
        walk.chunks = [chunk for chunk in walk.chunks if chunk.offset not in indexed] + list(indexed.values())
    else:
        with contextlib.suppress(*_DAMAGE):
            _take_index(walk, file)
    stored_bytes = sum(
        _stored_bytes(file, chunk.offset, walk.size) for chunk in walk.chunks if chunk.offset not in walked
    )
    if stored_bytes > walk.size:
        raise ValueError(
            f"{file.name}: chunks of the index must not overlap, {stored_bytes} bytes of a file of {walk.size}"
        )
    unpacked = sum(chunk.unpacked_bytes for chunk in walk.chunks)
    if unpacked > (limit := max(_FREE_UNPACKED_BYTES, _MAX_UNPACKED_RATIO * walk.size)):
        raise ValueError(
            f"{file.name}: chunks unpack to {unpacked} bytes, at most {limit} are read of a file of {walk.size}"
        )
    return walk


def _stored_bytes(file: BinaryIO, offset: int, size: int) -> int:
    """Return the size of a record's body by its head, 0 for one that does not end within the file: it is not read."""
    file.seek(offset)
    head = file.read(_RECORD_HEAD.size)
    length: int = _RECORD_HEAD.unpack(head)[1] if len(head) == _RECORD_HEAD.size else size
    return length if file.tell() + length <= size else 0


def _take_index(walk: _Walk, file: BinaryIO) -> None:
    """Take the positions of the chunks from the index at the end, if it is intact: damage blocked the walk to some."""
    offset = walk.size - len(MCAP0_MAGIC) - _RECORD_HEAD.size - 20
    file.seek(max(offset, 0))
    opcode, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
    if offset < 0 or (opcode, length) != (Opcode.FOOTER, 20):
        return
    footer = Footer.read(_body(file, length))
    if not (footer.summary_start and footer.summary_crc):
        return
    _require_index_intact(file, footer, offset)
    indexed = _Walk(walk.size)
    at = footer.summary_start
    while at < (footer.summary_offset_start or offset):
        file.seek(at)
        opcode, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
        _note_record(indexed, file, opcode, at, length)
        at += _RECORD_HEAD.size + length
    if indexed.indexed:
        walk.chunks = list({chunk.offset: chunk for chunk in indexed.indexed}.values())
        walk.channels, walk.schemas = indexed.channels, indexed.schemas
        walk.damage = f"{walk.damage}; all chunks found by the index"


def _note_record(walk: _Walk, file: BinaryIO, opcode: int, offset: int, length: int) -> None:
    """Note one record whose body is at the file's position."""
    if opcode == Opcode.CHUNK:
        start_ns, end_ns, unpacked, _, compressed = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
        walk.chunks.append(_Chunk(offset, start_ns, end_ns, unpacked if compressed else 0))
    elif opcode == Opcode.MESSAGE:
        channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack(file.read(_MESSAGE_HEAD.size))
        walk.chunks.append(_Chunk(offset, log_time, log_time, 0, (channel_id,)))
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(_body(file, length))
        walk.channels[channel.id] = channel
    elif opcode == Opcode.SCHEMA:
        schema = Schema.read(_body(file, length))
        walk.schemas[schema.id] = schema
    elif opcode == Opcode.METADATA:
        metadata = Metadata.read(_body(file, length))
        walk.metadata[metadata.name] = metadata.metadata
    elif opcode == Opcode.CHUNK_INDEX:
        index = ChunkIndex.read(_body(file, length))
        if index.chunk_start_offset >= walk.size:
            raise ValueError(f"its chunk would begin at byte {index.chunk_start_offset} of {walk.size}")
        walk.indexed.append(
            _Chunk(
                index.chunk_start_offset,
                index.message_start_time,
                index.message_end_time,
                index.uncompressed_size if index.compression else 0,
                tuple(index.message_index_offsets),
            )
        )
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
    content = file.read(length)
    if len(content) < length:
        raise ValueError(f"record of {length} bytes is cut off")
    return ReadDataStream(BytesIO(content))


def _read_chunk(file: BinaryIO, chunk: _Chunk) -> list[object]:
    """Return records of a chunk, its checksum verified; may raise anything of `_DAMAGE`."""
    file.seek(chunk.offset)
    opcode, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
    body = _body(file, length)
    if opcode == Opcode.MESSAGE:
        return [Message.read(body, length)]
    whole = Chunk.read(body)
    if whole.compression and whole.uncompressed_size != chunk.unpacked_bytes:
        raise ValueError(f"chunk of {whole.uncompressed_size} bytes, of which the index says {chunk.unpacked_bytes}")
    return _records_of(_unpacked(whole), _FREE_RECORDS + len(whole.data) // _BYTES_PER_RECORD)


def _unpacked(chunk: Chunk) -> bytes:
    """Return the records of a chunk as bytes: as many as its head promises, with the checksum of its head."""
    size = chunk.uncompressed_size
    if chunk.compression and size > _MAX_UNPACKED_CHUNK_BYTES:
        raise ValueError(f"chunk of {size} bytes exceeds {_MAX_UNPACKED_CHUNK_BYTES}")
    data = unpack(chunk.data, chunk.compression, size)
    if len(data) != size:
        raise ValueError(f"chunk does not unpack to the {size} bytes that it promises")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("checksum of the chunk disagrees")
    return data


def _records_of(data: bytes, limit: int) -> list[object]:
    """Return schemas, channels and messages of an unpacked chunk; `ValueError` for more than `limit` records."""
    records: list[object] = []
    at = 0
    while at < len(data):
        opcode, length = _RECORD_HEAD.unpack_from(data, at)
        at, end = at + _RECORD_HEAD.size, at + _RECORD_HEAD.size + length
        limit -= 1
        if not opcode or end > len(data) or limit < 0:
            raise ValueError("chunk holds " + ("too many records for its size" if limit < 0 else "what is no record"))
        if opcode == Opcode.MESSAGE:
            channel_id, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(data[at : min(end, at + 22)])
            records.append(Message(channel_id, log_time, data[at + 22 : end], publish_time, sequence))
        elif opcode == Opcode.CHANNEL:
            records.append(Channel.read(ReadDataStream(BytesIO(data[at:end]))))
        elif opcode == Opcode.SCHEMA:
            records.append(Schema.read(ReadDataStream(BytesIO(data[at:end]))))
        at = end
    return records


def _decode(topic: str, channel: Channel, raw: Message) -> msgspec.Struct | None:
    """Return a topic's message; None if topic or encoding is unknown or its bytes are unreadable."""
    if topic not in TOPICS or channel.message_encoding != MessageEncoding.MessagePack:
        return None
    facts = TOPICS[topic]
    try:
        message: msgspec.Struct = decode_inline(facts.type, raw.data)
    except CodecError:
        return None
    return message


def publisher_of(channel: Channel) -> str:
    """Return the node that sent the messages of a channel; empty where the file does not say."""
    return channel.metadata.get(_PUBLISHER_KEY, "")


def _crc32(file: BinaryIO, start: int, end: int) -> int:
    """Return checksum of a file's bytes from `start` to before `end`."""
    file.seek(start)
    crc = 0
    while (remaining := end - file.tell()) > 0:
        crc = zlib.crc32(file.read(min(remaining, CHUNK_BYTES)), crc)
    return crc


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
