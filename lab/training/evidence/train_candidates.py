"""Training of the candidate network: a second look at what the evidence network proposes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lab.networks.candidate_net import CandidateNet
from lab.training.data.candidate_samples import CandidateSamples
from lab.training.data.evidence_samples import SCALE
from lab.training.data.evidence_store import load_candidates, load_truths
from lab.training.evidence.grid_training import GridSchedule, GridTraining
from lab.training.evidence.scoring import EvidenceTally
from models.perception.see.candidate_predictor import FACTS, CandidateEncoding, corrected
from msgs.values.radar import RangeAzimuthGrid


class CandidateTraining(GridTraining):
    """A run on sample files (`evidence_store.CandidateTask`); a batch is one of candidates of any scans."""

    averages = True

    def __init__(
        self,
        train: Sequence[Path],
        validation: Sequence[Path],
        encoding: CandidateEncoding,
        grid: RangeAzimuthGrid,
        schedule: GridSchedule,
        run_dir: Path,
    ) -> None:
        torch.manual_seed(schedule.seed)
        super().__init__(CandidateNet(encoding.shapes["places"][0], FACTS), schedule, run_dir)
        self._encoding = encoding
        self._azimuth_rad = grid.azimuth_at(np.arange(grid.azimuth_bins))
        self._samples = CandidateSamples.joined([item for path in train for item in load_candidates(path)])
        if len(self._samples) < schedule.batch_size:
            raise ValueError(
                f"training scans must hold at least {schedule.batch_size} candidates, a batch, got {len(self._samples)}"
            )
        self._validation = [
            (truth, item)
            for path in validation
            for truth, item in zip(load_truths(path), load_candidates(path), strict=True)
        ]

    @property
    def scans(self) -> int:
        """Training candidates."""
        return len(self._samples)

    def batch_loss(self, index: Tensor, flip: bool) -> Tensor:
        """Return the loss of some candidates; none is flipped, since all are seen from one side."""
        batch = self._samples.take(index.numpy())
        facts = torch.from_numpy(batch.facts).to(self.device)
        logits = facts[:, 0] + self.network(self._places(batch), facts)
        finds = torch.from_numpy(batch.finds).to(self.device)
        return functional.binary_cross_entropy_with_logits(logits, finds.float())

    def inputs(self, index: Tensor) -> Tensor:
        """Return the evidence about some candidates."""
        return self._places(self._samples.take(index.numpy()))

    def _places(self, batch: CandidateSamples) -> Tensor:
        return torch.from_numpy(batch.places).to(self.device).float() / SCALE

    def validate(self) -> tuple[float, dict[str, float]]:
        """Return the least loss a scan over thresholds, and the recall at some numbers of false reports."""
        tally = EvidenceTally(self._encoding.evidence, self._azimuth_rad)
        network = self.kept_network()
        with torch.no_grad():
            for truth, item in self._validation:
                correction = np.zeros(0, np.float32)
                if len(item):
                    facts = torch.from_numpy(item.facts).to(self.device)
                    correction = network(self._places(item), facts).cpu().numpy()
                tally.add(truth, corrected(item.proposals, correction))
        return tally.best()
