"""Points from the output of a radar tensor network: one anchor every few cells, each with classes and an offset."""

from __future__ import annotations

import numpy as np

from models.perception.find.peaks import Points, keep_apart
from msgs.values.perception import PathClass

#: Class of an anchor without a point; the path classes come before it.
NOISE = len(PathClass)
#: Channels of an answer: class logits with noise last, then the offset (range, azimuth) in cells of the map.
CHANNELS = NOISE + 3


def anchor_cells(count: int, stride: int) -> np.ndarray:
    """Return the fractional cells [count] of the anchors of one axis: the middle of each `stride` cells of the map."""
    return stride * np.arange(count) + 0.5 * (stride - 1)


def anchor_points(output: np.ndarray, stride: int, threshold: float, min_distance: int) -> Points:
    """Return the points in an answer [5, rows, columns], in cells of the map.

    A point is an anchor plus its offset, kept on the map. The class probability of the anchor is at least `threshold`
    and no less than that of its neighbours. One within `min_distance` cells (on both axes) of a stronger one of its
    class is left out. Raises ValueError for another shape or values not finite.
    """
    # here: a network of heatmaps has no anchors
    from scipy import ndimage

    if output.ndim != 3 or output.shape[0] != CHANNELS:
        raise ValueError(f"output must have shape ({CHANNELS}, rows, columns), got {output.shape}")
    if stride < 1:
        raise ValueError(f"stride must be at least 1, got {stride}")
    if not np.isfinite(output).all():
        raise ValueError(f"output must be finite, got {np.count_nonzero(~np.isfinite(output))} values that are not")
    logits = output[: NOISE + 1].astype(np.float64)
    weight = np.exp(logits - logits.max(axis=0))
    probability = weight / weight.sum(axis=0)
    cells, score = [], []
    for channel in probability[:NOISE]:
        # Anchors are kept apart by where they point to, not by their own positions: with a stride, two points may lie
        # on neighbouring anchors.
        anchors = np.argwhere((channel >= threshold) & (channel >= ndimage.maximum_filter(channel, size=3)))
        level = channel[anchors[:, 0], anchors[:, 1]]
        anchors, level = anchors[order := np.argsort(-level, kind="stable")], level[order]
        points = _points(output, anchors, stride)
        kept = keep_apart(points, (min_distance, min_distance))
        cells.append(points[kept])
        score.append(level[kept])
    path_class = np.repeat(np.arange(NOISE, dtype=np.uint8), [len(at) for at in cells])
    return Points(cells=np.concatenate(cells), score=np.concatenate(score), path_class=path_class)


def _points(output: np.ndarray, anchors: np.ndarray, stride: int) -> np.ndarray:
    """Return the fractional cells [N, 2] to which the anchors [N, 2] point, kept on the map."""
    rows, columns = (anchor_cells(count, stride) for count in output.shape[1:])
    at = np.stack([rows[anchors[:, 0]], columns[anchors[:, 1]]], axis=-1)
    offset = output[NOISE + 1 :, anchors[:, 0], anchors[:, 1]].T
    return np.clip(at + offset, 0.0, stride * np.array(output.shape[1:]) - 1.0)
