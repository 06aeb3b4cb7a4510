"""Training samples of the candidate network: what is seen of the candidates of a scan, and which find an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.measures.object_rows import scan_row
from lab.training.data.evidence_samples import quantized
from lab.training.data.stored_truth import ScanTruth, image_truths, scan_truth
from models.perception.see.candidate_predictor import ODD_ANSWERS, CandidateInputs, signs
from models.perception.see.detections import ANSWERS
from models.perception.see.evidence_answers import Candidates
from msgs.values.array_table import ArrayTable
from msgs.values.perception import HiddenObject


@dataclass(frozen=True)
class CandidateSamples(ArrayTable):
    """Candidates of one scan, N of them."""

    row: np.ndarray
    column: np.ndarray
    wall: np.ndarray
    #: As `CandidateInputs`; places as whole numbers, int8.
    places: np.ndarray
    facts: np.ndarray
    mirrored: np.ndarray
    #: Its report finds an object, one to one.
    finds: np.ndarray

    @property
    def proposals(self) -> Candidates:
        """The candidates as the evidence network answers them."""
        values = self.facts[:, :ANSWERS] * signs(ANSWERS, ODD_ANSWERS, self.mirrored)
        return Candidates(self.row, self.column, values.astype(np.float64), self.wall)


def candidate_samples(
    proposals: Candidates, inputs: CandidateInputs, reports: Sequence[HiddenObject], stored: ScanTruth
) -> CandidateSamples:
    """Return the samples of the candidates of a scan, of which `reports` are made."""
    row = scan_row(0, reports, scan_truth(0, stored), image_truths(stored))
    return CandidateSamples(
        row=proposals.row,
        column=proposals.column,
        wall=proposals.wall,
        places=quantized(inputs.places),
        facts=inputs.facts,
        mirrored=inputs.mirrored,
        finds=np.array([each.found for each in row.reports], bool),
    )
