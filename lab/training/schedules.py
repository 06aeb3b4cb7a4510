"""Optimisers and learning rates of dense training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig:
    """Optimiser and learning rate. Defaults: a one-cycle schedule for compact networks and short runs."""

    #: One_cycle: AdamW, up and down again. Constant: Adam. Steps: AdamW, the head apart, falling once.
    kind: Literal["one_cycle", "constant", "steps"] = "one_cycle"
    epochs: int = 20
    batch_size: int = 8
    learning_rate: float = 2e-3
    #: Of the head, if it differs.
    head_learning_rate: float | None = None
    weight_decay: float = 1e-3
    clip_norm: float = 1.0
    #: Share of the steps in which the learning rate rises, one_cycle.
    warm_up: float = 0.15
    #: Epoch after which the learning rate is a tenth, steps.
    step_epoch: int = 40
    #: Length of a run that ends by the clock; None: `epochs`.
    minutes: float | None = None

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size", "learning_rate", "clip_norm", "step_epoch"):
            if not getattr(self, name) > 0:
                raise ValueError(f"schedule.{name} must be positive, got {getattr(self, name)}")
        if self.minutes is not None and not self.minutes > 0.0:
            raise ValueError(f"schedule.minutes must be positive, got {self.minutes}")
        if not 0.0 < self.warm_up < 1.0:
            raise ValueError(f"schedule.warm_up must be in (0, 1), got {self.warm_up}")

    def factor(self, step: int, steps_per_epoch: int) -> float:
        """Return the learning rate at a step, relative to the largest."""
        if self.kind == "constant":
            return 1.0
        if self.kind == "steps":
            return 1.0 if step < self.step_epoch * steps_per_epoch else 0.1
        total = self.epochs * steps_per_epoch
        rise = max(self.warm_up * total, 1.0)
        if step < rise:
            return 0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * step / rise))
        return max(0.5 * (1.0 + math.cos(math.pi * (step - rise) / max(total - rise, 1.0))), 1e-4)

    def factor_at(self, share: float) -> float:
        """Return the learning rate at a share of the run, relative to the largest."""
        steps = 1_000_000
        return self.factor(round(share * self.epochs * steps), steps)


#: Section 3.3.
PUBLISHED = ScheduleConfig(kind="constant", epochs=100, batch_size=4, learning_rate=1e-4, weight_decay=0.0)
#: The released fine-tuning on real captures.
FINE_TUNING = ScheduleConfig(
    kind="steps", epochs=60, batch_size=4, learning_rate=5e-6, head_learning_rate=5e-5, clip_norm=0.1
)
SCHEDULES = {"one_cycle": ScheduleConfig(), "published": PUBLISHED, "fine_tuning": FINE_TUNING}


def optimiser_of(
    network: nn.Module, config: ScheduleConfig, head: tuple[str, ...], steps_per_epoch: int
) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
    """Return optimiser and schedule of a network; `head` are the prefixes of its head's parameters."""
    parameters = list(network.named_parameters())
    of_head = [parameter for name, parameter in parameters if name.split(".")[0] in head]
    of_body = [parameter for name, parameter in parameters if name.split(".")[0] not in head]
    groups = [
        {"params": of_body, "lr": config.learning_rate},
        {"params": of_head, "lr": config.head_learning_rate or config.learning_rate},
    ]
    if config.kind == "constant":
        optimiser: torch.optim.Optimizer = torch.optim.Adam(groups, weight_decay=config.weight_decay)
    else:
        optimiser = torch.optim.AdamW(groups, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: config.factor(step, steps_per_epoch))
    return optimiser, schedule
