"""Loss of the dense network."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

#: Exponents of Eq. (23).
ALPHA, BETA = 2.0, 4.0


def heatmap_focal_loss(logits: Tensor, heatmap: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the focal loss of Eq. (23), a scalar; `logits` and `heatmap` are of one shape, `heatmap` is 1 at peaks.

    Written on logits: log c = logsigmoid(z), log(1 - c) = -softplus(z), so no probability is clamped and gradients
    stay finite for any logit. Divided by the number of peaks; without a peak, the sum of the negatives. `weights`
    (None: all 1) multiply the terms they are broadcast to. Raises `ValueError` if shapes differ.
    """
    if logits.shape != heatmap.shape:
        raise ValueError(f"logits must have the heatmap's shape {tuple(heatmap.shape)}, got {tuple(logits.shape)}")
    # half precision holds neither the square of a small confidence nor a sum over a map
    logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
    is_peak = heatmap == 1.0
    weight = torch.ones_like(heatmap) if weights is None else weights.expand_as(heatmap).to(heatmap.dtype)
    at_peak = logits[is_peak]
    positive = weight[is_peak] * torch.sigmoid(-at_peak) ** ALPHA * -functional.logsigmoid(at_peak)
    # (1 - Y)^BETA is zero at the peaks themselves
    negative = _Negatives.apply(logits, weight * (1.0 - heatmap) ** BETA)
    return (positive.sum() + negative) / is_peak.sum().clamp(min=1)


class _Negatives(torch.autograd.Function):
    """Sum of w c^ALPHA softplus(z) with c = sigmoid(z), and its derivative w c^ALPHA (ALPHA (1 - c) softplus(z) + c).

    Nearly all cells are negatives and the head is wide: in autograd, these few products were a quarter of the
    time of a training step.
    """

    @staticmethod
    def forward(ctx: Any, logits: Tensor, weight: Tensor) -> Tensor:
        confidence, softplus = torch.sigmoid(logits), functional.softplus(logits)
        scaled = weight * confidence**ALPHA
        ctx.save_for_backward(scaled * (ALPHA * (1.0 - confidence) * softplus + confidence))
        return (scaled * softplus).sum()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (derivative,) = ctx.saved_tensors
        return gradient * derivative, None
