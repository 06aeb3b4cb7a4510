"""Probabilities of an object network: tables from its answers, its threshold and its scores, on validation samples."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

from models.evaluation.object_metrics import ObjectReport, Ratio
from models.evaluation.object_rows import ScanRow
from models.perception.detection.score_calibration import ScoreTable
from models.perception.objects.predictor import ObjectCard, ObjectPredictor
from models.training.calibration import fit_table
from models.training.data.object_store import StoredSample, load_samples
from models.training.object_scoring import ObjectTally

#: Probabilities that may be thresholds; answers above the first one fit the tables, in so many groups.
THRESHOLDS, GROUPS = tuple(round(0.05 * step, 2) for step in range(1, 16)), 60


def with_probabilities(
    card: ObjectCard, predictor: ObjectPredictor, files: Sequence[Path], false_cost: float
) -> ObjectCard:
    """Return a card with tables for a vehicle at rest and for one that moves, and with the threshold of the least loss
    and its scores by them, of a predictor's answers to files of validation samples.
    """
    tallies = {moving: ObjectTally(card.encoding, THRESHOLDS) for moving in (False, True)}
    for stored, answer in _answered(predictor, files):
        tallies[stored.ego_compensated].add(stored, answer)
    card = msgspec.structs.replace(
        card,
        calibration=probability_table(tallies[False].rows),
        calibration_moving=probability_table(tallies[True].rows),
    )
    tally = ObjectTally(card.encoding, THRESHOLDS, card.calibration_of)
    for stored, answer in _answered(predictor, files):
        tally.add(stored, answer)
    threshold, report = tally.best(false_cost)
    return msgspec.structs.replace(card, threshold=threshold, scores=_scores(report))


def probability_table(rows: Mapping[float, Sequence[ScanRow]]) -> ScoreTable:
    """Return the table from answers to the share of reports that are a hidden object, one to one, of the rows of scans
    at some thresholds.

    Each report counts in the list from the highest threshold that it reaches: a fainter one that lies nearer to the
    object takes it in a longer list alone.
    """
    outcomes = [
        (report.score, report.found)
        for low, high in pairwise((*sorted(rows), math.inf))
        for row in rows[low]
        for report in row.reports
        if low <= report.score < high
    ]
    score, is_true = np.array(outcomes, np.float64).reshape(-1, 2).T
    return fit_table(score, is_true.astype(bool), GROUPS)


def _answered(predictor: ObjectPredictor, files: Sequence[Path]) -> Iterator[tuple[StoredSample, np.ndarray]]:
    for path in files:
        for stored in load_samples(path):
            yield stored, predictor.answer(stored.sample.cells.astype(np.float32))


def _scores(report: ObjectReport) -> dict[str, float]:
    """Return the headline measures, those without a value left out."""
    ratios: dict[str, Ratio] = {
        "recall": report.recall,
        "recall_single_25_db": report.recall_single_25_db,
        "precision": report.precision,
        "false_per_scan": report.false_per_scan,
        "loss_per_scan": report.loss,
    }
    return {"scans": float(report.scans)} | {
        name: round(ratio.value, 4) for name, ratio in ratios.items() if ratio.value is not None
    }
