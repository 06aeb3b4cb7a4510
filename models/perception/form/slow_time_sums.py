"""Folding: a beam's chirps summed into a few slow-time groups, in integers, at about the speed of memory.

Group g of G sums the chirps floor(g C / G) .. floor((g+1) C / G) - 1 of C.
"""

from __future__ import annotations

import numpy as np

from models.compiled import compiled
from msgs.values.arrays import require_array

#: Codes from here on, in magnitude, count as full scale.
SATURATION_CODE = 32767
#: 65536 codes of -32768 sum to -2^31, the last value an int32 holds.
MAX_CHIRPS_PER_GROUP = 65536
#: Codes summed at a time: a block's 32-bit sums stay in cache while its chirps stream by.
_BLOCK = 16384


def group_edges(chirps: int, groups: int) -> np.ndarray:
    """Return the first chirp of each group and the number of chirps, int64 [groups + 1]; `ValueError` on overflow."""
    if not 1 <= groups <= chirps:
        raise ValueError(f"groups must be 1..chirps = {chirps}, got {groups!r}")
    edges = np.arange(groups + 1, dtype=np.int64) * chirps // groups
    if int(np.diff(edges).max()) > MAX_CHIRPS_PER_GROUP:
        raise ValueError(f"chirps per group must be at most {MAX_CHIRPS_PER_GROUP}, got {chirps} chirps in {groups}")
    return edges


def fold_chirps(samples: np.ndarray, groups: int) -> tuple[np.ndarray, int]:
    """Sum I/Q codes int16 [chirps, samples, 2] over groups; int32 [groups, samples, 2], and samples at full scale."""
    require_array("samples", samples, "<i2", (None, None, 2))
    chirps, length = samples.shape[:2]
    edges = group_edges(chirps, groups)
    codes = np.require(samples, requirements=("C", "A")).reshape(chirps, 2 * length)
    # messages come read-only, simulated beams do not: one compiled kernel for both
    codes.flags.writeable = False
    sums = np.zeros((groups, 2 * length), np.int32)
    saturated = _fold(codes, edges, sums)
    return sums.reshape(groups, length, 2), int(saturated)


@compiled
def _fold(codes: np.ndarray, edges: np.ndarray, sums: np.ndarray) -> int:
    """Add rows of `codes` [chirps, 2 samples] into `sums` [groups, 2 samples]; returns saturated samples."""
    saturated = 0
    for group in range(len(edges) - 1):
        first, last = edges[group], edges[group + 1]
        fours = last - (last - first) % 4
        for start in range(0, codes.shape[1], _BLOCK):
            block = slice(start, min(start + _BLOCK, codes.shape[1]))
            # rows are sliced one by one: a row of a two-dimensional slice would be a strided array, and slow
            total = sums[group, block]
            for row in range(first, fours, 4):
                if _add_four(
                    codes[row, block], codes[row + 1, block], codes[row + 2, block], codes[row + 3, block], total
                ):
                    saturated += _count_saturated(codes[row : row + 4, block])
            for row in range(fours, last):
                total += codes[row, block]
                saturated += _count_saturated(codes[row : row + 1, block])
    return saturated


@compiled
def _add_four(first: np.ndarray, second: np.ndarray, third: np.ndarray, fourth: np.ndarray, total: np.ndarray) -> bool:
    """Add four rows to `total`, without a branch for SIMD; return whether any code is at full scale."""
    highest = np.int16(0)
    lowest = np.int16(0)
    for i in range(len(total)):
        a, b, c, d = first[i], second[i], third[i], fourth[i]
        total[i] += np.int32(a) + np.int32(b) + np.int32(c) + np.int32(d)
        highest = max(highest, a, b, c, d)
        lowest = min(lowest, a, b, c, d)
    return bool(highest >= SATURATION_CODE or lowest <= -SATURATION_CODE)


@compiled
def _count_saturated(rows: np.ndarray) -> int:
    """Return the samples of interleaved I/Q codes with either at full scale: run on the rare blocks that have any."""
    count = 0
    for row in rows:
        for i in range(0, len(row), 2):
            if abs(np.int32(row[i])) >= SATURATION_CODE or abs(np.int32(row[i + 1])) >= SATURATION_CODE:
                count += 1
    return count
