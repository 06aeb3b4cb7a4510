"""Quality of reports of hidden objects, object by object: found objects, false reports, errors, confidence.

Every scan is reduced to a row of its hidden objects and of its reports; all measures are weighted sums over the
rows of places, so that bootstrap draws of places cost no more than their sums. No scan is skipped.

The position error of a report is the distance of its centre to the nearest visible face of the true box or to that
box's centre, whichever is nearer, with the truth moved to the time of the report; the distance of centres is reported
too. A hidden object is found when a report of its own (one to one) errs by `FOUND_M` at most.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise

import msgspec
import numpy as np

from lab.measures.frame_scores import INTERVAL, Estimate, estimated
from lab.measures.object_rows import (
    BAND_EDGES_DB,
    BANDS,
    HiddenRow,
    ReportRow,
    ScanRow,
    band,
    is_false,
    is_nothing,
    single_reaches,
)

#: Squared Mahalanobis distance within which 95 % of the truths lie (chi-squared, two degrees of freedom).
ELLIPSE_95 = -2.0 * math.log(0.05)
#: Edges of the bins of scores.
SCORE_EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.99, 1.0)
VEHICLES = ("car", "van", "truck", "bus")
VULNERABLE = ("pedestrian", "bicycle")
#: Centres of objects out of sight nearer than this crowd each other.
CROWDED_M = 2.0
#: False reports a scan at which the curve of recall is read.
CURVE_FALSE = (0.02, 0.05, 0.1, 0.15, 0.24, 0.5, 1.0)
QUANTILES = (0.5, 0.75, 0.9, 0.95)


class ObjectScores:
    """All scans of one profile, ready for measures under any weights of the places."""

    def __init__(self, scans: Sequence[ScanRow]) -> None:
        self.scans = sorted(scans, key=lambda scan: (scan.place, scan.scan))
        self.places = sorted({scan.place for scan in self.scans})
        self._row = {place: row for row, place in enumerate(self.places)}

    @cached_property
    def asked(self) -> list[tuple[int, HiddenRow]]:
        """Row of the place and every hidden object that a mirror shows."""
        return [(self._row[scan.place], row) for scan in self.scans for row in scan.hidden if row.image.mirrored]

    @cached_property
    def crowded(self) -> list[tuple[int, HiddenRow]]:
        """As `asked`, those with another object out of sight within `CROWDED_M`."""
        return [
            (self._row[scan.place], row)
            for scan in self.scans
            for row in scan.hidden
            if row.image.mirrored
            and any(other is not row and math.dist(other.at_m, row.at_m) < CROWDED_M for other in scan.hidden)
        ]

    @cached_property
    def unseen(self) -> int:
        """Objects out of sight that no mirror shows."""
        return sum(not row.image.mirrored for scan in self.scans for row in scan.hidden)

    @cached_property
    def reports(self) -> list[tuple[int, ReportRow]]:
        """Row of the place and every report."""
        return [(self._row[scan.place], row) for scan in self.scans for row in scan.reports]

    def of_objects(self, holds: Callable[[HiddenRow], bool]) -> np.ndarray:
        """Return the number of askable objects for which a condition holds, by place [P]."""
        return self._count([row for row, item in self.asked if holds(item)])

    def sum_of_objects(self, value: Callable[[HiddenRow], float]) -> np.ndarray:
        """Return the sum of a value over the askable objects, by place [P]."""
        return self._count([row for row, _ in self.asked], [float(value(item)) for _, item in self.asked])

    def of_crowded(self, holds: Callable[[HiddenRow], bool]) -> np.ndarray:
        """As `of_objects`, of crowded ones."""
        return self._count([row for row, item in self.crowded if holds(item)])

    def of_reports(self, value: Callable[[ReportRow], float]) -> np.ndarray:
        """Return the sum of a value over the reports, by place [P]."""
        return self._count([row for row, _ in self.reports], [float(value(report)) for _, report in self.reports])

    @cached_property
    def scans_by_place(self) -> np.ndarray:
        """Number of scans of each place [P]."""
        return self._count([self._row[scan.place] for scan in self.scans])

    def _count(self, rows: list[int], values: list[float] | None = None) -> np.ndarray:
        weights = None if values is None else np.array(values, np.float64)
        return np.bincount(np.array(rows, np.int64), weights, minlength=len(self.places)).astype(np.float64)


class Ratio(msgspec.Struct, frozen=True, kw_only=True):
    """A share or a rate: part over whole, with the interval of the quotient over draws of places."""

    part: float
    whole: float
    value: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.part:g} of {self.whole:g}"
        return f"{self.part:g} of {self.whole:g} ({self.value:.2f} [{self.low:.2f}, {self.high:.2f}])"


class ScoreBin(msgspec.Struct, frozen=True, kw_only=True):
    """Reports whose score lies in low <= score < high (the last bin holds 1)."""

    low: float
    high: float
    mean_score: float | None
    #: Share that found a hidden object, and share that lies within `FALSE_M` of one.
    found: Ratio
    near: Ratio


class ObjectReport(msgspec.Struct, frozen=True, kw_only=True):
    """All measures of one profile on one set."""

    scans: int
    places: int
    recall: Ratio
    recall_by_centre: Ratio
    recall_by_class: dict[str, Ratio]
    recall_vehicles: Ratio
    recall_by_band: dict[str, Ratio]
    #: Of objects that one mirror alone shows at 25 dB or more, at 15 to 25 dB; of pedestrians and bicycles among the
    #: first.
    recall_single_25_db: Ratio
    recall_single_15_db: Ratio
    recall_vulnerable_25_db: Ratio
    #: Of objects with another one out of sight within `CROWDED_M`.
    recall_crowded: Ratio
    #: Of objects that one mirror shows at 25 dB or more, the share found by the reports of the highest scores, so many
    #: that `CURVE_FALSE` of them a scan are false; fewer points where the profile's threshold leaves out the others.
    recall_at_false: dict[str, float]
    #: Found objects by class, and by the class that their reports say.
    classes: dict[str, dict[str, int]]
    #: Of vehicles where the view calls a vehicle observable by a mirror.
    recall_promised: Ratio
    #: Objects out of sight that no mirror shows; they are not to be found.
    not_mirrored: int
    reports: int
    precision: Ratio
    #: Mean precision over recall from 0 to 1, reports by falling score, found within 1 m and within 2 m; what the
    #: profile's threshold leaves out counts as missed.
    average_precision: Estimate
    average_precision_2_m: Estimate
    #: Share of the reports, and their number a scan.
    false: Ratio
    false_per_scan: Ratio
    nothing: Ratio
    nothing_per_scan: Ratio
    #: Of these the rest: something stands there, but not out of sight.
    in_sight_per_scan: Ratio
    #: Quantiles [m] of found objects; and of all reports in places with an object out of sight, whatever their error.
    error_found_m: dict[str, Estimate]
    centre_found_m: dict[str, Estimate]
    error_ungated_m: dict[str, Estimate]
    centre_ungated_m: dict[str, Estimate]
    #: Share of the objects found whose truth lies within the 95 % ellipse of its report, and the mean squared
    #: Mahalanobis distance: at most 2 where covariances are right, for the nearest point of a face counts.
    inside_ellipse: Ratio
    nees: Ratio
    scores: list[ScoreBin]
    #: Mean distance of score and share found over the bins, weighted by their reports.
    calibration_error: float | None
    #: Missed objects and false reports a scan, weighted by `false_cost`.
    false_cost: float
    loss: Ratio


def object_report(scores: ObjectScores, weights: np.ndarray, false_cost: float) -> ObjectReport:
    """Measure one profile; `weights` [B, P] are bootstrap draws of its places (`evaluation.bootstrap_weights`).

    Raises `ValueError` without a scan or with weights of other places.
    """
    draw = Draws(scores, weights)
    asked, found_count = scores.of_objects(lambda item: True), scores.of_objects(_is_found)
    reports = scores.of_reports(lambda item: 1.0)
    false, nothing = scores.of_reports(is_false), scores.of_reports(is_nothing)
    scans = scores.scans_by_place
    bins = [_score_bin(draw, low, high) for low, high in pairwise(SCORE_EDGES)]
    return ObjectReport(
        scans=len(scores.scans),
        places=len(scores.places),
        recall=draw.ratio(found_count, asked),
        recall_by_centre=draw.ratio(scores.of_objects(lambda item: item.found_by_centre), asked),
        recall_by_class=draw.recalls(
            lambda item: item.object_class, sorted({item.object_class for _, item in scores.asked})
        ),
        recall_vehicles=draw.recall(lambda item: item.object_class in VEHICLES),
        recall_by_band=draw.recalls(lambda item: band(item.image), BANDS),
        recall_single_25_db=draw.recall(lambda item: single_reaches(item, BAND_EDGES_DB[1])),
        recall_single_15_db=draw.recall(
            lambda item: single_reaches(item, BAND_EDGES_DB[0]) and not single_reaches(item, BAND_EDGES_DB[1])
        ),
        recall_vulnerable_25_db=draw.recall(
            lambda item: item.object_class in VULNERABLE and single_reaches(item, BAND_EDGES_DB[1])
        ),
        recall_crowded=draw.ratio(scores.of_crowded(_is_found), scores.of_crowded(lambda item: True)),
        recall_at_false=_recall_at_false(scores),
        classes=_classes(scores),
        recall_promised=draw.recall(lambda item: item.promised and item.object_class in VEHICLES),
        not_mirrored=scores.unseen,
        reports=len(scores.reports),
        precision=draw.ratio(scores.of_reports(lambda item: item.found), reports),
        average_precision=draw.average_precision(lambda item: item.found),
        average_precision_2_m=draw.average_precision(lambda item: item.found_wide),
        false=draw.ratio(false, reports),
        false_per_scan=draw.ratio(false, scans),
        nothing=draw.ratio(nothing, reports),
        nothing_per_scan=draw.ratio(nothing, scans),
        in_sight_per_scan=draw.ratio(scores.of_reports(lambda item: is_false(item) and not is_nothing(item)), scans),
        error_found_m=draw.quantiles([(place, row.error_m) for place, row in scores.asked]),
        centre_found_m=draw.quantiles([(place, row.centre_m) for place, row in scores.asked]),
        error_ungated_m=draw.quantiles([(place, row.error_m) for place, row in scores.reports]),
        centre_ungated_m=draw.quantiles([(place, row.centre_m) for place, row in scores.reports]),
        inside_ellipse=draw.ratio(scores.of_objects(_is_inside), found_count),
        nees=draw.ratio(scores.sum_of_objects(lambda item: item.mahalanobis2 or 0.0), found_count),
        scores=bins,
        calibration_error=_calibration_error(bins),
        false_cost=false_cost,
        loss=draw.ratio(asked - found_count + false_cost * false, scans),
    )


def _recall_at_false(scores: ObjectScores) -> dict[str, float]:
    """Return the share of loud objects found at each rate of false reports that is reached."""
    loud = [row for _, row in scores.asked if _is_loud(row)]
    false = sorted((report.score for _, report in scores.reports if is_false(report)), reverse=True)
    points = {}
    for rate in CURVE_FALSE:
        count = round(rate * len(scores.scans))
        if loud and count < len(false):
            points[f"{rate:g}"] = sum((row.score or 0.0) > false[count] for row in loud) / len(loud)
    return points


def _classes(scores: ObjectScores) -> dict[str, dict[str, int]]:
    """Return how often found objects of each class were given each."""
    pairs = Counter((row.object_class, row.reported_class) for _, row in scores.asked if row.reported_class)
    return {
        true: {said: count for (kind, said), count in sorted(pairs.items()) if kind == true}
        for true in sorted({kind for kind, _ in pairs})
    }


def _is_found(row: HiddenRow) -> bool:
    return row.error_m is not None


def _is_inside(row: HiddenRow) -> bool:
    return row.mahalanobis2 is not None and row.mahalanobis2 <= ELLIPSE_95


class Draws:
    """Quotients and quantiles of scores with their intervals under bootstrap draws."""

    def __init__(self, scores: ObjectScores, weights: np.ndarray) -> None:
        if not scores.scans or weights.shape[1:] != (len(scores.places),):
            raise ValueError(f"weights must have shape [draws, {len(scores.places)}] for places, got {weights.shape}")
        self._scores, self._weights = scores, np.asarray(weights, np.float64)

    def ratio(self, part: np.ndarray, whole: np.ndarray) -> Ratio:
        """Return the quotient of sums over places [P]."""
        total = float(whole.sum())
        drawn = self._weights @ whole
        positive = drawn > 0.0
        value = float(part.sum()) / total if total else None
        low, high = _interval((self._weights @ part)[positive] / drawn[positive])
        return Ratio(part=float(part.sum()), whole=total, value=value, low=low, high=high)

    def recall(self, holds: Callable[[HiddenRow], bool]) -> Ratio:
        """Return the found share of the objects for which a condition holds."""
        found_count = self._scores.of_objects(lambda row: holds(row) and _is_found(row))
        return self.ratio(found_count, self._scores.of_objects(holds))

    def recalls(self, name: Callable[[HiddenRow], str], names: Sequence[str]) -> dict[str, Ratio]:
        """Return the found share of each group."""
        return {group: self.recall(lambda row, group=group: name(row) == group) for group in names}  # type: ignore[misc]

    def average_precision(self, is_match: Callable[[ReportRow], bool]) -> Estimate:
        """Return the area under precision over recall, precision at each recall the best there or beyond."""
        ranked = sorted(self._scores.reports, key=lambda pair: -pair[1].score)
        rows = np.array([row for row, _ in ranked], np.int64)
        matches = np.array([is_match(report) for _, report in ranked], bool)
        asked = self._scores.of_objects(lambda item: True)
        drawn = np.concatenate([np.ones((1, len(asked))), self._weights])
        areas = np.array([_area(weights[rows], matches, float(weights @ asked)) for weights in drawn])
        low, high = _interval(areas[1:])
        return Estimate(float(areas[0]), math.nan if low is None else low, math.nan if high is None else high)

    def quantiles(self, values: Sequence[tuple[int, float | None]]) -> dict[str, Estimate]:
        """Return quantiles of the known values, with intervals: the smallest value that so large a share reaches."""
        pairs = sorted((value, row) for row, value in values if value is not None)
        if not pairs:
            return {}
        at, rows = np.array([value for value, _ in pairs]), np.array([row for _, row in pairs])
        weights = np.concatenate([np.ones((1, len(at))), self._weights[:, rows]])
        reached = np.cumsum(weights, axis=1)
        estimates: dict[str, Estimate] = {}
        for share in QUANTILES:
            first = np.argmax(reached >= share * reached[:, -1:] * (1.0 - 1e-12), axis=1)
            low, high = _interval(at[first[1:]][reached[1:, -1] > 0.0])
            ends = (math.nan if low is None else low, math.nan if high is None else high)
            estimates[f"p{100.0 * share:g}"] = Estimate(float(at[first[0]]), *ends)
        return estimates


def _area(weight: np.ndarray, matches: np.ndarray, asked: float) -> float:
    """Return the average precision of ranked reports of some weights [R]; 0 where none is asked for."""
    hits, reports = np.cumsum(weight * matches), np.cumsum(weight)
    precision = np.divide(hits, reports, out=np.zeros(len(hits)), where=reports > 0.0)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((best * weight * matches).sum() / asked) if asked else 0.0


def object_measures(scores: ObjectScores, weights: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return few measures that rows of a comparison share, under weights [B, P] of the places (default: each once).

    Arrays [B]: `object_recall` and, of objects that one mirror shows at 25 dB, `object_recall_25_db`; `object_f1` of
    found objects and reports; false reports and missed objects with them a scan. NaN where a draw has nothing to count.
    """
    weights = np.ones((1, len(scores.places))) if weights is None else weights
    asked, found_count = weights @ scores.of_objects(lambda item: True), weights @ scores.of_objects(_is_found)
    loud = weights @ scores.of_objects(_is_loud)
    loud_found = weights @ scores.of_objects(lambda item: _is_loud(item) and _is_found(item))
    reports, false = weights @ scores.of_reports(lambda item: 1.0), weights @ scores.of_reports(is_false)
    scans = weights @ scores.scans_by_place
    return {
        "object_recall": _quotient(found_count, asked),
        "object_recall_25_db": _quotient(loud_found, loud),
        "object_f1": _quotient(2.0 * found_count, asked + reports),
        "false_objects_per_scan": _quotient(false, scans),
        "object_loss_per_scan": _quotient(asked - found_count + false, scans),
    }


def _is_loud(row: HiddenRow) -> bool:
    return single_reaches(row, 25.0)


def _quotient(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.divide(part, whole, out=np.full_like(whole, np.nan), where=whole > 0.0)


def object_estimates(scores: ObjectScores, weights: np.ndarray) -> dict[str, Estimate]:
    """Return `object_measures` with their intervals over draws [B, P] of the places."""
    return estimated(object_measures(scores), object_measures(scores, weights))


def object_differences(scores: ObjectScores, other: ObjectScores, weights: np.ndarray) -> dict[str, Estimate]:
    """Return `object_measures` of `scores` minus those of `other`, paired: both on the same draws of the places."""
    first, second = object_measures(scores), object_measures(other)
    drawn, other_drawn = object_measures(scores, weights), object_measures(other, weights)
    return estimated(
        {name: first[name] - second[name] for name in first}, {name: drawn[name] - other_drawn[name] for name in first}
    )


def _interval(draws: np.ndarray) -> tuple[float | None, float | None]:
    if len(draws) == 0:
        return None, None
    low, high = np.percentile(draws, INTERVAL)
    return float(low), float(high)


def _score_bin(draw: Draws, low: float, high: float) -> ScoreBin:
    """Return the reports of one bin of scores."""
    scores = draw._scores

    def inside(report: ReportRow) -> bool:
        return low <= report.score < high or (high == SCORE_EDGES[-1] and report.score >= high)

    whole = scores.of_reports(inside)
    total = float(whole.sum())
    summed = float(scores.of_reports(lambda item: item.score if inside(item) else 0.0).sum())
    return ScoreBin(
        low=low,
        high=high,
        mean_score=summed / total if total else None,
        found=draw.ratio(scores.of_reports(lambda item: inside(item) and item.found), whole),
        near=draw.ratio(scores.of_reports(lambda item: inside(item) and not is_false(item)), whole),
    )


def _calibration_error(bins: Sequence[ScoreBin]) -> float | None:
    """Return the expected calibration error over the bins; None without a report."""
    parts = [
        (score_bin.found.whole, abs(score_bin.mean_score - score_bin.found.value))
        for score_bin in bins
        if score_bin.mean_score is not None and score_bin.found.value is not None
    ]
    total = sum(count for count, _ in parts)
    return sum(count * error for count, error in parts) / total if total else None


def mean_loss(reports: Mapping[str, ObjectReport]) -> float:
    """Return the mean loss over sets with equal weight."""
    values = [report.loss.value for report in reports.values() if report.loss.value is not None]
    return sum(values) / len(values)
