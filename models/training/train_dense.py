"""Training of the dense network: schedule, checkpoints, validation."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import nn

from models.networks.compact_unet import CompactUNet, CompactUNetConfig
from models.training.datasets import DataConfig, TrainingData, encode_batch, shuffled_batches
from models.training.losses import heatmap_focal_loss
from models.training.scoring import DEFAULT_THRESHOLD, DetectionTally
from msgs.perception import PathClass

LAST, BEST, CONFIG, CURVES = "last.pt", "best.pt", "config.json", "curves.json"


@dataclass(frozen=True, kw_only=True)
class TrainDenseConfig:
    """Schedule of a run. The published one (Adam, 1e-4, 100 epochs) is for a network 40 times as large."""

    epochs: int = 20
    seed: int = 0
    batch_size: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    clip_norm: float = 1.0
    #: Share of the steps in which the learning rate rises.
    warm_up: float = 0.15
    threads: int = 1
    #: Convolutions in bfloat16 (the published training uses mixed precision as well).
    mixed_precision: bool = True
    network: CompactUNetConfig = field(default_factory=CompactUNetConfig)

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"train.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("learning_rate", "clip_norm"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"train.{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """All that a run was made with; its JSON lies in the run folder."""

    training: TrainDenseConfig
    data: DataConfig

    def __post_init__(self) -> None:
        network, data = self.training.network, self.data
        takes = network.in_channels, network.range_bins, network.columns
        if takes != data.encoding.shape:
            raise ValueError(f"network must take the encoding's shape {data.encoding.shape}, takes {takes}")
        if network.columns * network.azimuth_factor != data.grid.azimuth_bins:
            raise ValueError(
                f"network.azimuth_factor must spread {network.columns} columns to {data.grid.azimuth_bins} azimuths, "
                f"got {network.azimuth_factor}"
            )


@dataclass(frozen=True, kw_only=True)
class EpochReport:
    """What one epoch brought."""

    epoch: int
    train_loss: float
    validation_loss: float
    macro_f1: float
    los_f1: float
    mirrored_f1: float
    is_best: bool


class DenseTraining:
    """One run: network, optimiser and schedule, resumable after every epoch.

    `run_dir` receives the resolved configuration, the curves, the last state and the best network. A run that was
    killed goes on where it stood and ends with the same weights as one that was not.
    """

    def __init__(self, config: TrainDenseConfig, data: TrainingData, run_dir: Path) -> None:
        self.run_config = RunConfig(training=config, data=data.config)
        if len(data.train) < config.batch_size:
            raise ValueError(f"train.batch_size must be at most the {len(data.train)} scenes, got {config.batch_size}")
        torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.config, self.data, self.run_dir = config, data, run_dir
        self.network = CompactUNet(config.network).to(memory_format=torch.channels_last)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser,
            max_lr=config.learning_rate,
            total_steps=config.epochs * (len(data.train) // config.batch_size),
            pct_start=config.warm_up,
        )
        self.reports: list[EpochReport] = []
        run_dir.mkdir(parents=True, exist_ok=True)
        self._adopt_config()
        if (run_dir / LAST).exists():
            self._resume()

    def run(self, report: Callable[[EpochReport], None]) -> EpochReport:
        """Train the epochs that are left, reporting each; returns the best one."""
        for epoch in range(len(self.reports), self.config.epochs):
            train_loss = self._train_epoch(epoch)
            self.reports.append(self._validate(epoch, train_loss))
            self._save()
            report(self.reports[-1])
        return max(self.reports, key=lambda r: r.macro_f1)

    def _train_epoch(self, epoch: int) -> float:
        config, data = self.config, self.data
        self.network.train()
        losses = []
        # the epoch's own seed: a resumed run draws what it would have drawn
        batches = shuffled_batches(
            data.train, config.batch_size, data.config.encoding, data.config.grid, seed=(config.seed, epoch)
        )
        for inputs, heatmaps in batches:
            self.optimiser.zero_grad()
            loss = heatmap_focal_loss(self._logits(inputs), torch.from_numpy(heatmaps))
            loss.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), config.clip_norm)
            self.optimiser.step()
            self.schedule.step()
            losses.append(loss.item())
        return float(np.mean(losses))

    def _logits(self, inputs: np.ndarray) -> torch.Tensor:
        batch = torch.from_numpy(inputs).contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.mixed_precision):
            logits = self.network(batch)
        return logits.float()

    def _validate(self, epoch: int, train_loss: float) -> EpochReport:
        loss, tally = evaluate_network(self._logits, self.network, self.data, self.config.batch_size)
        scores = tally.counts[DEFAULT_THRESHOLD]
        return EpochReport(
            epoch=epoch,
            train_loss=train_loss,
            validation_loss=loss,
            macro_f1=tally.macro_f1(),
            los_f1=scores[PathClass.LOS].f1,
            mirrored_f1=scores[PathClass.MIRRORED].f1,
            is_best=tally.macro_f1() > max((r.macro_f1 for r in self.reports), default=-1.0),
        )

    def _adopt_config(self) -> None:
        """Write the resolved configuration, or insist that the run's own is the same."""
        path = self.run_dir / CONFIG
        wanted = _json(self.run_config)
        if path.exists() and path.read_bytes() != wanted:
            raise ValueError(f"{path} must hold the configuration of this run; use another run folder for another one")
        path.write_bytes(wanted)

    def _save(self) -> None:
        state = {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "reports": [asdict(report) for report in self.reports],
        }
        if self.reports[-1].is_best:
            _write(self.run_dir / BEST, {"network": state["network"], "epoch": self.reports[-1].epoch})
        (self.run_dir / CURVES).write_bytes(_json(self.reports))
        # last of all: a run killed before this line repeats the epoch
        _write(self.run_dir / LAST, state)

    def _resume(self) -> None:
        state = torch.load(self.run_dir / LAST, weights_only=True)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        self.reports = [EpochReport(**report) for report in state["reports"]]


def evaluate_network(
    logits_of: Callable[[np.ndarray], torch.Tensor], network: nn.Module, data: TrainingData, batch_size: int
) -> tuple[float, DetectionTally]:
    """Mean loss a batch and detection scores over the validation maps."""
    network.eval()
    tally = DetectionTally(data.config.grid)
    losses = []
    with torch.no_grad():
        for start in range(0, len(data.validation), batch_size):
            samples = data.validation[start : start + batch_size]
            inputs, heatmaps = encode_batch(samples, data.config.encoding, data.config.grid)
            logits = logits_of(inputs)
            losses.append(heatmap_focal_loss(logits, torch.from_numpy(heatmaps)).item())
            for sample, confidence in zip(samples, torch.sigmoid(logits).numpy(), strict=True):
                tally.add(confidence, sample.labels)
    return float(np.mean(losses)), tally


def load_best(run_dir: Path) -> tuple[CompactUNet, RunConfig, int]:
    """The best network of a run in evaluation mode, the run's configuration, and the network's epoch.

    Raises `ValueError` where the folder holds none.
    """
    for name in (CONFIG, BEST):
        if not (run_dir / name).exists():
            raise ValueError(f"{run_dir / name} must exist: the run folder holds no trained network")
    config = msgspec.json.decode((run_dir / CONFIG).read_bytes(), type=RunConfig)
    network = CompactUNet(config.training.network)
    state = torch.load(run_dir / BEST, weights_only=True)
    network.load_state_dict(state["network"])
    return network.eval(), config, int(state["epoch"])


def _json(value: object) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"


def _write(path: Path, state: dict[str, object]) -> None:
    """Save whole or not at all: a kill in between leaves the old file."""
    partial = path.with_suffix(".partial")
    torch.save(state, partial)
    os.replace(partial, path)
