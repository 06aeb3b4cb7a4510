"""CRC-32 of joined bytes from those of the parts: to append n bytes multiplies by x^(8 n) over {0, 1}."""

from __future__ import annotations

from functools import lru_cache

_POLYNOMIAL = 0xEDB88320
_ONE, _X8 = 1 << 31, 1 << 23


def crc32_of_both(first: int, second: int, second_bytes: int) -> int:
    """Return the CRC-32 of bytes with CRC-32 `first` followed by `second_bytes` with CRC-32 `second`."""
    return _product(_shift(second_bytes), first) ^ second


@lru_cache(maxsize=64)
def _shift(size: int) -> int:
    """Return x^(8 size) modulo the polynomial."""
    power, square = _ONE, _X8
    while size:
        if size & 1:
            power = _product(power, square)
        square = _product(square, square)
        size >>= 1
    return power


def _product(first: int, second: int) -> int:
    """Return the product modulo the polynomial."""
    total = 0
    for bit in range(31, -1, -1):
        if first >> bit & 1:
            total ^= second
        second = second >> 1 ^ (_POLYNOMIAL if second & 1 else 0)
    return total
