"""Compressed bytes of others, unpacked to no more than is asked for: every frame, and nothing beyond the limit."""

from __future__ import annotations

import contextlib
import resource
import threading
import zlib
from collections.abc import Iterator
from io import BufferedIOBase, BytesIO, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard

#: A limit of memory is of the process: it is set by one at a time.
_LIMITING = threading.Lock()
#: Exceptions of the decompressors for bytes that are not theirs.
UNPACKING_ERRORS = (zstandard.ZstdError, RuntimeError, zlib.error, EOFError, MemoryError)


def unpack(data: bytes, method: str, limit: int) -> bytes:
    """Return what all frames of `data` unpack to by "zstd", "lz4", "zlib" or "" (none), at most `limit` bytes and one.

    May raise any of `UNPACKING_ERRORS`, and `ValueError` for another method or data that end within a frame: of zstd
    whole frames are taken then.
    """
    if method == "" or not data:
        return data
    if method == "zstd":
        # one call unpacks the first frame alone
        with zstandard.ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True) as reader:
            return reader.read(limit + 1)
    if method == "zlib":
        stream = zlib.decompressobj()
        unpacked = stream.decompress(data, limit + 1)
        if not stream.eof and len(unpacked) <= limit:
            raise ValueError("ends within a zlib stream")
        return unpacked
    if method != "lz4":
        raise ValueError(f"compression must be zstd, lz4 or none, got {method[:20]!r}")
    with lz4.frame.open(BytesIO(data)) as frames:
        try:
            return bytes(frames.read(limit + 1))
        except EOFError:
            raise ValueError("ends within an lz4 frame") from None


class Budget:
    """What a stream may unpack to: 8 MiB and a hundred times what was read; logs become 3 to 30 times smaller."""

    FREE_BYTES, RATIO = 1 << 23, 100

    def __init__(self) -> None:
        self._unpacked = 0

    def spend(self, unpacked: int, read: int) -> None:
        """Count `unpacked` more bytes, of `read` bytes read so far; raises `ValueError` beyond the budget."""
        self._unpacked += unpacked
        if self._unpacked > self.FREE_BYTES + self.RATIO * read:
            raise ValueError(
                f"unpacks to more than {self.FREE_BYTES} bytes and {self.RATIO} times what is read, {read} bytes so far"
            )


class UnpackedFile(RawIOBase):
    """What a compressed file unpacks to, read forward within a `Budget`."""

    def __init__(self, unpacking: BufferedIOBase, stored: BinaryIO) -> None:
        self._unpacking, self._stored = unpacking, stored
        self._budget = Budget()

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Fill a buffer, or part of it; returns the number of bytes, 0 at the end."""
        # of a file that is cut off all is taken that unpacks
        data = self._unpacking.read1(min(len(buffer), self._budget.FREE_BYTES))
        self._budget.spend(len(data), self._stored.tell())
        buffer[: len(data)] = data
        return len(data)


@contextlib.contextmanager
def limited_memory(more_bytes: int) -> Iterator[None]:
    """Have allocations of this process fail beyond `more_bytes` of what it holds."""
    with _LIMITING:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        held = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
        limit = held + more_bytes if soft == resource.RLIM_INFINITY else min(soft, held + more_bytes)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
