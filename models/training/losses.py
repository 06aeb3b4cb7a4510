"""Loss of the dense network."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def heatmap_focal_loss(
    logits: Tensor, heatmap: Tensor, alpha: float = 2.0, beta: float = 4.0, weights: Tensor | None = None
) -> Tensor:
    """Focal loss of Eq. (23), a scalar; `logits` and `heatmap` have the same shape, `heatmap` is 1 at each peak.

    Written on logits: log c = logsigmoid(z), log(1 - c) = logsigmoid(-z), so no probability is clamped and gradients
    stay finite for any logit. Divided by the number of peaks; without a peak, the sum of the negatives. `weights`
    (None: all one) multiply the terms they are broadcast to. Raises `ValueError` where shapes differ.
    """
    if logits.shape != heatmap.shape:
        raise ValueError(f"logits must have the heatmap's shape {tuple(heatmap.shape)}, got {tuple(logits.shape)}")
    is_peak = heatmap == 1.0
    confidence = torch.sigmoid(logits)
    at_peak = (1.0 - confidence) ** alpha * functional.logsigmoid(logits)
    elsewhere = (1.0 - heatmap) ** beta * confidence**alpha * functional.logsigmoid(-logits)
    terms = torch.where(is_peak, at_peak, elsewhere)
    return -(terms if weights is None else weights * terms).sum() / is_peak.sum().clamp(min=1)
