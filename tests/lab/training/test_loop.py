"""What a training run keeps in its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from lab.training.loop import KeptRun
from lab.training.run_folder import BEST, load_state


@dataclass(frozen=True)
class Report:
    epoch: int
    is_best: bool


def test_the_best_network_names_its_own_epoch(tmp_path: Path) -> None:
    """The second of two is the better one."""
    run = KeptRun(tmp_path, Report)
    run.network = nn.Linear(2, 1)
    run.optimiser = torch.optim.SGD(run.network.parameters(), lr=0.1)
    for epoch in range(2):
        run.reports.append(Report(epoch, is_best=True))
        run.save()
    assert load_state(tmp_path / BEST)["epoch"] == 1
