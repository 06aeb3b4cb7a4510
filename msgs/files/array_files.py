"""Arrays from .npy and .npz files of others: nothing is allocated or trusted before it is checked."""

from __future__ import annotations

import lzma
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import IO

import numpy as np

#: No archive of this project comes near; one that unpacks to more would exhaust memory. One of zeros is a thousandth of
#: what it unpacks to: beyond the first size it may be so many times the file.
MAX_UNPACKED_BYTES, FREE_UNPACKED_BYTES, MAX_UNPACKED_RATIO = 1 << 33, 1 << 29, 100
#: Exceptions of numpy, zip and their decompressors for bytes of another format.
_TROUBLE = (
    ValueError, TypeError, KeyError, EOFError, SyntaxError, SystemError, ArithmeticError, MemoryError, RecursionError,
    RuntimeError, tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error, lzma.LZMAError,
)  # fmt: skip


def load_array(path: Path) -> np.ndarray:
    """Return the array of a .npy file; raises `ValueError` with a reason of one line, `OSError` if it is unreadable."""
    with path.open("rb") as file:
        try:
            return _read(file, path.stat().st_size)
        except _TROUBLE as error:
            raise ValueError(_reason(error)) from None


def array_header(path: Path) -> tuple[tuple[int, ...], np.dtype, int]:
    """Return shape and type of a .npy file in C order and its first byte of data, of which some may be missing."""
    with path.open("rb") as file, warnings.catch_warnings():
        # as in `_read`
        warnings.simplefilter("ignore")
        try:
            shape, is_fortran, dtype = _header(file)
        except _TROUBLE as error:
            raise ValueError(_reason(error)) from None
        if is_fortran or dtype.hasobject or min(shape, default=0) < 0:
            raise ValueError(f"must hold numbers in C order, got {dtype} {shape}")
        return shape, dtype, file.tell()


def load_arrays(source: Path | IO[bytes], only: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of a .npz archive by name, of `only` those that it has; `ValueError` with the reason."""
    try:
        with zipfile.ZipFile(source) as archive:
            infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            unpacked = sum(info.file_size for info in infos.values())
            stored = sum(info.compress_size for info in infos.values())
            limit = min(MAX_UNPACKED_BYTES, max(FREE_UNPACKED_BYTES, MAX_UNPACKED_RATIO * stored))
            if unpacked > limit:
                raise ValueError(f"unpacks to {unpacked} bytes, at most {limit} are read of {stored} stored ones")
            return {name: _member(archive, info) for name, info in infos.items() if only is None or name in only}
    except _TROUBLE as error:
        raise ValueError(_reason(error)) from None


def array_names(path: Path) -> list[str]:
    """Return names of the arrays of a .npz archive; raises as `load_arrays` does."""
    try:
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except _TROUBLE as error:
        raise ValueError(_reason(error)) from None


def is_archive(path: Path) -> bool:
    """Return whether a file is a .npz archive by its first bytes, whatever its name."""
    with path.open("rb") as file:
        return file.read(2) == b"PK"


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as file:
        return _read(file, info.file_size)


def _read(file: IO[bytes], size: int) -> np.ndarray:
    """Return one array of a file of `size` bytes; a header that promises more than that is refused, not allocated."""
    with warnings.catch_warnings():
        # a header written by Python 2 is slow to read, but valid
        warnings.simplefilter("ignore")
        shape, _, dtype = _header(file)
        promised = math.prod(shape) * dtype.itemsize
        # objects are refused by numpy itself, as pickle is not allowed
        if not dtype.hasobject and (min(shape, default=0) < 0 or promised > size):
            raise ValueError(f"header promises {dtype} {shape}, {promised} bytes, of a file of {size}")
        file.seek(0)
        array: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    if dtype.kind == "U":
        # invalid characters would raise SystemError later, when they are used
        array.tolist()
    return array


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, whether it is in Fortran's order, and type."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read_header(file)


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
