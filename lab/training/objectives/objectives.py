"""Objectives of a network, and the reading of its answer: heatmaps, plain segmentation, anchors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from lab.training.data.samples import PointLabels
from lab.training.objectives.anchors import anchor_loss, anchor_targets
from lab.training.objectives.focal import binary_focal_loss
from lab.training.objectives.heatmaps import class_heatmaps, class_masks
from lab.training.objectives.losses import heatmap_focal_loss
from models.perception.find.anchors import anchor_points
from models.perception.find.peaks import PeakParams, Points, heatmap_points

#: Gaussian heatmaps and Eq. (23); the focal segmentation of Further than CFAR; anchors with offsets.
ObjectiveKind = Literal["heatmap", "binary_focal", "anchors"]


@dataclass(frozen=True, kw_only=True)
class ObjectiveConfig:
    """Target and loss of a run."""

    kind: ObjectiveKind = "heatmap"
    #: Width of the Gaussians, in cells.
    sigma_px: float = 1.0
    #: Weights of the classes LOS and mirrored (1.5 and 1.0 where real captures are fine-tuned on).
    class_weights: tuple[float, float] = (1.0, 1.0)
    #: Weight of a positive cell against a negative one, binary_focal.
    alpha: float = 0.99


class Objective(Protocol):
    """Loss of a batch of raw answers, and the points of one."""

    def loss(self, answer: Tensor, labels: Sequence[PointLabels]) -> Tensor:
        """Return scalar loss of answers [batch, ...] against the truth of each map."""

    def points(self, answer: np.ndarray, floor: float) -> Points:
        """Return points of one raw answer with at least this score."""


def objective_of(config: ObjectiveConfig, network: Any) -> Objective:
    """Return the objective of a network of this configuration; `ValueError` if only one of them has anchors."""
    stride = getattr(network, "anchor_stride", None)
    if (config.kind == "anchors") != (stride is not None):
        rule = "not be anchors for a network without anchors" if stride is None else "be anchors for such a network"
        raise ValueError(f"objective.kind must {rule}, got {config.kind!r}")
    if stride is not None:
        return Anchors(stride, network.output_shape[1:])
    return Heatmaps(config, network.output_shape[1:])


class Heatmaps:
    """Answers are logits of each class in each cell."""

    def __init__(self, config: ObjectiveConfig, shape: tuple[int, int]) -> None:
        self.config, self.shape = config, shape

    def loss(self, answer: Tensor, labels: Sequence[PointLabels]) -> Tensor:
        """Return scalar loss of logits [batch, 2, range, azimuth]."""
        config = self.config
        if config.kind == "heatmap":
            heatmaps = [
                class_heatmaps(self.shape, p.row, p.column, p.path_class, sigma_px=config.sigma_px) for p in labels
            ]
            weights = torch.tensor(config.class_weights, device=answer.device).reshape(1, -1, 1, 1)
            return heatmap_focal_loss(answer, torch.from_numpy(np.stack(heatmaps)).to(answer.device), weights=weights)
        masks = np.stack([class_masks(self.shape, p.row, p.column, p.path_class) for p in labels])
        mask = torch.from_numpy(masks).to(answer.device)
        return binary_focal_loss(answer, mask, config.alpha)

    def points(self, answer: np.ndarray, floor: float) -> Points:
        """Return local maxima of the confidence, section 3.1.1."""
        return heatmap_points(expit(answer), floor, PeakParams().min_distance)


class Anchors:
    """Answers are three class logits and an offset for each anchor, section 4.1."""

    def __init__(self, stride: int, shape: tuple[int, int]) -> None:
        self.stride, self.shape = stride, shape

    def loss(self, answer: Tensor, labels: Sequence[PointLabels]) -> Tensor:
        """Return scalar loss of answers [batch, 5, rows, columns]."""
        classes, offsets = anchor_targets(labels, self.shape, self.stride)
        device = answer.device
        return anchor_loss(answer, torch.from_numpy(classes).to(device), torch.from_numpy(offsets).to(device))

    def points(self, answer: np.ndarray, floor: float) -> Points:
        """Return anchors that are not noise, moved by their offsets."""
        return anchor_points(answer, self.stride, floor, PeakParams().min_distance)
