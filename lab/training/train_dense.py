"""Training of dense networks: epochs, checkpoints, validation, and resumption after a kill."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from lab.training.data.samples import DataConfig, PointLabels, SampleFormer, TrainingData, shuffled_batches
from lab.training.exported_weights import SETTLING_BATCHES, load_exported, settle_norms
from lab.training.loop import TrainingLoop
from lab.training.map_networks import FAMILIES, NetworkChoice
from lab.training.objectives.objectives import ObjectiveConfig, objective_of
from lab.training.pretrained import load_initial
from lab.training.run_folder import BEST, LAST, SUMMARY, adopt_config, load_config, load_json, load_state
from lab.training.schedules import ScheduleConfig, optimiser_of
from lab.training.scoring import DEFAULT_THRESHOLD, DetectionTally
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole
from msgs.values.perception import PathClass

#: Thresholds of the validation of every epoch; the first is the least confident peak considered.
WATCHED_THRESHOLDS = (0.1, 0.2, DEFAULT_THRESHOLD, 0.4, 0.5, 0.6, 0.7, 0.8)
#: A score that rises by more than this over the last fifth of a run has not converged.
CONVERGED_RISE = 0.01


@dataclass(frozen=True, kw_only=True)
class TrainDenseConfig:
    """Configuration of a training."""

    network: NetworkChoice
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    seed: int = 0
    threads: int = 1
    #: Arithmetic in bfloat16 where it is safe (section 3.3: mixed precision).
    mixed_precision: bool = True
    #: File of initial weights: a checkpoint, or an exported network.
    init: str = ""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Complete configuration of a run; its JSON lies in the run folder."""

    training: TrainDenseConfig
    data: DataConfig
    #: What made the run, if not `train dense`.
    command: str = ""

    def __post_init__(self) -> None:
        config, encoding = self.training.network.resolved, self.data.encoding
        takes = config.in_channels, config.range_bins, config.columns
        if takes != encoding.shape:
            raise ValueError(f"network must take the encoding's shape {encoding.shape}, takes {takes}")
        stride = getattr(config, "anchor_stride", 1)
        answers = tuple(stride * cells for cells in config.output_shape[1:])
        if answers != (encoding.range_bins, self.data.grid.azimuth_bins):
            raise ValueError(
                f"network must answer on {encoding.range_bins} ranges and the grid's {self.data.grid.azimuth_bins} "
                f"azimuths, answers on {answers}"
            )


@dataclass(frozen=True, kw_only=True)
class EpochReport:
    """Result of one epoch; scores are on the validation scenes at the published threshold."""

    epoch: int
    train_loss: float
    validation_loss: float
    macro_f1: float
    los_f1: float
    mirrored_f1: float
    #: The best of the validation thresholds, and its score, which selects the checkpoint.
    best_threshold: float
    best_macro_f1: float
    is_best: bool


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The budget of a run and its result."""

    family: str
    parameters: int
    scenes: int
    epochs: int
    #: Samples that went through the network in training.
    sample_steps: int
    best: EpochReport
    #: The validation score rose by more than 0.01 over the last fifth.
    unconverged: bool


class NonFiniteLossError(ValueError):
    """A loss that is not finite, with the batch that caused it."""


class DenseTraining(TrainingLoop[EpochReport]):
    """One run; `run_dir` receives the resolved configuration and the summary too."""

    def __init__(self, config: TrainDenseConfig, data: TrainingData, run_dir: Path) -> None:
        self.run_config = RunConfig(training=config, data=data.config)
        super().__init__(run_dir, config.schedule.epochs, config.schedule.clip_norm, EpochReport)
        self.config, self.data = config, data
        self._check_batches()
        torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        family = FAMILIES[config.network.family]
        self.network = config.network.build().to(self.device, memory_format=torch.channels_last)
        self.former = SampleFormer(data.config, data.setup)
        self.objective = objective_of(config.objective, config.network.resolved)
        self.steps_per_epoch = len(data.train) // config.schedule.batch_size
        self.optimiser, self.schedule = optimiser_of(self.network, config.schedule, family.head, self.steps_per_epoch)
        if config.init and not (run_dir / LAST).exists():
            # before the folder is taken: a file that is refused leaves it free
            self._start(Path(config.init))
        run_dir.mkdir(parents=True, exist_ok=True)
        adopt_config(run_dir, self.run_config)
        self.resume()

    def _start(self, path: Path) -> None:
        """Fill the network with the weights of a checkpoint or of an exported file."""
        if path.suffix != ".onnx":
            load_initial(self.network, path)
            return
        load_exported(self.network, path)
        size = self.config.schedule.batch_size
        batches = shuffled_batches(self.data.train, self.former, size, (self.config.seed, 0))
        first = islice(batches, SETTLING_BATCHES)
        settle_norms(self.network, (torch.from_numpy(inputs).to(self.device) for _, inputs, _ in first))

    def _check_batches(self) -> None:
        size = self.config.schedule.batch_size
        if len(self.data.train) < size:
            raise ValueError(f"schedule.batch_size must be at most the {len(self.data.train)} scenes, got {size}")

    def run(
        self,
        report: Callable[[EpochReport], None] = lambda _: None,
        on_step: Callable[[int, int], None] = lambda done, steps: None,
    ) -> EpochReport:
        """Train the remaining epochs, reporting each; `on_step` is called for every batch (done, total).

        Raises `NonFiniteLossError` naming epoch, batch and scenes if a loss is not finite.
        """
        self._on_step = on_step
        return super().run(report)

    def summary(self) -> RunSummary:
        """Return the result of the run so far; raises `ValueError` before the first epoch."""
        if not self.reports:
            raise ValueError(f"{self.run_dir} must hold at least one epoch, holds none")
        scores = [report.best_macro_f1 for report in self.reports]
        earlier = scores[: max(len(scores) - max(len(scores) // 5, 1), 1)]
        return RunSummary(
            family=self.config.network.family,
            parameters=sum(parameter.numel() for parameter in self.network.parameters()),
            scenes=len(self.data.train),
            epochs=len(self.reports),
            sample_steps=len(self.reports) * self.steps_per_epoch * self.config.schedule.batch_size,
            best=max(self.reports, key=lambda report: report.best_macro_f1),
            unconverged=max(scores) - max(earlier) > CONVERGED_RISE,
        )

    def train_epoch(self, epoch: int) -> float:
        """Train one epoch and return its mean loss."""
        config = self.config
        losses = []
        # the epoch's own seed: a resumed run draws the same numbers
        torch.manual_seed(config.seed + 1_000_003 * epoch)
        batches = shuffled_batches(
            self.data.train,
            self.former,
            config.schedule.batch_size,
            (config.seed, epoch),
        )
        for step, (scenes, inputs, labels) in enumerate(batches):
            loss = self.objective.loss(self._answer(inputs), labels)
            losses.append(loss.item())
            self._refuse_non_finite(losses[-1], epoch, step, scenes)
            self.descend(loss)
            self.schedule.step()
            self._on_step(step + 1, self.steps_per_epoch)
        return float(np.mean(losses))

    def _refuse_non_finite(self, loss: float, epoch: int, step: int, scenes: np.ndarray) -> None:
        if not np.isfinite(loss):
            names = ", ".join(str(self.data.train[scene].index) for scene in scenes)
            raise NonFiniteLossError(
                f"{self.run_dir}: loss must be finite, got {loss} in epoch {epoch}, batch {step}, scenes {names}"
            )

    def _answer(self, inputs: np.ndarray) -> torch.Tensor:
        batch = torch.from_numpy(inputs).to(self.device).contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.mixed_precision):
            answer = self.network(batch)
        return answer.float()

    def judge(self, epoch: int, train_loss: float) -> EpochReport:
        """Return the scores on the validation scenes."""
        loss, tally = self.evaluate()
        published = tally.counts[DEFAULT_THRESHOLD]
        threshold = max(tally.counts, key=tally.macro_f1)
        return EpochReport(
            epoch=epoch,
            train_loss=train_loss,
            validation_loss=loss,
            macro_f1=tally.macro_f1(),
            los_f1=published[PathClass.LOS].f1,
            mirrored_f1=published[PathClass.MIRRORED].f1,
            best_threshold=threshold,
            best_macro_f1=tally.macro_f1(threshold),
            is_best=tally.macro_f1(threshold) > max((r.best_macro_f1 for r in self.reports), default=-1.0),
        )

    def save(self) -> None:
        """Write the summary, then the rest."""
        write_whole(self.run_dir / SUMMARY, json_lines(self.summary()))
        super().save()

    def state(self) -> dict[str, Any]:
        """Return the schedule's state."""
        return {"schedule": self.schedule.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over the schedule's state."""
        self.schedule.load_state_dict(state["schedule"])

    def evaluate(self) -> tuple[float, DetectionTally]:
        """Return the mean loss of a batch and detection scores over the validation maps."""
        self.network.eval()
        tally = DetectionTally(self.data.config.grid, WATCHED_THRESHOLDS)
        losses, size = [], self.config.schedule.batch_size
        with torch.no_grad():
            for start in range(0, len(self.data.validation), size):
                samples = self.data.validation[start : start + size]
                answer = self._answer(self.former.encode(samples))
                labels: list[PointLabels] = [sample.labels for sample in samples]
                losses.append(self.objective.loss(answer, labels).item())
                for map_answer, truth in zip(answer.cpu().numpy(), labels, strict=True):
                    tally.add(self.objective.points(map_answer, WATCHED_THRESHOLDS[0]), truth)
        return float(np.mean(losses)), tally


def load_best(run_dir: Path) -> tuple[nn.Module, RunConfig, int]:
    """Return the best network of a run in evaluation mode, the run's configuration, and the network's epoch.

    Raises `ValueError` if the folder holds none, naming the file.
    """
    config = load_config(run_dir, RunConfig)
    network = config.training.network.build()
    state = load_state(run_dir / BEST)
    network.load_state_dict(state["network"])
    return network.eval(), config, int(state["epoch"])


def load_summary(run_dir: Path) -> RunSummary:
    """Return the result of a run; raises `ValueError` if it has not finished an epoch."""
    return load_json(run_dir / SUMMARY, RunSummary)
