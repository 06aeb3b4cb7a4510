"""Checks that a message's arrays match its type; used by every `__post_init__`."""

from __future__ import annotations

import numpy as np

#: Permitted dtypes. No object, no structured, no datetime dtype: nothing that could carry code or pointers.
DTYPES = frozenset({"|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8", "<c8", "<c16"})
MAX_NDIM = 6
#: Stamps beyond this, 146 years, fit no message: neither two of them nor their difference would fit 64 bits.
MAX_STAMP_NS = 1 << 62


def require_array(name: str, array: np.ndarray, dtype: str, shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` naming the field unless `array` has `dtype` ("<c8") and `shape` (None: any length)."""
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name} must be an array, got {type(array).__name__}")
    if array.dtype.str != dtype:
        raise ValueError(f"{name} must have dtype {dtype}, got {array.dtype.str}")
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = "x".join("?" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must have shape {expected}, got {array.shape}")


def require_finite(name: str, *values: float) -> None:
    """Raise `ValueError` naming the field unless every value is finite."""
    for value in values:
        if not np.isfinite(value):
            raise ValueError(f"{name} must be finite, got {value!r}")


def require_positive(name: str, value: float) -> None:
    """Raise `ValueError` naming the field unless `value` is finite and above zero."""
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be finite and positive, got {value!r}")


def require_within(name: str, minimum: float, maximum: float, *values: float) -> None:
    """Raise `ValueError` naming the field unless every value lies in `minimum`..`maximum`, ends included."""
    for value in values:
        if not minimum <= value <= maximum:
            raise ValueError(f"{name} must lie in {minimum:g}..{maximum:g}, got {value!r}")


def require_stamps(name: str, *stamps_ns: int | np.ndarray) -> None:
    """Raise `ValueError` naming the field unless every stamp [ns] lies within `MAX_STAMP_NS` of zero."""
    for stamp_ns in stamps_ns:
        ends = (stamp_ns,) if isinstance(stamp_ns, int) else (stamp_ns.min(initial=0), stamp_ns.max(initial=0))
        for end in ends:
            if not -MAX_STAMP_NS <= end <= MAX_STAMP_NS:
                raise ValueError(f"{name} must lie within 2^62 ns of zero, got {end}")
