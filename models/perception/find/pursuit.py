"""Pursuit of peaks in a confidence map: take the highest cell, subtract what one point there explains, repeat.

Where several points are uncertain the map holds one broad hill, which gives as many peaks as its mass is worth.
"""

from __future__ import annotations

import numpy as np

from models.compiled import compiled

#: Blur before the pursuit, in cells (range, azimuth): it joins those over which a point's confidence is scattered.
BLUR = 0.5, 2.0
#: Standard deviations of the Gaussian that one point explains, in cells.
EXPLAINED = 1.5, 2.5
#: More peaks than this in one map are noise.
MAX_PEAKS = 512


def pursued_peaks(confidence: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells int64 [N, 2] and scores float64 [N] of a confidence map [range, azimuth], strongest first.

    A score is what is left of the blurred confidence when its cell is taken; none is below `threshold`. Of equal cells
    the first one is taken. Cells that are not finite count as empty.
    """
    if confidence.ndim != 2:
        raise ValueError(f"confidence must have shape [range, azimuth], got {confidence.shape}")
    if not threshold > 0.0:
        raise ValueError(f"threshold must be positive, got {threshold!r}")
    # as it comes from a network, or in one other type: for each of them the blur is compiled
    plain = np.ascontiguousarray(confidence, np.float32 if confidence.dtype == np.float32 else np.float64)
    left = _blurred(plain, threshold, *(_gaussian(std) for std in BLUR))
    return _pursue(left, threshold, _kept(EXPLAINED), MAX_PEAKS)


def _gaussian(std: float) -> np.ndarray:
    """Return the weights of a blur out to four standard deviations, of sum 1; of one cell where there is none."""
    reach = int(4.0 * std + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(std, 1e-9)) ** 2)
    return np.asarray(weights / weights.sum())


@compiled
def _blurred(confidence: np.ndarray, threshold: float, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return a map [rows, columns] blurred by both kernels, float64; rows without a cell at the threshold stay zero."""
    rows, columns = confidence.shape
    reach_row, reach_column = len(down) // 2, len(across) // 2
    hot = np.zeros(rows, np.bool_)
    for i in range(rows):
        for j in range(columns):
            if confidence[i, j] >= threshold and np.isfinite(confidence[i, j]):
                hot[max(i - reach_row, 0) : i + reach_row + 1] = True
                break
    blurred, padded = np.zeros((rows, columns)), np.zeros(columns + 2 * reach_column)
    for i in range(rows):
        if not hot[i]:
            continue
        padded[:] = 0.0
        inside, of_row = padded[reach_column : reach_column + columns], blurred[i]
        for row in range(max(i - reach_row, 0), min(i + reach_row + 1, rows)):
            weight, source = down[row - i + reach_row], confidence[row]
            for j in range(columns):
                inside[j] += weight * (np.float64(source[j]) if np.isfinite(source[j]) else 0.0)
        for offset in range(len(across)):
            weight, shifted = across[offset], padded[offset : offset + columns]
            for j in range(columns):
                of_row[j] += weight * shifted[j]
    return blurred


def _kept(explained: tuple[float, float]) -> np.ndarray:
    """Return the factor that a point leaves of the cells about it: 1 less its Gaussian, out to three sigma."""
    row, column = (np.arange(-int(np.ceil(3.0 * std)), int(np.ceil(3.0 * std)) + 1) / std for std in explained)
    return 1.0 - np.exp(-0.5 * np.add.outer(row**2, column**2))


@compiled
def _highest(left: np.ndarray, row: int) -> tuple[float, int]:
    """Return the highest value of a row and its column, the first of equals."""
    value, column = left[row, 0], 0
    for j in range(1, left.shape[1]):
        if left[row, j] > value:
            value, column = left[row, j], j
    return value, column


@compiled
def _pursue(left: np.ndarray, threshold: float, kept: np.ndarray, max_peaks: int) -> tuple[np.ndarray, np.ndarray]:
    """Take cells of `left` [rows, columns] while the highest reaches the threshold; changes `left`."""
    rows, columns = left.shape
    reach_row, reach_column = kept.shape[0] // 2, kept.shape[1] // 2
    highest, at = np.empty(rows), np.empty(rows, np.int64)
    for i in range(rows):
        highest[i], at[i] = _highest(left, i)
    cells, scores = np.empty((max_peaks, 2), np.int64), np.empty(max_peaks)
    count = 0
    while count < max_peaks:
        i = int(highest.argmax())
        if highest[i] < threshold:
            break
        j = at[i]
        cells[count, 0], cells[count, 1], scores[count] = i, j, highest[i]
        count += 1
        first, last = max(j - reach_column, 0), min(j + reach_column, columns - 1)
        for row in range(max(i - reach_row, 0), min(i + reach_row + 1, rows)):
            for column in range(first, last + 1):
                left[row, column] *= kept[row - i + reach_row, column - j + reach_column]
            # values only fall: a row's highest stays where it lies outside
            if first <= at[row] <= last:
                highest[row], at[row] = _highest(left, row)
    return cells[:count], scores[:count]
