"""Focal loss of a binary mask: the supervision of Further than CFAR."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def binary_focal_loss(logits: Tensor, mask: Tensor, alpha: float = 0.99, gamma: float = 2.0) -> Tensor:
    """Return the mean over all cells of the focal loss of `logits` against a 0/1 `mask` of their shape, a scalar.

    Cells of the mask weigh `alpha`, all others 1 - `alpha`. Written on logits: with z the logit towards the truth,
    (1 - p)^gamma is exp(gamma logsigmoid(-z)), so loss and gradient are finite for any finite logit.
    """
    if logits.shape != mask.shape:
        raise ValueError(f"logits must have the mask's shape {tuple(mask.shape)}, got {tuple(logits.shape)}")
    # half precision cannot represent the weights of confident cells
    logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
    mask = mask.to(logits.dtype)
    towards_truth = (2.0 * mask - 1.0) * logits
    weight = alpha * mask + (1.0 - alpha) * (1.0 - mask)
    focus = (gamma * functional.logsigmoid(-towards_truth)).exp()
    return -(weight * focus * functional.logsigmoid(towards_truth)).mean()
