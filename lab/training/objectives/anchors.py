"""Targets of the anchors of a radar tensor network, and their loss."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lab.training.data.samples import PointLabels
from models.perception.find.anchors import NOISE, anchor_cells


def anchor_targets(
    labels: Sequence[PointLabels], shape: tuple[int, int], stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return class [batch, rows, columns] (int64), offset [batch, 2, rows, columns] (float32, cells) of every anchor.

    `shape` is (rows, columns) of the anchors. An anchor within 1.5 cells or one stride of a point takes the class of
    the nearest and the offset to it, any other is noise: every point has an anchor.
    """
    targets = [_map_targets(at, shape, stride, max(1.5, float(stride))) for at in labels]
    return np.stack([classes for classes, _ in targets]), np.stack([offsets for _, offsets in targets])


def _map_targets(
    labels: PointLabels, shape: tuple[int, int], stride: int, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the targets of one map; points off the map are left out."""
    at = np.stack([labels.row, labels.column], axis=-1).astype(np.float64)
    on_map = ((at > -0.5) & (at < stride * np.array(shape) - 0.5)).all(axis=-1)
    anchor, offset, owner = _anchors_about(at[on_map], stride, radius)
    near = ((anchor >= 0) & (anchor < shape)).all(axis=-1) & (np.hypot(*offset.T) <= radius)
    anchor, offset, owner = anchor[near], offset[near], owner[near]
    # of two writes to one anchor the later stays: farthest first, so that the nearest point has it
    order = np.argsort(np.hypot(*offset.T), kind="stable")[::-1]
    i, j = anchor[order].T
    classes = np.full(shape, NOISE, np.int64)
    offsets = np.zeros((2, *shape), np.float32)
    classes[i, j] = labels.path_class[on_map][owner[order]]
    offsets[:, i, j] = offset[order].T
    return classes, offsets


def _anchors_about(at: np.ndarray, stride: int, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return anchors in a square about each point: indices [N, 2], offsets to the points [N, 2], their indices [N]."""
    reach = math.ceil(radius / stride)
    step = np.arange(-reach, reach + 1)
    square = np.stack(np.meshgrid(step, step, indexing="ij"), axis=-1).reshape(-1, 2)
    first = anchor_cells(1, stride)
    anchor = (np.rint((at - first) / stride).astype(np.int64)[:, None] + square).reshape(-1, 2)
    owner = np.repeat(np.arange(len(at)), len(square))
    return anchor, at[owner] - (first + stride * anchor), owner


def anchor_loss(output: Tensor, classes: Tensor, offsets: Tensor) -> Tensor:
    """Return the loss of an answer [batch, 5, rows, columns] against the targets of `anchor_targets`, a scalar.

    Softmax focal loss (gamma 2), its mean over the anchors of points plus its mean over noise, so that the many do not
    outweigh the few; and the smooth l1 distance [cells] of the offsets of anchors of points, its mean. Finite without a
    single point and for any finite logit.
    """
    if output.shape[0] != len(classes) or output.shape[2:] != classes.shape[1:]:
        raise ValueError(f"classes must fit the output {tuple(output.shape)}, got {tuple(classes.shape)}")
    is_point = classes != NOISE
    log_probability = torch.log_softmax(output[:, : NOISE + 1].float(), dim=1)
    log_probability = log_probability.gather(1, classes[:, None]).squeeze(1)
    focal = -((1.0 - log_probability.exp()) ** 2) * log_probability
    distance = functional.smooth_l1_loss(output[:, NOISE + 1 :].float(), offsets, reduction="none").sum(dim=1)
    return _mean_where(focal + distance, is_point) + _mean_where(focal, ~is_point)


def _mean_where(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of the values under a mask, 0 where it is empty."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)
