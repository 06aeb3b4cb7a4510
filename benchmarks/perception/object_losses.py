"""What becomes of hidden objects that one mirror shows at 25 dB or more: reported within a metre, or lost, and where.

The first stage that loses an object counts: no fitted wall leads from its image to it; a wall does and the network's
answer stays under the threshold, faint (a tenth and more) or silent; the answer reaches the threshold but
its place is off or another report stands for both. Scans are those of a data set with true objects; `perfect peaks`
are the labels in place of the detector's peaks, for the walls and for the network alike.
Usage: nice -n 2 mirrorwave sim dataset --out data/losses --count 300 --effects all --truth --seed 8400
       nice -n 2 python -m benchmarks.perception.object_losses --data data/losses [--snr-db 25] [--limit N] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.special import expit
from threadpoolctl import threadpool_limits

from mirrorwave.console import progress_bar
from mirrorwave.node_chain import SharedParts
from mirrorwave.studies.report import table
from mirrorwave.studies.tradeoff.settings import profile_setting
from models.evaluation.object_rows import HiddenRow, is_false, single_reaches
from models.perception.detection.score_calibration import calibrated
from models.perception.objects.answers import ANSWERS
from models.perception.objects.hypotheses import HYPOTHESES
from models.perception.objects.predictor import ObjectPredictor
from models.training.data.frames import DataSet
from models.training.data.object_samples import SampleMaker
from models.training.data.object_store import StoredSample, stored_sample
from models.training.data.residual_samples import truth_peaks
from models.training.object_scoring import ObjectTally
from msgs.values.perception import Peaks
from msgs.values.radar import RangeAzimuthMap

FATES = ("reported within 1 m", "no wall leads to it", "answer silent", "answer faint", "placed off or merged")
#: Cells about a true one, along and across, in which an answer counts as given to it.
NEAR_CELLS = (2, 1)
#: Least probability of a faint answer.
FAINT = 0.1


class _Labels:
    """Perfect peaks in place of a detector: the labels of the frame at hand."""

    def __init__(self) -> None:
        self.peaks: Peaks | None = None

    def detect(self, ra_map: RangeAzimuthMap) -> Peaks:
        """Return the frame's labels."""
        assert self.peaks is not None
        return self.peaks


class Losses:
    """Fates of the objects of all scans, and false reports, of one kind of peaks."""

    def __init__(self, predictor: ObjectPredictor, snr_db: float) -> None:
        self._predictor, self._snr_db, self._threshold = predictor, snr_db, predictor.threshold
        self._tally = ObjectTally(predictor.card.encoding, (self._threshold,), predictor.card.calibration_of)
        self.fates: Counter[str] = Counter()
        self.scans = self.false = 0

    def add(self, stored: StoredSample) -> None:
        """Judge one scan."""
        answer = self._predictor.answer(stored.sample.cells.astype(np.float32))
        self._tally.add(stored, answer)
        row = self._tally.rows[self._threshold][-1]
        self.scans, self.false = self.scans + 1, self.false + sum(map(is_false, row.reports))
        number = {item.id: index for index, item in enumerate(stored.truth)}
        for item in row.hidden:
            if item.image.mirrored and single_reaches(item, self._snr_db):
                self.fates[self._fate(stored, item, number[item.object_id], answer)] += 1

    def _fate(self, stored: StoredSample, item: HiddenRow, number: int, answer: np.ndarray) -> str:
        """Return what becomes of one object."""
        if item.error_m is not None:
            return FATES[0]
        at = stored.sample.targets.at[stored.sample.targets.number == number]
        if not len(at):
            return FATES[1]
        table = self._predictor.card.calibration_of(stored.ego_compensated)
        said = calibrated(table, np.array([_said(stored, answer, *cell) for cell in at.tolist()])).max()
        if said < FAINT:
            return FATES[2]
        return FATES[3] if said < self._threshold else FATES[4]

    def columns(self) -> dict[str, str]:
        """Return the cells of a table."""
        total = max(sum(self.fates.values()), 1)
        shares = {name: f"{self.fates[name]} ({self.fates[name] / total:.2f})" for name in FATES}
        return shares | {"objects": str(total), "false reports a scan": f"{self.false / max(self.scans, 1):.2f}"}


def _said(stored: StoredSample, answer: np.ndarray, which: int, row: int, column: int) -> float:
    """Return the largest probability about a true cell, among cells of the same walls."""
    near = (
        which,
        slice(max(row - NEAR_CELLS[0], 0), row + NEAR_CELLS[0] + 1),
        slice(max(column - NEAR_CELLS[1], 0), column + NEAR_CELLS[1] + 1),
    )
    logit = answer.reshape(HYPOTHESES, ANSWERS, *answer.shape[1:])[which, 0, near[1], near[2]]
    same = stored.sample.wall[near] == stored.sample.wall[which, row, column]
    return float(expit(logit[same].max()))


def main() -> None:
    """Print the table, or its numbers as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perception.object_losses", description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--profile", default="default")
    parser.add_argument("--snr-db", type=float, default=25.0)
    parser.add_argument("--limit", type=int, default=None)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    data = DataSet(options.data)
    parts = SharedParts.of(profile_setting(options.profile).params, data.setup)
    if parts.predictor is None:
        parser.error(f"--profile must have an object network, {options.profile} has none")
    labels, encoding = _Labels(), parts.predictor.card.encoding
    makers = {"detector's peaks": SampleMaker(encoding, parts.detector), "perfect peaks": SampleMaker(encoding, labels)}
    losses = {name: Losses(parts.predictor, options.snr_db) for name in makers}
    count = min(len(data), options.limit or len(data))
    with threadpool_limits(1, "blas"), progress_bar("scans", count) as advance:
        for index in range(count):
            frame = data.frame(index)
            labels.peaks = truth_peaks(frame.labels)
            for name, maker in makers.items():
                losses[name].add(stored_sample(frame, maker))
            advance()
    columns = {name: result.columns() for name, result in losses.items()}
    if options.json:
        json.dump(columns, sys.stdout, indent=1)
        return
    rows = [(name, *(cells[name] for cells in columns.values())) for name in next(iter(columns.values()))]
    sys.stdout.write("\n".join(table(("", *columns), rows)) + "\n")


if __name__ == "__main__":
    main()
