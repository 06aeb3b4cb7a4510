"""Compressed bytes of others, unpacked to no more than is asked for: every frame, and nothing beyond the limit."""

from __future__ import annotations

import zlib
from io import BytesIO

import lz4.frame
import zstandard

#: Exceptions of the decompressors for bytes that are not theirs.
UNPACKING_ERRORS = (zstandard.ZstdError, RuntimeError, zlib.error, EOFError, MemoryError)


def unpack(data: bytes, method: str, limit: int) -> bytes:
    """Return what all frames of `data` unpack to, at most `limit` bytes and one: more is never held.

    Methods: "zstd", "lz4" (frames), "zlib", and "" for none. May raise any of `UNPACKING_ERRORS`, and `ValueError` for
    another method and for data that end within a frame.
    """
    if method == "":
        return data
    if method == "zstd":
        # one call unpacks the first frame alone
        with zstandard.ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True) as reader:
            return reader.read(limit + 1)
    if method == "zlib":
        return zlib.decompressobj().decompress(data, limit + 1)
    if method != "lz4":
        raise ValueError(f"compression must be zstd, lz4 or none, got {method[:20]!r}")
    unpacked = b""
    while data and len(unpacked) <= limit:
        frame = lz4.frame.LZ4FrameDecompressor()
        unpacked += frame.decompress(data, max_length=limit + 1 - len(unpacked))
        if not frame.eof and len(unpacked) <= limit:
            raise ValueError("ends within an lz4 frame")
        data = frame.unused_data or b""
    return unpacked
