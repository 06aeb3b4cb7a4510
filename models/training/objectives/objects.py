"""Loss of the object network: a focal loss over all hypotheses for existence, the rest at the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from models.perception.objects.answers import (
    ANSWERS,
    CENTRE,
    CLASS,
    HEADING,
    LOG_SIZE,
    LOG_STD,
    LOG_STD_LIMITS,
    OBJECT,
    PLACE,
)
from models.perception.objects.hypotheses import HYPOTHESES


@dataclass(frozen=True, kw_only=True)
class ObjectLossConfig:
    """Weights of the parts of the loss relative to that of existence."""

    object_class: float = 0.3
    place: float = 0.5
    size: float = 0.2
    heading: float = 0.1
    centre: float = 0.1


@dataclass(frozen=True)
class TrueHypotheses:
    """True hypotheses of a batch, N of them: int64 [N, 4] (sample, which, row, column), class [N], float32 values."""

    at: Tensor
    object_class: Tensor
    place_m: Tensor
    log_size: Tensor
    heading: Tensor
    centre_m: Tensor


def object_loss(answer: Tensor, heat: Tensor, true: TrueHypotheses, config: ObjectLossConfig) -> Tensor:
    """Return the loss of answers [B, K * answers, R, C] against targets [B, K, R, C], one at the true hypotheses."""
    said = answer.float().unflatten(1, (HYPOTHESES, ANSWERS))
    loss = existence_loss(said[:, :, OBJECT].squeeze(2), heat)
    if not len(true.at):
        return loss
    sample, which, row, column = true.at.unbind(1)
    values = said[sample, which, :, row, column]
    place = laplace_loss(values[:, PLACE], values[:, LOG_STD], true.place_m)
    parts = (
        (config.object_class, functional.cross_entropy(values[:, CLASS], true.object_class)),
        (config.place, place),
        (config.size, (values[:, LOG_SIZE] - true.log_size).abs().mean()),
        (config.heading, (values[:, HEADING] - true.heading).abs().mean()),
        (config.centre, (values[:, CENTRE] - true.centre_m).abs().mean()),
    )
    return loss + sum((weight * part for weight, part in parts), torch.zeros(()))


def existence_loss(logits: Tensor, heat: Tensor) -> Tensor:
    """Return the focal loss of logits against a target in 0..1 that is one at objects, per object.

    Cells beside an object count less: (1 - target)^4. (Law, Deng: CornerNet, Eq. (1).)
    """
    yes, no = functional.logsigmoid(logits), functional.logsigmoid(-logits)
    at_object = heat == 1.0
    hit = no.exp() ** 2 * yes
    miss = (1.0 - heat) ** 4 * yes.exp() ** 2 * no
    return -torch.where(at_object, hit, miss).sum() / at_object.sum().clamp_min(1)


def laplace_loss(place_m: Tensor, log_std: Tensor, true_m: Tensor) -> Tensor:
    """Return the mean negative log likelihood of errors under Laplace's law of the standard deviations said.

    Its scale is std / sqrt(2): log(sqrt(2) std) + sqrt(2) |error| / std.
    """
    log_std = log_std.clamp(*LOG_STD_LIMITS)
    root = 2.0**0.5
    return (log_std + root * (place_m - true_m).abs() * torch.exp(-log_std)).mean()
