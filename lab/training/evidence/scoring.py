"""Scores of the evidence network on stored scans: objects found one to one, and reports where none is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from lab.measures.object_rows import ScanRow, is_false, single_reaches
from lab.training.calibration import fit_table
from lab.training.data.evidence_samples import SCALE
from lab.training.data.evidence_store import load_channels, load_truths
from lab.training.data.stored_truth import ScanTruth
from lab.training.evidence.scan_rows import add_rows
from models.perception.find.score_calibration import ScoreTable, calibrated
from models.perception.mirrors.observability import visibility_at
from models.perception.mirrors.peaks_to_view import GeometryParams
from models.perception.see.evidence_answers import Candidates, evidence_detections, least_answer, shifted
from models.perception.see.evidence_predictor import EvidenceCard, EvidencePredictor
from models.perception.see.scan_evidence import EvidenceEncoding

#: False reports a scan at which the recall is shown.
SHOWN_FALSE = (0.10, 0.15, 0.24)
#: Thresholds watched; the loss of the best one selects the checkpoint.
WATCHED_THRESHOLDS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7)
#: Probabilities that may be thresholds; answers above the first one fit the tables, in so many groups.
THRESHOLDS, GROUPS = tuple(round(0.05 * step, 2) for step in range(1, 16)), 60
#: Least answer that is a candidate.
LEAST = 0.01
#: Reports that fit what the mask adds.
LIKELY = 0.2
#: What the mask adds: nothing.
NO_LOGITS = (0.0, 0.0, 0.0)


def as_answered(moving: bool) -> ScoreTable:
    """Return the table that leaves answers as they are."""
    return ()


class EvidenceTally:
    """Rows of all scans at some thresholds; `calibration` gives the table of a vehicle that moves or does not, `logits`
    are added by what the mask says.
    """

    def __init__(
        self,
        encoding: EvidenceEncoding,
        azimuth_rad: np.ndarray,
        thresholds: Sequence[float] = WATCHED_THRESHOLDS,
        calibration: Callable[[bool], ScoreTable] = as_answered,
        logits: tuple[float, float, float] = NO_LOGITS,
    ) -> None:
        self._grid, self._azimuth_rad, self._calibration = encoding.grid, azimuth_rad, calibration
        self._logits = logits
        self.rows: dict[float, list[ScanRow]] = {threshold: [] for threshold in thresholds}
        #: What the mask says of the reports of each scan that reach the lowest threshold.
        self.states: list[np.ndarray] = []

    def add(self, stored: ScanTruth, proposals: Candidates) -> None:
        """Score the candidates of one scan."""
        table = self._calibration(stored.ego_compensated)
        least = least_answer(table, min(self.rows), self._logits)
        likely = evidence_detections(proposals, self._grid, stored.walls, least)
        states = visibility_at(stored.visibility, GeometryParams().grid, likely.place_m)
        likely = replace(likely, score=shifted(calibrated(table, likely.score), np.array(self._logits)[states]))
        self.states.append(states[likely.score >= min(self.rows)])
        stamp_ns = np.interp(likely.azimuth_rad, self._azimuth_rad, stored.azimuth_stamp_ns)
        add_rows(self.rows, likely, stamp_ns, stored)

    def add_all(self, scans: Sequence[tuple[ScanTruth, Candidates]]) -> None:
        """Score the candidates of many scans."""
        for stored, proposals in scans:
            self.add(stored, proposals)

    def points(self) -> list[CurvePoint]:
        """Return the measures at each threshold, the lowest first."""
        return [_point(threshold, rows) for threshold, rows in sorted(self.rows.items())]

    def best(self) -> tuple[float, dict[str, float]]:
        """Return the least loss a scan over thresholds, and the scores there and at some numbers of false reports."""
        points = self.points()
        best = min(points, key=lambda point: point.loss_per_scan)
        scores = {f"recall_at_{false:g}": recall_at(points, false) for false in SHOWN_FALSE}
        scores |= {"threshold": best.threshold, "recall_single_25_db": best.recall_single_25_db}
        return best.loss_per_scan, scores | {"false_per_scan": best.false_per_scan}


@dataclass(frozen=True)
class CurvePoint:
    """Measures at a threshold: shares of the objects that a mirror shows, and of those at 25 dB by one mirror, that
    are found; false reports a scan; missed objects and false reports a scan.
    """

    threshold: float
    recall: float
    recall_single_25_db: float
    false_per_scan: float
    loss_per_scan: float


def with_probabilities(card: EvidenceCard, predictor: EvidencePredictor, files: Sequence[Path]) -> EvidenceCard:
    """Return a card with tables for a vehicle at rest and for one that moves, and with the threshold of the least loss
    and its scores by them, of what a predictor finds in files of validation samples.
    """
    azimuth_rad = predictor.grid.azimuth_at(np.arange(predictor.grid.azimuth_bins))
    scans = [
        (truth, predictor.candidates(channels / SCALE, truth.mirror, truth.walls, LEAST, truth.ego_compensated))
        for path in files
        for truth, channels in zip(load_truths(path), load_channels(path).astype(np.float32), strict=True)
    ]
    tallies = [EvidenceTally(card.encoding, azimuth_rad, THRESHOLDS) for _ in (False, True)]
    for stored, proposals in scans:
        tallies[stored.ego_compensated].add(stored, proposals)
    at_rest, moving = (probability_table(tally.rows) for tally in tallies)
    card = msgspec.structs.replace(card, calibration=at_rest, calibration_moving=moving)
    likely = EvidenceTally(card.encoding, azimuth_rad, (LIKELY,), card.calibration_of)
    likely.add_all(scans)
    card = msgspec.structs.replace(card, visibility_logits=visibility_logits(likely))
    tally = EvidenceTally(card.encoding, azimuth_rad, THRESHOLDS, card.calibration_of, card.visibility_logits)
    tally.add_all(scans)
    points = tally.points()
    best = min(points, key=lambda point: point.loss_per_scan)
    scores = {name: round(getattr(best, name), 4) for name in CurvePoint.__dataclass_fields__ if name != "threshold"}
    scores |= {f"recall_at_{false}": round(recall_at(points, false), 4) for false in SHOWN_FALSE}
    return msgspec.structs.replace(card, threshold=best.threshold, scores={"scans": float(len(scans)), **scores})


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


def visibility_logits(tally: EvidenceTally) -> tuple[float, float, float]:
    """Return what best explains, added to the logits of likely reports in each state of the mask, which were found."""
    (rows,) = tally.rows.values()
    reports = [report for row in rows for report in row.reports]
    score, right = (np.array([getattr(report, name) for report in reports], np.float64) for name in ("score", "found"))
    state = np.concatenate([np.zeros(0, int), *tally.states])
    return tuple(_shift(score[state == each], right[state == each]) for each in range(3))  # type: ignore[return-value]


def _shift(score: np.ndarray, right: np.ndarray) -> float:
    """Return the logit after which the mean probability is the share found; one report more is half found."""
    logits = logit(np.append(score, 0.5))
    wanted = float(right.sum() + 0.5)
    return round(float(brentq(lambda by: expit(logits + by).sum() - wanted, -5.0, 5.0)), 2)


def _point(threshold: float, rows: Sequence[ScanRow]) -> CurvePoint:
    asked = [item for row in rows for item in row.hidden if item.image.mirrored]
    loud = [item for item in asked if single_reaches(item, 25.0)]
    hits = sum(item.error_m is not None for item in asked)
    false = sum(is_false(report) for row in rows for report in row.reports)
    return CurvePoint(
        threshold,
        hits / max(len(asked), 1),
        sum(item.error_m is not None for item in loud) / max(len(loud), 1),
        false / max(len(rows), 1),
        (len(asked) - hits + false) / max(len(rows), 1),
    )


def recall_at(points: Sequence[CurvePoint], false_per_scan: float) -> float:
    """Return the recall at 25 dB at a number of false reports a scan, linear between thresholds."""
    ordered = sorted(points, key=lambda point: point.false_per_scan)
    false = [point.false_per_scan for point in ordered]
    return float(np.interp(false_per_scan, false, [point.recall_single_25_db for point in ordered]))
