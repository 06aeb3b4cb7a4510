"""Writer of MCAP files at the rate of raw beams: each chunk compressed or not, no message copied on its way out.

The `mcap` library's writer has one compression a file and copies messages; its records alone are used here. Each chunk
declares its channels and schemas and can be read alone.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from io import FileIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from msgs.recording.crc32 import crc32_of_both
from msgs.values.wording import as_utf8

CHUNK_BYTES = 1 << 20
#: Compression that keeps up with a running graph.
ZSTD_LEVEL = 3
#: Disk space taken ahead of the data, with which the file system writes several times as fast (docs/results/README.md).
RESERVE_BYTES = 16 << 20
#: Written data is sent to the disk, and its memory freed, while this much more is written.
CACHED_BYTES = 64 << 20
MAX_U64 = (1 << 64) - 1
_FALLOC_KEEP_SIZE = 1
#: Sizes in the index: of a message, the surplus of a chunk or a channel, the surplus of all other records.
_INDEX_ENTRY_BYTES, _INDEX_BYTES = 16, 256
_TAIL_BYTES = 1 << 16
#: Maximum number of buffers of one system call.
_IOV_MAX = 1024
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
#: Fields of a message record behind opcode and length.
_MESSAGE_FIELDS_BYTES = _MESSAGE_HEAD.size - 9
_CHUNK_HEAD = struct.Struct("<BQQQQI")
_FOOTER_HEAD = struct.Struct("<BQQQ")


class _Batch:
    """A chunk in progress."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.size = 0
        self.start_ns, self.end_ns = MAX_U64, 0
        self.indexes: dict[int, MessageIndex] = {}
        self.times: set[int] = set()

    def append(self, piece: bytes) -> None:
        self.pieces.append(piece)
        self.size += len(piece)

    def note(self, channel_id: int, log_time_ns: int) -> None:
        """Index the message that is appended next."""
        self.indexes[channel_id].records.append((log_time_ns, self.size))
        self.times.add(log_time_ns)
        self.start_ns, self.end_ns = min(self.start_ns, log_time_ns), max(self.end_ns, log_time_ns)


class McapFile:
    """Append to a new MCAP file with both checksums and a full index; `file` is unbuffered and stays the caller's.

    A write that the disk refuses raises `OSError` with the file's name and leaves the file as it was after its last
    whole chunk; the data of the chunk in progress is lost, and the file may still be finished. `zstd_level` is that of
    compressed chunks.
    """

    def __init__(self, file: FileIO, profile: str, zstd_level: int = ZSTD_LEVEL) -> None:
        self._file = file
        self._zstd_level = zstd_level
        self._size = self._data_crc = 0
        # a small file does not need it
        self._reserved = RESERVE_BYTES
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._compressed: dict[int, bool] = {}
        #: Per channel: its own record and its schema's, as each chunk repeats them.
        self._declarations: dict[int, bytes] = {}
        self._batches = {False: _Batch(), True: _Batch()}
        #: As bytes: objects would take a kilobyte a beam, and a recording may last for hours.
        self._chunk_indexes = bytearray()
        self._chunk_count = 0
        self._first_ns, self._last_ns = MAX_U64, 0
        self._metadata: list[MetadataIndex] = []
        #: Messages per channel in whole chunks, which the file system has.
        self.counts: dict[int, int] = defaultdict(int)
        #: End of the data and their checksum, once the file is finished.
        self._finished: tuple[int, int] | None = None
        self._append([MCAP0_MAGIC, _record(Header(profile, profile))])

    @property
    def size(self) -> int:
        """Bytes so far, chunks in progress included."""
        return self._size + sum(batch.size for batch in self._batches.values())

    @property
    def messages(self) -> int:
        """Messages in whole chunks."""
        return sum(self.counts.values())

    def growth(self, more: int) -> int:
        """Return the maximum disk space in bytes until the file is finished, if `more` are added before."""
        waiting = more + sum(batch.size for batch in self._batches.values())
        messages = sum(len(index.records) for batch in self._batches.values() for index in batch.indexes.values())
        declared = sum(map(len, self._declarations.values())) + _INDEX_BYTES * (len(self._declarations) + 1)
        index = len(self._chunk_indexes) + 2 * declared + _INDEX_ENTRY_BYTES * messages
        ahead = RESERVE_BYTES if self._size + waiting > self._reserved else 0
        return waiting + index + _TAIL_BYTES + ahead

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record at once."""
        values = {as_utf8(key): as_utf8(value) for key, value in values.items()}
        record, offset = _record(Metadata(as_utf8(name), values)), self._size
        self._append([record])
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Return the number of a schema, the same for equal ones."""
        for schema in self._schemas.values():
            if (schema.name, schema.encoding, schema.data) == (name, encoding, data):
                return schema.id
        number = len(self._schemas) + 1
        self._schemas[number] = Schema(id=number, name=name, encoding=encoding, data=data)
        return number

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: dict[str, str], *, compressed: bool
    ) -> int:
        """Return the number of a new channel; schema 0 means none. Its chunks are either compressed or plain."""
        number = len(self._channels) + 1
        channel = Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema_id, metadata=dict(metadata)
        )
        schema = self._schemas.get(schema_id)
        self._channels[number], self._compressed[number] = channel, compressed
        self._declarations[number] = (_record(schema) if schema else b"") + _record(channel)
        return number

    def add_message(self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Append a message; `data` must not change until its chunk is written."""
        compressed = self._compressed[channel_id]
        if log_time_ns in self._batches[not compressed].times:
            # of equal times, the first written comes first in the file
            self._write_batch(not compressed)
        batch = self._batches[compressed]
        if channel_id not in batch.indexes:
            batch.append(self._declarations[channel_id])
            batch.indexes[channel_id] = MessageIndex(channel_id=channel_id, records=[])
        batch.note(channel_id, log_time_ns)
        length = _MESSAGE_FIELDS_BYTES + len(data)
        batch.append(_MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel_id, sequence, log_time_ns, publish_time_ns))
        batch.append(data)
        if batch.size > CHUNK_BYTES:
            self._write_batch(compressed)

    def flush(self) -> None:
        """Write the chunks in progress, one also where the other is refused."""
        try:
            self._write_batch(False)
        finally:
            self._write_batch(True)

    def finish(self) -> None:
        """Write the chunks in progress, then the index, which is tried also where a chunk was refused."""
        try:
            self.flush()
        finally:
            self._finished = self._size, self._data_crc
            data_end = _record(DataEnd(self._data_crc))
            self._append([data_end, *self._summary(self._size + len(data_end))])
            if self._reserved > RESERVE_BYTES:
                # frees the space reserved ahead
                os.ftruncate(self._file.fileno(), self._size)

    def amend(self, name: str, values: dict[str, str]) -> None:
        """Add a metadata record to the finished file; if there is no room for it the file stays as it is."""
        assert self._finished is not None
        offset, data_crc = self._finished
        record = _record(Metadata(name, values))
        previous = self._metadata
        self._metadata = [*previous, MetadataIndex(offset=offset, length=len(record), name=name)]
        crc = _crc32([record], data_crc)
        end = offset + len(record)
        data_end = _record(DataEnd(crc))
        pieces = [record, data_end, *self._summary(end + len(data_end))]
        size = offset + sum(map(len, pieces))
        try:
            # before any byte is overwritten: afterwards no more disk space is needed
            os.posix_fallocate(self._file.fileno(), 0, size)
        except OSError as error:
            self._metadata = previous
            os.ftruncate(self._file.fileno(), self._size)
            raise OSError(error.errno, error.strerror, str(self._file.name)) from None
        _write_all(self._file.fileno(), pieces, offset)
        self._finished, self._size = (end, crc), size

    def _write_batch(self, compressed: bool) -> None:
        batch, self._batches[compressed] = self._batches[compressed], _Batch()
        if not batch.indexes:
            return
        crc = _crc32(batch.pieces)
        pieces: Sequence[bytes] = batch.pieces
        if compressed:
            pieces = [zstandard.compress(b"".join(batch.pieces), self._zstd_level)]
        name = b"zstd" if compressed else b""
        stored = sum(len(piece) for piece in pieces)
        stored_crc = _crc32(pieces) if compressed else crc
        tail = struct.pack(f"<I{len(name)}sQ", len(name), name, stored)
        length = _CHUNK_HEAD.size - 9 + len(tail) + stored
        head = _CHUNK_HEAD.pack(Opcode.CHUNK, length, batch.start_ns, batch.end_ns, batch.size, crc) + tail
        indexes = {number: _record(index) for number, index in batch.indexes.items()}
        offset = self._size
        # a beam is large enough that to read it twice shows
        chunk_crc = crc32_of_both(zlib.crc32(head), stored_crc, stored)
        self._append([head, *pieces, *indexes.values()], _crc32(indexes.values(), chunk_crc))
        self._note_chunk(batch, name.decode(), stored, offset, 9 + length, indexes)

    def _note_chunk(
        self, batch: _Batch, compression: str, stored: int, offset: int, length: int, indexes: dict[int, bytes]
    ) -> None:
        """Index a chunk of `length` bytes at `offset`, with its message indexes behind it."""
        offsets, at = {}, offset + length
        for number, record in indexes.items():
            offsets[number] = at
            at += len(record)
            self.counts[number] += len(batch.indexes[number].records)
        self._chunk_indexes += _record(
            ChunkIndex(
                chunk_start_offset=offset,
                chunk_length=length,
                compression=compression,
                compressed_size=stored,
                uncompressed_size=batch.size,
                message_start_time=batch.start_ns,
                message_end_time=batch.end_ns,
                message_index_offsets=offsets,
                message_index_length=at - offset - length,
            )
        )
        self._chunk_count += 1
        self._first_ns, self._last_ns = min(self._first_ns, batch.start_ns), max(self._last_ns, batch.end_ns)

    def _summary(self, start: int) -> list[bytes]:
        """Return summary section that begins at `start`, offsets of its groups, footer and magic."""
        groups = [
            (Opcode.SCHEMA, _records(self._schemas.values())),
            (Opcode.CHANNEL, _records(self._channels.values())),
            (Opcode.STATISTICS, _record(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.METADATA_INDEX, _records(self._metadata)),
        ]
        summary, offsets = b"", b""
        for opcode, group in groups:
            if group:
                offsets += _record(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offset_start = start + len(summary)
        # the checksum spans the footer's fields before it
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, 20, start, offset_start)
        crc = _crc32([summary, offsets, head])
        return [summary, offsets, _record(Footer(start, offset_start, crc)), MCAP0_MAGIC]

    def _statistics(self) -> Statistics:
        return Statistics(
            message_count=self.messages,
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=0,
            metadata_count=len(self._metadata),
            chunk_count=self._chunk_count,
            message_start_time=self._first_ns if self._chunk_count else 0,
            message_end_time=self._last_ns,
            channel_message_counts=dict(self.counts),
        )

    def _append(self, pieces: Sequence[bytes], crc: int | None = None) -> None:
        """Write all of `pieces`, whose checksum `crc` may be known, or, where the disk refuses, nothing."""
        size = sum(len(piece) for piece in pieces)
        self._reserve(self._size + size)
        try:
            _write_all(self._file.fileno(), pieces, self._size)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fileno(), self._size)
            raise OSError(error.errno, error.strerror, str(self._file.name)) from None
        self._data_crc = crc32_of_both(self._data_crc, _crc32(pieces) if crc is None else crc, size)
        self._size += size

    def _reserve(self, end: int) -> None:
        """Reserve disk space ahead; if that is refused the write itself reports why."""
        if end > self._reserved:
            self._reserved = end + RESERVE_BYTES
            reserve(self._file.fileno(), self._size, self._reserved - self._size)


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _records(records: Iterable[McapRecord]) -> bytes:
    return b"".join(_record(record) for record in records)


def _crc32(pieces: Iterable[bytes], crc: int = 0) -> int:
    for piece in pieces:
        crc = zlib.crc32(piece, crc)
    return crc


def _write_all(descriptor: int, pieces: Iterable[bytes], offset: int) -> None:
    """Write `pieces` one behind the other from `offset` on, however few bytes each call takes."""
    views = [memoryview(piece) for piece in pieces if piece]
    at = 0
    while at < len(views):
        written = os.pwritev(descriptor, views[at : at + _IOV_MAX], offset)
        offset += written
        while at < len(views) and written >= len(views[at]):
            written -= len(views[at])
            at += 1
        if written:
            views[at] = views[at][written:]


def reserve(descriptor: int, size: int, length: int) -> None:
    """Have the system prepare `length` bytes behind the `size` of a file, which stays; never fails.

    Recent data starts for the disk and data on it leaves memory: a long recording displaces no other memory.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "fallocate"):
        libc.fallocate(descriptor, _FALLOC_KEEP_SIZE, ctypes.c_int64(size), ctypes.c_int64(length))
    with contextlib.suppress(OSError):
        start = max(0, size - CACHED_BYTES)
        os.posix_fadvise(descriptor, start, size - start, os.POSIX_FADV_DONTNEED)
