"""Training of the object network: epochs, checkpoints, scores on validation scans, resumption after a kill."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import nn

from models.networks.object_unet import ObjectUNet, ObjectUNetConfig
from models.perception.objects.answers import ANSWERS
from models.perception.objects.encoding import ObjectEncoding
from models.perception.objects.hypotheses import HYPOTHESES
from models.perception.trained_radar import TrainedRadar
from models.training.data.object_samples import ObjectSample
from models.training.data.object_store import count_samples, load_samples, shuffled
from models.training.exported_weights import SETTLING_BATCHES, load_exported, settle_norms
from models.training.object_scoring import WATCHED_THRESHOLDS, ObjectTally
from models.training.objectives.objects import ObjectLossConfig, TrueHypotheses, object_loss
from models.training.run_folder import BEST, LAST, adopt_config, load_config, load_state, save_epoch
from models.training.schedules import ScheduleConfig, optimiser_of

#: Batches that are read before they are needed.
READ_AHEAD = 32


@dataclass(frozen=True, kw_only=True)
class TrainObjectsConfig:
    """Configuration of a training."""

    widths: tuple[int, ...] = (32, 64, 128, 192)
    loss: ObjectLossConfig = field(default_factory=ObjectLossConfig)
    schedule: ScheduleConfig = field(default_factory=lambda: ScheduleConfig(weight_decay=1e-2, clip_norm=5.0))
    seed: int = 0
    threads: int = 1
    #: Half the bits in forward and backward passes: five times as fast where the processor multiplies bfloat16 itself,
    #: ten times as slow where it does not.
    mixed_precision: bool = True
    #: A false report costs so many missed objects in the score that selects the checkpoint.
    false_cost: float = 1.0
    #: Exported network (ONNX) whose weights are the first ones.
    start: str = ""

    def __post_init__(self) -> None:
        if self.threads < 1:
            raise ValueError(f"train.threads must be at least 1, got {self.threads}")
        if self.seed < 0:
            raise ValueError(f"train.seed must not be negative, got {self.seed}")
        if not self.false_cost > 0.0:
            raise ValueError(f"train.false_cost must be positive, got {self.false_cost}")


@dataclass(frozen=True, kw_only=True)
class ObjectRunConfig:
    """Complete configuration of a run; its JSON lies in the run folder."""

    training: TrainObjectsConfig
    encoding: ObjectEncoding
    #: Data sets with the hashes of their scenes; detector and its SHA-256.
    data: dict[str, str]
    radar: TrainedRadar = field(default_factory=TrainedRadar)

    @property
    def network(self) -> ObjectUNetConfig:
        """Shape of the network."""
        channels, rows, columns = self.encoding.shape
        return ObjectUNetConfig(
            in_channels=channels,
            rows=rows,
            columns=columns,
            hypotheses=HYPOTHESES,
            answers=ANSWERS,
            widths=self.training.widths,
        )


@dataclass(frozen=True, kw_only=True)
class ObjectEpoch:
    """Result of one epoch; scores are on the validation scans at the threshold of the least loss."""

    epoch: int
    train_loss: float
    validation_loss: float
    threshold: float
    recall: float
    #: Of objects that one mirror shows at 25 dB or more.
    recall_single_25_db: float
    false_per_scan: float
    #: Missed objects and false reports a scan.
    loss_per_scan: float
    is_best: bool


class ObjectTraining:
    """One run: network, optimiser and schedule, resumable after every epoch.

    `train` and `validation` are files of samples (`object_store.make_samples`). A run that was killed resumes and ends
    with the same weights as an uninterrupted one.
    """

    def __init__(
        self,
        config: ObjectRunConfig,
        train: Sequence[Path],
        validation: Sequence[Path],
        run_dir: Path,
        device: torch.device | None = None,
    ) -> None:
        self.run_config, self.config, self.run_dir = config, config.training, run_dir
        self.device = device or torch.device("cpu")
        self._train, self._validation = list(train), list(validation)
        torch.set_num_threads(self.config.threads)
        torch.manual_seed(self.config.seed)
        self._layout = torch.channels_last if self.config.mixed_precision else torch.contiguous_format
        self.network = ObjectUNet(config.network).to(self.device, memory_format=self._layout)
        scans = sum(count_samples(path) for path in self._train)
        self.steps_per_epoch = scans // self.config.schedule.batch_size
        if not self.steps_per_epoch:
            raise ValueError(
                f"schedule.batch_size must be at most the {scans} scans, got {self.config.schedule.batch_size}"
            )
        self.optimiser, self.schedule = optimiser_of(
            self.network, self.config.schedule, ("head",), self.steps_per_epoch
        )
        self.reports: list[ObjectEpoch] = []
        run_dir.mkdir(parents=True, exist_ok=True)
        adopt_config(run_dir, config)
        if (run_dir / LAST).exists():
            self._resume()
        elif self.config.start:
            load_exported(self.network, Path(self.config.start))
            settle_norms(self.network, self._first_inputs())

    def run(
        self,
        report: Callable[[ObjectEpoch], None] = lambda _: None,
        on_step: Callable[[], None] = lambda: None,
    ) -> ObjectEpoch:
        """Train the remaining epochs, reporting each, and return the best; `on_step` is called for every batch.

        Raises `ValueError` naming epoch and batch if a loss is not finite.
        """
        for epoch in range(len(self.reports), self.config.schedule.epochs):
            train_loss = self._train_epoch(epoch, on_step)
            self.reports.append(self._validate(epoch, train_loss))
            self._save()
            report(self.reports[-1])
        return min(self.reports, key=lambda entry: entry.loss_per_scan)

    def _train_epoch(self, epoch: int, on_step: Callable[[], None]) -> float:
        self.network.train()
        # the epoch's own seed: a resumed run draws the same numbers
        rng = np.random.default_rng((self.config.seed, epoch))
        samples = self._augmented(shuffled(self._train, rng), rng)
        losses = []
        for step, batch in enumerate(_batches(samples, self.config.schedule.batch_size, self.steps_per_epoch)):
            self.optimiser.zero_grad()
            loss = self._loss(batch)[0]
            if not torch.isfinite(loss):
                raise ValueError(f"loss must be finite, got {loss.item()} in epoch {epoch}, batch {step}")
            loss.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.schedule.clip_norm)
            self.optimiser.step()
            self.schedule.step()
            losses.append(loss.item())
            on_step()
        return float(np.mean(losses))

    def _augmented(self, samples: Iterator[ObjectSample], rng: np.random.Generator) -> Iterator[ObjectSample]:
        """Yield samples, half of them with left and right exchanged."""
        odd = self.run_config.encoding.odd_channels
        return (sample.flipped(odd) if rng.random() < 0.5 else sample for sample in samples)

    def _first_inputs(self) -> Iterator[torch.Tensor]:
        """Yield inputs of the first batches, by whose statistics the norms of an exported network begin."""
        samples = shuffled(self._train, np.random.default_rng(self.config.seed))
        steps = min(SETTLING_BATCHES, self.steps_per_epoch)
        return (self._inputs(batch) for batch in _batches(samples, self.config.schedule.batch_size, steps))

    def _inputs(self, batch: Sequence[ObjectSample]) -> torch.Tensor:
        cells = torch.from_numpy(np.stack([sample.cells for sample in batch])).float().to(self.device)
        return cells.contiguous(memory_format=self._layout)

    def _loss(self, batch: Sequence[ObjectSample]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of a batch and the answers to it."""
        device, mixed = self.device, self.network.training and self.config.mixed_precision
        with torch.autocast(device.type, torch.bfloat16, enabled=mixed):
            answer = self.network(self._inputs(batch))
        heat = torch.from_numpy(np.stack([sample.heat() for sample in batch])).to(device)
        return object_loss(answer, heat, true_hypotheses(batch, device), self.config.loss), answer

    def _validate(self, epoch: int, train_loss: float) -> ObjectEpoch:
        self.network.eval()
        tally, losses = ObjectTally(self.run_config.encoding, WATCHED_THRESHOLDS), []
        with torch.no_grad():
            for path in self._validation:
                samples = load_samples(path)
                for first in range(0, len(samples), self.config.schedule.batch_size):
                    batch = samples[first : first + self.config.schedule.batch_size]
                    loss, answer = self._loss([stored.sample for stored in batch])
                    losses.append(loss.item())
                    for stored, said in zip(batch, answer.float().cpu().numpy(), strict=True):
                        tally.add(stored, said)
        threshold, report = tally.best(self.config.false_cost)
        loss_per_scan = report.loss.value or 0.0
        return ObjectEpoch(
            epoch=epoch,
            train_loss=train_loss,
            validation_loss=float(np.mean(losses)),
            threshold=threshold,
            recall=report.recall.value or 0.0,
            recall_single_25_db=report.recall_single_25_db.value or 0.0,
            false_per_scan=report.false_per_scan.value or 0.0,
            loss_per_scan=loss_per_scan,
            is_best=loss_per_scan < min((entry.loss_per_scan for entry in self.reports), default=np.inf),
        )

    def _save(self) -> None:
        save_epoch(
            self.run_dir,
            {"network": self.network, "optimiser": self.optimiser, "schedule": self.schedule},
            self.reports,
        )

    def _resume(self) -> None:
        state = load_state(self.run_dir / LAST, self.device)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        self.reports = [ObjectEpoch(**report) for report in state["reports"]]


def _batches(samples: Iterator[ObjectSample], size: int, count: int) -> Iterator[list[ObjectSample]]:
    """Yield batches in order, read by another thread while earlier ones are trained on."""
    with ThreadPoolExecutor(1) as reader:
        ahead = deque(reader.submit(list, islice(samples, size)) for _ in range(min(READ_AHEAD, count)))
        for batch in range(count):
            ready = ahead.popleft().result()
            if batch + READ_AHEAD < count:
                ahead.append(reader.submit(list, islice(samples, size)))
            yield ready


def true_hypotheses(batch: Sequence[ObjectSample], device: torch.device) -> TrueHypotheses:
    """Return the true hypotheses of a batch as tensors."""
    targets = [sample.targets for sample in batch]

    def tensor(name: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(table, name) for table in targets])).to(device)

    sample = np.repeat(np.arange(len(targets)), [len(table.at) for table in targets])
    at = torch.cat([torch.from_numpy(sample).to(device)[:, None], tensor("at")], dim=1)
    values = (tensor(name) for name in ("object_class", "place_m", "log_size", "heading", "centre_m"))
    return TrueHypotheses(at, *values)


def load_best_objects(run_dir: Path) -> tuple[ObjectUNet, ObjectRunConfig, int]:
    """Return the best network of a run in evaluation mode, the run's configuration, and the network's epoch.

    Raises `ValueError` if the folder holds none, naming the file.
    """
    config = load_config(run_dir, ObjectRunConfig)
    network = ObjectUNet(config.network)
    state = load_state(run_dir / BEST)
    network.load_state_dict(state["network"])
    return network.eval(), config, int(state["epoch"])
