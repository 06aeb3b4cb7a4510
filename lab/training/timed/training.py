"""Training by the clock on a device that is faster than one process can form maps: arrays made beforehand, batches
augmented, encoded and given targets on the device, a learning rate that follows the share of the time that has gone.

Run folders are those of `lab.training.train_dense`, and exported alike. A checkpoint is written every two minutes,
in short runs four times; a run that was stopped goes on with the time it has left, though not with the same numbers as
an uninterrupted one.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lab.measures.point_scores import Counts
from lab.training.data.map_arrays import MapArrays, Maps
from lab.training.data.samples import PointLabels
from lab.training.loop import KeptRun
from lab.training.map_networks import FAMILIES
from lab.training.objectives.anchors import anchor_loss, anchor_targets
from lab.training.objectives.focal import binary_focal_loss
from lab.training.objectives.losses import heatmap_focal_loss
from lab.training.objectives.objectives import objective_of
from lab.training.run_folder import SUMMARY, adopt_config
from lab.training.schedules import optimiser_of
from lab.training.scoring import DEFAULT_THRESHOLD, THRESHOLDS, DetectionTally
from lab.training.timed.batches import augmented, encode, flipped_labels, heatmaps, masks, point_table
from lab.training.train_dense import EpochReport, NonFiniteLossError, RunConfig, RunSummary
from models.perception.find.peaks import Points
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole
from msgs.values.perception import PathClass

CHECKPOINT_S = 120.0
#: Between two looks for further arrays.
REFRESH_S = 2.0
#: Batches that wait for the device.
AHEAD = 4
#: Points of a map that are scored, the strongest: a fresh network finds thousands, whose matching takes minutes.
MAX_SCORED_POINTS = 500
#: Steps in a row whose gradients were not finite, after which a run is given up; each is left out.
MAX_LOST_STEPS = 50


@dataclass(frozen=True)
class Batch:
    """A batch on the way to the device: maps, which of them are mirrored, and the truth of what is seen then."""

    maps: Maps
    flips: np.ndarray
    labels: list[PointLabels]
    #: `anchor_targets`, for networks with anchors.
    anchors: tuple[np.ndarray, np.ndarray] | None


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What a run has done so far, as its state keeps it."""

    elapsed_s: float = 0.0
    steps: int = 0


class TimedTraining(KeptRun[EpochReport]):
    """One run on one device. `limit` (0: all) trains on the first so many scenes alone."""

    def __init__(
        self, config: RunConfig, train: MapArrays, run_dir: Path, device: torch.device, limit: int = 0
    ) -> None:
        if config.training.schedule.minutes is None:
            raise ValueError("schedule.minutes must be set for a run that ends by the clock")
        super().__init__(run_dir, EpochReport, device)
        self.run_config, self.config, self.train, self.limit = config, config.training, train, limit
        torch.manual_seed(self.config.seed)
        family = FAMILIES[self.config.network.family]
        # on processors, oneDNN fails on narrow layers of that order
        self.order = torch.channels_last if device.type == "cuda" else torch.contiguous_format
        self.network = self.config.network.build().to(device, memory_format=self.order)
        self.shape: tuple[int, int, int] = self.config.network.resolved.output_shape
        self.stride: int | None = getattr(self.config.network.resolved, "anchor_stride", None)
        self.objective = objective_of(self.config.objective, self.config.network.resolved)
        self.optimiser, _ = optimiser_of(self.network, self.config.schedule, family.head, 1)
        self.rates = [group["lr"] for group in self.optimiser.param_groups]
        self.progress = Progress()
        #: Of the steps since the last report.
        self.losses: list[float] = []
        adopt_config(run_dir, config)
        self.resume()

    @property
    def is_done(self) -> bool:
        """Whether the run has ended before."""
        return any(report.is_best for report in self.reports)

    @property
    def samples(self) -> int:
        """Samples that have gone through the network."""
        return self.progress.steps * self.config.schedule.batch_size

    def run(self, ends_s: float, report: Callable[[str], None] = lambda _: None) -> None:
        """Train a step at least, and until the minutes of the schedule are used or until `ends_s` (of
        `time.monotonic`), whichever is earlier: the learning rate has fallen then either way.

        Raises `NonFiniteLossError` when gradients stay without a finite value.
        """
        before_s, start_s = self.progress.elapsed_s, time.monotonic()
        minutes = self.config.schedule.minutes or 0.0
        total_s = before_s + max(min(60.0 * minutes - before_s, ends_s - start_s), 0.1)
        stop = threading.Event()
        lost, saved_s, first_step = 0, start_s, self.progress.steps
        every_s = min(CHECKPOINT_S, 15.0 * minutes)
        self.network.train()
        for batch in _ahead(self._batches(stop), stop):
            elapsed_s = before_s + time.monotonic() - start_s
            if elapsed_s >= total_s and self.progress.steps > first_step:
                stop.set()
                break
            loss = self._step(batch, min(elapsed_s / total_s, 1.0))
            lost = 0 if np.isfinite(loss) else lost + 1
            if lost > MAX_LOST_STEPS:
                stop.set()
                raise NonFiniteLossError(f"{self.run_dir}: loss must be finite, was not {lost} times in a row")
            self.losses.append(loss)
            self.progress = Progress(elapsed_s=elapsed_s, steps=self.progress.steps + 1)
            if time.monotonic() - saved_s > every_s:
                self.reports.append(self._report(self.losses, None))
                self.losses = []
                self.save()
                saved_s = time.monotonic()
                rate = self.samples / elapsed_s
                report(f"{self.samples} samples, {rate:.0f}/s, loss {self.reports[-1].train_loss:.3f}")

    def finish(self, validation: MapArrays, scenes: Sequence[int] | np.ndarray) -> tuple[RunSummary, DetectionTally]:
        """Score the network on the validation scenes, and write the folder's results; returns them."""
        loss, tally = self.score(self.network, validation, scenes)
        self.reports.append(self._report(self.losses, (loss, tally)))
        summary = RunSummary(
            family=self.config.network.family,
            parameters=sum(parameter.numel() for parameter in self.network.parameters()),
            scenes=self.scenes,
            epochs=len(self.reports),
            sample_steps=self.samples,
            best=self.reports[-1],
            unconverged=False,
        )
        write_whole(self.run_dir / SUMMARY, json_lines(summary))
        self.save()
        return summary, tally

    @property
    def scenes(self) -> int:
        """Scenes that are trained on by now."""
        return min(len(self.train), self.limit) if self.limit else len(self.train)

    def score(
        self, network: nn.Module, arrays: MapArrays, scenes: Sequence[int] | np.ndarray
    ) -> tuple[float, DetectionTally]:
        """Return the mean loss of a map and the detections on scenes as recorded."""
        network.eval()
        tally = DetectionTally(self.run_config.data.grid, THRESHOLDS)
        losses, size = [], self.config.schedule.batch_size

        def points(answer: np.ndarray) -> Points:
            return _strongest(self.objective.points(answer, THRESHOLDS[0]))

        with ThreadPoolExecutor(4) as threads, torch.no_grad():
            waiting = []
            for start in range(0, len(scenes), size):
                maps = arrays.take(scenes[start : start + size])
                values, noise = self._to_device(maps.values).float(), self._to_device(maps.noise)
                answer = self._answer(network, encode(self.run_config.data.encoding, values, noise))
                batch = Batch(maps, np.zeros(len(maps.labels), np.bool_), maps.labels, self._anchors(maps.labels))
                losses.append(float(self._loss(answer, batch)))
                waiting.append((threads.map(points, answer.cpu().numpy()), maps.labels))
            for answers, labels in waiting:
                for detected, truth in zip(answers, labels, strict=True):
                    tally.add(detected, truth)
        return float(np.mean(losses)), tally

    def state(self) -> dict[str, Any]:
        """Return what the run has done so far."""
        return {"progress": asdict(self.progress)}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over that."""
        self.progress = Progress(**state["progress"])

    def _batches(self, stop: threading.Event) -> Iterator[Batch]:
        rng = np.random.default_rng((self.config.seed, self.progress.steps))
        size, azimuths = self.config.schedule.batch_size, self.run_config.data.grid.azimuth_bins
        looked_s = 0.0
        while not stop.is_set():
            if time.monotonic() - looked_s > REFRESH_S:
                self.train.refresh()
                looked_s = time.monotonic()
            if not self.scenes:
                time.sleep(0.1)
                continue
            maps = self.train.take(rng.integers(self.scenes, size=size), rng)
            flips = rng.random(size) < 0.5
            labels = flipped_labels(maps.labels, flips, azimuths)
            yield Batch(maps, flips, labels, self._anchors(labels))

    def _anchors(self, labels: Sequence[PointLabels]) -> tuple[np.ndarray, np.ndarray] | None:
        return None if self.stride is None else anchor_targets(labels, self.shape[1:], self.stride)

    def _step(self, batch: Batch, share: float) -> float:
        """Take one step; returns its loss, not finite where the step was left out."""
        factor = self.config.schedule.factor_at(share)
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        values, noise, flips = (self._to_device(a) for a in (batch.maps.values, batch.maps.noise, batch.flips))
        values, noise = augmented(values.float(), noise, flips)
        answer = self._answer(self.network, encode(self.run_config.data.encoding, values, noise))
        loss = self._loss(answer, batch)
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.schedule.clip_norm)
        if not torch.isfinite(norm):
            return float("nan")
        self.optimiser.step()
        return float(loss.detach())

    def _answer(self, network: nn.Module, inputs: Tensor) -> Tensor:
        inputs = inputs.contiguous(memory_format=self.order)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.mixed_precision):
            answer: Tensor = network(inputs)
        return answer.float()

    def _loss(self, answer: Tensor, batch: Batch) -> Tensor:
        config = self.config.objective
        if batch.anchors is not None:
            classes, offsets = batch.anchors
            return anchor_loss(answer, self._to_device(classes), self._to_device(offsets))
        points, shape = self._to_device(point_table(batch.labels)), (len(answer), *self.shape)
        if config.kind == "heatmap":
            weights = torch.tensor(config.class_weights, device=self.device).reshape(1, -1, 1, 1)
            return heatmap_focal_loss(answer, heatmaps(points, shape, config.sigma_px), weights=weights)
        return binary_focal_loss(answer, masks(points, shape), config.alpha)

    def _to_device(self, array: np.ndarray) -> Tensor:
        tensor = torch.from_numpy(array)
        if self.device.type == "cuda":
            tensor = tensor.pin_memory()
        return tensor.to(self.device, non_blocking=True)

    def _report(self, losses: Sequence[float], scored: tuple[float, DetectionTally] | None) -> EpochReport:
        """Return a report; without scores those are not numbers, and it is not the best."""
        # JSON has no NaN
        train_loss = float(np.nanmean(losses)) if np.isfinite(losses).any() else 0.0
        if scored is None:
            return EpochReport(
                epoch=len(self.reports),
                train_loss=train_loss,
                validation_loss=0.0,
                macro_f1=0.0,
                los_f1=0.0,
                mirrored_f1=0.0,
                best_threshold=DEFAULT_THRESHOLD,
                best_macro_f1=0.0,
                is_best=False,
            )
        loss, tally = scored
        threshold = best_threshold(tally)
        published: dict[PathClass, Counts] = tally.counts[DEFAULT_THRESHOLD]
        return EpochReport(
            epoch=len(self.reports),
            train_loss=train_loss,
            validation_loss=loss,
            macro_f1=tally.macro_f1(),
            los_f1=published[PathClass.LOS].f1,
            mirrored_f1=published[PathClass.MIRRORED].f1,
            best_threshold=threshold,
            best_macro_f1=tally.macro_f1(threshold),
            is_best=True,
        )


def _strongest(points: Points) -> Points:
    kept = np.sort(np.argsort(-points.score, kind="stable")[:MAX_SCORED_POINTS])
    return Points(cells=points.cells[kept], score=points.score[kept], path_class=points.path_class[kept])


def best_threshold(tally: DetectionTally) -> float:
    """Return the threshold of the best Macro-F1, the lowest of equals."""
    return max(tally.counts, key=tally.macro_f1)


def _ahead(batches: Iterator[Batch], stop: threading.Event) -> Iterator[Batch]:
    """Yield batches that a thread makes ahead of their use; raises what making them raised."""
    waiting: queue.Queue[Batch | BaseException] = queue.Queue(AHEAD)

    def put(item: Batch | BaseException) -> None:
        while not stop.is_set():
            try:
                waiting.put(item, timeout=0.2)
                return
            except queue.Full:
                continue

    def make() -> None:
        try:
            for batch in batches:
                put(batch)
        except BaseException as error:  # noqa: BLE001
            put(error)

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    while not stop.is_set():
        try:
            item = waiting.get(timeout=0.2)
        except queue.Empty:
            continue
        if isinstance(item, BaseException):
            raise item
        yield item
