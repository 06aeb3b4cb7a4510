"""Confocal transients in MATLAB's files: `rect_data` [points, points, bins] and `width`, half the square's side.

The layout of the Stanford confocal data sets (2018): counts with each wall point's own return shifted to bin 0, bins
of 4 ps that the file does not name.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lab.transients.scan import ConfocalTransients, require_layout
from msgs.files.unpacking import limited_memory

DEFAULT_BIN_S = 4e-12
COUNTS, HALF_WIDTH = "rect_data", "width"
#: Bytes of a file, which may be packed.
MAX_FILE_BYTES = 1 << 28
MAX_COUNT = (1 << 32) - 1
#: Memory to read one: what a variable unpacks to is not bounded, its counts as doubles are 128 MiB.
MAX_READ_BYTES = 1 << 29


def read_confocal(path: Path, bin_s: float = DEFAULT_BIN_S) -> ConfocalTransients:
    """Return the transients of a `.mat` file of version 5 to 7.

    Raises `ValueError` for a file that is none, cut or too large, for a field that is missing or not as above, and for
    counts that are negative, no whole numbers or not finite; `OSError` where it cannot be read.
    """
    if (size := path.stat().st_size) > MAX_FILE_BYTES:
        raise ValueError(f"{path}: must hold at most {MAX_FILE_BYTES} bytes, got {size}")
    _require_fields(path, {name: (shape, kind) for name, shape, kind in _listed(path)})
    content = _loaded(path)
    try:
        return ConfocalTransients(_counts(content[COUNTS]), _half_width_m(content[HALF_WIDTH]), bin_s)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _listed(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """Return names, shapes and classes of a file's variables, before any is unpacked."""
    from scipy.io import whosmat

    return _parsed(path, lambda: whosmat(str(path), appendmat=False))


def _loaded(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    return _parsed(path, lambda: loadmat(str(path), appendmat=False, variable_names=[COUNTS, HALF_WIDTH]))


def _parsed(path: Path, parse: Callable[[], Any]) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            with limited_memory(MAX_READ_BYTES):
                return parse()
        except Exception as error:
            # scipy's parser documents no errors: cut and foreign bytes raise what they happen to break, an OSError
            # without a number where they end too early
            if isinstance(error, OSError) and error.errno is not None:
                raise
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(f"{path}: must be a whole MATLAB file of version 5 to 7: {reason}") from None


def _require_fields(path: Path, listed: dict[str, tuple[tuple[int, ...], str]]) -> None:
    for name in (COUNTS, HALF_WIDTH):
        if name not in listed:
            raise ValueError(f"{path}: {name} is missing, the file holds {', '.join(sorted(listed)) or 'nothing'}")
        shape, kind = listed[name]
        if kind in ("cell", "struct", "object", "char", "sparse", "function", "opaque"):
            raise ValueError(f"{path}: {name} must be an array of numbers, got class {kind!r}")
        if name == HALF_WIDTH and math.prod(shape) != 1:
            raise ValueError(f"{path}: {name} must be a single number, got shape {tuple(shape)}")
    try:
        require_layout(COUNTS, listed[COUNTS][0])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _counts(values: np.ndarray) -> np.ndarray:
    if values.dtype.kind not in "uif":
        raise ValueError(f"{COUNTS} must be real numbers, got {values.dtype}")
    require_layout(COUNTS, values.shape)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise ValueError(f"{COUNTS} must be finite, got {int((~np.isfinite(values)).sum())} counts that are not")
    low, high = values.min(), values.max()
    if low < 0 or high > MAX_COUNT:
        raise ValueError(f"{COUNTS} must lie in 0..{MAX_COUNT}, got {(low if low < 0 else high).item()!r}")
    if values.dtype.kind == "f" and (np.floor(values) != values).any():
        raise ValueError(
            f"{COUNTS} must be whole numbers of photons, got {float(values[np.floor(values) != values][0])}"
        )
    return values.astype(np.uint32)


def _half_width_m(values: np.ndarray) -> float:
    if values.dtype.kind not in "uif" or values.size != 1:
        raise ValueError(f"{HALF_WIDTH} must be a single real number, got {values.dtype} {tuple(values.shape)}")
    half_width_m = float(values.ravel()[0])
    if not (math.isfinite(half_width_m) and half_width_m > 0.0):
        raise ValueError(f"{HALF_WIDTH} must be finite and positive, got {half_width_m!r}")
    return half_width_m
