"""Training on arrays in memory: an epoch's order, learning rate, checkpoints and resumption, on CPU or GPU.

The learning rate follows the share of the run that is over: of its steps, or of its minutes where they are fewer.
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from lab.training.exported_weights import fill_exported, settle_norms
from lab.training.loop import TrainingLoop
from lab.training.schedules import ScheduleConfig

#: Scans whose statistics the norms of an exported network take before the training goes on.
SETTLING_SCANS = 192
#: Largest share of its weights that an averaged network keeps in a step, so that it averages the last thousand, and
#: the steps after which it keeps half.
KEPT_SHARE, HALF_AFTER = 0.999, 10.0


@dataclass(frozen=True, kw_only=True)
class GridSchedule(ScheduleConfig):
    """Length and learning rate of a run: of `epochs`, or of `minutes` where they end first."""

    epochs: int = 6
    batch_size: int = 16
    learning_rate: float = 3e-3
    weight_decay: float = 1e-2
    clip_norm: float = 5.0
    seed: int = 0
    threads: int = 1
    #: bfloat16 in forward and backward passes.
    mixed_precision: bool = True


@dataclass(frozen=True, kw_only=True)
class GridEpoch:
    """Result of one epoch; `loss` chooses the network: the lower the better."""

    epoch: int
    train_loss: float
    seconds: float
    loss: float
    scores: dict[str, float]
    is_best: bool


class GridTraining(TrainingLoop[GridEpoch]):
    """One run on arrays in memory."""

    #: The network judged and kept has the average of the weights of the last steps.
    averages: ClassVar[bool] = False

    def __init__(self, network: nn.Module, schedule: GridSchedule, run_dir: Path) -> None:
        super().__init__(run_dir, schedule.epochs, schedule.clip_norm, GridEpoch)
        self.schedule = schedule
        torch.set_num_threads(schedule.threads)
        self.network = network.to(self.device, memory_format=torch.channels_last)
        self.optimiser = torch.optim.AdamW(
            network.parameters(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay
        )
        self._averaged = (
            AveragedModel(self.network, multi_avg_fn=average, use_buffers=True).eval() if self.averages else None
        )
        self._spent_s = 0.0
        run_dir.mkdir(parents=True, exist_ok=True)
        self.resume()

    @property
    @abstractmethod
    def scans(self) -> int:
        """Training scans."""

    @abstractmethod
    def batch_loss(self, index: Tensor, flip: bool) -> Tensor:
        """Return the loss of some training scans, int64 [B] on the CPU; `flip`: left and right exchanged."""

    @abstractmethod
    def inputs(self, index: Tensor) -> Tensor:
        """Return what the network sees of some training scans, int64 [B] on the CPU."""

    def start_from(self, path: Path, sha256: str) -> None:
        """Begin with the weights of an exported network, in a run without an epoch; raises `ValueError` naming a file
        of another shape.
        """
        if not self.reports:
            fill_exported(self.network, path, sha256)
            self.settle()

    def settle(self) -> None:
        """Give the norms the statistics of the first training scans."""
        settle_norms(self.network, map(self.inputs, torch.arange(min(self.scans, SETTLING_SCANS)).split(16)))

    @abstractmethod
    def validate(self) -> tuple[float, dict[str, float]]:
        """Return what chooses the network, the lower the better, and further scores."""

    def is_over(self, epoch: int) -> bool:
        """Return whether an epoch would begin after the run's last minute."""
        return self._share(epoch, 0.0) >= 1.0

    def judge(self, epoch: int, train_loss: float) -> GridEpoch:
        """Return the scores on the validation scans."""
        loss, scores = self.validate()
        best = loss < min((entry.loss for entry in self.reports), default=math.inf)
        return GridEpoch(
            epoch=epoch, train_loss=train_loss, seconds=self._spent_s, loss=loss, scores=scores, is_best=best
        )

    def kept_network(self) -> nn.Module:
        """Return the averaged network where there is one."""
        return self.network if self._averaged is None else self._averaged.module

    def state(self) -> dict[str, Any]:
        """Return the time that training took so far, and the averaged weights."""
        return {"spent_s": self._spent_s, "averaged": self._averaged and self._averaged.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over what `state` gave."""
        self._spent_s = float(state["spent_s"])
        if self._averaged is not None and state.get("averaged"):
            self._averaged.load_state_dict(state["averaged"])

    def _share(self, epoch: int, since_s: float, step: float = 0.0) -> float:
        share = (epoch + step) / self.schedule.epochs
        if self.schedule.minutes is not None:
            share = max(share, (self._spent_s + since_s) / (60.0 * self.schedule.minutes))
        return share

    def train_epoch(self, epoch: int) -> float:
        """Train one epoch and return its mean loss; `ValueError` names epoch and step of a loss that is not finite."""
        started = time.monotonic()
        schedule, size = self.schedule, self.schedule.batch_size
        # the epoch's own seed: a resumed run draws the same numbers
        rng = np.random.default_rng((schedule.seed, epoch))
        order = torch.from_numpy(rng.permutation(self.scans))
        steps = max(self.scans // size, 1)
        losses: list[Tensor] = []
        for step in range(steps):
            share = self._share(epoch, time.monotonic() - started, step / steps)
            if share >= 1.0:
                break
            for group in self.optimiser.param_groups:
                group["lr"] = schedule.learning_rate * schedule.factor_at(share)
            index = order[step * size : (step + 1) * size]
            loss = self.batch_loss(index, bool(rng.random() < 0.5))
            self.descend(loss)
            if self._averaged is not None:
                self._averaged.update_parameters(self.network)
            losses.append(loss.detach())
            if step % 100 == 99 and not torch.isfinite(losses[-1]):
                raise ValueError(f"loss must be finite, got {losses[-1].item()} in epoch {epoch}, step {step}")
        mean = float(torch.stack(losses).mean()) if losses else math.nan
        self._spent_s += time.monotonic() - started
        return mean

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the network's answers, in training with half the bits."""
        mixed = self.network.training and self.schedule.mixed_precision
        network = self.network if self.network.training else self.kept_network()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=mixed):
            return network(inputs.contiguous(memory_format=torch.channels_last))


def average(averaged: Sequence[Tensor], current: Sequence[Tensor], step: Tensor) -> None:
    """Move averaged weights towards those of a step, counted from 0."""
    kept = min(KEPT_SHARE, float(step) / (float(step) + HALF_AFTER))
    for into, weight in zip(averaged, current, strict=True):
        into.lerp_(weight, 1.0 - kept) if into.is_floating_point() else into.copy_(weight)
