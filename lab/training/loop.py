"""The loop of every training: epochs, the best network, checkpoints and resumption after a kill."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn

from lab.training.run_folder import BEST, CURVES, LAST, load_state, save_state
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole


class EpochOfRun(Protocol):
    """What the reports of all trainings have, each a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def epoch(self) -> int:
        """Its number."""

    @property
    def is_best(self) -> bool:
        """Whether it is the best so far."""


Epoch = TypeVar("Epoch", bound=EpochOfRun)


class KeptRun(Generic[Epoch]):
    """Network, optimiser and reports of a run, kept in its folder: the curves, the last state and the best network."""

    network: nn.Module
    optimiser: torch.optim.Optimizer

    def __init__(self, run_dir: Path, report_type: type[Epoch], device: torch.device | None = None) -> None:
        self.run_dir, self.reports, self._report_type = run_dir, list[Epoch](), report_type
        self.device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")

    def kept_network(self) -> nn.Module:
        """Return the network that is judged and kept as the best."""
        return self.network

    def state(self) -> dict[str, Any]:
        """Return what the last state holds beside network, optimiser and reports."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over what `state` gave."""

    def save(self) -> None:
        """Write what an epoch has left; the states come last of all: a run killed before them repeats the epoch."""
        network = self.network.state_dict()
        if self.reports and self.reports[-1].is_best:
            best = {"network": self.kept_network().state_dict(), "epoch": self.reports[-1].epoch}
            save_state(self.run_dir / BEST, best)
        write_whole(self.run_dir / CURVES, json_lines(self.reports))
        reports = [asdict(report) for report in self.reports]
        state = {"network": network, "optimiser": self.optimiser.state_dict(), "reports": reports}
        save_state(self.run_dir / LAST, state | self.state())

    def resume(self) -> bool:
        """Go on from the last state, if the folder holds one; return whether it does."""
        if not (self.run_dir / LAST).exists():
            return False
        state = load_state(self.run_dir / LAST, self.device)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.reports = [self._report_type(**report) for report in state["reports"]]
        self.restore(state)
        return True


class TrainingLoop(KeptRun[Epoch], ABC):
    """One run, epoch by epoch: one that was killed resumes and ends with the same weights as an uninterrupted one."""

    def __init__(self, run_dir: Path, epochs: int, clip_norm: float, report_type: type[Epoch]) -> None:
        super().__init__(run_dir, report_type)
        self._epochs, self._clip_norm = epochs, clip_norm

    @abstractmethod
    def train_epoch(self, epoch: int) -> float:
        """Train one epoch, its order drawn from seed and number, and return its loss; `ValueError` if it is none."""

    @abstractmethod
    def judge(self, epoch: int, train_loss: float) -> Epoch:
        """Return the report of an epoch; it says whether its network is the best so far."""

    def is_over(self, epoch: int) -> bool:
        """Return whether an epoch has no time left."""
        return False

    def run(self, report: Callable[[Epoch], None] = lambda _: None) -> Epoch:
        """Train the remaining epochs, reporting each, and return the best of all."""
        for epoch in range(len(self.reports), self._epochs):
            if self.is_over(epoch):
                break
            self.network.train()
            train_loss = self.train_epoch(epoch)
            self.network.eval()
            self.reports.append(self.judge(epoch, train_loss))
            self.save()
            report(self.reports[-1])
        return next((each for each in reversed(self.reports) if each.is_best), self.reports[-1])

    def descend(self, loss: Tensor) -> None:
        """Take one step down the gradient, its length limited."""
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), self._clip_norm)
        self.optimiser.step()
