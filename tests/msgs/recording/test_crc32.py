"""Checksums of bytes in pieces, against zlib over all of them."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from msgs.recording.crc32 import crc32_of_both


@pytest.mark.parametrize("sizes", [(0, 0), (0, 5), (5, 0), (1, 1), (9, 4096), (4096, 9), (3_000_000, (4 << 20) + 317)])
def test_the_checksum_of_both_is_that_of_all_bytes(sizes: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(sizes))
    first, second = (rng.bytes(size) for size in sizes)
    assert crc32_of_both(zlib.crc32(first), zlib.crc32(second), len(second)) == zlib.crc32(first + second)


def test_many_pieces_add_up() -> None:
    rng = np.random.default_rng(0)
    pieces = [rng.bytes(int(size)) for size in rng.integers(0, 300, 50)]
    total = 0
    for piece in pieces:
        total = crc32_of_both(total, zlib.crc32(piece), len(piece))
    assert total == zlib.crc32(b"".join(pieces))
