"""Target heatmaps of the dense network, Eq. (22)."""

from __future__ import annotations

import numpy as np

#: Beyond this many sigma a Gaussian is left out (5e-7 of its peak).
REACH_SIGMA = 5.4
#: Line of sight and mirrored.
PATH_CLASSES = 2


def gaussian_heatmap(shape: tuple[int, int], row: np.ndarray, column: np.ndarray, sigma_px: float = 1.0) -> np.ndarray:
    """Return the maximum of the Gaussians around points, float32 [rows, columns], Eq. (22).

    It is exactly 1 in the cell of each point. `row` and `column` are fractional cells [points]; each is rounded to its
    cell, points off the map are left out.
    """
    heatmap = np.zeros(shape, np.float32)
    reach = int(np.ceil(REACH_SIGMA * sigma_px))
    offset = np.arange(-reach, reach + 1)
    kernel = np.exp(-np.add.outer(offset**2, offset**2) / (2.0 * sigma_px**2)).astype(np.float32)
    cells = np.stack([np.rint(row), np.rint(column)], axis=-1).astype(np.int64)
    inside = ((cells >= 0) & (cells < shape)).all(axis=-1)
    for i, j in cells[inside]:
        top, left = max(i - reach, 0), max(j - reach, 0)
        patch = heatmap[top : i + reach + 1, left : j + reach + 1]
        kernel_top, kernel_left = top - (i - reach), left - (j - reach)
        clipped = kernel[kernel_top : kernel_top + patch.shape[0], kernel_left : kernel_left + patch.shape[1]]
        np.maximum(patch, clipped, out=patch)
    return heatmap


def class_heatmaps(
    shape: tuple[int, int],
    row: np.ndarray,
    column: np.ndarray,
    path_class: np.ndarray,
    sigma_px: float = 1.0,
) -> np.ndarray:
    """Return one heatmap per path class, float32 [classes, rows, columns]."""
    return np.stack(
        [gaussian_heatmap(shape, row[path_class == k], column[path_class == k], sigma_px) for k in range(PATH_CLASSES)]
    )


def class_masks(shape: tuple[int, int], row: np.ndarray, column: np.ndarray, path_class: np.ndarray) -> np.ndarray:
    """Return one mask per path class, float32 [classes, rows, columns]: 1 in the cell of each point, 0 elsewhere."""
    masks = np.zeros((PATH_CLASSES, *shape), np.float32)
    cells = np.stack([np.rint(row), np.rint(column)], axis=-1).astype(np.int64)
    inside = ((cells >= 0) & (cells < shape)).all(axis=-1)
    masks[path_class[inside], cells[inside, 0], cells[inside, 1]] = 1.0
    return masks
