"""Training of the evidence network: hidden objects in the bird's-eye view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lab.networks.evidence_unet import EvidenceUNet
from lab.training.data.evidence_samples import SCALE, EvidenceObjects, joined_objects
from lab.training.data.evidence_store import load_channels, load_objects, load_truths
from lab.training.evidence.grid_training import GridSchedule, GridTraining
from lab.training.evidence.scoring import WATCHED_THRESHOLDS, EvidenceTally
from lab.training.objectives.evidence import EvidenceTargets, evidence_loss
from models.perception.see.detections import ANSWERS
from models.perception.see.evidence_answers import candidates
from models.perception.see.gathering import BY_MIRROR
from models.perception.see.scan_evidence import EvidenceEncoding
from msgs.values.radar import RangeAzimuthGrid

#: Direction of the way on at a place by its likeliest mirror.
TOWARD = slice(BY_MIRROR.index("toward_x"), BY_MIRROR.index("toward_y") + 1)


class EvidenceTraining(GridTraining):
    """A run on sample files (`evidence_store.EvidenceTask`)."""

    #: Least loss on object_places_validation_2: 0.775, without 0.782.
    averages = True

    def __init__(
        self,
        train: Sequence[Path],
        validation: Sequence[Path],
        encoding: EvidenceEncoding,
        grid: RangeAzimuthGrid,
        schedule: GridSchedule,
        run_dir: Path,
    ) -> None:
        torch.manual_seed(schedule.seed)
        network = EvidenceUNet(encoding.shape[0], ANSWERS)
        super().__init__(network, schedule, run_dir)
        self._encoding = encoding
        self._azimuth_rad = grid.azimuth_at(np.arange(grid.azimuth_bins))
        self._x_m, self._y_m = (
            torch.from_numpy(axis).float().to(self.device) for axis in (encoding.grid.x_m, encoding.grid.y_m)
        )
        # of each scan, on disk: a few ten thousand of them fill the memory
        self._channels = [channels for path in train for channels in load_channels(path)]
        self._objects = [item for path in train for item in load_objects(path)]
        self._validation = list(validation)

    @property
    def scans(self) -> int:
        """Training scans."""
        return len(self._channels)

    def batch_loss(self, index: Tensor, flip: bool) -> Tensor:
        """Return the loss of some training scans."""
        objects = [self._objects[number] for number in index.tolist()]
        return self._loss(self._batch(index), objects, flip)[0]

    def inputs(self, index: Tensor) -> Tensor:
        """Return the evidence of some training scans."""
        return self._inputs(self._batch(index), False)

    def _batch(self, index: Tensor) -> Tensor:
        return torch.from_numpy(np.stack([self._channels[number] for number in index.tolist()])).to(self.device)

    def _inputs(self, channels: Tensor, flip: bool) -> Tensor:
        inputs = channels.float() / SCALE
        if flip:
            inputs = inputs.flip(3)
            inputs[:, self._encoding.odd_channels] *= -1.0
        return inputs

    def _loss(self, channels: Tensor, objects: Sequence[EvidenceObjects], flip: bool) -> tuple[Tensor, Tensor]:
        inputs = self._inputs(channels, flip)
        answer = self.forward(inputs)
        targets = self._targets(objects, flip)
        return evidence_loss(answer, targets, inputs[:, TOWARD], self._x_m, self._y_m), answer

    def _targets(self, objects: Sequence[EvidenceObjects], flip: bool) -> EvidenceTargets:
        table, scan = joined_objects(objects)
        across = torch.tensor([1.0, -1.0 if flip else 1.0])
        place, centre, heading = (
            (torch.from_numpy(values) * across).to(self.device)
            for values in (table.place_m, table.centre_m, table.heading)
        )
        size, kind, asked, of = (
            torch.from_numpy(values).to(self.device)
            for values in (table.log_size, table.object_class, table.asked, scan)
        )
        return EvidenceTargets(of, place, centre, size, heading, kind, asked)

    def validate(self) -> tuple[float, dict[str, float]]:
        """Return the least loss a scan over thresholds, and the recall at some numbers of false reports."""
        tally = EvidenceTally(self._encoding, self._azimuth_rad)
        losses = []
        with torch.no_grad():
            for path in self._validation:
                channels = torch.from_numpy(np.array(load_channels(path))).to(self.device)
                loss, answer = self._loss(channels, load_objects(path), False)
                losses.append(loss.item())
                for stored, said in zip(load_truths(path), answer.float().cpu().numpy(), strict=True):
                    tally.add(stored, candidates(said, stored.mirror, min(WATCHED_THRESHOLDS)))
        best, scores = tally.best()
        return best, scores | {"validation_loss": float(np.mean(losses))}
