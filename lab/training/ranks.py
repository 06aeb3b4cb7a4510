"""Processes of a training run: one CPU, one GPU, or several processes started by torchrun."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NoReturn

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel


@dataclass(frozen=True)
class Ranks:
    """This process among those of a run."""

    rank: int = 0
    count: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def leads(self) -> bool:
        """Return whether this process writes the run folder."""
        return self.rank == 0

    def shared(self, network: nn.Module) -> nn.Module:
        """Return the network whose gradients are averaged over all ranks; itself if there is one rank."""
        if self.count == 1:
            return network
        devices = [self.device.index] if self.device.type == "cuda" else None
        return DistributedDataParallel(network, device_ids=devices)

    def mean(self, value: float) -> float:
        """Return mean of a number over all ranks."""
        if self.count == 1:
            return value
        total = torch.tensor(value, device=self.device, dtype=torch.float64)
        distributed.all_reduce(total)
        return float(total) / self.count


def lone_device() -> torch.device:
    """Return the device of a run that no ranks share; raise `ValueError` where torchrun started several processes."""
    if (count := _started()) != 1:
        raise ValueError(f"WORLD_SIZE must be 1 for a training of one process, got {count}")
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@contextmanager
def joined_ranks() -> Iterator[Ranks]:
    """Join the ranks that torchrun's environment names for the duration of the context; else this process alone."""
    if _started() == 1:
        yield Ranks(device=lone_device())
        return
    cuda = torch.cuda.is_available()
    local = int(os.environ.get("LOCAL_RANK", "0"))
    if cuda:
        torch.cuda.set_device(local)
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        device = torch.device("cuda", local) if cuda else torch.device("cpu")
        yield Ranks(distributed.get_rank(), distributed.get_world_size(), device)
    finally:
        distributed.destroy_process_group()


def _started() -> int:
    """Return how many processes torchrun has started for this run; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def leave() -> NoReturn:
    """End a process that does not lead and has nothing left to do, with exit code 0.

    Not by the end of its interpreter: threads of torch that still wait for it then abort the process (one run in
    fifteen on a busy machine), and torchrun ends all others for that.
    """
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(0)
